"""The skeleton of a single surface: a tree of curves in its middle."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg._checks import check_choice, check_count, check_positive
from torchreg.errors import InputError
from torchreg.geometry.far_origin import far_origin
from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.skeleton import Skeleton, build_skeleton
from torchreg.geometry.spread import SPREADS, spread_dimensions
from torchreg.geometry.support import SUPPORTS, warn_about_support
from torchreg.geometry.surface_graph import PIECES, coarsened, one_piece
from torchreg.spines.curves import align_frames, tangents
from torchreg.spines.labeled_tree import Tips
from torchreg.spines.paper.metanodes import metanode_junctions
from torchreg.spines.paper.vertex_level_sets import vertex_level_sets
from torchreg.spines.skeleton.centering import centered_curves
from torchreg.spines.skeleton.level_sets import LevelSets, MeshEdges, level_sets
from torchreg.spines.skeleton.limb_curves import JunctionBall, Rings, best_rings, largest_cost, limb_curve
from torchreg.spines.skeleton.limb_placement import Interior
from torchreg.spines.skeleton.loops import OpenedLoops, open_loops
from torchreg.spines.skeleton.protrusions import average_geodesic_distance, find_protrusions
from torchreg.spines.skeleton.surface import as_surface, split_surface
from torchreg.spines.skeleton.tip_relations import TipRelations, surface_relations
from torchreg.spines.skeleton.tip_trees import TipTree, consensus_junctions, estimate_junction, grow_tip_tree

FLAT = "the surface is flat"  # how the note on it begins


@dataclass(frozen=True)
class SkeletonizeConfig:
    """What counts as a limb, and how finely it is drawn.

    Args:
        min_protrusion: least height of a tip, as a share of the largest geodesic distance; noise makes bumps of 1 %.
        num_levels: levels of the largest geodesic distance from a tip; nodes are as far apart as levels.
        num_base: base points that stand for the whole surface in average distances.
        overlap: junctions closer to each other than this times the sum of their widths are one.
        max_vertices: surfaces of more than twice as many vertices are coarsened to that many first.
        pieces: for loose parts: keep the "largest", "bridge" the gaps, or raise an "error".
        printed: as in the paper: bins of vertices instead of curves on the surface, trees merged from the tips inward
            instead of by majority, nodes left at the centers of their bins.

    Raises:
        InputError: if a number is out of range or ``pieces`` is unknown.
    """

    min_protrusion: float = 0.05
    num_levels: int = 100
    num_base: int = 20
    overlap: float = 2 / 3
    max_vertices: int = 8000
    pieces: str = "largest"
    printed: bool = False

    def __post_init__(self) -> None:
        check_positive(self.min_protrusion, "min_protrusion")
        check_count(self.num_levels, "num_levels", 8)
        check_count(self.num_base, "num_base", 1)
        check_positive(self.overlap, "overlap", allow_zero=True)
        check_count(self.max_vertices, "max_vertices", 100)
        check_choice(self.pieces, "pieces", PIECES)


def skeletonize(
    mesh: TriangleMesh | Tensor, config: SkeletonizeConfig | None = None, *, support: str = "auto"
) -> Skeleton:
    """Return the skeleton of a surface: a tree of curves in its middle that ends in the tips of its limbs.

    Tips are salient local maxima of the average geodesic distance. From each tip, level sets of the geodesic distance
    cut the surface into rings; the paths from all other tips through the rings make a tree of ring centers. The trees
    of all tips are merged: the tree on which most of them agree gives the limbs, junctions that overlap are one (of any
    degree), and each limb comes from the tree with the best rings for it, ``Q = N - sum C_i``,
    ``C_i = (s1^2 + s2^2 + s3^2) / n_i`` over the largest of all.

    Different from the paper: rings are the curves on which the distance takes a value, not bins of vertices; a majority
    replaces walking inward from supernodes, so that trees that contradict each other are no problem; junctions and
    limbs are moved to the middle of the body.

    Handles (genus above zero) are cut at their thinnest ring where the loop through them is longer than the ends of two
    tips; shorter ones, and all if pieces were bridged, are bypassed on one side. Holes are closed; ``notes`` tell what
    else was done. A body without protrusions, like a ball, becomes a single limb between two points far apart, of
    confidence 0. Limbs that lie flank to flank without a gap are one until they separate.

    Args:
        mesh: any triangles that make a surface: open, with duplicate vertices, wrong winding, edges of more than two
            triangles; or points of a surface (N, 3), a cloud or a scan without faces, to which a surface is
            fitted, see `poisson_body`, and for what is seen from one side `cloud_surface`.
        config: defaults do for bodies with limbs.
        support: "auto" leaves out a table or a floor that the body stands on, see `split_support`; "keep" keeps it.

    Returns:
        A `Skeleton` in the unit, dtype and device of the mesh. Nodes are about equally far apart on each limb; the
        radius is the distance to the nearest vertex or center of a triangle of the (coarsened) surface.

    Raises:
        InputError: if there is no triangle with an area, there are fewer than 100 different points, or several pieces
            and ``config.pieces`` is "error".
        InputTypeError: if ``mesh`` is neither a `TriangleMesh` nor points.

    Warns:
        FileWarning: if a support is left out.

    Differentiable: no.

    Cost: 0.4 s for 10,000 vertices, 0.5 s for 100,000, 1 s for 400,000, of one CPU core.

    References: Brostow, Essa, Steedly and Kwatra 2004, section 4.1, eq. 4 and 5.
    """
    check_choice(support, "support", SUPPORTS)
    body, split = split_surface(mesh, "mesh", support)
    if split is not None:
        warn_about_support(f"{int(split.mask.sum())} of {len(split.mask)} points of mesh", stacklevel=2)
    surface, notes = as_surface(body, "mesh")
    found = skeletonize_surface(surface, config)[0]
    return replace(found, notes=(*found.notes, *notes)) if notes else found


@torch.no_grad()
def skeletonize_surface(mesh: TriangleMesh, config: SkeletonizeConfig | None = None) -> tuple[Skeleton, TipRelations]:
    """Return the skeleton of a surface, see `skeletonize`, and the relations of its tips along the surface."""
    config = SkeletonizeConfig() if config is None else config
    origin = far_origin(mesh.vertices)
    if origin is not None:
        offset = origin.to(mesh.vertices)
        found, relations = skeletonize_surface(TriangleMesh(mesh.vertices - offset, mesh.faces), config)
        return replace(found, nodes=found.nodes + offset), relations
    body = _prepared(mesh, config)
    tips = _find_tips(body, config)  # section 4.1: maxima of the average geodesic distance
    # "Growing Skeletons": rings of the distance from each tip; "Merging Skeletons", figure 3B.
    trees = _grow_trees(body, tips, vertex_level_sets if config.printed else level_sets)
    junctions = metanode_junctions(trees) if config.printed else consensus_junctions(trees, config.overlap)
    interior = Interior(body.mesh)
    if config.printed:
        metanodes = [JunctionBall(estimate_junction(junction, trees)[0], 0.0) for junction in junctions]
        return _assembled(_best_limbs(trees, junctions, metanodes, None, tips), interior, tips, mesh.vertices)
    balls = [interior.junction_ball(junction, trees) for junction in junctions]
    limbs = _best_limbs(trees, junctions, balls, interior, tips)  # eq. 4 and 5
    limbs = _centered_limbs(limbs, body.mesh, interior, tips)
    return _assembled(limbs, interior, tips, mesh.vertices)


@dataclass(frozen=True, eq=False)
class _Body:
    """A closed surface in one piece, float64 on the CPU, with long loops cut; ``bridges`` (B, 2) join its pieces."""

    opened: OpenedLoops
    bridges: Tensor
    notes: tuple[str, ...]

    @property
    def mesh(self) -> TriangleMesh:
        return self.opened.mesh


def _prepared(mesh: TriangleMesh, config: SkeletonizeConfig) -> _Body:
    """Return the surface as one piece of not too many vertices, with its holes closed and its long loops cut."""
    piece = one_piece(mesh, config.pieces)
    notes, bridged = piece.notes, bool(len(piece.bridges))
    area = piece.mesh.face_areas().sum()
    if not bool(area.isfinite()):
        raise InputError("mesh must have a finite area, got coordinates whose products overflow; use a larger unit")
    extent = float((piece.mesh.vertices.amax(0) - piece.mesh.vertices.amin(0)).norm())
    if int(spread_dimensions(piece.mesh.vertices, extent)) < len(SPREADS):
        notes += (f"{FLAT}: it encloses no body",)
    if piece.mesh.num_vertices > 2 * config.max_vertices:
        # Coarsening leaves pinholes where patches meet.
        piece = one_piece(coarsened(piece.mesh, config.max_vertices, area), "bridge" if bridged else "largest")
    if bridged:
        # Cuts would renumber the vertices that bridges join.
        return _Body(OpenedLoops.from_uncut(piece.mesh), piece.bridges, notes)
    opened = open_loops(piece.mesh, 2 * config.min_protrusion, config.num_levels)
    if len(opened.stumps):
        notes += (f"{len(opened.stumps)} loop(s) cut",)
    return _Body(opened, piece.bridges, notes)


@dataclass(frozen=True, eq=False)
class _SurfaceTips:
    """The K tips of a body, two or more."""

    positions: Tensor
    vertices: Tensor  # (K,) of the surface
    confidence: Tensor
    distances: Tensor  # (K, V) geodesic distances from them
    relations: TipRelations
    spacing: float  # between levels of these distances, and so between nodes
    notes: tuple[str, ...]


def _find_tips(body: _Body, config: SkeletonizeConfig) -> _SurfaceTips:
    """Return the salient maxima of the average geodesic distance; two vertices far apart if there is only one."""
    mesh, notes = body.mesh, body.notes
    graph = GeodesicGraph.from_mesh(mesh)
    if len(body.bridges):
        ends = mesh.vertices[body.bridges]
        graph = graph.with_edges(body.bridges, (ends[:, 0] - ends[:, 1]).norm(dim=-1))
    areas = mesh.face_areas().repeat_interleave(3) / 3
    areas = torch.bincount(mesh.faces.reshape(-1), areas, minlength=mesh.num_vertices)
    average, largest = average_geodesic_distance(graph, areas, config.num_base)
    protrusions = find_protrusions(graph, average, config.min_protrusion * largest)
    keep = body.opened.keep_tips(protrusions)
    vertices, confidence = protrusions.tips[keep], protrusions.confidence[keep]
    if len(vertices) == 1:
        notes += ("no limb stands out: a single one between two places far apart",)
        vertices, confidence = _farthest_pair(graph, vertices), torch.zeros(2, dtype=torch.float64)
    distances = graph.distances(vertices)
    return _SurfaceTips(
        positions=mesh.vertices[vertices],
        vertices=vertices,
        confidence=confidence,
        distances=distances,
        relations=surface_relations(mesh, distances, vertices),
        spacing=float(distances.max()) / config.num_levels,
        notes=notes,
    )


def _farthest_pair(graph: GeodesicGraph, start: Tensor) -> Tensor:
    """Return two vertices (2,) that are each other's farthest, or nearly."""
    far = graph.distances(start)[0].argmax()
    return torch.stack((far, graph.distances(far[None])[0].argmax()))


