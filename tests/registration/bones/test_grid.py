"""Sparse grids: cells, corners and neighbors against loops, trilinear values, and what turning and scaling leave."""

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import RegularGridInterpolator

import torchreg as tr
from tests.geometry.draws import D, rand, seeded
from torchreg.geometry.rotation import so3_exp
from torchreg.registration.bones.sparse_grid import SparseGrid

InputError, InputTypeError = tr.errors.InputError, tr.errors.InputTypeError


def surface(count=800, seed=0, dtype=D):
    """A bent, uneven tube: principal axes and their signs are clear."""
    along, around = rand(2, count, seed=seed)
    angle, radius = 2 * math.pi * around, 0.1 + 0.1 * along
    points = [2 * along**2, radius * angle.cos() + 0.4 * along**2, 0.6 * radius * angle.sin() + 0.1 * along]
    return torch.stack(points, dim=-1).to(dtype)


def blocks(*cells, spacing=1.0):
    cells = torch.tensor(sorted(cells))
    shape = tuple(int(n) + 1 for n in cells.amax(0))
    origin, axes = torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    return SparseGrid.from_cells(cells, shape, origin, axes, spacing)


def test_cells_are_those_that_hold_points():
    points = surface()
    grid = SparseGrid.from_points(points, 20, frame="world")
    low, high = points.amin(0), points.amax(0)
    assert grid.spacing == pytest.approx(float((high - low).max()) / 20)
    held = {tuple(c) for c in grid.coordinates(points).floor().clamp(min=0).long().clamp(max=19).tolist()}
    assert {tuple(c) for c in grid.cells.tolist()} == held
    assert grid.shape[0] == 20
    assert grid.num_cells == len(grid.cells) == len(grid.cell_centers())


def test_corners_are_shared():
    grid = SparseGrid.from_points(surface(), 6)
    table = {tuple(c): k for k, c in enumerate(grid.corners.tolist())}
    assert len(table) == grid.num_corners
    offsets = [(n >> 2 & 1, n >> 1 & 1, n & 1) for n in range(8)]
    for cell, corners in zip(grid.cells.tolist(), grid.cell_corners.tolist(), strict=True):
        assert corners == [table[tuple(np.add(cell, offset))] for offset in offsets]
    assert torch.equal(grid.cell_corners.unique(), torch.arange(grid.num_corners))
    expected = grid.origin + grid.spacing * grid.corners.double() @ grid.axes.mT
    torch.testing.assert_close(grid.corner_points(), expected)
    torch.testing.assert_close(grid.cell_centers(), expected[grid.cell_corners].mean(1))
    single = grid.to(torch.float32)
    assert torch.equal(single.cells, grid.cells)
    torch.testing.assert_close(single.corner_points(), expected.float())
    two = blocks((0, 0, 0), (0, 0, 1))
    shares = two.spread_to_corners(torch.eye(2, dtype=D))[:, 1]
    torch.testing.assert_close(shares, 0.5 * two.corners[:, 2].double())


def test_values_are_trilinear():
    points = surface(300)
    grid = SparseGrid.from_points(points, 9, frame="world")
    size = [n + 1 for n in grid.shape]
    dense = np.random.default_rng(0).normal(size=[*size, 2])
    values = torch.from_numpy(dense[tuple(grid.corners.numpy().T)])
    oracle = RegularGridInterpolator([np.arange(n) for n in size], dense)
    expected = oracle(grid.coordinates(points).numpy().clip(0, np.array(grid.shape)))
    found = grid.interpolate(values, points)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-12)
    torch.testing.assert_close(grid.interpolate(values, points.reshape(2, 50, 3, 3)).reshape(300, 2), found)
    location = grid.locate(points)
    assert bool((location.coefficients >= 0).all())
    torch.testing.assert_close(location.coefficients.sum(-1), torch.ones(300, dtype=D))
    corners = grid.corner_points()[grid.cell_corners[location.cell]]
    torch.testing.assert_close((location.coefficients.unsqueeze(-1) * corners).sum(1), points)
    assert torch.autograd.gradcheck(grid.interpolate, (values.requires_grad_(), points[:4].clone().requires_grad_()))


def test_points_outside_take_the_nearest_cell():
    grid = blocks((0, 0, 0), (4, 0, 0))
    points = torch.tensor([[1.4, 0.5, 0.5], [3.6, 0.5, 0.5], [9.0, 7.0, -3.0], [-5.0, 0.2, 0.5]], dtype=D)
    location = grid.locate(points)
    assert location.cell.tolist() == [0, 1, 1, 0]
    nearest = (location.coefficients.unsqueeze(-1) * grid.corner_points()[grid.cell_corners[location.cell]]).sum(1)
    box = torch.tensor([[1.0, 0.5, 0.5], [4.0, 0.5, 0.5], [5.0, 1.0, 0.0], [0.0, 0.2, 0.5]], dtype=D)
    torch.testing.assert_close(nearest, box)
    some = SparseGrid.from_points(surface(), 15)
    outside = some.origin + 3 * rand(200, 3)
    # The distance between middles of cells is the least there is.
    middle = torch.minimum(some.coordinates(outside).floor().clamp(min=0), torch.tensor(some.shape) - 1.0)
    far = torch.cdist(middle, some.cells.double())
    torch.testing.assert_close(far.gather(1, some.locate(outside).cell[:, None])[:, 0], far.amin(1))


