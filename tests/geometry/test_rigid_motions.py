"""Rigid motions: the group, fits to points, and fits of groups from their moments."""

import math

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from torch.func import jacfwd, jacrev

from tests.geometry.draws import D, rand, randn
from torchreg.geometry.rigid import adjoint, fit_rigid, invert_rigid, se3_exp, se3_log, transform_points
from torchreg.geometry.rigid_moments import least_cost, rigid_moments


def matches(noise=0.1, count=60):
    source = randn(count, 3)
    target = transform_points(se3_exp(randn(6, seed=1)), source) + noise * randn(count, 3, seed=2)
    return source, target, rand(count, seed=3), torch.arange(count) % 3


# torch's own forward mode compiles its decompositions with a deprecated call on first use.
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")


@pytest.mark.parametrize("angle", [0.0, 1e-8, 5e-3, 0.011, 1.0, math.pi, 5.0])
def test_se3_exp_is_the_matrix_exponential(angle):
    x, y, z = (angle * np.array([2.0, -1.0, 2.0]) / 3).tolist()
    generator = np.array([[0, -z, y, 0.3], [z, 0, -x, -0.2], [-y, x, 0, 0.5], [0, 0, 0, 0]])
    twist = torch.tensor([0.3, -0.2, 0.5, x, y, z], dtype=D)
    np.testing.assert_allclose(se3_exp(twist), expm(generator), atol=1e-14)
    np.testing.assert_allclose(se3_exp(twist.float()), expm(generator), atol=2e-6)


def test_se3_exp_differentiates_at_zero_in_every_mode():
    zero = torch.zeros(6, dtype=D)
    forward, reverse = jacfwd(se3_exp)(zero), jacrev(se3_exp)(zero)
    torch.testing.assert_close(forward, reverse)
    assert torch.equal(forward[:3, 3, :3], torch.eye(3, dtype=D))
    for twist in (zero, randn(6)):
        assert torch.autograd.gradcheck(se3_exp, twist.clone().requires_grad_(), check_forward_ad=True)


def test_transforming_points_is_homogeneous_multiplication():
    matrices, points = se3_exp(randn(2, 6)), randn(2, 5, 3)
    homogeneous = torch.cat([points, torch.ones(2, 5, 1, dtype=D)], dim=-1)
    expected = torch.einsum("bij,bnj->bni", matrices, homogeneous)[..., :3]
    torch.testing.assert_close(transform_points(matrices, points), expected)
    torch.testing.assert_close(transform_points(matrices, points[0])[1], transform_points(matrices[1], points[0]))
    torch.testing.assert_close(transform_points(invert_rigid(matrices), transform_points(matrices, points)), points)


def test_fit_agrees_with_scipy_under_noise_and_weights():
    source, target, weights = randn(20, 3), randn(20, 3, seed=1), rand(20, seed=2)
    centers = [(weights @ points) / weights.sum() for points in (source, target)]
    expected, _ = Rotation.align_vectors((target - centers[1]).numpy(), (source - centers[0]).numpy(), weights.numpy())
    fitted = fit_rigid(source, target, weights)
    np.testing.assert_allclose(fitted[:3, :3], expected.as_matrix(), atol=1e-10)
    torch.testing.assert_close(transform_points(fitted, centers[0][None])[0], centers[1])
    inputs = [value[:6].clone().requires_grad_() for value in (source, target, weights)]
    assert torch.autograd.gradcheck(fit_rigid, inputs)