def _grow_trees(
    body: _Body, tips: _SurfaceTips, rings_of: Callable[[MeshEdges, Tensor, float], LevelSets]
) -> list[TipTree]:
    """Return the tree of rings of each tip."""
    edges, trees = MeshEdges(body.mesh), []
    for root, distances in enumerate(tips.distances):
        sets = rings_of(edges, distances, tips.spacing)
        trees.append(grow_tip_tree(sets, sets.vertex_bands[tips.vertices], root, sets.vertex_bands[body.bridges]))
    return trees


@dataclass(frozen=True, eq=False)
class _Limb:
    """A limb, points (n, 3) and frames, between two nodes, of which the tips are numbered first, then the junctions."""

    points: Tensor
    frames: Tensor
    ends: tuple[int, int]


def _best_limbs(
    trees: Sequence[TipTree],
    junctions: Sequence[tuple[Tips, ...]],
    balls: Sequence[JunctionBall],
    interior: Interior | None,
    tips: _SurfaceTips,
) -> list[_Limb]:
    """Return every limb as a curve through its best tree's rings, with ends inside the body if interior is given."""

    def cap(tip: int, rings: Rings) -> tuple[Tensor, Rings]:
        position = tips.positions[tip]
        return (position, rings) if interior is None else interior.cap_limb(position, rings)

    num_tips, limbs, cost = len(trees), [], largest_cost(trees)
    for beyond, (near, far) in _limb_ends(junctions, num_tips).items():
        start, end = (None if junction is None else balls[junction] for junction in (near, far))
        rings = best_rings(beyond, trees, start, end, cost)
        first, rings = cap(0, rings) if start is None else (start.center, rings)
        rings = rings.flip()
        last, rings = cap(min(beyond), rings) if end is None else (end.center, rings)
        points, frames = limb_curve(first, rings.flip(), last, tips.spacing)
        ends = (0 if near is None else num_tips + near, min(beyond) if far is None else num_tips + far)
        if far is None and near is not None:
            # Limbs start at their tips; a half turn about the major axis reverses the frames with them.
            half_turn = frames.new_tensor((1.0, -1.0, -1.0))
            points, frames, ends = points.flip(0), frames.flip(0) * half_turn, ends[::-1]
        limbs.append(_Limb(points, frames, ends))
    return limbs