@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e3])
def test_turning_and_scaling_change_nothing_else(factor):
    points = surface()
    grid, turn = SparseGrid.from_points(points, 25), so3_exp(torch.tensor([0.5, -1.0, 2.0], dtype=D))
    shift = factor * torch.tensor([3.0, -2.0, 1.0], dtype=D)
    moved = factor * points @ turn.mT + shift
    other = SparseGrid.from_points(moved, 25)
    assert other.shape == grid.shape
    assert torch.equal(other.cells, grid.cells)
    assert other.spacing == pytest.approx(factor * grid.spacing)
    torch.testing.assert_close(other.corner_points(), factor * grid.corner_points() @ turn.mT + shift)
    assert torch.equal(other.locate(moved).cell, grid.locate(points).cell)
    mixed = torch.cat([points, points[:100]])[torch.randperm(900, generator=seeded())]
    cells = [SparseGrid.from_points(given, 25, frame="world").cells for given in (mixed, points)]
    assert torch.equal(*cells)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_flat_and_straight_scans(dtype):
    plane = surface(dtype=dtype) * torch.tensor([1.0, 1.0, 0.0], dtype=dtype)
    grid = SparseGrid.from_points(plane, 10)
    assert sorted(grid.shape)[0] == 1
    # Amid the cells, so that rounding takes no point across a side.
    flat = (grid.coordinates(plane) - 0.5).abs().amin(-1)
    assert float(flat.max()) < 1e-5
    line = SparseGrid.from_points(plane * torch.tensor([1.0, 0.0, 0.0], dtype=dtype), 10)
    assert line.shape == (10, 1, 1)
    assert line.origin.dtype == dtype
    two = SparseGrid.from_points(torch.tensor([[0.0, 0, 0], [1.0, 0, 0]], dtype=dtype), 1)
    assert two.num_cells == 1


def test_edges_are_those_of_the_cells_and_neighbors_share_a_side():
    grid = blocks((0, 0, 0), (0, 0, 1), (2, 0, 0))
    assert len(grid.edges()) == 20 + 12
    steps = grid.corners[grid.edges()].diff(dim=1)[:, 0]
    assert bool((steps.sum(-1) == 1).all() & (steps >= 0).all())
    grid = SparseGrid.from_points(surface(), 14)
    apart = torch.cdist(grid.cells.double(), grid.cells.double(), p=1)
    assert grid.neighbors(-1).tolist() == (apart == 1).triu().nonzero().tolist()


def test_gaps_are_bridged_by_the_nearest_cells_and_links_reach_however_far():
    grid = blocks((0, 0, 0), (1, 0, 0), (2, 1, 0), (5, 0, 0), (5, 1, 0))
    assert grid.neighbors(-1).tolist() == [[0, 1], [3, 4]]
    assert grid.regions(-1).unique().tolist() == [0, 1, 2]
    assert grid.neighbors().tolist() == [[0, 1], [1, 2], [3, 4]]
    assert grid.neighbors(2).tolist() == [[0, 1], [1, 2], [2, 4], [3, 4]]
    assert len(grid.regions(2).unique()) == 1
    grid = blocks((0, 0, 0), (1, 0, 0), (1, 1, 0), (7, 0, 0), (7, 1, 0), (9, 0, 0))
    assert sorted(grid.links().tolist()) == [[1, 3], [2, 4], [3, 5]]
    assert blocks((0, 0, 0), (1, 1, 1)).links().shape == (0, 2)


def of_cells(cells=((0, 0, 0),), shape=(1, 1, 1), axes=None, spacing=1.0):
    axes = torch.eye(3) if axes is None else axes
    return SparseGrid.from_cells(torch.as_tensor(cells).reshape(-1, 3), shape, torch.zeros(3), axes, spacing)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: SparseGrid.from_points(torch.zeros(5, 3)), InputError, "different places"),
        (lambda: SparseGrid.from_points(torch.zeros(0, 3)), InputError, "at least 1 point"),
        (lambda: SparseGrid.from_points(torch.full((5, 3), torch.nan)), InputError, "points must be finite"),
        (lambda: SparseGrid.from_points(surface(), 0), InputError, "resolution must be at least 1"),
        (lambda: SparseGrid.from_points(surface(), 300), InputError, "resolution must be at most 256"),
        (lambda: SparseGrid.from_points(surface(), frame="camera"), InputError, "frame must be one of"),
        (lambda: blocks((0, 0, 0), (0, 0, 0)), InputError, "must be different"),
        (lambda: of_cells(torch.zeros(0, 3).long()), InputError, "at least one"),
        (lambda: of_cells([[0, 0, 2]]), InputError, "lie in the box"),
        (lambda: of_cells(shape=(1, 0, 1)), InputError, "three counts"),
        (lambda: of_cells(axes=-torch.eye(3)), InputError, "a rotation"),
        (lambda: of_cells(spacing=0.0), InputError, "spacing must"),
        (lambda: of_cells([[0.0, 0.0, 0.0]]), InputTypeError, "cells must hold integers"),
    ],
)
def test_bad_input_is_named(call, error, words):
    with pytest.raises(error, match=words):
        call()
