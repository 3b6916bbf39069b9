"""The two stages of an alignment on a small arm: fixed points, convergence, widths, records, limits."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from tests.alignment.made import make_problem
from torchreg.alignment.fit.annealed_em import anneal
from torchreg.alignment.fit.objectives import GaussianPosePrior
from torchreg.alignment.fit.surface_fit import (
    fit_surface,
    pose_covariance,
    residual_noise,
)
from torchreg.solvers.e_step import posterior

DOFS = 8


@pytest.fixture(scope="module")
def skin(links_skin):
    return links_skin


@pytest.fixture(scope="module")
def truths():
    generator = torch.Generator().manual_seed(3)
    poses = 0.5 * torch.randn(3, DOFS, generator=generator).double()
    poses[:, :3] *= 0.2
    return poses


def nudged(skin, poses, size, seed=0):
    step = torch.randn(poses.shape, generator=torch.Generator().manual_seed(seed)).double()
    step[:, :3] *= 0.3
    return skin.shape.retract(poses, size * step)


def on_surface(shape, pose):
    """Return points (N, 3) of the surface and its normals there, by Newton steps from a mesh."""
    points = shape.surface_mesh(pose, spacing=0.006).vertices
    for _ in range(4):
        points = points.detach().requires_grad_()
        distance = shape.distance(points, pose)
        (slope,) = torch.autograd.grad(distance.sum(), points)
        points = points - (distance / slope.square().sum(-1)).unsqueeze(-1) * slope
    return points.detach(), torch.nn.functional.normalize(slope, dim=-1)


def pose_error(skin, poses, truths):
    """Return the largest distance (B,) of a model point from its true place."""
    return (skin(poses) - skin(truths)).norm(dim=-1).amax(-1)


@pytest.mark.parametrize("m_steps", [1, 3])
def test_em_finds_the_pose_of_a_matching_cloud(skin, truths, m_steps):
    problem = make_problem(skin, skin(truths))
    start = nudged(skin, truths, 0.1)
    schedule = tr.SigmaSchedule.geometric(0.03, 0.001, 7)
    found = anneal(problem, start, schedule, em_steps=6, m_steps=m_steps)
    assert float(pose_error(skin, start, truths).min()) > 0.015
    assert float(pose_error(skin, found.pose, truths).max()) < 2e-5
    torch.testing.assert_close(found.sigma, torch.full_like(found.sigma, 0.001))


def test_a_wide_kernel_shrinks_the_model_and_debiasing_takes_that_back(skin, truths):
    """At the true pose a wide kernel bends the arm; what the model does to itself shows by how much."""
    wide = tr.SigmaSchedule.constant(0.03, 1)
    errors = []
    for share in (0.0, 0.5, 1.0):
        problem = make_problem(skin, skin(truths), debias=share)
        found = anneal(problem, truths, wide, em_steps=4, m_steps=1)
        errors.append(float(pose_error(skin, found.pose, truths).max()))
    assert errors[0] > 1.5 * errors[1]
    assert errors[2] < 1e-6


def test_an_adaptive_sigma_is_the_root_mean_square_residual(skin, truths):
    """Every estimate is sqrt(sum alpha r^2 / 3 sum alpha) of the points just moved, inside the schedule's range."""
    problem, records = make_problem(skin, skin(truths)[:1], debias=0.8), []
    start = nudged(skin, truths, 0.1)[:1]
    schedule = tr.SigmaSchedule.adaptive(0.03, 0.002, 8)
    found = anneal(problem, start, schedule, em_steps=1, m_steps=1, on_step=records.append)
    sigmas = torch.cat([record.sigma for record in records])
    assert float(sigmas[0]) == 0.03
    assert float(sigmas.min()) >= 0.002
    alpha = posterior(skin(start), problem.data, torch.tensor([0.03]).double())
    squares = (skin(records[0].pose).unsqueeze(-2) - problem.data.unsqueeze(-3)).square().sum(-1)
    expected = ((alpha * squares).sum() / (3 * alpha.sum())).sqrt()
    torch.testing.assert_close(sigmas[1], expected)
    assert float(pose_error(skin, found.pose, truths[:1])) < 0.004
    assert float(found.sigma) >= 0.002


