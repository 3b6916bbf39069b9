"""Priors of poses against numpy and torch.distributions; turned worlds, limits, heads, files."""

import math

import numpy as np
import pytest
import torch
from torch import nn

from torchreg.errors import FormatError, InputError, InputTypeError
from torchreg.geometry.rotation import compose_rotation_vectors, so3_exp
from torchreg.io.tensors import save_tensors
from torchreg.shapes.hand import Hand
from torchreg.shapes.pose_head import PoseHead
from torchreg.shapes.pose_prior import PosePrior

D = torch.float64


@pytest.fixture(scope="module")
def hand():
    return Hand(dtype=D).requires_grad_(False)


def randn(*size, seed=0):
    return torch.randn(*size, generator=torch.Generator().manual_seed(seed), dtype=D)


@pytest.fixture(scope="module")
def poses(hand):
    """Fingers that close together with a little noise, the base near a half turn, where vectors flip their signs."""
    count = 300
    poses = 0.02 * randn(count, 27)
    poses[:, 6:] += 0.4 * hand.upper[6:] * (1 + 0.3 * randn(count, 1, seed=1))
    half = torch.tensor([0.0, math.pi, 0.0], dtype=D).expand(count, 3)
    poses[:, 3:6] = compose_rotation_vectors(0.2 * randn(count, 3, seed=2), half)
    return poses


@pytest.fixture(scope="module")
def prior(hand, poses):
    return PosePrior.fit(hand, poses)


def test_the_joints_have_the_mean_and_axes_of_numpy(hand, poses, prior):
    joints = poses[:, 6:].numpy()
    np.testing.assert_allclose(prior.mean[6:], joints.mean(0), atol=1e-14)
    _, values, axes = np.linalg.svd(joints - joints.mean(0), full_matrices=False)
    np.testing.assert_allclose(prior.deviations[6:], values[: prior.num_components - 6] / math.sqrt(299), rtol=1e-9)
    np.testing.assert_allclose(np.abs(prior.components[6:, 6:].numpy() @ axes[0])[0], 1, atol=1e-9)
    torch.testing.assert_close(prior.components @ prior.components.mT, torch.eye(prior.num_components, dtype=D))
    explained = PosePrior.fit(hand, poses, explained=0.5)
    assert explained.num_components == 7


def test_the_mean_rotation_is_in_the_middle_though_vectors_flip(poses, prior):
    assert (poses[:, 4] > 0).any()
    assert (poses[:, 4] < 0).any()
    half = torch.tensor([0.0, math.pi, 0.0], dtype=D)
    assert compose_rotation_vectors(prior.mean[3:6], -half).norm() < 0.05
    steps = compose_rotation_vectors(poses[:, 3:6], -prior.mean[3:6].expand(300, 3))
    assert steps.mean(0).norm() < 1e-12
    assert prior.deviations[:6].max() < 0.3


def test_log_prob_is_that_of_the_gaussian_of_the_same_covariance(hand, poses):
    prior = PosePrior.fit(hand, poses, num_components=3)
    joints = prior.components[6:, 6:]
    covariance = prior.residual**2 * (torch.eye(21, dtype=D) - joints.mT @ joints)
    covariance = torch.block_diag(torch.zeros(6, 6, dtype=D), covariance)
    covariance = covariance + (prior.components.mT * prior.deviations**2) @ prior.components
    reference = torch.distributions.MultivariateNormal(torch.zeros(27, dtype=D), covariance)
    turn = compose_rotation_vectors(poses[:, 3:6], -prior.mean[3:6].expand(300, 3))
    steps = torch.cat([poses[:, :3] - prior.mean[:3], turn, poses[:, 6:] - prior.mean[6:]], dim=-1)
    inside = ((poses >= hand.lower) & (poses <= hand.upper)).all(-1)
    assert inside.sum() > 100
    torch.testing.assert_close(prior.log_prob(poses[inside]), reference.log_prob(steps[inside]), rtol=1e-8, atol=1e-6)
    torch.testing.assert_close(prior.log_prob(poses.reshape(3, 100, 27)).flatten(), prior.log_prob(poses))


def test_limits_cost(hand, prior):
    beyond, steeper = prior.mean.clone(), prior.mean.clone()
    beyond[7], steeper[7] = hand.upper[7], hand.upper[7] + 0.05
    assert prior.log_prob(steeper) < prior.log_prob(beyond) - 0.5


def test_a_turned_world_changes_no_joint_and_turns_the_mean(hand, poses, prior):
    turn = torch.tensor([0.5, -1.0, 0.8], dtype=D)
    turned = torch.cat([
        poses[:, :3] @ so3_exp(turn).mT, compose_rotation_vectors(turn.expand(300, 3), poses[:, 3:6]), poses[:, 6:]
    ], dim=-1)  # fmt: skip
    other = PosePrior.fit(hand, turned)
    mean = so3_exp(turn) @ so3_exp(prior.mean[3:6])
    torch.testing.assert_close(so3_exp(other.mean[3:6]), mean, atol=1e-10, rtol=0)
    torch.testing.assert_close(other.deviations, prior.deviations, atol=1e-9, rtol=0)
    torch.testing.assert_close(other.log_prob(turned), prior.log_prob(poses))


