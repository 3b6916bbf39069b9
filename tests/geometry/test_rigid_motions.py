"""Rigid motions: the group, fits to points, and fits of groups from their moments."""

import math

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from torch.func import jacfwd, jacrev

from torchreg.geometry.rigid import adjoint, fit_rigid, invert_rigid, se3_exp, se3_log, transform_points
from torchreg.geometry.rigid_moments import least_cost, rigid_moments

# torch's own forward mode compiles its decompositions with a deprecated call on first use.
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")

D = torch.float64


def random_twists(count, seed=0):
    return torch.randn(count, 6, generator=torch.Generator().manual_seed(seed), dtype=D)


def random_points(*shape, seed=0):
    return torch.randn(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=D)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 5e-3, 0.011, 1.0, math.pi, 5.0])
def test_se3_exp_is_the_matrix_exponential(angle):
    axis = np.array([2.0, -1.0, 2.0]) / 3
    generator = np.zeros((4, 4))
    w = angle * axis
    generator[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
    generator[:3, 3] = [0.3, -0.2, 0.5]
    twist = torch.tensor([0.3, -0.2, 0.5, *w], dtype=D)
    np.testing.assert_allclose(se3_exp(twist), expm(generator), atol=1e-14)
    np.testing.assert_allclose(se3_exp(twist.float()), expm(generator), atol=2e-6)


def test_se3_exp_differentiates_at_zero_in_every_mode():
    zero = torch.zeros(6, dtype=D)
    forward, reverse = jacfwd(se3_exp)(zero), jacrev(se3_exp)(zero)
    torch.testing.assert_close(forward, reverse)
    assert torch.equal(forward[:3, 3, :3], torch.eye(3, dtype=D))
    assert torch.equal(forward[1, 2], -forward[2, 1])
    for twist in (zero, random_twists(1)[0]):
        assert torch.autograd.gradcheck(se3_exp, twist.clone().requires_grad_(), check_forward_ad=True)


def test_transforming_points_is_homogeneous_multiplication():
    matrices, points = se3_exp(random_twists(2)), random_points(2, 5)
    homogeneous = torch.cat([points, torch.ones(2, 5, 1, dtype=D)], dim=-1)
    expected = torch.einsum("bij,bnj->bni", matrices, homogeneous)[..., :3]
    torch.testing.assert_close(transform_points(matrices, points), expected)
    torch.testing.assert_close(transform_points(matrices, points[0])[1], transform_points(matrices[1], points[0]))
    torch.testing.assert_close(transform_points(invert_rigid(matrices), transform_points(matrices, points)), points)


def test_fit_agrees_with_scipy_under_noise_and_weights():
    source, target = random_points(20), random_points(20, seed=1)
    weights = torch.rand(20, generator=torch.Generator().manual_seed(2), dtype=D)
    share = (weights / weights.sum()).unsqueeze(-1)
    centers = (share * source).sum(0), (share * target).sum(0)
    expected, _ = Rotation.align_vectors((target - centers[1]).numpy(), (source - centers[0]).numpy(), weights.numpy())
    fitted = fit_rigid(source, target, weights)
    np.testing.assert_allclose(fitted[:3, :3], expected.as_matrix(), atol=1e-10)
    torch.testing.assert_close(transform_points(fitted, centers[0][None])[0], centers[1])


def test_fit_of_points_in_a_plane_and_of_one_point_stays_rigid():
    matrix = se3_exp(random_twists(1)[0])
    flat = random_points(8) * torch.tensor([1.0, 1.0, 0.0], dtype=D)
    torch.testing.assert_close(fit_rigid(flat, transform_points(matrix, flat)), matrix, atol=1e-12, rtol=0)
    one = fit_rigid(flat[:1], flat[:1] + 2)
    assert torch.det(one[:3, :3]) == pytest.approx(1.0)
    torch.testing.assert_close(transform_points(one, flat[:1]), flat[:1] + 2)


def test_a_zero_weight_removes_a_pair_and_no_weight_at_all_is_finite():
    source, target = random_points(6), random_points(6, seed=1)
    weights = torch.tensor([1.0, 1, 1, 1, 0, 0], dtype=D)
    torch.testing.assert_close(fit_rigid(source, target, weights), fit_rigid(source[:4], target[:4]))
    nothing = fit_rigid(source, target, torch.zeros(6, dtype=D))
    assert torch.isfinite(nothing).all()
    assert torch.det(nothing[:3, :3]) == pytest.approx(1.0)


def test_fit_is_exact_far_from_the_origin():
    matrix = se3_exp(torch.tensor([0.1, 0.2, 0.3, 0.2, -0.1, 0.4], dtype=D))
    source = random_points(40) + 1e6
    target = transform_points(matrix, source)
    torch.testing.assert_close(transform_points(fit_rigid(source, target), source), target, atol=1e-8, rtol=0)


def test_fit_is_differentiable_in_all_arguments():
    inputs = [random_points(6), random_points(6, seed=1), torch.rand(6, dtype=D) + 0.5]
    assert torch.autograd.gradcheck(fit_rigid, [value.requires_grad_() for value in inputs])


def matches(count=60, seed=0, noise=0.1):
    generator = torch.Generator().manual_seed(seed)
    source = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    motion = se3_exp(torch.randn(6, generator=generator, dtype=torch.float64))
    target = transform_points(motion, source) + noise * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    weights = torch.rand(count, generator=generator, dtype=torch.float64)
    return source, target, weights, torch.arange(count) % 3


def test_costs_and_motions_are_those_of_a_fit_to_the_points():
    source, target, weights, labels = matches()
    moments = rigid_moments(source, target, weights, labels, 3)
    assert moments.num_groups == 3
    for label, motion in enumerate(moments.motions()):
        own = labels == label
        expected = fit_rigid(source[own], target[own], weights[own])
        torch.testing.assert_close(motion, expected)
        squares = (transform_points(expected, source[own]) - target[own]).square().sum(-1)
        torch.testing.assert_close(moments.cost()[label], (weights[own] * squares).sum())
        torch.testing.assert_close(moments.mass[label], weights[own].sum())


def test_joined_groups_are_groups_of_all_their_points():
    source, target, weights, labels = matches()
    joined = rigid_moments(source, target, weights, labels, 3).joined(torch.tensor([1, 0, 1]), 2)
    direct = rigid_moments(source, target, weights, (labels != 1).long(), 2)
    torch.testing.assert_close(joined.cost(), direct.cost())
    torch.testing.assert_close(joined.motions(), direct.motions())


def test_no_mirror_image_is_a_motion():
    source, _, weights, labels = matches()
    moments = rigid_moments(source, source * torch.tensor([1.0, 1.0, -1.0]), weights, labels, 3)
    torch.testing.assert_close(torch.linalg.det(moments.motions()[:, :3, :3]), torch.ones(3, dtype=torch.float64))
    for label in range(3):
        own = labels == label
        moved = transform_points(moments.motions()[label], source[own])
        squares = (moved - source[own] * torch.tensor([1.0, 1.0, -1.0])).square().sum(-1)
        torch.testing.assert_close(moments.cost()[label], (weights[own] * squares).sum())


def test_far_origins_lose_no_digits():
    source, target, weights, labels = matches(noise=0.0)
    moments = rigid_moments(source + 1e6, target - 1e6, weights, labels, 3)
    assert float(moments.cost().max()) < 1e-6
    moved = transform_points(moments.motions()[0], source + 1e6)
    torch.testing.assert_close(moved[labels == 0], (target - 1e6)[labels == 0], atol=1e-6, rtol=0)


def test_a_group_without_points_stays_and_costs_nothing():
    source, target, weights, labels = matches()
    moments = rigid_moments(source, target, weights, labels, 4)
    torch.testing.assert_close(moments.motions()[3], torch.eye(4, dtype=torch.float64))
    assert float(moments.cost()[3]) == 0


def test_a_batch_is_a_loop():
    source, target, weights, labels = matches()
    other, heavy = target.flip(0), weights.flip(0)
    both = rigid_moments(source, torch.stack([target, other]), torch.stack([weights, heavy]), labels, 3)
    for row, (place, weight) in enumerate(((target, weights), (other, heavy))):
        single = rigid_moments(source, place, weight, labels, 3)
        torch.testing.assert_close(both.cost()[row], single.cost())
        torch.testing.assert_close(both.motions()[row], single.motions())
        torch.testing.assert_close(
            both.joined(torch.zeros(3).long(), 1).cost()[row], single.joined(torch.zeros(3).long(), 1).cost()
        )


def test_costs_are_differentiable():
    source, target, weights, labels = matches(12)
    assert torch.autograd.gradcheck(
        lambda x, y, w: least_cost(rigid_moments(x, y, w, labels, 3).sums),
        [value.requires_grad_() for value in (source, target, weights)],
    )


def test_twists_come_back_from_their_motions():
    twist = torch.randn(200, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    twist[:, 3:] *= 0.6
    twist[:50] *= 1e-5
    twist[0] = 0
    assert float(twist[:, 3:].norm(dim=-1).max()) < math.pi
    torch.testing.assert_close(se3_log(se3_exp(twist)), twist, atol=1e-9, rtol=1e-9)
    motion = se3_exp(twist[100:])
    seen = motion @ se3_exp(0.3 * twist[:100]) @ torch.linalg.inv(motion)
    torch.testing.assert_close(se3_exp((adjoint(motion) @ (0.3 * twist[:100]).unsqueeze(-1)).squeeze(-1)), seen)
    assert torch.autograd.gradcheck(lambda x: se3_log(se3_exp(x)), twist[100:103].clone().requires_grad_(True))