def test_fits_of_a_plane_of_one_point_of_far_points_and_without_weights_stay_rigid():
    matrix, source, target = se3_exp(randn(6)), randn(40, 3), randn(40, 3, seed=1)
    flat = source * torch.tensor([1.0, 1.0, 0.0], dtype=D)
    torch.testing.assert_close(fit_rigid(flat, transform_points(matrix, flat)), matrix, atol=1e-12, rtol=0)
    far = transform_points(matrix, source + 1e6)
    torch.testing.assert_close(transform_points(fit_rigid(source + 1e6, far), source + 1e6), far, atol=1e-8, rtol=0)
    weights = (torch.arange(40) < 4).to(D)
    torch.testing.assert_close(fit_rigid(source, target, weights), fit_rigid(source[:4], target[:4]))
    one = fit_rigid(flat[:1], flat[:1] + 2)
    torch.testing.assert_close(transform_points(one, flat[:1]), flat[:1] + 2)
    for motion in (one, fit_rigid(source, target, torch.zeros(40, dtype=D))):
        assert torch.det(motion[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_costs_and_motions_are_those_of_a_fit_to_the_points_also_to_a_mirror_image(mirror):
    source, target, weights, labels = matches()
    target = target * torch.tensor([1.0, 1.0, mirror])
    moments = rigid_moments(source, target, weights, labels, 4)
    assert moments.num_groups == 4
    for label, motion in enumerate(moments.motions()[:3]):
        own = labels == label
        torch.testing.assert_close(motion, fit_rigid(source[own], target[own], weights[own]))
        squares = (transform_points(motion, source[own]) - target[own]).square().sum(-1)
        torch.testing.assert_close(moments.cost()[label], (weights[own] * squares).sum())
        torch.testing.assert_close(moments.mass[label], weights[own].sum())
    # The last group has no points.
    torch.testing.assert_close(moments.motions()[3], torch.eye(4, dtype=D))
    assert float(moments.cost()[3]) == 0


def test_joined_groups_are_groups_of_all_their_points():
    source, target, weights, labels = matches()
    joined = rigid_moments(source, target, weights, labels, 3).joined(torch.tensor([1, 0, 1]), 2)
    direct = rigid_moments(source, target, weights, (labels != 1).long(), 2)
    torch.testing.assert_close(joined.cost(), direct.cost())
    torch.testing.assert_close(joined.motions(), direct.motions())


def test_far_origins_lose_no_digits():
    source, target, weights, labels = matches(noise=0.0)
    moments = rigid_moments(source + 1e6, target - 1e6, weights, labels, 3)
    assert float(moments.cost().max()) < 1e-6
    moved = transform_points(moments.motions()[0], source + 1e6)
    torch.testing.assert_close(moved[labels == 0], (target - 1e6)[labels == 0], atol=1e-6, rtol=0)


def test_a_batch_is_a_loop():
    source, target, weights, labels = matches()
    rows = ((target, weights), (target.flip(0), weights.flip(0)))
    both = rigid_moments(source, *map(torch.stack, zip(*rows, strict=True)), labels, 3)
    one = torch.zeros(3).long()
    for row, (points, weight) in enumerate(rows):
        single = rigid_moments(source, points, weight, labels, 3)
        torch.testing.assert_close(both.cost()[row], single.cost())
        torch.testing.assert_close(both.motions()[row], single.motions())
        torch.testing.assert_close(both.joined(one, 1).cost()[row], single.joined(one, 1).cost())


def test_costs_are_differentiable():
    *values, labels = matches(count=12)
    values = [value.requires_grad_() for value in values]
    assert torch.autograd.gradcheck(lambda x, y, w: least_cost(rigid_moments(x, y, w, labels, 3).sums), values)


def test_twists_come_back_from_their_motions():
    twist = randn(200, 6)
    twist[:, 3:] *= 0.6
    twist[:50] *= 1e-5
    twist[0] = 0
    assert float(twist[:, 3:].norm(dim=-1).max()) < math.pi
    torch.testing.assert_close(se3_log(se3_exp(twist)), twist, atol=1e-9, rtol=1e-9)
    motion, small = se3_exp(twist[100:]), 0.3 * twist[:100]
    seen = motion @ se3_exp(small) @ torch.linalg.inv(motion)
    torch.testing.assert_close(se3_exp((adjoint(motion) @ small.unsqueeze(-1)).squeeze(-1)), seen)
    assert torch.autograd.gradcheck(lambda x: se3_log(se3_exp(x)), twist[100:103].clone().requires_grad_(True))
