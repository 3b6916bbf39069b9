"""Refined weights: the solution against scipy on rows built by hand, what refinement may do."""

import numpy as np
import pytest
import torch
from scipy.optimize import nnls as scipy_nnls

import torchreg as tr
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.bones.correspondences import Correspondences
from torchreg.registration.bones.sparse_grid import SparseGrid
from torchreg.registration.bones.weights import WeightsConfig, refine_weights


@pytest.fixture(scope="module")
def scene(bones):
    """Return a bar whose second half turns, its true weights smooth: labels, points, targets and random normals."""

    def make(batch=(), dtype=torch.float64):
        points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        points = points * torch.tensor([3.0, 0.5, 0.4])
        grid = SparseGrid.from_points(points, 10, frame="world")
        labels = (grid.cell_centers()[:, 0] > 1.5).long()
        transforms = torch.stack([torch.eye(4).double(), bones.turned_about([1.5, 0.25, 0.2], [0, 0, 0.8])])
        transforms = se3_exp(0.1 * torch.ones(*batch, 1, 6, dtype=torch.float64)) @ transforms
        share = ((points[:, :1] - 1.0) / 1.0).clamp(0, 1)
        parts = transform_points(transforms, points.expand(*batch, 2, -1, 3))
        targets = (1 - share) * parts[..., 0, :, :] + share * parts[..., 1, :, :]
        normals = torch.nn.functional.normalize(bones.draw(*targets.shape, seed=1), dim=-1)
        model = tr.GridLBS.from_labels(grid.to(dtype), labels, 2, transforms.to(dtype))
        return model, points.to(dtype), targets.to(dtype), normals.to(dtype)

    return make


def reachable(model, steps):
    """Corners (K, B) within so many edges of a label, by walking."""
    found = model.corner_weights().detach() > 0
    for _ in range(steps):
        grown = found.clone()
        for c, d in model.grid.edges().tolist():
            grown[c] |= found[d]
            grown[d] |= found[c]
        found = grown
    return found


def refined(model, points, targets, normals, weights=None, share=0.0, **settings):
    """Weights refined by correspondences of a share of point to point."""
    weights = torch.ones_like(targets[..., 0]) if weights is None else weights
    return refine_weights(model, points, Correspondences(targets, normals, weights, share), WeightsConfig(**settings))


def least_squares_by_hand(model, points, targets, normals, weights, share, config):
    """A and b of the objective over the reachable corners and bones, one entry at a time."""
    grid, labels = model.grid, model.corner_weights().detach()
    where = reachable(model, config.reach).nonzero().tolist()
    column = {tuple(entry): k for k, entry in enumerate(where)}
    rows, right = [], []

    def add(entries, target):
        row = np.zeros(len(column))
        for key, value in entries:
            if key in column:
                row[column[key]] += value
        rows.append(row)
        right.append(target)

    place = grid.locate(points)
    scale = grid.num_cells / float(weights.sum())
    for k in range(len(points)):
        off = (transform_points(model.transforms.detach(), points[k].expand(2, 1, 3))[:, 0] - targets[k]) / grid.spacing
        corners = grid.cell_corners[place.cell[k]].tolist()
        directions = [((1 - share) ** 0.5, normals[k])]
        directions += [(share**0.5, axis) for axis in torch.eye(3, dtype=torch.float64)]
        for factor, direction in directions:
            factor = factor * float(scale * weights[k]) ** 0.5
            entries = [
                ((c, j), factor * float(place.coefficients[k, s] * (off[j] @ direction)))
                for s, c in enumerate(corners)
                for j in range(2)
            ]
            add(entries, 0.0)
    for c, d in grid.edges().tolist():
        for j in range(2):
            add([((c, j), config.smoothness**0.5), ((d, j), -(config.smoothness**0.5))], 0.0)
    for c in range(grid.num_corners):
        add([((c, j), config.normalization**0.5) for j in range(2)], config.normalization**0.5)
        for j in range(2):
            add([((c, j), config.closeness**0.5)], config.closeness**0.5 * float(labels[c, j]))
    return np.array(rows), np.array(right), where


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_the_objective_is_scipys(share, scene):
    model, points, targets, normals = scene()
    weights = torch.rand(200, generator=torch.Generator().manual_seed(2), dtype=torch.float64).clamp_min(0.4) - 0.4
    settings = {"reach": 2, "closeness": 0.05}
    a, b, where = least_squares_by_hand(model, points, targets, normals, weights, share, WeightsConfig(**settings))
    best, residual = scipy_nnls(a, b)
    found = refined(model, points, targets, normals, weights, share, **settings)
    assert found.converged
    assert found.objective == pytest.approx(residual**2, rel=1e-6)
    labels = model.corner_weights().detach()
    start = np.array([float(labels[c, j]) for c, j in where])
    assert found.objective < ((a @ start - b) ** 2).sum()
    assert not bool((found.weights[~reachable(model, 2)] > 0).any())
    raw = torch.zeros_like(found.weights)
    raw[tuple(np.array(where).T)] = torch.from_numpy(best)
    torch.testing.assert_close(found.weights, raw / raw.sum(-1, keepdim=True), atol=5e-3, rtol=0)


