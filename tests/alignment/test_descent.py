"""The two stages of an alignment on a small arm: fixed points, convergence, widths, noise, limits, priors."""

import pytest
import torch

import torchreg as tr
from torchreg.alignment.fit.surface_fit import pose_covariance
from torchreg.solvers.e_step import posterior


@pytest.fixture(scope="module")
def truths():
    poses = 0.5 * torch.randn(3, 8, generator=torch.Generator().manual_seed(3)).double()
    poses[:, :3] *= 0.2
    return poses


@pytest.fixture(scope="module")
def data(links_skin, truths):
    return links_skin(truths)


@pytest.fixture(scope="module")
def descend(links, links_skin):
    """A function that aligns the arm without prior and without debiasing; by default the EM alone."""

    def aligned(data, start, schedule=None, skin=links_skin, mask=None, **options):
        options = {"search": "never", "prior_std": None, "pose_atol": 1e-6, "debias": 0.0, "surface_steps": 0} | options
        config = tr.AlignConfig(schedule=schedule, **options)
        return tr.align(links, data, start, mask=mask, model_points=skin, config=config)

    return aligned


def nudged(shape, poses, size):
    step = torch.randn(poses.shape, generator=torch.Generator().manual_seed(0)).double()
    step[:, :3] *= 0.3
    return shape.retract(poses, size * step)


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
def test_em_finds_the_pose_of_a_matching_cloud(links, links_skin, truths, data, descend, m_steps):
    start = nudged(links, truths, 0.1)
    found = descend(data, start, tr.SigmaSchedule.geometric(0.03, 0.001, 7), em_steps=6, m_steps=m_steps)
    assert float(pose_error(links_skin, start, truths).min()) > 0.015
    assert float(pose_error(links_skin, found.pose, truths).max()) < 2e-5
    torch.testing.assert_close(found.sigma, torch.full_like(found.sigma, 0.001))


def test_a_wide_kernel_shrinks_the_model_and_debiasing_takes_that_back(links_skin, truths, data, descend):
    """At the true pose a wide kernel bends the arm; what the model does to itself shows by how much."""
    wide = tr.SigmaSchedule.constant(0.03, 1)
    none, half, whole = (
        float(pose_error(links_skin, descend(data, truths, wide, em_steps=4, debias=share).pose, truths).max())
        for share in (0.0, 0.5, 1.0)
    )
    assert none > 1.5 * half
    assert whole < 1e-6


def test_an_adaptive_sigma_is_the_root_mean_square_residual(links, links_skin, truths, data, descend):
    """Every estimate is sqrt(sum alpha r^2 / 3 sum alpha) of the points just moved, inside the schedule's range."""
    start = nudged(links, truths, 0.1)[:1]
    schedule = tr.SigmaSchedule.adaptive(0.03, 0.002, 8)
    found = descend(data[:1], start, schedule, em_steps=1, debias=0.8)
    sigmas = torch.cat([record.sigma for record in found.history])
    assert float(sigmas[0]) == 0.03
    assert float(sigmas.min()) >= 0.002
    alpha = posterior(links_skin(start), data[:1], torch.tensor([0.03]).double())
    squares = (links_skin(found.history[0].pose).unsqueeze(-2) - data[:1].unsqueeze(-3)).square().sum(-1)
    torch.testing.assert_close(sigmas[1], ((alpha * squares).sum() / (3 * alpha.sum())).sqrt())
    assert float(pose_error(links_skin, found.pose, truths[:1])) < 0.004


@pytest.mark.parametrize(("correspondence", "least"), [("softassign", 3), ("closest", 2)])
def test_rivals_of_the_e_step_find_the_pose(links, links_skin, truths, data, descend, correspondence, least):
    """Of three arms; closest points may leave one turned about its own axis, where it is nearly round."""
    start, schedule = nudged(links, truths, 0.05), tr.SigmaSchedule.geometric(0.03, 0.004, 5)
    found, plain = (
        descend(data, start, schedule, em_steps=6, debias=0.8, correspondence=rule) for rule in (correspondence, "em")
    )
    assert int((pose_error(links_skin, found.pose, truths) < 1e-3).sum()) >= least
    assert not torch.allclose(found.pose, plain.pose, rtol=0, atol=1e-9)


def test_the_volume_constant_gives_outliers_less_room(links, truths, data, descend):
    """Where kernels fill the volume, eq. 18 makes c smaller; narrow kernels and what padding holds change nothing."""
    start = nudged(links, truths, 0.05)
    padded, mask = torch.cat([data, data + 3.0], dim=1), torch.arange(600).expand(3, 600) < 300
    for sigma, alike in ((0.04, False), (5e-4, True)):
        once = tr.SigmaSchedule.constant(sigma, 1)
        limit, volume = (descend(data, start, once, em_steps=1, outlier=kind).pose for kind in ("limit", "volume"))
        assert torch.allclose(limit, volume, rtol=0, atol=1e-5) is alike
        masked = descend(padded, start, once, em_steps=1, outlier="volume", mask=mask).pose
        torch.testing.assert_close(masked, volume)


