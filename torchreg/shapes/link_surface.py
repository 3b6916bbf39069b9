"""The exact surface of shapes whose meshes are rigid: distances to the mesh of every link, each in its own frame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh, even_samples
from torchreg.geometry.neighbors import NeighborTree, weld
from torchreg.geometry.rigid import invert_rigid, transform_points
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.spec import RigSurface


@dataclass(frozen=True)
class _LinkSampling:
    """Numbers of the samples that stand for the meshes of links."""

    num_samples: int = 60_000  # of all links: 3 mm apart on an arm of half a square metre
    reach: float = 2.0  # off a sample, in their spacing, up to which its tangent plane stands for the mesh
    open_share: float = 0.01  # of edges without a neighbor: a mesh with more has no inside


_SAMPLING = _LinkSampling()


@dataclass(frozen=True, eq=False)
class LinkMesh:
    """Samples (S, 3) of a link's mesh in its part's coordinates, float64, their normals, search tree and box (2, 3)."""

    part: int
    points: Tensor
    normals: Tensor
    tree: NeighborTree
    box: Tensor
    is_closed: bool


@dataclass(frozen=True, eq=False)
class LinkMeshes:
    """The meshes of the links of a shape that have one, and the spacing of their samples, metres."""

    links: tuple[LinkMesh, ...]
    spacing: float


def has_rigid_links(shape: Articulation) -> bool:
    """Return whether a shape came from a file each vertex of which hangs on one part alone, as robots and props do."""
    surface = shape.surface
    return surface is not None and (surface.is_rigid or bool((surface.weights.amax(-1) == 1).all()))


def link_meshes(shape: Articulation) -> LinkMeshes:
    """Return the meshes of the links of a shape with `has_rigid_links`, made once for every shape."""
    surface = shape.surface
    if surface is None:
        raise InputError("this shape has no meshes: it was not read from a file with a mesh")
    made = _MADE.get(shape)
    if made is None or made[0] is not surface:
        with torch.inference_mode(False), torch.no_grad():
            to_parts = invert_rigid(shape.part_transforms(torch.zeros_like(shape.rest))).cpu().double()
            made = _MADE[shape] = surface, _make_links(surface, to_parts)
    return made[1]


_MADE: WeakKeyDictionary[Articulation, tuple[RigSurface, LinkMeshes]] = WeakKeyDictionary()


def _make_links(surface: RigSurface, to_parts: Tensor) -> LinkMeshes:
    mesh = TriangleMesh(surface.vertices.detach().cpu().double(), surface.faces.cpu())
    owner = surface.weights.argmax(-1).cpu()[mesh.faces[:, 0]]
    areas = mesh.face_areas()
    spacing = math.sqrt(float(areas.sum()) / _SAMPLING.num_samples)
    links = []
    for part in owner[areas > 0].unique().tolist():
        used, faces = mesh.faces[owner == part].unique(return_inverse=True)
        link = TriangleMesh(transform_points(to_parts[part], mesh.vertices[used]), faces)
        points, face = even_samples(link, max(1, round(float(link.face_areas().sum()) / spacing**2)))
        outward = _inside_sign(link)
        links.append(
            LinkMesh(
                part=part,
                points=points,
                normals=link.face_normals()[face] * (outward or 1.0),
                tree=NeighborTree(points),
                box=link.bounds(),
                is_closed=outward != 0,
            )
        )
    return LinkMeshes(tuple(links), spacing)


def _inside_sign(mesh: TriangleMesh) -> float:
    """Return 1 if the normals of a closed mesh point outwards, -1 if inwards, 0 for a mesh without an inside."""
    corners = weld(mesh.vertices)[mesh.faces]
    edges = torch.stack((corners, corners.roll(-1, 1)), dim=-1).flatten(0, 1)
    size = int(corners.max()) + 1
    forward, backward = edges[:, 0] * size + edges[:, 1], edges[:, 1] * size + edges[:, 0]
    if float((~torch.isin(forward, backward)).double().mean()) > _SAMPLING.open_share:
        return 0.0
    first, second, third = (mesh.vertices - mesh.vertices.mean(0))[mesh.faces].unbind(1)
    return 1.0 if float((first * torch.linalg.cross(second, third)).sum()) >= 0 else -1.0


class LinkSurface:
    """The meshes of a shape's rigid links: signed distances to tangent planes of their nearest samples."""

    def __init__(self, shape: Articulation) -> None:
        self.shape, self.meshes = shape, link_meshes(shape)

    def distance(self, points: Tensor, pose: Tensor) -> Tensor:
        """Return the signed distances (..., N) of points (..., N, 3) in poses (..., num_dofs), metres."""
        return self._nearest(points, self.shape.part_transforms(pose))[0]

    def distance_jacobian(self, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Return distances (..., N) and their Jacobian (..., N, num_dofs) in tangent coordinates."""
        transforms, twists = self.shape.part_twists(pose, chart="tangent")
        distance, normal, part = self._nearest(points, transforms)
        wrench = torch.cat([normal, torch.linalg.cross(points.expand_as(normal), normal)], dim=-1)
        index = part[..., None, None].expand(*part.shape, 1, 6)
        rows = wrench.new_zeros(*part.shape, self.shape.num_parts, 6).scatter_(-2, index, wrench.unsqueeze(-2))
        # A fixed point moves backwards relative to a link that moves by a twist.
        return distance, -(rows.flatten(-2) @ twists.mT.flatten(-3, -2))

    @torch.no_grad()
    def _nearest(self, points: Tensor, transforms: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return distances (..., N), their gradients (..., N, 3) in the points, and the nearest parts (..., N)."""
        parts = [link.part for link in self.meshes.links]
        frames = invert_rigid(transforms[..., parts, :, :])
        # Links first, then all points of a batch in a row.
        local = transform_points(frames, points.unsqueeze(-3)).movedim(-3, 0)
        shape = local.shape[1:-1]
        local = local.flatten(1, -2).cpu().double()
        offset, normal, link = _search(self.meshes, local)
        along, length = (offset * normal).sum(-1), offset.norm(dim=-1)
        off_plane = (length.square() - along.square()).clamp_min(0).sqrt() > _SAMPLING.reach * self.meshes.spacing
        outside = torch.where(along < 0, -1.0, 1.0)
        away = torch.where(off_plane.unsqueeze(-1), offset / length.clamp_min(1e-12).unsqueeze(-1), normal)
        away = torch.where(off_plane, outside, 1.0).unsqueeze(-1) * away
        distance = torch.where(off_plane, outside * length, along)
        closed = torch.tensor([mesh.is_closed for mesh in self.meshes.links])
        flip = torch.where(~closed[link] & (distance < 0), -1.0, 1.0)
        link, part = link.to(points.device), torch.tensor(parts, device=points.device)[link]
        rotation = transforms[..., parts, :3, :3].expand(*shape[:-1], len(parts), 3, 3)
        index = link.reshape(shape)[..., None, None].expand(*shape, 3, 3)
        turned = (flip.unsqueeze(-1) * away).to(points).reshape(*shape, 3, 1)
        gradient = (rotation.gather(-3, index) @ turned).squeeze(-1)
        return (flip * distance).to(points).reshape(shape), gradient, part.reshape(shape)


def _search(meshes: LinkMeshes, local: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return offsets (N, 3) from the nearest samples, their normals (N, 3) and links (N,), of points (L, N, 3)."""
    boxes = torch.stack([link.box for link in meshes.links])
    low, high = boxes[:, None, 0], boxes[:, None, 1]
    bound = (torch.maximum(low - local, local - high).clamp_min(0)).norm(dim=-1)
    first = bound.argmin(0)
    best = torch.full_like(bound[0], torch.inf)
    offset, normal = torch.zeros_like(local[0]), torch.zeros_like(local[0])
    found = torch.zeros_like(first)
    for is_second in (False, True):
        for number, asked in _asked(bound, first, best, is_second):
            link = meshes.links[number]
            index, length = link.tree.nearest(local[number, asked])
            nearer = length < best[asked]
            rows, index = asked[nearer], index[nearer]
            best[rows], found[rows] = length[nearer], number
            offset[rows], normal[rows] = local[number, rows] - link.points[index], link.normals[index]
    return offset, normal, found


def _asked(bound: Tensor, first: Tensor, best: Tensor, is_second: bool) -> Iterator[tuple[int, Tensor]]:
    """Yield links and the points (K,) to be sought on each, in the first or the second round."""
    for number in range(len(bound)):
        asked = (first != number) & (bound[number] < best) if is_second else first == number
        if bool(asked.any()):
            yield number, asked.nonzero()[:, 0]