@pytest.mark.parametrize(("correspondence", "least"), [("softassign", 3), ("closest", 2)])
def test_rivals_of_the_e_step_find_the_pose(skin, truths, correspondence, least):
    """Of three arms; closest points may leave one turned about its own axis, where it is nearly round."""
    problem = make_problem(skin, skin(truths), correspondence=correspondence, debias=0.8)
    start, schedule = nudged(skin, truths, 0.05), tr.SigmaSchedule.geometric(0.03, 0.004, 5)
    found = anneal(problem, start, schedule, em_steps=6, m_steps=1)
    assert int((pose_error(skin, found.pose, truths) < 1e-3).sum()) >= least
    plain = anneal(replace(problem, correspondence="em"), start, schedule, em_steps=6, m_steps=1)
    assert not torch.allclose(found.pose, plain.pose, rtol=0, atol=1e-9)


def test_the_volume_constant_gives_outliers_less_room(skin, truths):
    """Where the kernels fill the volume, eq. 18 makes c smaller, so data weigh more; narrow kernels do not notice."""
    start = nudged(skin, truths, 0.05)
    problem = make_problem(skin, skin(truths))
    for sigma, alike in ((0.04, False), (5e-4, True)):
        once = tr.SigmaSchedule.constant(sigma, 1)
        limit, volume = (
            anneal(replace(problem, outlier=kind), start, once, em_steps=1, m_steps=1).pose
            for kind in ("limit", "volume")
        )
        assert torch.allclose(limit, volume, rtol=0, atol=1e-5) is alike


def test_padding_is_never_looked_at(skin, truths):
    start = nudged(skin, truths, 0.05)
    data = skin(truths)
    padded = torch.cat([data, torch.full((3, 50, 3), 0.03).double()], dim=1)
    valid = torch.arange(350).expand(3, 350) < 300
    schedule = tr.SigmaSchedule.geometric(0.03, 0.005, 3)
    for outlier in ("limit", "volume"):
        plain = make_problem(skin, data, outlier=outlier)
        masked = replace(make_problem(skin, padded, outlier=outlier), valid=valid)
        poses = [anneal(each, start, schedule, em_steps=2, m_steps=1).pose for each in (plain, masked)]
        torch.testing.assert_close(poses[0], poses[1])
        fitted = [fit_surface(each, poses[0], steps=2).pose for each in (plain, masked)]
        torch.testing.assert_close(fitted[0], fitted[1])
        torch.testing.assert_close(residual_noise(plain, truths), residual_noise(masked, truths))


def test_surface_fit_finds_the_pose_under_outliers(skin, truths):
    data = skin(truths)
    generator = torch.Generator().manual_seed(5)
    clutter = 0.4 * (torch.rand(3, 100, 3, generator=generator).double() - 0.5) + data.mean(1, keepdim=True)
    problem, records = make_problem(skin, torch.cat([data, clutter], dim=1)), []
    start = nudged(skin, truths, 0.03)
    found = fit_surface(problem, start, steps=5, on_step=records.append)
    # The skin slides on the surface where it bends, and points of the skin lie up to a millimeter off the solids.
    assert float(pose_error(skin, found.pose, truths).max()) < 0.002
    steps = [(record.stage, record.step, record.num_steps) for record in records]
    assert steps == [("surface", step, 3) for step in range(3)]
    widths = torch.stack([record.sigma for record in records])
    assert bool((widths[1:] <= widths[:-1]).all())
    torch.testing.assert_close(found.sigma, widths[-1])


@pytest.mark.parametrize("noise", [0.001, 0.002])
def test_noise_is_estimated_from_inliers_only(skin, truths, noise):
    points, normals = on_surface(skin.shape, truths[0])
    generator = torch.Generator().manual_seed(6)
    measured = points + noise * torch.randn(len(points), 1, generator=generator).double() * normals
    clutter = points[:50] + torch.tensor([0.0, 0.0, 0.5])
    found = residual_noise(make_problem(skin, torch.cat([measured, clutter]).unsqueeze(0)), truths[:1])
    assert len(points) > 1000
    assert float(found) == pytest.approx(noise, rel=0.12)


