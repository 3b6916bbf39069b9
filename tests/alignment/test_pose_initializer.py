"""PoseInitializer as a function and as a layer: gradients against finite differences and unrolling, batches, limits."""

import math

import pytest
import torch

import torchreg as tr
from tests.alignment.made import D, cloud, finger
from torchreg.geometry.rotation import so3_exp
from torchreg.shapes.skin import bending_weights

EXACT = tr.PoseInitializerConfig(sigma_steps=1, em_steps=1, fit_steps=6, newton_steps=3, noise=0.004)


@pytest.fixture(scope="module")
def shape():
    return finger()


@pytest.fixture(scope="module")
def skin(shape):
    return tr.sample_skin(shape, 60)


@pytest.fixture(scope="module")
def truth():
    """At no rotation, a half turn, and any."""
    truth = torch.zeros(3, 7, dtype=D)
    truth[:, :3] = torch.tensor([0.2, -0.1, 0.4], dtype=D)
    truth[1, 3:6] = torch.tensor([0.0, math.pi, 0.0], dtype=D)
    truth[2, 3:6] = torch.tensor([1.0, -0.7, 0.4], dtype=D)
    truth[:, 6] = torch.tensor([0.3, 0.7, 0.1], dtype=D)
    return truth


@pytest.fixture(scope="module")
def points(shape, truth):
    cloud = tr.sample_skin(shape, 60, seed=5)(truth)
    return cloud + 0.002 * torch.randn(cloud.shape, generator=torch.Generator().manual_seed(0), dtype=D)


@pytest.fixture(scope="module")
def start(shape, truth):
    step = 0.06 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(2), dtype=D)
    step[:, :3] *= 0.1
    return shape.retract(truth, step)


def loss_of(result):
    """A smooth function of the rotation, not of its vector, which flips at half turns."""
    generator = torch.Generator().manual_seed(9)
    weights = torch.randn(result.keypoints.shape, generator=generator, dtype=D)
    return (weights * result.keypoints).sum() + (so3_exp(result.pose[:, 3:6]).diagonal(dim1=-2, dim2=-1)).sum()


def direction_like(value, seed):
    return torch.randn(value.shape, generator=torch.Generator().manual_seed(seed), dtype=D)


def check_slope(gradient, function, at, direction, size=1e-3):
    """Compare a directional derivative with central differences of fourth order."""
    far_down, down, up, far_up = (function(at + shift * size * direction).detach() for shift in (-2, -1, 1, 2))
    slope = float((8 * (up - down) - (far_up - far_down)) / (12 * size))
    assert float((gradient * direction).sum()) == pytest.approx(slope, rel=1e-5)


def test_poses_are_found_from_starts(shape, skin, points, start, truth):
    layer = tr.PoseInitializer(shape, model_points=skin)
    with torch.no_grad():
        result = layer(points, start=start)
    assert isinstance(result, tr.InitialPose)
    assert not result.pose.requires_grad
    torch.testing.assert_close(shape.keypoints(result.pose), shape.keypoints(truth), atol=2e-3, rtol=0)
    assert result.registered.shape == (3, 60, 3)
    assert (result.confidence > 0.7).all()
    assert (layer(points + 0.5, start=start).confidence < 0.1).all()


@pytest.mark.parametrize("which", ["points", "start"])
def test_gradients_are_those_of_finite_differences(shape, skin, points, start, which):
    layer = tr.PoseInitializer(shape, EXACT, model_points=skin)
    given = {"points": points, "start": start}

    def function(value):
        return loss_of(layer(**{**given, which: value.requires_grad_()}))

    leaf = given[which].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(leaf), leaf)
    check_slope(gradient, function, given[which], direction_like(leaf, 1) * (1.0 if which == "start" else 0.01))


def test_gradients_in_the_sizes_of_the_shape(points, start):
    shape = finger().requires_grad_(True)
    layer = tr.PoseInitializer(shape, EXACT, model_points=tr.sample_skin(shape, 60))
    scales = torch.nn.ParameterList([shape.log_length_scales, shape.log_radius_scales])

    def function(value):
        torch.nn.utils.vector_to_parameters(value, scales)
        return loss_of(layer(points[2:], start=start[2:]))

    at = torch.zeros(4, dtype=D)
    gradients = torch.autograd.grad(function(at), list(scales))
    check_slope(torch.cat(gradients), function, at, torch.tensor([1.0, -0.7, 0.5, 0.8], dtype=D))