def test_the_surface_fit_finds_the_pose_under_outliers(links, links_skin, truths, data, descend):
    clutter = 0.4 * (torch.rand(3, 100, 3, generator=torch.Generator().manual_seed(5)).double() - 0.5)
    cluttered, start = torch.cat([data, clutter + data.mean(1, keepdim=True)], dim=1), nudged(links, truths, 0.03)
    # One EM step with a wide kernel leads away; the surface fit makes up for it.
    found = descend(cluttered, start, tr.SigmaSchedule.constant(0.03, 1), em_steps=1, surface_steps=5)
    # The skin slides on the surface where it bends, and points of the skin lie up to a millimeter off the solids.
    assert float(pose_error(links_skin, found.pose, truths).max()) < 0.002
    records = [record for record in found.history if record.stage == "surface"]
    assert [(record.step, record.num_steps) for record in records] == [(step, 3) for step in range(3)]
    widths = torch.stack([record.sigma for record in records])
    assert bool((widths[1:] <= widths[:-1]).all())


@pytest.mark.parametrize(("noise", "shift"), [(0.001, 0.0), (0.002, 0.0), (0.0, 0.0), (0.0, 10.0)])
def test_the_last_kernel_is_as_wide_as_the_noise_of_the_inliers(links, links_skin, truths, descend, noise, shift):
    """2.5 standard deviations, within a range of the size: of exact data it does not vanish, without inliers ends."""
    points, normals = on_surface(links, truths[0])
    generator = torch.Generator().manual_seed(6)
    measured = points + noise * torch.randn(len(points), 1, generator=generator).double() * normals
    measured = torch.cat([measured, points[:50] + torch.tensor([0.0, 0.0, 0.5])]) + shift
    narrow = tr.SigmaSchedule.constant(5e-4, 1)
    width = descend(measured, truths[0], narrow, em_steps=1, surface_steps=3).history[-1].sigma
    size = float((links_skin.points.amax(0) - links_skin.points.amin(0)).norm())
    assert len(points) > 1000
    if noise > 0:
        assert float(width) == pytest.approx(2.5 * noise, rel=0.12)
    else:
        torch.testing.assert_close(width, torch.full_like(width, (0.003 if shift == 0 else 0.02) * size))


def test_a_joint_whose_truth_lies_beyond_its_limit_ends_at_it(links, links_skin, descend):
    truth = torch.tensor([0.0, 0, 0, 0, 0, 0, 2.3, 0.3]).double()
    start = torch.tensor([0.0, 0, 0, 0, 0, 0, 1.9, 0.0]).double()
    found = descend(links_skin(truth), start, tr.SigmaSchedule.geometric(0.03, 0.005, 4), em_steps=3, surface_steps=4)
    assert float(found.pose[6]) == pytest.approx(2.0, abs=1e-9)
    assert float(found.pose[7]) > 0.15


def test_a_prior_weighs_more_where_more_model_points_share_a_datum(links, links_skin, truths, data, descend):
    """With every model point twice, twice as many share a datum under a wide kernel: joints stay nearer to the mean."""
    start, once = nudged(links, truths, 0.1), tr.SigmaSchedule.constant(0.03, 1)
    twice = tr.LinearBlendSkin(
        links, links_skin.points.repeat(2, 1), links_skin.weights.repeat(2, 1), links_skin.reference_pose
    )
    plain, doubled = (
        (descend(data, start, once, skin=skin, em_steps=3, prior_std=0.7).pose - start)[:, 6:].abs().sum()
        for skin in (links_skin, twice)
    )
    assert float(doubled) < 0.95 * float(plain)


def test_covariance_of_linear_problems_is_exact():
    generator = torch.Generator().manual_seed(2)
    jacobian = torch.randn(2, 40, 5, generator=generator, dtype=torch.float64)
    jacobian[0, :, 4] = 0
    weights = torch.rand(2, 40, generator=generator, dtype=torch.float64)
    precision = torch.tensor([[0.0, 1.0, 0.0, 0.0, 4.0], [1.0, 2.0, 1.0, 1.0, 5.0]], dtype=torch.float64)
    noise = torch.tensor([0.1, 0.2], dtype=torch.float64)
    information = jacobian.mT @ (weights.unsqueeze(-1) * jacobian) / noise[:, None, None].square()
    covariance = pose_covariance(jacobian, weights, noise, precision)
    torch.testing.assert_close(covariance, torch.linalg.inv(information + torch.diag_embed(precision)))
    # What no datum says is what the prior says.
    assert covariance[0, 4, 4].sqrt() == pytest.approx(0.5)