def test_limits_and_priors_hold(skin, truths):
    """A joint whose truth lies beyond its limit ends at it; a strong prior keeps a joint where it is."""
    upper = skin.shape.upper.clone()
    upper[6] = 0.1
    truth = truths[:1].clone()
    truth[:, 6:] = torch.tensor([0.4, 0.3])
    start = truth.clone()
    start[:, 6:] = 0.0
    problem = make_problem(skin, skin(truth), upper=upper)
    found = anneal(problem, start, tr.SigmaSchedule.geometric(0.03, 0.005, 4), em_steps=3, m_steps=2).pose
    found = fit_surface(problem, found, steps=4).pose
    assert float(found[0, 6]) == pytest.approx(0.1, abs=1e-9)
    assert float(found[0, 7]) > 0.15
    precision = torch.zeros(DOFS).double()
    precision[7] = 1e9
    held = make_problem(skin, skin(truth), prior=GaussianPosePrior(start, precision))
    found = fit_surface(held, start, steps=4).pose
    assert float(found[0, 7]) == pytest.approx(0.0, abs=1e-3)


def test_covariance_of_linear_problems_is_exact():
    generator = torch.Generator().manual_seed(2)
    jacobian = torch.randn(40, 5, generator=generator, dtype=torch.float64)
    jacobian[:, 4] = 0
    weights = torch.rand(40, generator=generator, dtype=torch.float64)
    precision = torch.tensor([0.0, 1.0, 0.0, 0.0, 4.0], dtype=torch.float64)
    noise = torch.tensor(0.1, dtype=torch.float64)
    covariance = pose_covariance(jacobian, weights, noise, precision)
    expected = torch.linalg.inv(jacobian.T @ weights.diag() @ jacobian / 0.01 + precision.diag())
    torch.testing.assert_close(covariance, expected)
    # What no datum says is what the prior says.
    assert covariance[4, 4].sqrt() == pytest.approx(0.5)
    # A batch gives what its problems give alone.
    other = torch.randn(40, 5, generator=generator, dtype=torch.float64)
    both = pose_covariance(
        torch.stack([jacobian, other]), weights.expand(2, -1), noise.expand(2), (precision + 1).expand(2, -1)
    )
    for row, alone in zip(both, (jacobian, other), strict=True):
        torch.testing.assert_close(row, pose_covariance(alone, weights, noise, precision + 1))


def test_noise_stays_within_a_range_of_the_size(skin, truths):
    """Without inliers the noise is the largest that a fit uses; exact data do not make the kernel vanish."""
    size = make_problem(skin, skin(truths)).size
    lost = make_problem(skin, skin(truths) + 10.0)
    torch.testing.assert_close(residual_noise(lost, truths), torch.full((3,), 0.02 * size / 2.5).double())
    exact = on_surface(skin.shape, truths[0])[0].unsqueeze(0)
    found = residual_noise(make_problem(skin, exact), truths[:1])
    torch.testing.assert_close(found, torch.full((1,), 0.003 * size / 2.5).double())


def test_a_prior_weighs_more_where_more_model_points_share_a_datum(skin, truths):
    """With every model point twice, twice as many share a datum under a wide kernel: joints stay nearer to the mean."""
    precision = torch.zeros(DOFS).double()
    precision[6:] = 2.0
    start, once = nudged(skin, truths, 0.1), tr.SigmaSchedule.constant(0.03, 1)
    doubled = tr.LinearBlendSkin(skin.shape, skin.points.repeat(2, 1), skin.weights.repeat(2, 1), skin.reference_pose)
    problem = make_problem(skin, skin(truths), prior=GaussianPosePrior(start, precision))
    plain, twice = (
        (anneal(replace(problem, skin=each), start, once, em_steps=3, m_steps=1).pose - start)[:, 6:].abs().sum()
        for each in (skin, doubled)
    )
    assert float(twice) < 0.95 * float(plain)
