"""Refined weights: the solution against scipy on rows built by hand, what refinement may do."""

import pytest
import torch

import torchreg as tr
from tests.geometry.draws import D, rand, randn
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.bones.correspondences import Correspondences
from torchreg.registration.bones.sparse_grid import SparseGrid
from torchreg.registration.bones.weights import WeightsConfig, refine_weights


@pytest.fixture(scope="module")
def scene(bones):
    """A bar whose second half turns, its true weights smooth: labels, points, targets and random normals."""

    def make(dtype=D, poses=1):
        points = rand(200, 3) * torch.tensor([3.0, 0.5, 0.4])
        grid = SparseGrid.from_points(points, 10, frame="world")
        labels = (grid.cell_centers()[:, 0] > 1.5).long()
        turns = [bones.turned_about([1.5, 0.25, 0.2], [0, 0.1 * pose, 0.8]) for pose in range(poses)]
        transforms = torch.stack([torch.stack([torch.eye(4).double(), turn]) for turn in turns])
        transforms = se3_exp(0.1 * torch.ones(6, dtype=D)) @ transforms
        share = (points[:, :1] - 1.0).clamp(0, 1)
        parts = transform_points(transforms, points)
        targets = (1 - share) * parts[:, 0] + share * parts[:, 1]
        normals = torch.nn.functional.normalize(randn(*targets.shape, seed=1), dim=-1)
        transforms, targets, normals = (v if poses > 1 else v[0] for v in (transforms, targets, normals))
        model = tr.GridLBS.from_labels(grid.to(dtype), labels, 2, transforms.to(dtype))
        return model, points.to(dtype), targets.to(dtype), normals.to(dtype)

    return make


def refined(model, points, targets, normals, weights=None, share=0.0, **settings):
    """Weights refined by correspondences of a share of point to point."""
    weights = torch.ones_like(targets[..., 0]) if weights is None else weights
    return refine_weights(model, points, Correspondences(targets, normals, weights, share), WeightsConfig(**settings))


@pytest.mark.parametrize(("share", "poses"), [(0.0, 1), (0.3, 1), (0.3, 2)])
def test_the_registration_energy_is_least_over_reachable_corners(share, poses, scene):
    model, points, targets, normals = scene(poses=poses)
    kept, labels = (rand(*targets.shape[:-1], seed=2) - 0.4).clamp_min(0), model.corner_weights().detach()
    # With rows that sum to one, so that raw and normalized weights agree.
    found = refined(model, points, targets, normals, kept, share, reach=2, closeness=0.05, normalization=1e4)
    assert found.converged
    where = labels > 0
    for _ in range(2):
        grown = where.clone()
        for c, d in (*model.grid.edges().tolist(), *model.grid.edges().flip(1).tolist()):
            grown[c] |= where[d]
        where = grown
    assert not bool((found.weights[~where] > 0).any())
    terms = {"joint": 0.0, "smoothness": WeightsConfig().smoothness, "norm": 1e4, "discontinuity": 0.05}
    energy = tr.RegistrationEnergy(model, label_weights=labels, point_to_point=share, **terms)

    def total(weights):
        return torch.func.functional_call(energy, {"model.weights": weights}, (points, targets, normals, kept)).mean()

    slope = torch.func.grad(total)(found.weights).detach()
    # Along the simplex no move of weight from one bone to another lowers the energy.
    slope = torch.where(where, slope, torch.inf) - torch.where(found.weights > 1e-6, slope, -torch.inf).amax(1, True)
    assert float(slope.amin()) > -0.02
    least, start = (total(weights).item() for weights in (found.weights, labels))
    assert found.objective == pytest.approx(least, rel=1e-3)
    assert least < start


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
    kept = (points[:, 0] < 1.4).double()
    expected = refined(model, points, targets, normals, kept)
    targets[kept == 0] = torch.nan
    assert torch.equal(refined(model, points, targets, normals, kept).weights, expected.weights)
    nothing = refined(model, points, targets, normals, 0 * kept, smoothness=0.0)
    torch.testing.assert_close(nothing.weights, model.corner_weights().detach(), atol=1e-6, rtol=0)


def test_motions_and_units_change_nothing_else(scene):
    model, points, targets, normals = scene()
    expected = refined(model, points, targets, normals)
    motion = se3_exp(torch.tensor([5.0, -2, 1, 1, 0.5, -1], dtype=D))
    moved = tr.GridLBS(model.grid, model.weights, motion @ model.transforms)
    turned = refined(moved, points, transform_points(motion, targets), normals @ motion[:3, :3].mT)
    torch.testing.assert_close(turned.weights, expected.weights, atol=1e-4, rtol=0)
    scaled = refined(model.rescaled(100.0, torch.zeros(3).double()), 100 * points, 100 * targets, normals)
    assert [turned.objective, scaled.objective] == pytest.approx([expected.objective] * 2)


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
