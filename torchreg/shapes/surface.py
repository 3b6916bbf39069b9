"""Two surfaces of an articulated shape behind one interface: its fused solids, or a skin's tangent planes."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh, interpolate, sample_surface
from torchreg.geometry.neighbors import nearest_neighbor, sampling_distance
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.skin import LinearBlendSkin, stacked_rows

# Meshes with this many vertices carry their own sampling.
_MIN_VERTICES, _MAX_VERTICES, _NUM_SAMPLES = 800, 6000, 4000


class Surface(Protocol):
    """What a surface fit needs: signed distances and their Jacobian with respect to the pose."""

    def distance(self, points: Tensor, pose: Tensor) -> Tensor:
        """Return the signed distances (..., N) of points (..., N, 3) in poses (..., num_dofs), metres."""

    def distance_jacobian(self, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Return distances (..., N) and their Jacobian (..., N, num_dofs) in tangent coordinates."""


class FusedSurface:
    """The fused surface of a shape's solids, eq. 2.

    Args:
        shape: the articulated shape.
    """

    def __init__(self, shape: Articulation) -> None:
        self.shape = shape

    def distance(self, points: Tensor, pose: Tensor) -> Tensor:
        """Return the signed distances (..., N) of points (..., N, 3) in poses (..., num_dofs), metres."""
        return self.shape.distance(points, pose)

    def distance_jacobian(self, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Return distances (..., N) and their Jacobian (..., N, num_dofs) in tangent coordinates."""
        return self.shape.distance_jacobian(points, pose, chart="tangent")


class SkinSurface:
    """A surface given by a dense skin with normals: distance to the tangent plane of the nearest skin point.

    For shapes whose file brings a mesh this is closer to the thing than its fused solids.

    Args:
        skin: a skin with normals, dense enough that its points' tangent planes follow the surface.
    """

    def __init__(self, skin: LinearBlendSkin) -> None:
        self.skin = skin
        self.first = _first_copies(skin)
        self.gap = _GAP_SPACINGS * _spacing(skin.points, self.first)

    def distance(self, points: Tensor, pose: Tensor) -> Tensor:
        """Return the signed distances (..., N) of points (..., N, 3) in poses (..., num_dofs), metres."""
        rows = stacked_rows(self.skin.shape.part_transforms(pose))
        return self._plane_distance(points, self.skin.place(rows), self.skin.turn_normals(rows))[0]

    def distance_jacobian(self, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Return distances (..., N) and their Jacobian (..., N, num_dofs) in tangent coordinates."""
        rows, derivative = self.skin.shape.transform_jacobian(pose, chart="tangent")
        posed, normals = self.skin.place(rows), self.skin.turn_normals(rows)
        distance, nearest, normal = self._plane_distance(points, posed, normals)
        # Contracted with the normals first: their products with the basis are smaller than every point's motions.
        along = (self.skin.basis[nearest].unsqueeze(-1) * normal.unsqueeze(-2)).flatten(-2)
        return distance, -(along @ derivative.flatten(-3, -2))

    def _plane_distance(self, points: Tensor, posed: Tensor, normals: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        nearest = self.first[nearest_neighbor(points, posed)[0]]
        index = nearest.unsqueeze(-1).expand(*nearest.shape, 3)
        offset = points - posed.expand(*nearest.shape[:-1], *posed.shape[-2:]).gather(-2, index)
        normal = normals.expand(*nearest.shape[:-1], *normals.shape[-2:]).gather(-2, index)
        along = (offset * normal).sum(-1)
        # Beside the rim of a skin the tangent plane says little: the distance to the point takes over, with its sign.
        reach = offset.norm(dim=-1)
        beside = (along.abs() < _PLANE_SHARE * reach) & (reach > self.gap)
        return torch.where(beside, _signed(reach, along), along), nearest, normal


# A datum whose offset is this oblique, and longer than this many distances between skin points, lies beside the rim.
_PLANE_SHARE = 0.2
_GAP_SPACINGS = 2.0
_NUM_SPACINGS = 500


def _spacing(points: Tensor, first: Tensor) -> float:
    """Return the median distance of points from their nearest neighbors elsewhere, zero for a single place."""
    places = points[first.unique()]
    return 0.0 if len(places) < 2 else sampling_distance(places, points[:: -(-len(points) // _NUM_SPACINGS)])


def _first_copies(skin: LinearBlendSkin) -> Tensor:
    """Return, per skin point, the first point that is everywhere where it is: files split vertices along seams.

    Copies may have normals of their own, and which of them is nearest must not depend on how neighbors are searched.
    """
    group = torch.unique(skin.points, dim=0, return_inverse=True)[1]
    index = torch.arange(len(skin), device=group.device)
    first = torch.full_like(index, len(skin)).scatter_reduce(0, group, index, "amin")[group]
    return torch.where((skin.weights[first] == skin.weights).all(-1), first, index)


def _signed(size: Tensor, sign: Tensor) -> Tensor:
    return torch.where(sign < 0, -size, size)


def dense_file_skin(shape: Articulation) -> LinearBlendSkin:
    """Return a dense skin with normals of the file's mesh: its vertices, or samples if they are too many or too few.

    Raises:
        InputError: if the shape was not read from a file with a mesh.
    """
    if shape.surface is None:
        raise InputError("this shape has no file surface: it was not read from a file with a mesh")
    mesh = TriangleMesh(shape.surface.vertices, shape.surface.faces)
    used = mesh.faces.unique()
    if _MIN_VERTICES <= len(used) <= _MAX_VERTICES:
        points, normals, weights = mesh.vertices[used], mesh.vertex_normals()[used], shape.surface.weights[used]
    else:
        points, face, barycentric = sample_surface(mesh, _NUM_SAMPLES)
        normals = mesh.face_normals()[face]
        weights = interpolate(shape.surface.weights.to(barycentric), mesh.faces, face, barycentric)
    # The file's vertices lie in the pose of all zeros, whether or not the joint limits allow it.
    reference = torch.zeros_like(shape.rest)
    return LinearBlendSkin(
        shape, points.to(shape.rest), weights.to(shape.rest), reference, normals=normals.to(shape.rest)
    )
