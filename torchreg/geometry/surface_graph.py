"""Meshes as graphs: edges, connected pieces, closed holes, coarser meshes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.graphs import connected_components, minimum_spanning_forest
from torchreg.geometry.mesh import TriangleMesh, distinct_faces
from torchreg.geometry.neighbors import NeighborTree, weld

PIECES = ("largest", "bridge", "error")
# How the note begins on pieces that are left out and large.
ANOTHER_BODY = "another body left out"


@dataclass(frozen=True)
class _Repair:
    """Numbers by which meshes are repaired and coarsened."""

    # Share of the faces below which a piece is dust: never bridged to, and no reason for an error.
    dust: float = 1e-3
    # Area of a piece, in those of the largest one, from which on it is a body of its own rather than a fragment.
    body: float = 0.5
    # Pieces with the nearest boxes to which bridges are searched.
    near_pieces: int = 12
    # Edge of a cell whose vertices are merged, in square roots of the wanted area per vertex.
    cell: float = 1.15


_REPAIR = _Repair()


@dataclass(frozen=True, eq=False)
class OnePiece:
    """A surface without holes or loose parts, made from any triangles."""

    mesh: TriangleMesh  # float64 on the CPU, with the centers of closed holes as last vertices
    vertex: Tensor  # (V,) original vertex of each vertex; -1 for the center of a hole
    bridges: Tensor  # (B, 2) vertices that count as joined, empty unless pieces were bridged
    notes: tuple[str, ...]  # the repairs, in words


def unique_edges(faces: Tensor) -> tuple[Tensor, Tensor]:
    """Return the edges (E, 2) of triangles, smaller index first, and the edges 01, 12, 20 (F, 3) of each triangle."""
    if faces.numel() == 0:
        return faces.new_zeros(0, 2), faces
    keys, count = _edge_keys(faces)
    keys, which = keys.unique(return_inverse=True)
    return torch.stack((keys // count, keys % count), dim=-1), which


def _edge_keys(faces: Tensor) -> tuple[Tensor, int]:
    """Return a number for each edge 01, 12, 20 (F, 3) of triangles: the smaller index times a count, and the larger."""
    following, count = faces.roll(-1, dims=1), int(faces.max()) + 1
    return torch.minimum(faces, following) * count + torch.maximum(faces, following), count


def _is_closed(faces: Tensor, keys: Tensor) -> bool:
    """Return whether every edge of triangles is used as often in one direction as in the other."""
    # The sum of pseudo-random numbers of edges, signed by direction, is zero by chance once in 2^64.
    numbers = keys * -7046029254386353131  # the odd integer nearest to 2^64 over the golden ratio, as a signed one
    numbers = (numbers ^ (numbers >> 29)) * numbers
    return int(torch.where(faces < faces.roll(-1, dims=1), numbers, -numbers).sum()) == 0


def one_piece(mesh: TriangleMesh, pieces: str = "largest") -> OnePiece:
    """Return a surface with duplicate vertices welded, holes closed and loose parts dropped or bridged.

    Holes are closed by triangles to the mean of the rim. ``pieces``: "largest" keeps the piece of largest area,
    "bridge" joins the others by the shortest segments between vertices, "error" raises. Pieces with less than a
    thousandth of the triangles are left out.
    """
    position = weld(mesh.vertices.detach().cpu().double())
    faces = position[mesh.faces.cpu()]
    if not bool((faces != faces.roll(1, dims=1)).all(1).any()):
        raise InputError(f"mesh must have a triangle with three different corners, got {mesh.num_faces} faces without")
    # A face used twice would make its edges look shared.
    faces = distinct_faces(faces)
    original = torch.zeros(int(position.max()) + 1, dtype=torch.int64)
    original = original.index_copy(0, position, torch.arange(len(position)))
    vertices = mesh.vertices.detach().cpu().double()[original]
    areas = TriangleMesh(vertices, faces).face_areas()
    if not float(areas.sum()) > 0:
        raise InputError("mesh must have a surface, got triangles without area")
    faces, kept, notes, labels = _kept_pieces(vertices, faces, areas, pieces)
    used, faces = _used_vertices(faces, len(vertices))
    vertices, original = vertices[used], original[used]
    bridges = _bridges(vertices, labels[used], kept) if kept > 1 else faces.new_zeros(0, 2)
    if kept > 1:
        notes += (f"{kept} pieces joined by {len(bridges)} bridges",)
    vertices, faces, holes = close_holes(vertices, faces)
    if holes:
        notes += (f"{holes} hole(s) closed",)
    original = torch.cat((original, original.new_full((holes,), -1)))
    return OnePiece(TriangleMesh(vertices, faces), original, bridges, notes)


def _used_vertices(faces: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the vertices (M,) of a number that faces (F, 3) use, ascending, and the faces in terms of these."""
    flags = torch.zeros(count, dtype=torch.bool)
    flags[faces.reshape(-1)] = True
    return flags.nonzero()[:, 0], (flags.cumsum(0) - 1)[faces]