def _limb_ends(junctions: Sequence[tuple[Tips, ...]], num_tips: int) -> dict[Tips, tuple[int | None, int | None]]:
    """Return the limbs, as the tips away from tip 0, with the junctions towards and away from tip 0."""
    if not junctions:
        return {frozenset({1}): (None, None)}
    every = frozenset(range(num_tips))
    near = {limb: number for number, junction in enumerate(junctions) for limb in junction[1:]}
    far = {every - junction[0]: number for number, junction in enumerate(junctions)}
    return {limb: (near.get(limb), far.get(limb)) for limb in {**far, **near}}


def _centered_limbs(limbs: Sequence[_Limb], mesh: TriangleMesh, interior: Interior, tips: _SurfaceTips) -> list[_Limb]:
    """Return the limbs moved to the axis of the surface around them, and inside."""
    num_tips = len(tips.vertices)
    free = [(limb.ends[0] < num_tips, limb.ends[1] < num_tips) for limb in limbs]
    curves = centered_curves([limb.points for limb in limbs], mesh, tips.spacing, free)
    points = interior.keep_inside(torch.cat([limb.points for limb in limbs]), torch.cat(curves), tips.spacing)
    parts = points.split([len(curve) for curve in curves])
    return [
        replace(limb, points=part, frames=align_frames(limb.frames, tangents(part)))
        for limb, part in zip(limbs, parts, strict=True)
    ]


def _assembled(
    limbs: Sequence[_Limb], interior: Interior, tips: _SurfaceTips, like: Tensor
) -> tuple[Skeleton, TipRelations]:
    """Return the skeleton of limbs that share end nodes, and the relations of its tips, in the dtype of ``like``."""
    rows = [(limb.points, interior.clearance(limb.points), limb.frames) for limb in limbs]
    skeleton = build_skeleton(rows, [limb.ends for limb in limbs], tips.notes)
    # Tips are nodes in the order in which limbs name them first.
    first_named = list(dict.fromkeys(end for limb in limbs for end in limb.ends))
    order = torch.tensor(sorted(range(len(tips.vertices)), key=first_named.index))
    skeleton = replace(
        skeleton,
        nodes=skeleton.nodes.to(like),
        edges=skeleton.edges.to(like.device),
        radii=skeleton.radii.to(like),
        frames=skeleton.frames.to(like),
        confidence=tips.confidence[order].to(like),
    )
    return skeleton, tips.relations.of_tips(order)
