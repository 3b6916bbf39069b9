"""The skeleton of a single surface: a tree of curves in its middle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg._checks import check_choice, check_count, check_positive
from torchreg.errors import InputTypeError
from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.skeleton import Skeleton, build_skeleton
from torchreg.geometry.surface_graph import PIECES, OnePiece, coarsened, one_piece
from torchreg.spines.centering import centered_curves
from torchreg.spines.clearance import Clearance, Inside
from torchreg.spines.curves import follow, tangents
from torchreg.spines.level_sets import Surface, level_sets
from torchreg.spines.limb_curves import Ball, Rings, best_rings, largest_cost, limb_curve
from torchreg.spines.loops import OpenedLoops, open_loops
from torchreg.spines.protrusions import Protrusions, average_geodesic_distance, find_protrusions
from torchreg.spines.tip_trees import Tips, TipTree, consensus, grow_tip_tree, locate

# Of the two ends of a cut loop the lower one is a tip if it has this share of the other's height.
_STUMP_SHARE = 0.5
# What a wider place is worth, as a share of its distance from where the trees say that a junction is.
_PLACE_WEIGHT = 0.25
# Most places that are looked at for a junction.
_MAX_PLACES = 8
# Rings are around a limb if they are this many widths from its tip, within this share of the limb; it ends where, of
# the way on straight to the height of the tip, the first of these shares is inside.
_CAP_WIDTHS, _CAP_SHARE, _CAP_REACHES = 1.5, 0.4, (0.9, 0.8, 0.7, 0.5)
# Or else: rings from the tip, and shares of the way to them.
_CAP_RINGS, _CAP_SHARES = 6, (0.5, 0.75, 0.9)
# How far behind the surface points outside are moved, in steps of the limbs.
_DEPTHS = (0.1, 0.3, 0.6, 1.0)
_FLIP = (1.0, -1.0, -1.0)


@dataclass(frozen=True)
class SkeletonizeConfig:
    """What counts as a limb, and how finely it is drawn.

    Args:
        min_protrusion: least height of a tip, as a share of the longest way on the surface; noise makes bumps of 1 %.
        num_levels: levels along the longest way from a tip; steps of the curves are as long as the levels are apart.
        num_base: base points that stand for the whole surface in average distances.
        overlap: junctions closer to each other than this times the sum of their widths are one.
        max_vertices: surfaces with more are thinned before anything is looked for on them.
        pieces: what to do with loose parts: keep the "largest", "bridge" the gaps, or raise an "error".

    Raises:
        InputError: if a number is out of range or ``pieces`` is unknown.
    """

    min_protrusion: float = 0.05
    num_levels: int = 100
    num_base: int = 40
    overlap: float = 2 / 3
    max_vertices: int = 16_000
    pieces: str = "largest"

    def __post_init__(self) -> None:
        check_positive(self.min_protrusion, "min_protrusion")
        check_count(self.num_levels, "num_levels", 8)
        check_count(self.num_base, "num_base", 1)
        check_positive(self.overlap, "overlap", allow_zero=True)
        check_count(self.max_vertices, "max_vertices", 100)
        check_choice(self.pieces, "pieces", PIECES)


@torch.no_grad()
def skeletonize(mesh: TriangleMesh, config: SkeletonizeConfig | None = None) -> Skeleton:
    """Return the skeleton of a surface: a tree of curves in its middle that ends in the tips of its limbs.

    Tips are where the average geodesic distance to everywhere else is largest around, by some height. From each tip,
    level sets of the geodesic distance cut the surface into rings; the ways from all other tips through the rings make
    a tree of ring centers. The trees of all tips are merged: the tree that most of them agree on says which limbs there
    are, junctions that overlap are one (of any degree), and each limb comes from the tree with the best rings for it,
    ``Q = N - sum C_i``, ``C_i = (s1^2 + s2^2 + s3^2) / n_i`` over the largest of all.

    Different from the paper: rings are the curves on which the distance takes a value, not bins of vertices; a majority
    replaces walking inward from supernodes, so that trees that contradict each other are no problem; junctions are
    moved to the middle of the body.

    Handles (genus above zero) are cut at their thinnest ring where the loop through them is longer than the ends of two
    tips; shorter ones, and all if pieces were bridged, are bypassed on one side. Holes are closed; what else was done
    is told in ``notes``. A body without protrusions, like a ball, becomes a single limb between two places far apart,
    of confidence 0. Limbs that lie flank to flank without a gap are one until they part.

    Args:
        mesh: any triangles that make a surface: open, with duplicate vertices, wrong winding, edges of more than two
            triangles.
        config: defaults do for bodies with limbs.

    Returns:
        a `Skeleton` in the unit, dtype and device of the mesh. Nodes are about equally far apart on each limb; the
        radius is the distance to the nearest vertex or middle of a triangle of the (thinned) surface.

    Raises:
        InputError: if there is no triangle to speak of, or several pieces and ``config.pieces`` is "error".
        InputTypeError: if ``mesh`` is no `TriangleMesh`.

    Differentiable: no.

    Cost: 0.6 s for 10,000 vertices, 1.1 s for 115,000, 2.3 s for 400,000, of one CPU core.

    References: Brostow, Essa, Steedly and Kwatra 2004, section 4.1, eq. 4 and 5.
    """
    if not isinstance(mesh, TriangleMesh):
        raise InputTypeError(f"mesh must be a TriangleMesh, got {type(mesh).__name__}")
    config = SkeletonizeConfig() if config is None else config
    whole = _thinned(one_piece(mesh, config.pieces), config.max_vertices)
    body = _Body.of(_opened(whole, config), whole, config)
    joints = consensus(body.trees, config.overlap) if len(body.trees) > 2 else []
    balls = [body.ball(joint) for joint in joints]
    limbs, ends = _limbs(body, joints, balls)
    skeleton = build_skeleton(limbs, ends, body.notes)
    # Tips are nodes in the order in which their limbs were named.
    order = {name: place for place, name in enumerate(dict.fromkeys(end for pair in ends for end in pair))}
    names = sorted(range(len(body.tips)), key=lambda tip: order[tip])
    return _like(replace(skeleton, confidence=body.confidence[names]), mesh.vertices)


def _like(skeleton: Skeleton, like: Tensor) -> Skeleton:
    values = {name: getattr(skeleton, name).to(like) for name in ("nodes", "radii", "frames", "confidence")}
    return replace(skeleton, edges=skeleton.edges.to(like.device), **values)


def _opened(whole: OnePiece, config: SkeletonizeConfig) -> OpenedLoops:
    if len(whole.bridges):
        # Cutting would renumber the vertices that bridges join.
        return OpenedLoops(whole.mesh, torch.zeros(0, 2, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.float64))
    return open_loops(whole.mesh, 2 * config.min_protrusion, config.num_levels)


def _thinned(whole: OnePiece, max_vertices: int) -> OnePiece:
    few = coarsened(whole.mesh, max_vertices)
    if few is whole.mesh:
        return whole
    # Thinning leaves pinholes where patches meet.
    thin = one_piece(few, "bridge" if len(whole.bridges) else "largest")
    return replace(thin, notes=whole.notes)


@dataclass(frozen=True, eq=False)
class _Body:
    """All that is known of a surface before limbs are drawn.

    Args:
        surface: closed, without long loops.
        clearance: distances to it.
        inside: what lies inside.
        tips: (K,) vertices, at least two.
        confidence: (K,).
        trees: one per tip.
        spacing: between levels.
        notes: for the skeleton.
    """

    surface: TriangleMesh
    clearance: Clearance
    inside: Inside
    tips: Tensor
    confidence: Tensor
    trees: list[TipTree]
    spacing: float
    notes: tuple[str, ...]

    @classmethod
    def of(cls, opened: OpenedLoops, whole: OnePiece, config: SkeletonizeConfig) -> _Body:
        surface, notes = opened.mesh, whole.notes
        graph = GeodesicGraph.from_mesh(surface)
        if len(whole.bridges):
            ends = surface.vertices[whole.bridges]
            graph = graph.with_edges(whole.bridges, (ends[:, 0] - ends[:, 1]).norm(dim=-1))
        areas = torch.bincount(
            surface.faces.reshape(-1), surface.face_areas().repeat_interleave(3) / 3, minlength=surface.num_vertices
        )
        average = average_geodesic_distance(graph, areas, config.num_base)
        found = find_protrusions(graph, average.values, config.min_protrusion * average.size)
        keep = _sound_tips(surface, found, opened)
        tips, confidence = found.tips[keep], found.confidence[keep]
        if len(opened.stumps):
            notes += (f"{len(opened.stumps)} loop(s) cut",)
        if len(tips) == 1:
            notes += ("no limb stands out: a single one between two places far apart",)
            tips, confidence = _far_apart(graph, tips), torch.zeros(2, dtype=torch.float64)
        distances = graph.distances(tips)
        spacing = float(distances.max()) / config.num_levels
        rings = Surface(surface)
        trees = []
        for root, values in enumerate(distances):
            sets = level_sets(rings, values, spacing)
            trees.append(grow_tip_tree(sets, sets.vertex_bands[tips], root, sets.vertex_bands[whole.bridges]))
        return cls(surface, Clearance(surface), Inside(surface), tips, confidence, trees, spacing, notes)

    def ball(self, joint: tuple[Tips, ...]) -> Ball:
        """Return where a junction is, in the middle of the body, and the room that it has there."""
        place, width = locate(joint, self.trees)
        # Between the legs, below a skirt, the place is outside; the centers of rings around it are not.
        seen = torch.cat([tree.sets.centers[branch.rings] for tree in self.trees for branch in tree.branches])
        near = torch.cat((place[None], seen[(seen - place).norm(dim=-1) <= width]))
        inside = self.inside(near)
        near = near[inside] if inside.any() else near
        middles = self.clearance.middles(near[self._worth(near, place)[:_MAX_PLACES]], float(width))
        center = middles[self._worth(middles, place)[0]]
        return Ball(center, float(self.clearance(center[None])[0]))

    def _worth(self, points: Tensor, place: Tensor) -> Tensor:
        """Return the order of points (N, 3), those first that are near a place and have room around them."""
        worth = self.clearance(points) - _PLACE_WEIGHT * (points - place).norm(dim=-1)
        return worth.argsort(descending=True, stable=True)

    def kept_in(self, before: Tensor, points: Tensor) -> Tensor:
        """Return points (n, 3) of a limb with those that lie outside, as in the bend of a flat foot, moved inside.

        Some were inside before they were centered; those go back.
        """
        points = torch.where((self.inside(before) & ~self.inside(points))[:, None], before, points)
        for depth in _DEPTHS:
            outside = (~self.inside(points)).nonzero()[:, 0]
            if len(outside) == 0:
                break
            within = self.clearance.beyond(points[outside], depth * self.spacing)
            sound = self.inside(within)
            points[outside[sound]] = self.clearance.middles(within[sound], self.spacing)
        return points

    def capped(self, tip: int, rings: Rings) -> tuple[Tensor, Rings]:
        """Return the last point (3,) of a limb and its rings, which start at its tip.

        Rings that are not yet around the limb say little: those nearer to the tip than they are wide, by a margin. The
        limb goes on straight from the others, to the height of the tip. Where that leads outside, as it may in the bend
        of a foot, the point is in the cap between the tip and the nearest ring whose center is inside.
        """
        vertex = self.surface.vertices[self.tips[tip]]
        around = ((rings.centers - vertex).norm(dim=-1) > _CAP_WIDTHS * rings.widths).nonzero()[:, 0]
        if len(around) and around[0] <= _CAP_SHARE * len(rings):
            limb = rings[int(around[0]) :]
            back = (limb.centers - limb.centers[0]).norm(dim=-1)
            behind = int((back >= torch.minimum(limb.widths[0], back.max())).nonzero()[0, 0])
            ahead = torch.nn.functional.normalize(limb.centers[0] - limb.centers[behind], dim=0)
            reach = ((vertex - limb.centers[0]) @ ahead).clamp(min=0)
            places = limb.centers[0] + torch.tensor(_CAP_REACHES, dtype=torch.float64)[:, None] * reach * ahead
            sound = self.inside(places)
            if reach > 0 and sound[-1]:
                return places[int(sound.nonzero()[0, 0])], limb
        near = rings.centers[:_CAP_RINGS]
        if len(near) == 0:
            return vertex, rings
        places = vertex + torch.tensor(_CAP_SHARES, dtype=torch.float64)[:, None] * (near - vertex)[:, None]
        sound = self.inside(places) & self.inside(near)[:, None]
        ring, share = sound.nonzero()[0].tolist() if sound.any() else (0, 0)
        return places[ring, share], rings[ring:]


def _sound_tips(surface: TriangleMesh, found: Protrusions, opened: OpenedLoops) -> list[int]:
    """Return the numbers of the tips, without those at the end of a cut whose other end is a tip much higher."""
    places, keep = surface.vertices[found.tips], list(range(len(found.tips)))
    for ends, radius in zip(opened.stumps, opened.radii, strict=True):
        near = torch.cdist(ends, places) <= radius
        highest = (near * found.heights).amax(1)
        low = near[int(highest.argmin())] & (found.heights < _STUMP_SHARE * highest.max())
        keep = [tip for tip in keep if not low[tip]]
    return keep


def _far_apart(graph: GeodesicGraph, start: Tensor) -> Tensor:
    """Return two places (2,) that are each other's farthest, or nearly."""
    far = graph.distances(start)[0].argmax()
    return torch.stack((far, graph.distances(far[None])[0].argmax()))