def test_poses_count_alike_together(scene):
    model, points, targets, normals = scene((2,))
    found = refined(model, points, targets, normals)
    swapped = tr.GridLBS(model.grid, model.weights, model.transforms.flip(0))
    again = refined(swapped, points, targets.flip(0), normals.flip(0))
    assert again.objective == pytest.approx(found.objective)
    torch.testing.assert_close(again.weights, found.weights, atol=1e-5, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_refinement_fits_better_and_stays_weights(dtype, scene):
    model, points, targets, normals = scene(dtype=dtype)
    before = model.weights.detach().clone()
    found = refined(model, points, targets, normals, share=0.5, smoothness=0.025, closeness=0.01).weights
    assert torch.equal(model.weights, before)
    assert found.dtype == dtype
    assert bool((found >= 0).all())
    torch.testing.assert_close(found.sum(-1), torch.ones(len(found), dtype=dtype))
    after = tr.GridLBS(model.grid, found, model.transforms)
    with torch.no_grad():
        error = [float((space(points) - targets).norm(dim=-1).mean()) for space in (model, after)]
    assert error[1] < 0.5 * error[0]


def test_dropped_matches_do_not_count(scene):
    model, points, targets, normals = scene()
    seen = (points[:, 0] < 1.4).double()
    expected = refined(model, points, targets, normals, seen)
    targets[seen == 0] = torch.nan
    found = refined(model, points, targets, normals, seen)
    assert torch.equal(found.weights, expected.weights)
    nothing = refined(model, points, targets, normals, 0 * seen, smoothness=0.0)
    torch.testing.assert_close(nothing.weights, model.corner_weights().detach(), atol=1e-6, rtol=0)


def test_motions_and_units_change_nothing_else(scene):
    model, points, targets, normals = scene()
    expected = refined(model, points, targets, normals)
    motion = se3_exp(torch.tensor([5.0, -2, 1, 1, 0.5, -1], dtype=torch.float64))
    moved = tr.GridLBS(model.grid, model.weights, motion @ model.transforms)
    turned = refined(moved, points, transform_points(motion, targets), normals @ motion[:3, :3].mT)
    assert turned.objective == pytest.approx(expected.objective)
    torch.testing.assert_close(turned.weights, expected.weights, atol=1e-4, rtol=0)
    scaled = refined(model.rescaled(100.0, torch.zeros(3).double()), 100 * points, 100 * targets, normals)
    assert scaled.objective == pytest.approx(expected.objective)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"closeness": 0.0}, "closeness must be positive"),
        ({"smoothness": -1.0}, "smoothness must be zero or positive"),
        ({"reach": -1}, "reach must be at least 0"),
    ],
)
def test_bad_settings_are_named(change, message):
    with pytest.raises(tr.errors.InputError, match=message):
        WeightsConfig(**change)
