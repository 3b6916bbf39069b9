"""The bones on a grid as plain data, which files hold."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class GridLBSRecord:
    """A `GridLBS` as plain data: its grid, see `SparseGrid`, weights (K, B) before they are normalized, and motions."""

    cells: Tensor
    shape: tuple[int, int, int]
    origin: Tensor
    axes: Tensor
    spacing: float
    weights: Tensor
    transforms: Tensor
    blend: str