def coarsened(mesh: TriangleMesh, count: int, area: Tensor | None = None) -> TriangleMesh:
    """Return a surface with about ``count`` vertices at most, each the mean of a patch of the given ones."""
    if mesh.num_vertices <= count:
        return mesh
    vertices, faces = mesh.vertices, mesh.faces
    size = _REPAIR.cell * ((mesh.face_areas().sum() if area is None else area) / count).sqrt()
    cells = ((vertices - vertices.amin(0)) / size).floor().long()
    number = cells.amax(0) + 1
    cell = (cells[:, 0] * number[1] + cells[:, 1]) * number[2] + cells[:, 2]
    # Each edge of a closed surface belongs to two triangles: only those within a cell are made unique.
    sides = torch.stack((faces, faces.roll(-1, dims=1)), dim=-1).reshape(-1, 2)
    sides = sides[cell[sides[:, 0]] == cell[sides[:, 1]]]
    keys = (torch.minimum(*sides.unbind(1)) * len(vertices) + torch.maximum(*sides.unbind(1))).unique()
    edges = torch.stack((keys // len(vertices), keys % len(vertices)), dim=-1)
    patch = connected_components(edges, len(vertices))
    inner = patch[faces[(patch[faces] == patch[faces[:, :1]]).all(1), 0]]
    most = int(patch.max()) + 1
    euler = torch.bincount(patch) + torch.bincount(inner, minlength=most)
    euler = euler - torch.bincount(patch[edges[:, 0]], minlength=most)
    patch = torch.where(euler[patch] == 1, patch, most + torch.arange(len(vertices)))
    patch = patch.unique(return_inverse=True)[1]
    total = vertices.new_zeros(int(patch.max()) + 1, 3).index_add(0, patch, vertices)
    faces = patch[faces]
    faces = faces[(faces != faces.roll(1, dims=1)).all(1)]
    return TriangleMesh(total / torch.bincount(patch)[:, None], faces)


def _kept_pieces(
    vertices: Tensor, faces: Tensor, areas: Tensor, pieces: str
) -> tuple[Tensor, int, tuple[str, ...], Tensor]:
    """Return the faces of the pieces to keep, the number of these, notes and the piece (V,) of each vertex."""
    labels = connected_components(torch.cat((faces[:, :2], faces[:, 1:])), len(vertices))
    piece = labels[faces[:, 0]]
    number = torch.bincount(piece)
    areas = torch.bincount(piece, areas, minlength=len(number))
    large = number >= _REPAIR.dust * len(faces)
    count = int(large.sum())
    if count > 1 and pieces == "error":
        shares = ", ".join(f"{share:.1%}" for share in (areas[large] / areas.sum()).sort(descending=True).values[:5])
        raise InputError(f"mesh must be one piece, got {count} (area {shares}); choose pieces='largest' or 'bridge'")
    keep = large if pieces == "bridge" else torch.arange(len(number)) == areas.argmax()
    dropped = int((number > 0).sum()) - int(keep.sum())
    notes: tuple[str, ...] = (
        f"{dropped} fragment(s) left out, {1 - float(number[keep].sum()) / len(faces):.2%} of the faces",
    )
    if not dropped:
        return faces[keep[piece]], int(keep.sum()), (), labels
    share = float((areas[~keep].max() / areas[keep].max()).nan_to_num())
    if share >= _REPAIR.body:
        notes += (f"{ANOTHER_BODY}, with {share:.0%} of the area of the one that is kept",)
    return faces[keep[piece]], int(keep.sum()), notes, labels


def _bridges(vertices: Tensor, labels: Tensor, count: int) -> Tensor:
    """Return the vertex pairs of least total length that join all pieces; of many, those in the nearest boxes."""
    groups = [(labels == label).nonzero()[:, 0] for label in labels.unique().tolist()]
    trees = [NeighborTree(vertices[group]) for group in groups]
    pairs = _near_pairs([vertices[group] for group in groups])
    lengths, ends = [], []
    for first, second in pairs.tolist():
        small, large = sorted((first, second), key=lambda piece: len(groups[piece]))
        nearest, distance = trees[large].nearest(vertices[groups[small]])
        start = distance.argmin()
        lengths.append(distance[start])
        ends.append(torch.stack((groups[small][start], groups[large][nearest[start]])))
    return torch.stack(ends)[minimum_spanning_forest(pairs, torch.stack(lengths), count).chosen()]


def _near_pairs(pieces: list[Tensor]) -> Tensor:
    """Return pairs (P, 2) of pieces with near boxes that together connect all pieces, the first before the second."""
    low = torch.stack([piece.amin(0) for piece in pieces])
    high = torch.stack([piece.amax(0) for piece in pieces])
    distance = (torch.maximum(low[:, None], low) - torch.minimum(high[:, None], high)).clamp(min=0).norm(dim=-1)
    near = distance <= distance.sort(dim=1).values[:, min(_REPAIR.near_pieces, len(pieces) - 1), None]
    pairs = torch.combinations(torch.arange(len(pieces)))
    kept = (near | near.mT)[pairs[:, 0], pairs[:, 1]]
    kept[minimum_spanning_forest(pairs, distance[pairs[:, 0], pairs[:, 1]], len(pieces)).chosen()] = True
    return pairs[kept]


def close_holes(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, int]:
    """Return vertices and faces with every rim joined to its mean by triangles, and the number of rims."""
    keys, _ = _edge_keys(faces)
    if _is_closed(faces, keys):
        return vertices, faces, 0
    ordered = torch.nn.functional.pad(keys.reshape(-1).sort().values, (1, 1), value=-1)
    rim = ordered[1:-1][(ordered[1:-1] != ordered[:-2]) & (ordered[1:-1] != ordered[2:])]
    if not len(rim):
        return vertices, faces, 0
    face, corner = torch.isin(keys, rim).nonzero().unbind(1)
    edges = torch.stack((faces[face, corner], faces[face, (corner + 1) % 3]), dim=-1)
    around, ends = edges.unique(return_inverse=True)
    label = connected_components(ends, len(around))
    holes = int(label.max()) + 1
    number = torch.bincount(label).unsqueeze(-1)
    centers = vertices.new_zeros(holes, 3).index_add(0, label, vertices[around]) / number
    fan = torch.cat((edges.flip(-1), len(vertices) + label[ends[:, :1]]), dim=-1)
    return torch.cat((vertices, centers)), torch.cat((faces, fan)), holes
