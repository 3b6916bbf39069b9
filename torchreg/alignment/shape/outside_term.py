"""What a scan of all sides says against a state: points of the skin outside of it, where it saw nothing."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from torchreg.alignment.fit.free_space_term import INTRUSION
from torchreg.alignment.fit.objectives import Factor
from torchreg.geometry.neighbors import nearest_neighbor
from torchreg.geometry.normals import NORMALS
from torchreg.shapes.shaped import ShapedSkin
from torchreg.solvers.levenberg_marquardt import Linearization
from torchreg.solvers.robust import welsch_cost, welsch_loss, welsch_system


@dataclass(frozen=True, eq=False)
class OutsideTerm(Factor):
    """The cost of skin points beyond the tangent planes of the nearest data (B, M, 3), by more than a tolerance.

    A skin point stands for `weight` (B,) data, for none in scans that are open. What lies inside costs nothing: bodies
    are thinner than their clothes.
    """

    beside_matches: ClassVar[bool] = False
    skin: ShapedSkin
    data: Tensor
    normals: Tensor
    weight: Tensor
    tolerance: float

    @classmethod
    def of_scans(cls, skin: ShapedSkin, data: Tensor, valid: Tensor, normals: Tensor, size: float) -> OutsideTerm:
        """Return the term for scans (B, M, 3) of a shape of some size, with outward normals, zero where unknown."""
        length = normals.norm(dim=-1).sum(-1)
        # The normals of a closed surface sum to zero.
        closed = normals.sum(-2).norm(dim=-1) < NORMALS.least_mean * length
        weight = closed * length / len(skin)
        far = torch.where(valid.unsqueeze(-1), data, torch.full_like(data, 1e3 * size))
        return cls(skin, far, normals, weight, INTRUSION.tolerance * size)

    def rows(self, index: Tensor) -> OutsideTerm:
        """Return the term for some problems, which may repeat."""
        return replace(self, data=self.data[index], normals=self.normals[index], weight=self.weight[index])

    def thinned(self, factor: Tensor) -> OutsideTerm:
        """Return the term for data of which each stands for (B,) times as many."""
        return replace(self, weight=self.weight / factor)

    def for_skin(self, skin: ShapedSkin) -> OutsideTerm:  # type: ignore[override]
        """Return the term for another skin of the shape."""
        return replace(self, skin=skin, weight=self.weight * len(self.skin) / len(skin))

    def score(self, pose: Tensor, width: float) -> Tensor:
        """Return the number of data (B, ...), softly counted, that skin points outside stand for."""
        flat = pose.flatten(1, -2) if pose.ndim > 2 else pose.unsqueeze(1)
        counted = welsch_loss((self._outside(self.skin(flat))[0] / width).square()).sum(-1)
        return (counted * self.weight.unsqueeze(-1)).reshape(pose.shape[:-1])

    def cost(self, pose: Tensor, sigma: Tensor, noise: Tensor) -> Tensor:
        """Return the cost (B,) of states in the units of a surface fit of widths and noises (B,)."""
        outside = self._outside(self.skin(pose).unsqueeze(1))[0][:, 0]
        return welsch_cost(outside, self.weight.unsqueeze(-1), sigma, noise)

    def linearized(self, pose: Tensor, sigma: Tensor, noise: Tensor) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian at states (B, D + K)."""
        points, _, along = self.skin.lazy_normal_jacobian(pose)
        outside, normal = (value[:, 0] for value in self._outside(points.unsqueeze(1)))
        # Points that are not outside cost nothing.
        index = (outside > 0).any(0).nonzero()[:, 0]
        outside = outside[:, index]
        jacobian = along(index, normal[:, index]) * (outside > 0).unsqueeze(-1)
        return welsch_system(outside, jacobian, self.weight.unsqueeze(-1), sigma, noise)

    def _outside(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return by how much points (B, S, N, 3) are farther outside than is tolerated, and the normals there."""
        data = self.data.unsqueeze(1)
        nearest = nearest_neighbor(points, data)[0].unsqueeze(-1).expand_as(points)
        datum, normal = (
            value.unsqueeze(1).expand(-1, points.shape[1], -1, -1).gather(-2, nearest)
            for value in (self.data, self.normals)
        )
        return (((points - datum) * normal).sum(-1) - self.tolerance).clamp_min(0), normal