def _limbs(
    body: _Body, joints: Sequence[tuple[Tips, ...]], balls: Sequence[Ball]
) -> tuple[list[tuple[Tensor, Tensor, Tensor]], list[tuple[int, int]]]:
    """Return points, radii and frames of all limbs, and the numbers of their ends: tips first, then junctions."""
    num_tips = len(body.tips)
    cost = largest_cost(body.trees)
    drawn, ends = [], []
    for tips, (near, far) in _limb_ends(joints, num_tips).items():
        start, end = (None if joint is None else balls[joint] for joint in (near, far))
        rings = best_rings(tips, body.trees, start, end, cost)
        first, rings = body.capped(0, rings) if start is None else (start.center, rings)
        last, rings = body.capped(min(tips), rings.flip()) if end is None else (end.center, rings.flip())
        points, frames = limb_curve(first, rings.flip(), last, body.spacing)
        names = (0 if near is None else num_tips + near, min(tips) if far is None else num_tips + far)
        if far is None and near is not None:
            # Limbs start at their tips; a half turn about the major axis turns frames round with them.
            points, frames, names = points.flip(0), frames.flip(0) * frames.new_tensor(_FLIP), names[::-1]
        drawn.append((points, frames))
        ends.append(names)
    free = [(first < num_tips, last < num_tips) for first, last in ends]
    curves = centered_curves([points for points, _ in drawn], body.surface, body.spacing, free)
    curves = [body.kept_in(points, curve) for curve, (points, _) in zip(curves, drawn, strict=True)]
    turned = [follow(frames, tangents(curve)) for curve, (_, frames) in zip(curves, drawn, strict=True)]
    return [(curve, body.clearance(curve), frames) for curve, frames in zip(curves, turned, strict=True)], ends


def _limb_ends(joints: Sequence[tuple[Tips, ...]], num_tips: int) -> dict[Tips, tuple[int | None, int | None]]:
    """Return the limbs, as the tips away from tip 0, with the junctions towards and away from tip 0."""
    if not joints:
        return {frozenset({1}): (None, None)}
    everything = frozenset(range(num_tips))
    near = {limb: number for number, joint in enumerate(joints) for limb in joint[1:]}
    far = {everything - joint[0]: number for number, joint in enumerate(joints)}
    return {limb: (near.get(limb), far.get(limb)) for limb in {**far, **near}}