def test_samples_are_like_the_poses_and_within_limits(hand, poses, prior):
    samples = prior.sample(2000, torch.Generator().manual_seed(1))
    assert bool(((samples >= hand.lower) & (samples <= hand.upper)).all())
    torch.testing.assert_close(samples[:, 6:].mean(0), poses[:, 6:].mean(0), atol=0.03, rtol=0)
    torch.testing.assert_close(samples[:, 6:].std(0), poses[:, 6:].std(0), atol=0.03, rtol=0)
    assert compose_rotation_vectors(samples[:, 3:6], -prior.mean[3:6].expand(2000, 3)).norm(dim=-1).max() < 1.2
    torch.testing.assert_close(prior.sample(3), prior.sample(3))
    assert prior.sample(0).shape == (0, 27)


def test_coefficients_and_poses_go_there_and_back(prior):
    coefficients = 0.5 * randn(2, 4, prior.num_components)
    torch.testing.assert_close(prior.coefficients(prior(coefficients)), coefficients)
    torch.testing.assert_close(prior(torch.zeros(prior.num_components, dtype=D)), prior.mean)


def test_a_free_base_is_left_alone(hand, poses, prior):
    free = PosePrior.fit(hand, poses, base=False)
    assert free.num_components == prior.num_components - 6
    moved = torch.cat([poses[:, :6].roll(7, 0) + 3, poses[:, 6:]], dim=-1)
    torch.testing.assert_close(free.log_prob(moved), free.log_prob(poses))
    assert not (free.sample(5)[:, :6] - free.mean[:6]).abs().gt(1e-12).any()


def test_gradients(prior, poses):
    assert torch.autograd.gradcheck(prior.log_prob, poses[:2].clone().requires_grad_())
    zero = torch.zeros(prior.num_components, dtype=D, requires_grad=True)
    assert torch.autograd.gradcheck(lambda c: so3_exp(prior(c)[3:6]).sum() + prior(c)[6:].sum(), zero)
    assert torch.autograd.gradcheck(prior.log_prob, prior.mean.clone().requires_grad_())


def test_a_layer_gives_the_mean_and_the_covariance(prior):
    linear = prior.init_head_(nn.Linear(64, 27).double())
    constant = linear(torch.full((64,), 7.0, dtype=D))
    torch.testing.assert_close(constant, prior.mean, atol=1e-10, rtol=0)
    covariance = linear.weight @ linear.weight.mT
    expected = (prior.components.mT * prior.deviations**2) @ prior.components
    torch.testing.assert_close(covariance[6:, 6:], expected[6:, 6:], atol=1e-9, rtol=0)
    few = prior.init_head_(nn.Linear(3, 27).double())
    assert torch.linalg.matrix_rank(few.weight.detach()) == 2


def test_a_layer_before_a_head_gives_the_mean_and_small_steps_along_components(hand, prior):
    head = PoseHead(hand, joints="sigmoid")
    linear = prior.init_head_(nn.Linear(64, head.num_features).double(), head)
    with torch.no_grad():
        mean = head(linear(torch.zeros(64, dtype=D)))
        near = head(linear(1e-4 * randn(64)))
    torch.testing.assert_close(hand.keypoints(mean), hand.keypoints(prior.mean), atol=1e-10, rtol=0)
    step = near[6:] - mean[6:]
    joints = prior.components[6:, 6:]
    assert (step - step @ joints.mT @ joints).norm() < 1e-3 * step.norm()


def test_files(tmp_path, prior):
    prior.save(tmp_path / "prior.safetensors")
    back = PosePrior.load(tmp_path / "prior.safetensors")
    assert back.residual == prior.residual
    assert all(torch.equal(a, b) for a, b in zip(back.buffers(), prior.buffers(), strict=True))
    torch.testing.assert_close(back.sample(2), prior.sample(2))
    save_tensors(tmp_path / "other.safetensors", {}, {"kind": "Spine"})
    with pytest.raises(FormatError, match="holds no PosePrior"):
        PosePrior.load(tmp_path / "other.safetensors")
    save_tensors(tmp_path / "part.safetensors", {}, {"kind": "PosePrior"})
    with pytest.raises(FormatError, match="no complete PosePrior"):
        PosePrior.load(tmp_path / "part.safetensors")


def test_lost_frames_are_left_out_and_float32_stays(poses):
    hand = Hand().requires_grad_(False)
    lost = torch.cat([poses, torch.full((1, 27), torch.nan)]).float()
    prior = PosePrior.fit(hand, lost)
    assert prior.mean.dtype == torch.float32
    torch.testing.assert_close(prior.mean[6:].double(), poses[:, 6:].mean(0), atol=1e-6, rtol=0)


def test_bad_input_is_told(hand, poses, prior):
    with pytest.raises(InputError, match="at least two finite poses"):
        PosePrior.fit(hand, poses[:1])
    with pytest.raises(InputError, match="poses must have shape"):
        PosePrior.fit(hand, poses[:, :5])
    with pytest.raises(InputError, match="linear must have 27 outputs"):
        prior.init_head_(nn.Linear(8, 26))
    with pytest.raises(InputTypeError, match=r"torch.nn.Linear with a bias"):
        prior.init_head_(nn.Linear(8, 27, bias=False))
    with pytest.raises(InputError, match="deviations must be positive"):
        PosePrior(prior.mean, prior.components, 0 * prior.deviations, 1.0, lower=prior.lower, upper=prior.upper,
                  has_base=True)  # fmt: skip
    with pytest.raises(InputError, match="coefficients must have shape"):
        prior(torch.zeros(2, dtype=D))