def test_gradients_of_a_shape_whose_file_has_a_mesh(shape, points, start):
    """The nearest points of a mesh jump; the last fit, to its solids, does not."""
    mesh = shape.surface_mesh(spacing=0.006)
    weights = bending_weights(shape, mesh.vertices, shape.rest_pose(), 2.0)
    joints = shape.part_transforms(shape.rest_pose())[:, :3, 3]
    rig = tr.ArticulatedShape.from_skinned_mesh(
        mesh.vertices, mesh.faces, weights, joints, [-1, 0], axes={"joint_0": [], "joint_1": ["x"]}, dtype=D
    ).requires_grad_(False)
    layer = tr.PoseInitializer(rig, EXACT)

    def function(value):
        return loss_of(layer(value.requires_grad_(), start=start[2:]))

    leaf = points[2:].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(leaf), leaf)
    check_slope(gradient, function, points[2:], 0.01 * direction_like(leaf, 1), 1e-4)


def test_joints_held_at_a_limit_take_no_gradient(shape, skin, truth):
    beyond = truth.clone()
    beyond[:, 6] = shape.upper[6] + 0.3
    points = tr.sample_skin(shape, 60, seed=5)(beyond).requires_grad_()
    result = tr.PoseInitializer(shape, EXACT, model_points=skin)(points, start=shape.clamp(beyond))
    torch.testing.assert_close(result.pose[:, 6], shape.upper[6].expand(3), atol=1e-12, rtol=0)
    (gradient,) = torch.autograd.grad(result.pose[:, 6].sum(), points, retain_graph=True)
    assert not gradient.any()
    assert torch.autograd.grad(result.pose[:, :3].sum(), points)[0].any()


def test_a_cloud_without_points_stays_at_its_start(shape, skin, points, start):
    mask = torch.ones(3, 60, dtype=torch.bool)
    mask[1] = False
    begin = start.clone().requires_grad_()
    cloud = points.clone().requires_grad_()
    result = tr.PoseInitializer(shape, EXACT, model_points=skin)(cloud, mask, begin)
    torch.testing.assert_close(result.pose[1], start[1], atol=1e-9, rtol=0)
    assert result.confidence[1] == 0
    weights = direction_like(start, 4)
    gradients = torch.autograd.grad((weights * result.pose).sum(), [begin, cloud])
    torch.testing.assert_close(gradients[0][1], weights[1], rtol=1e-6, atol=1e-6)
    assert not gradients[1][1].any()
    assert gradients[0].isfinite().all()


def test_points_that_fall_together_have_gradients(shape, skin, points, start):
    cloud = points.clone()
    cloud[:, 30:] = cloud[:, :30]
    cloud[0, 0] = start[0, :3]  # at the center of a solid
    leaf = cloud.requires_grad_()
    result = tr.PoseInitializer(shape, EXACT, model_points=skin)(leaf, start=start)
    (gradient,) = torch.autograd.grad(result.pose.sum(), leaf)
    assert gradient.isfinite().all()
    torch.testing.assert_close(gradient[1:, 30:], gradient[1:, :30], rtol=1e-6, atol=1e-9)


def test_a_batch_is_its_clouds_one_by_one(shape, skin, points, start):
    layer = tr.PoseInitializer(shape, EXACT, model_points=skin)
    leaf = points.clone().requires_grad_()
    together = layer(leaf, start=start)
    (gradient,) = torch.autograd.grad(together.pose.sum(), leaf)
    padded = torch.cat([points, torch.full((3, 5, 3), torch.nan, dtype=D)], dim=1)
    mask = torch.arange(65).expand(3, -1) < 60
    torch.testing.assert_close(layer(padded.requires_grad_(), mask, start).pose, together.pose, atol=1e-6, rtol=0)
    for row in range(3):
        single = points[row].clone().requires_grad_()
        alone = layer(single, start=start[row])
        torch.testing.assert_close(alone.pose, together.pose[row], atol=1e-6, rtol=0)
        (own,) = torch.autograd.grad(alone.pose.sum(), single)
        torch.testing.assert_close(own, gradient[row], rtol=1e-5, atol=1e-8)


def test_hands_are_found_from_scratch(plain_hand, plain_hand_skin, plain_hand_surface):
    pose = plain_hand.rest_pose()
    pose[3:6], pose[6:] = torch.tensor([2.0, 1.0, -0.5]), 0.2 * plain_hand.upper[6:]
    points = cloud(plain_hand, pose, num_points=300, skin=plain_hand_surface).points
    quick = tr.FindPoseConfig(num_candidates=16, num_placed=5, num_searched=2, search_rounds=1)
    layer = tr.PoseInitializer(plain_hand, tr.PoseInitializerConfig(find_pose=quick), model_points=plain_hand_skin)
    leaf = points.clone().requires_grad_()
    result = layer(leaf)
    error = (result.keypoints - plain_hand.keypoints(pose)).norm(dim=-1)
    assert error.mean() < 5e-3
    assert 0.0 < result.confidence <= 1.0
    shift = torch.autograd.grad(result.pose[:3].sum(), leaf)[0].sum(0)
    # Points that all move alike take the hand along.
    torch.testing.assert_close(shift, torch.ones(3), atol=5e-2, rtol=0)
