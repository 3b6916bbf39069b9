"""Sparse grids: the cubic cells around a surface, with shared corners that carry values to interpolate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchreg._checks import (
    as_float_tensor,
    as_tensor,
    check_choice,
    check_count,
    check_finite,
    check_points,
    check_positive,
    check_shape,
)
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.distance_transform import nearest_inside
from torchreg.geometry.graphs import component_links, connected_components
from torchreg.geometry.neighbors import pairs_within

# Cells along the longest side: a table over the whole box still takes 128 MiB.
MAX_RESOLUTION = 256
# The eight corners of a unit cell; corner 4 i + 2 j + k lies at (i, j, k).
_CUBE = tuple((i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1))
_CUBE_EDGES = tuple((a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b).bit_count() == 1)


class GridLocation(NamedTuple):
    """Cells of points, and trilinear coefficients in them."""

    cell: Tensor  # (..., N) int64, the cell that holds each point, or the occupied one nearest to it in the grid
    coefficients: Tensor  # (..., N, 8) trilinear, of the cell's corners; not negative, rows sum to one


@dataclass(frozen=True, eq=False)
class SparseGrid:
    """The cells of a regular grid that hold points of a surface, their corners shared between them.

    Grid coordinates ``u = axes^T (x - origin) / spacing`` count cells; cell (i, j, k) is the unit cube from there
    (Chang and Zwicker 2009, section 3).
    """

    cells: Tensor  # (C, 3) int64, different, in the order of their coordinates
    shape: tuple[int, int, int]  # numbers of cells of the box around them along the three axes
    origin: Tensor  # (3,) corner of the box, float32 or float64
    axes: Tensor  # (3, 3) directions of the grid as columns, a rotation
    spacing: float  # edge length h of a cell, in the unit of the points

    @classmethod
    def from_cells(cls, cells: Any, shape: Any, origin: Any, axes: Any, spacing: float) -> SparseGrid:
        """Return the grid of given cells, after checks; arguments as of the class."""
        cells = _checked_cells(cells, shape)
        origin = as_float_tensor(origin, "origin")
        axes = as_float_tensor(axes, "axes", like=origin)
        check_shape(origin, "origin", (3,))
        check_shape(axes, "axes", (3, 3))
        check_finite(origin, "origin")
        check_positive(spacing, "spacing")
        deviation = (axes.mT @ axes - torch.eye(3, dtype=axes.dtype, device=axes.device)).abs().max()
        if not float(deviation) < 1e-4 or float(torch.linalg.det(axes)) < 0:
            raise InputError(f"axes must be a rotation, got {axes.tolist()}")
        return cls(cells.to(origin.device), shape, origin, axes, spacing)

    @classmethod
    def from_points(cls, points: Any, resolution: int = 50, *, frame: str = "principal") -> SparseGrid:
        """Return the grid of the cells that hold points: ``resolution`` cubes along the longest side of their box.

        ``frame``: "principal": the sides follow the principal axes of the points, so that turning the points turns the
        grid and changes nothing else; "world": the coordinate axes.
        """
        points = as_float_tensor(points, "points").detach()
        check_points(points, "points", batch=False)
        check_count(resolution, "resolution", 1)
        check_choice(frame, "frame", ("principal", "world"))
        if resolution > MAX_RESOLUTION:
            raise InputError(f"resolution must be at most {MAX_RESOLUTION}, got {resolution}")
        exact = points.double()
        axes = torch.eye(3, dtype=torch.float64, device=points.device)
        if frame == "principal":
            axes = _principal_axes(exact)
        local = exact @ axes
        low, high = local.amin(0), local.amax(0)
        longest = float((high - low).max())
        if not longest > float(points.abs().max()) * torch.finfo(points.dtype).eps:
            raise InputError(f"points must lie at different places for a grid, got {len(points)} within {longest:.3g}")
        spacing = longest / resolution
        # The box is centered, so that flat scans lie amid cells and rounding moves no point across a side.
        counts = ((high - low) / spacing - 1e-9).ceil().clamp(min=1)
        corner = (low + high - counts * spacing) / 2
        shape = tuple(int(n) for n in counts)
        coordinates = ((local - corner) / spacing).floor().clamp(min=torch.zeros_like(counts), max=counts - 1).long()
        cells = _cells_of(_cell_numbers(coordinates, shape).unique(), shape)
        return cls(cells, shape, (axes @ corner).to(points), axes.to(points), spacing)  # type: ignore[arg-type]

    @cached_property
    def _corner_table(self) -> tuple[Tensor, Tensor]:
        size = tuple(n + 1 for n in self.shape)
        corners = _cell_numbers(self.cells[:, None] + self.cells.new_tensor(_CUBE), size)
        numbers, cell_corners = corners.unique(return_inverse=True)
        return _cells_of(numbers, size), cell_corners

    @property
    def corners(self) -> Tensor:
        """Grid coordinates (K, 3) int64 of the corners, in order."""
        return self._corner_table[0]

    @property
    def cell_corners(self) -> Tensor:
        """Corners (C, 8) int64 of each cell; number 4 i + 2 j + k is at offset (i, j, k)."""
        return self._corner_table[1]

    @cached_property
    def nearest(self) -> Tensor:
        """The occupied cell (prod(shape),) int64 nearest to each cell of the box."""
        return _nearest_cells(self.cells, self.shape)

    def __repr__(self) -> str:
        return f"SparseGrid({self.num_cells} cells of {self.spacing:.4g} in {self.shape}, {self.num_corners} corners)"

    @property
    def num_cells(self) -> int:
        """C."""
        return len(self.cells)

    @property
    def num_corners(self) -> int:
        """K."""
        return len(self.corners)

    def corner_points(self) -> Tensor:
        """Return the positions (K, 3) of the corners."""
        return self._world(self.corners.to(self.origin))

    def cell_centers(self) -> Tensor:
        """Return the positions (C, 3) of the middles of the cells."""
        return self._world(self.cells.to(self.origin) + 0.5)

    def _world(self, coordinates: Tensor) -> Tensor:
        return self.origin + (self.spacing * coordinates) @ self.axes.mT

    def coordinates(self, points: Tensor) -> Tensor:
        """Return grid coordinates (..., N, 3) of points (..., N, 3), in cells from the origin."""
        return ((points - self.origin) @ self.axes) / self.spacing

    def locate(self, points: Tensor) -> GridLocation:
        """Return the cell of each point (..., N, 3), or the nearest one, and trilinear coefficients."""
        return locate_in_cells(self.coordinates(points), self.shape, self.cells, self.nearest)

    def interpolate(self, values: Tensor, points: Tensor) -> Tensor:
        """Return values (..., N, B) at points (..., N, 3), of values (K, B) at the corners."""
        location = self.locate(points)
        return (location.coefficients.unsqueeze(-2) @ values[self.cell_corners[location.cell]]).squeeze(-2)

    def spread_to_corners(self, values: Tensor) -> Tensor:
        """Return values (K, B) at the corners, each the mean over the cells around it, of values (C, B) of the cells.

        Labels as rows of zeros and a one become the binary weights of eq. 12, averaged where labels meet.
        """
        index = self.cell_corners.flatten()
        total = values.new_zeros(self.num_corners, values.shape[-1])
        total = total.index_add(0, index, values.repeat_interleave(8, dim=0))
        return total / torch.bincount(index, minlength=self.num_corners).to(values).unsqueeze(-1)

    def edges(self) -> Tensor:
        """Return the pairs of corners (E, 2) that an edge of a cell joins, the lower number first, in order."""
        pairs = self.cell_corners[:, torch.tensor(_CUBE_EDGES, device=self.cells.device)].reshape(-1, 2)
        # Corner numbers grow along every axis, so the first of a pair is the lower one already.
        number = (pairs[:, 0] * self.num_corners + pairs[:, 1]).unique()
        return torch.stack([number // self.num_corners, number % self.num_corners], dim=-1)

    def neighbors(self, gap: float = 0.0) -> Tensor:
        """Return the pairs of cells (A, 2) that share a side, or join regions within ``gap`` empty cells."""
        pairs = torch.cat([self._side_by_side(axis) for axis in range(3)])
        if gap >= 0:
            pairs = torch.cat([pairs, self._bridges(pairs, gap)])
        number = (pairs[:, 0] * self.num_cells + pairs[:, 1]).unique()
        return torch.stack([number // self.num_cells, number % self.num_cells], dim=-1)

    def regions(self, gap: float = 0.0) -> Tensor:
        """Return the connected region (C,) int64 of each cell; see `neighbors` for ``gap``."""
        return connected_components(self.neighbors(gap), self.num_cells)

    def links(self) -> Tensor:
        """Return pairs of cells (L, 2), the lower number first, that link all regions, however far apart they are."""
        return component_links(self.cells, self.regions())[0]

    def _side_by_side(self, axis: int) -> Tensor:
        """Return pairs (A, 2) of cells that follow each other along an axis."""
        later = (self.cells[:, axis] > 0).nonzero()[:, 0]
        before = self.cells[later].clone()
        before[:, axis] -= 1
        earlier = self.nearest[_cell_numbers(before, self.shape)]
        occupied = (self.cells[earlier] == before).all(-1)
        return torch.stack([earlier[occupied], later[occupied]], dim=-1)

    def _bridges(self, pairs: Tensor, gap: float) -> Tensor:
        """Return pairs (A, 2) of cells of two regions, within the gap and nearest to each other."""
        region = connected_components(pairs, self.num_cells).cpu().numpy()
        if region.max(initial=0) == 0:
            return pairs[:0]
        cells = self.cells.cpu().numpy()
        # A gap of no cell is a step of up to sqrt(3) across a corner.
        reach = max(gap + 1, math.sqrt(3)) + 1e-6
        near = pairs_within(self.cells, reach).cpu().numpy()
        near = near[region[near[:, 0]] != region[near[:, 1]]]
        directed = np.concatenate([near, near[:, ::-1]])
        length = np.linalg.norm(cells[directed[:, 0]] - cells[directed[:, 1]], axis=1)
        # The nearest cell of each region to each cell, then the pairs that are so from either side.
        order = np.lexsort((directed[:, 1], length, region[directed[:, 1]], directed[:, 0]))
        directed = directed[order]
        first = np.unique(directed[:, 0] * (region.max() + 1) + region[directed[:, 1]], return_index=True)[1]
        bridges, uses = np.unique(np.sort(directed[first], axis=1), axis=0, return_counts=True)
        return torch.from_numpy(bridges[uses == 2].astype(np.int64)).to(pairs.device)

    def to(self, *args: Any, **kwargs: Any) -> SparseGrid:
        """Return the grid on another device or in another dtype; takes what ``Tensor.to`` takes."""
        origin = self.origin.to(*args, **kwargs)
        return SparseGrid(self.cells.to(origin.device), self.shape, origin, self.axes.to(origin), self.spacing)


def locate_in_cells(coordinates: Tensor, shape: Sequence[int], cells: Tensor, nearest: Tensor) -> GridLocation:
    """Return cells and coefficients of points, as `SparseGrid.locate` does, from tables that can be compiled."""
    last = torch.tensor([n - 1 for n in shape], dtype=coordinates.dtype, device=coordinates.device)
    inside = torch.minimum(coordinates.detach().floor().clamp(min=0), last).long()
    cell = nearest[_cell_numbers(inside, shape)]
    local = (coordinates - cells[cell].to(coordinates)).clamp(0, 1)
    x, y, z = torch.stack([1 - local, local], dim=-1).unbind(-2)
    coefficients = x[..., :, None, None] * y[..., None, :, None] * z[..., None, None, :]
    return GridLocation(cell, coefficients.flatten(-3))


def _principal_axes(points: Tensor) -> Tensor:
    """Return the principal directions (3, 3) as columns, longest first, a rotation that turns with the points."""
    centered = points - points.mean(0)
    centered = centered / centered.abs().max().clamp_min(torch.finfo(points.dtype).tiny)
    axes = torch.linalg.eigh(centered.mT @ centered)[1].flip(-1)
    # Signs by the skewness of the points along each axis: the one choice that turns with them.
    sign = torch.where((centered @ axes).pow(3).sum(0) < 0, -1.0, 1.0)
    axes = axes * sign
    return torch.cat([axes[:, :2], torch.linalg.cross(axes[:, 0], axes[:, 1])[:, None]], dim=1)


def _cell_numbers(cells: Tensor, shape: Sequence[int]) -> Tensor:
    """Return the running numbers (...) of cells (..., 3) in a box."""
    return (cells[..., 0] * shape[1] + cells[..., 1]) * shape[2] + cells[..., 2]


def _cells_of(numbers: Tensor, shape: Sequence[int]) -> Tensor:
    """Return the cells (..., 3) of running numbers (...)."""
    rows, last = numbers // shape[2], numbers % shape[2]
    return torch.stack([rows // shape[1], rows % shape[1], last], dim=-1)


def _nearest_cells(cells: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """Return, for every cell of the box, the position in ``cells`` of the one nearest to it."""
    number = _cell_numbers(cells, shape)
    position = cells.new_zeros(math.prod(shape)).index_copy(0, number, torch.arange(len(cells), device=cells.device))
    occupied = torch.zeros_like(position, dtype=torch.bool).index_fill(0, number, True)
    return position[nearest_inside(occupied.view(shape)).flatten()]


def _checked_cells(cells: Any, shape: Any) -> Tensor:
    cells = as_tensor(cells, "cells", "integers")
    if cells.is_floating_point() or cells.is_complex() or cells.dtype == torch.bool:
        raise InputTypeError(f"cells must hold integers, got {cells.dtype}")
    check_shape(cells, "cells", ("C", 3))
    if len(shape) != 3 or not all(isinstance(n, int) and 1 <= n <= MAX_RESOLUTION for n in shape):
        raise InputError(f"shape must be three counts from 1 to {MAX_RESOLUTION}, got {shape}")
    cells = cells.long()
    if len(cells) == 0:
        raise InputError("cells must hold at least one cell, got none")
    if int(cells.min()) < 0 or bool((cells >= cells.new_tensor(shape)).any()):
        raise InputError(
            f"cells must lie in the box of {tuple(shape)}, got {cells.amin(0).tolist()} to {cells.amax(0).tolist()}"
        )
    number = _cell_numbers(cells, shape)
    if bool((number[1:] <= number[:-1]).any()):
        raise InputError("cells must be different and in the order of their coordinates")
    return cells
