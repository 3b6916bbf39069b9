"""Distances of oriented data to the surface of a rig whose pose and shape coefficients vary."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.shapes.shaped import ShapedSkin
from torchreg.shapes.surface import SkinSurface


class ShapedSurface(SkinSurface):
    """Distances of data to the tangent planes of a `ShapedSkin`, whose normals must be on the side of the data's.

    Normals (B, M, 3) of data are zero where unknown; planes mean little off a rim by more than ``reach``, metres.
    """

    # A datum whose normal opposes that of the surface at this cosine or below lies on another part of it.
    opposed = 0.0
    # Distance of such data, metres: beyond every kernel.
    elsewhere = 1e3

    def __init__(self, skin: ShapedSkin, normals: Tensor, reach: float) -> None:
        self.shaped, self.normals, self.reach = skin, normals, reach
        self.first = torch.arange(len(skin), device=skin.points.device)

    def with_normals(self, normals: Tensor) -> ShapedSurface:
        """Return the surface for other data, with normals (B, M, 3)."""
        return ShapedSurface(self.shaped, normals, self.reach)

    def distance(self, points: Tensor, pose: Tensor) -> Tensor:
        """Return the signed distances (B, M) of the data (B, M, 3) in states (B, D + K), metres."""
        return self._oriented_distance(points, *self.shaped.oriented(pose))[0]

    def nearest(self, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distances (B, M) of the data in states, and the samples (B, M) that they are from."""
        return self._oriented_distance(points, *self.shaped.oriented(pose))

    def distance_jacobian(self, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Return distances (B, M) and their Jacobian (B, M, D + K) in tangent coordinates."""
        posed, normals, jacobian_of = self.shaped.lazy_normal_jacobian(pose)
        distance, nearest = self._oriented_distance(points, posed, normals)
        # Of a scan from one side half of the samples are nearest to no datum.
        used, index = nearest.unique(return_inverse=True)
        jacobian = jacobian_of(used)
        return distance, -jacobian.gather(-2, index.unsqueeze(-1).expand(*index.shape, jacobian.shape[-1]))

    def _oriented_distance(self, points: Tensor, posed: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        distance, nearest, normal = self._plane_distance(points, posed, normals)
        opposed = (normal * self.normals).sum(-1) < self.opposed
        return torch.where(opposed, self.elsewhere, distance), nearest
