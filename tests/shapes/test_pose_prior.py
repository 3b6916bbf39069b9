"""Priors of poses against numpy and torch.distributions; turned worlds, limits, heads, files."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import nn

import torchreg as tr
from tests.shapes.kinds import D, compare, seeded
from torchreg.geometry.rotation import so3_exp
from torchreg.io.tensors import save_tensors


def compose(first, second):
    """The rotation vector of the second rotation followed by the first."""
    return torch.from_numpy((Rotation.from_rotvec(first) * Rotation.from_rotvec(second)).as_rotvec())


HALF = torch.tensor([0.0, math.pi, 0.0], dtype=D)


@pytest.fixture(scope="module")
def poses(hand):
    """Fingers that close together with a little noise, the base near a half turn, where vectors flip their signs."""
    count = 300
    poses = 0.02 * seeded(count, 27)
    poses[:, 6:] += 0.4 * hand.upper[6:] * (1 + 0.3 * seeded(count, 1, seed=1))
    poses[:, 3:6] = compose(0.2 * seeded(count, 3, seed=2), HALF.expand(count, 3))
    return poses


@pytest.fixture(scope="module")
def prior(hand, poses):
    return tr.PosePrior.fit(hand, poses)


def test_the_joints_have_the_mean_and_axes_of_numpy(hand, poses, prior):
    joints = poses[:, 6:].numpy()
    np.testing.assert_allclose(prior.mean[6:], joints.mean(0), atol=1e-14)
    _, values, axes = np.linalg.svd(joints - joints.mean(0), full_matrices=False)
    np.testing.assert_allclose(prior.deviations[6:], values[: prior.num_components - 6] / math.sqrt(299), rtol=1e-9)
    np.testing.assert_allclose(np.abs(prior.components[6:, 6:].numpy() @ axes[0])[0], 1, atol=1e-9)
    torch.testing.assert_close(prior.components @ prior.components.mT, torch.eye(prior.num_components, dtype=D))
    explained = tr.PosePrior.fit(hand, poses, explained=0.5)
    assert explained.num_components == 7


def test_the_mean_rotation_is_in_the_middle_though_vectors_flip(poses, prior):
    assert (poses[:, 4] > 0).any()
    assert (poses[:, 4] < 0).any()
    assert compose(prior.mean[3:6], -HALF).norm() < 0.05
    steps = compose(poses[:, 3:6], -prior.mean[3:6].expand(300, 3))
    assert steps.mean(0).norm() < 1e-12
    assert prior.deviations[:6].max() < 0.3


def test_log_prob_is_that_of_the_gaussian_of_the_same_covariance(hand, poses):
    prior = tr.PosePrior.fit(hand, poses, num_components=3)
    joints = prior.components[6:, 6:]
    covariance = prior.residual**2 * (torch.eye(21, dtype=D) - joints.mT @ joints)
    covariance = torch.block_diag(torch.zeros(6, 6, dtype=D), covariance)
    covariance = covariance + (prior.components.mT * prior.deviations**2) @ prior.components
    reference = torch.distributions.MultivariateNormal(torch.zeros(27, dtype=D), covariance)
    turn = compose(poses[:, 3:6], -prior.mean[3:6].expand(300, 3))
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
        poses[:, :3] @ so3_exp(turn).mT, compose(turn.expand(300, 3), poses[:, 3:6]), poses[:, 6:]
    ], dim=-1)  # fmt: skip
    other = tr.PosePrior.fit(hand, turned)
    mean = so3_exp(turn) @ so3_exp(prior.mean[3:6])
    torch.testing.assert_close(so3_exp(other.mean[3:6]), mean, atol=1e-10, rtol=0)
    torch.testing.assert_close(other.deviations, prior.deviations, atol=1e-9, rtol=0)
    torch.testing.assert_close(other.log_prob(turned), prior.log_prob(poses))


def test_samples_are_like_the_poses_and_within_limits(hand, poses, prior):
    samples = prior.sample(2000, torch.Generator().manual_seed(1))
    assert bool(((samples >= hand.lower) & (samples <= hand.upper)).all())
    torch.testing.assert_close(samples[:, 6:].mean(0), poses[:, 6:].mean(0), atol=0.03, rtol=0)
    torch.testing.assert_close(samples[:, 6:].std(0), poses[:, 6:].std(0), atol=0.03, rtol=0)
    assert compose(samples[:, 3:6], -prior.mean[3:6].expand(2000, 3)).norm(dim=-1).max() < 1.2
    torch.testing.assert_close(prior.sample(3), prior.sample(3))
    assert prior.sample(0).shape == (0, 27)


def test_coefficients_and_poses_go_there_and_back(prior):
    coefficients = 0.5 * seeded(2, 4, prior.num_components)
    torch.testing.assert_close(prior.coefficients(prior(coefficients)), coefficients)
    torch.testing.assert_close(prior(torch.zeros(prior.num_components, dtype=D)), prior.mean)


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
    head = tr.PoseHead(hand, joints="sigmoid")
    linear = prior.init_head_(nn.Linear(64, head.num_features).double(), head)
    with torch.no_grad():
        mean, near = head(linear(torch.zeros(64, dtype=D))), head(linear(1e-4 * seeded(64)))
    torch.testing.assert_close(hand.keypoints(mean), hand.keypoints(prior.mean), atol=1e-10, rtol=0)
    step, joints = near[6:] - mean[6:], prior.components[6:, 6:]
    assert (step - step @ joints.mT @ joints).norm() < 1e-3 * step.norm()


def test_files(tmp_path, prior):
    path = tmp_path / "prior.safetensors"
    prior.save(path)
    back = tr.PosePrior.load(path)
    assert back.residual == prior.residual
    assert all(torch.equal(a, b) for a, b in zip(back.buffers(), prior.buffers(), strict=True))
    compare([back.sample(2)], [prior.sample(2)])
    for kind, message in (("Spine", "holds no PosePrior"), ("PosePrior", "no complete PosePrior")):
        save_tensors(tmp_path / "other.safetensors", {}, {"kind": kind})
        with pytest.raises(tr.errors.FormatError, match=message):
            tr.PosePrior.load(tmp_path / "other.safetensors")


def test_lost_frames_are_left_out_and_float32_stays(plain_hand, poses):
    lost = torch.cat([poses, torch.full((1, 27), torch.nan)]).float()
    prior = tr.PosePrior.fit(plain_hand, lost)
    assert prior.mean.dtype == torch.float32
    torch.testing.assert_close(prior.mean[6:].double(), poses[:, 6:].mean(0), atol=1e-6, rtol=0)
