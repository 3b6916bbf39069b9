"""Correspondences between moved points and a scan, and the residuals that they leave."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchreg._checks import check_positive, check_same_kind, check_shape
from torchreg.errors import InputError


@dataclass(frozen=True)
class Correspondences:
    """Targets (..., N, 3) of N points in each problem of a batch, and how residuals from them are measured."""

    targets: Tensor
    normals: Tensor | None  # (..., N, 3) unit normals at the targets; None measures from point to point alone
    weights: Tensor  # (..., N) not negative, zero for a dropped match, whose target and normal may be anything
    point_to_point: float = 1.0  # share s of the point-to-point distance, see `squared_residuals`

    def squared_residuals(self, positions: Tensor) -> Tensor:
        """Return the squared residuals (F, ..., N) of positions (F, ..., N, 3), several for each of F frames."""
        frame = (slice(None), *(None,) * (positions.ndim - self.targets.ndim))
        normals = None if self.normals is None else self.normals[frame]
        return squared_residuals(positions - self.targets[frame], normals, self.point_to_point)

    def residual_rows(self) -> Tensor:
        """Return rows (..., N, m, 3) of the root of ``(1 - s) n n^T + s I``, or ``n`` alone where s is zero."""
        identity = torch.eye(3, dtype=self.targets.dtype, device=self.targets.device)
        if self.normals is None or self.point_to_point == 1:
            return identity.expand(self.targets.shape[-2], 3, 3)
        if self.point_to_point == 0:
            return self.normals.unsqueeze(-2)
        root = self.point_to_point**0.5
        return (1 - root) * self.normals.unsqueeze(-1) * self.normals.unsqueeze(-2) + root * identity


def squared_residuals(offsets: Tensor, normals: Tensor | None, point_to_point: float) -> Tensor:
    """Return squared residuals (...) ``(1 - s) (n . d)^2 + s |d|^2`` of offsets d (..., 3) from targets with normals n.

    Point to plane, with a share s of point to point, which keeps flat parts from sliding where nothing else does.
    """
    squares = offsets.square().sum(-1)
    if normals is None or point_to_point == 1:
        return squares
    return (1 - point_to_point) * (offsets * normals).sum(-1).square() + point_to_point * squares


class ScanDistance(nn.Module):
    """Weighted mean of the squared residuals of moved points (Chang and Zwicker 2009, section 4.1).

    ``E = sum_k b_k ((1 - s) (n_k . d_k)^2 + s |d_k|^2) / sum_k b_k``, ``d_k = x_k - y_k``, see `squared_residuals`.
    """

    def __init__(self, point_to_point: float = 0.0) -> None:
        super().__init__()
        check_share(point_to_point, "point_to_point")
        self.point_to_point = float(point_to_point)

    def extra_repr(self) -> str:
        """Return the settings for the module's printed form."""
        return f"point_to_point={self.point_to_point:g}"

    def forward(
        self, moved: Tensor, targets: Tensor, normals: Tensor | None = None, match_weights: Tensor | None = None
    ) -> Tensor:
        """Return the loss (...) of every problem of the batch, squared units, zero where all match weights are."""
        check_shape(moved, "moved", ("N", 3), batch=True)
        check_shape(targets, "targets", (moved.shape[-2], 3), batch=True)
        check_same_kind(moved, "moved", targets, "targets")
        if normals is not None:
            check_shape(normals, "normals", (moved.shape[-2], 3), batch=True)
        elif self.point_to_point < 1:
            raise InputError("normals are needed for point to plane; pass them, or set point_to_point=1")
        offsets = moved - targets
        if match_weights is None:
            return squared_residuals(offsets, normals, self.point_to_point).mean(-1)
        check_shape(match_weights, "match_weights", (moved.shape[-2],), batch=True)
        offsets = torch.where(match_weights.unsqueeze(-1) > 0, offsets, 0.0)
        total = match_weights.sum(-1)
        residuals = squared_residuals(offsets, normals, self.point_to_point)
        return (match_weights * residuals).sum(-1) / total.clamp_min(torch.finfo(total.dtype).tiny)


def check_share(value: float, name: str) -> None:
    """Raise InputError unless ``value`` is a number from 0 to 1."""
    check_positive(value, name, allow_zero=True)
    if value > 1:
        raise InputError(f"{name} must be from 0 to 1, got {value}")
