"""Distances between matched points of two scans."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchreg._checks import check_positive, check_same_kind, check_shape
from torchreg.errors import InputError


class ScanDistance(nn.Module):
    """Mean squared distance of moved points from what they are matched with.

    ``E = sum_k b_k ((1 - s) (n_k . d_k)^2 + s |d_k|^2) / sum_k b_k``, ``d_k = x_k - y_k``: point to plane, with a share
    s of point to point, which keeps flat parts from sliding where nothing else does.

    Args:
        point_to_point: s, from 0 to 1.

    Raises:
        InputError: if ``point_to_point`` is out of range.

    References: Chang and Zwicker 2009, section 4.1.
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
        """Return the loss of every problem of the batch, squared units.

        Args:
            moved: (..., N, 3) points of one scan, moved onto the other.
            targets: (..., N, 3) what each is matched with, of the same dtype.
            normals: (..., N, 3) unit normals at the targets; not needed where only point to point counts.
            match_weights: (..., N) not negative, zero for a match that was dropped, whose target is never looked at;
                ones by default. Where all are zero the loss is zero.

        Returns:
            (...).

        Raises:
            InputError: if a shape does not fit, or normals are missing.
            InputTypeError: if dtypes or devices differ.

        Differentiable: in all; in ``match_weights`` where they are positive.
        """
        check_shape(moved, "moved", ("N", 3), batch=True)
        check_shape(targets, "targets", (moved.shape[-2], 3), batch=True)
        check_same_kind(moved, "moved", targets, "targets")
        off = moved - targets
        if match_weights is not None:
            check_shape(match_weights, "match_weights", (moved.shape[-2],), batch=True)
            off = torch.where(match_weights.unsqueeze(-1) > 0, off, 0.0)
        error = self.point_to_point * (off * off).sum(-1)
        if self.point_to_point < 1:
            if normals is None:
                raise InputError("normals are needed for point to plane; pass them, or set point_to_point=1")
            check_shape(normals, "normals", (moved.shape[-2], 3), batch=True)
            error = error + (1 - self.point_to_point) * (off * normals).sum(-1).square()
        if match_weights is None:
            return error.mean(-1)
        total = match_weights.sum(-1)
        return (match_weights * error).sum(-1) / total.clamp_min(torch.finfo(total.dtype).tiny)


def check_share(value: float, name: str) -> None:
    """Raise InputError unless ``value`` is a number from 0 to 1."""
    check_positive(value, name, allow_zero=True)
    if value > 1:
        raise InputError(f"{name} must be from 0 to 1, got {value}")
