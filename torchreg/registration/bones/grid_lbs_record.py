"""The bones on a grid as plain data, which files hold."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class GridLBSRecord:
    """A `GridLBS` as plain data.

    Args:
        cells: of the grid, see `SparseGrid`.
        shape: of the grid.
        origin: of the grid.
        axes: of the grid.
        spacing: of the grid.
        weights: (K, B) before rows are divided by their sums.
        transforms: (..., B, 4, 4).
        blend: see `GridLBS`.
    """

    cells: Tensor
    shape: tuple[int, int, int]
    origin: Tensor
    axes: Tensor
    spacing: float
    weights: Tensor
    transforms: Tensor
    blend: str
