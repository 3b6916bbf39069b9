"""Signed distances to an articulated shape: to its fused solids, or to the tangent planes of a skin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh, interpolate, sample_surface
from torchreg.geometry.neighbors import nearest_neighbor, sampling_distance
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.skin import LinearBlendSkin, stacked_rows


@dataclass(frozen=True)
class _DenseSkin:
    """Numbers of dense skins and of distances to their tangent planes."""

    # Of a file's mesh, evenly: vertices lie where the mesh bends, and far apart on its large faces.
    num_samples: int = 4000
    # Points from which the spacing of a skin is estimated.
    num_spacings: int = 500
    # A datum is off the rim of a skin if its offset is this oblique (distance to the plane over distance to the point)
    # and longer than this many spacings.
    rim_share: float = 0.2
    rim_spacings: float = 2.0


_DENSE = _DenseSkin()


class ShapeSurface(Protocol):
    """A surface that data are fitted to: signed distances and their Jacobian with respect to the pose."""

    def distance(self, points: Tensor, pose: Tensor) -> Tensor:
        """Return the signed distances (..., N) of points (..., N, 3) in poses (..., num_dofs), metres."""

    def distance_jacobian(self, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Return distances (..., N) and their Jacobian (..., N, num_dofs) in tangent coordinates."""


class FusedSurface:
    """The fused surface of a shape's solids, eq. 2."""

    def __init__(self, shape: Articulation) -> None:
        self.shape = shape

    def distance(self, points: Tensor, pose: Tensor) -> Tensor:
        """Return the signed distances (..., N) of points (..., N, 3) in poses (..., num_dofs), metres."""
        return self.shape.distance(points, pose)

    def distance_jacobian(self, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Return distances (..., N) and their Jacobian (..., N, num_dofs) in tangent coordinates."""
        return self.shape.distance_jacobian(points, pose, chart="tangent")


class SkinSurface:
    """A dense skin with normals: distances to the tangent plane of the nearest skin point."""

    def __init__(self, skin: LinearBlendSkin) -> None:
        self.skin = skin
        self.first = _first_copies(skin)
        self.reach = _DENSE.rim_spacings * _spacing(skin.points, self.first)
        self._moves = skin.shape.part_moves()
        self._subtree = skin.basis[:, 3::4] @ self._moves

    def distance(self, points: Tensor, pose: Tensor) -> Tensor:
        """Return the signed distances (..., N) of points (..., N, 3) in poses (..., num_dofs), metres."""
        rows = stacked_rows(self.skin.shape.part_transforms(pose))
        return self._plane_distance(points, self.skin.place(rows), self.skin.turn_normals(rows))[0]

    def distance_jacobian(self, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Return distances (..., N) and their Jacobian (..., N, num_dofs) in tangent coordinates."""
        shape = self.skin.shape
        frames = shape.frame_transforms(pose)
        transforms, (linear, angular) = (
            frames.index_select(-3, shape.part_index),
            shape.frame_twists(pose, frames, "tangent"),
        )
        rows = stacked_rows(transforms)
        distance, nearest, normal = self._plane_distance(points, self.skin.place(rows), self.skin.turn_normals(rows))
        # n . (v + w x p) = n . v + w . (p x n), summed over the parts that each degree of freedom moves.
        weighted = self.skin.basis[nearest].unflatten(-1, (-1, 4))
        by_part = transforms[..., :3, :] @ weighted.movedim(-3, -1)
        levers = torch.linalg.cross(by_part, normal.mT.unsqueeze(-3).expand_as(by_part), dim=-2)
        turning = (self._moves.unsqueeze(-2) * angular.mT.unsqueeze(-3)).flatten(-3, -2)
        along = (normal @ linear.mT) * self._subtree[nearest] + levers.flatten(-3, -2).mT @ turning
        return distance, -(along @ shape.couplings() if shape.kinematics.has_mimics else along)

    def _plane_distance(self, points: Tensor, posed: Tensor, normals: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        nearest = self.first[nearest_neighbor(points, posed)[0]]
        index = nearest.unsqueeze(-1).expand(*nearest.shape, 3)
        offset = points - posed.expand(*nearest.shape[:-1], *posed.shape[-2:]).gather(-2, index)
        normal = normals.expand(*nearest.shape[:-1], *normals.shape[-2:]).gather(-2, index)
        along = (offset * normal).sum(-1)
        # Off the rim of a skin the tangent plane means little: the distance to the point replaces it, with its sign.
        distance = offset.norm(dim=-1)
        off_rim = (along.abs() < _DENSE.rim_share * distance) & (distance > self.reach)
        return torch.where(off_rim, torch.where(along < 0, -distance, distance), along), nearest, normal


def _spacing(points: Tensor, first: Tensor) -> float:
    """Return the median distance of points from their nearest neighbors at other positions, zero without any."""
    positions = points[first.unique()]
    subset = points[:: -(-len(points) // _DENSE.num_spacings)]
    return 0.0 if len(positions) < 2 else sampling_distance(positions, subset)


def _first_copies(skin: LinearBlendSkin) -> Tensor:
    """Return the first point that coincides with each skin point in every pose: files split vertices along seams."""
    group = torch.unique(skin.points, dim=0, return_inverse=True)[1]
    index = torch.arange(len(skin), device=group.device)
    first = torch.full_like(index, len(skin)).scatter_reduce(0, group, index, "amin")[group]
    return torch.where((skin.weights[first] == skin.weights).all(-1), first, index)


def dense_file_skin(shape: Articulation) -> LinearBlendSkin:
    """Return a dense skin of samples, with normals, of the file's mesh."""
    surface = shape.surface
    if surface is None:
        raise InputError("this shape has no file surface: it was not read from a file with a mesh")
    mesh = TriangleMesh(surface.vertices, surface.faces)
    points, face, barycentric = sample_surface(mesh, _DENSE.num_samples)
    normals = mesh.face_normals()[face]
    weights = interpolate(surface.weights.to(barycentric), mesh.faces, face, barycentric)
    # The file's vertices lie in the pose of all zeros, whether or not the joint limits allow it.
    reference = torch.zeros_like(shape.rest)
    return LinearBlendSkin(
        shape, points.to(shape.rest), weights.to(shape.rest), reference, normals=normals.to(shape.rest)
    )
