"""Measured keypoints as evidence beside points: their likelihood, and what they change."""

import math

import pytest
import torch

import torchreg as tr
from torchreg.alignment.fit.landmarks import MeasuredKeypoints, keypoint_skin

CAMERA = tr.Camera(640, 480, (475.0, 480.0, 320.0, 240.0), None, (-0.1, 0.03, 1e-3, -2e-3))


@pytest.fixture(scope="module")
def pose(links):
    pose = links.rest_pose()
    pose[:3] = torch.tensor([-0.1, 0.02, 0.6])
    pose[3:] = torch.tensor([0.3, 1.2, -0.2, 0.4, -0.3])
    return pose


@pytest.mark.parametrize("pixels", [False, True], ids=["space", "picture"])
def test_the_gradient_is_that_of_the_likelihood(links, pose, pixels):
    truth = links.keypoints(pose)
    targets = CAMERA.project(truth)[0] if pixels else truth.clone()
    targets[1] = torch.nan
    origin = truth.mean(0)
    given = MeasuredKeypoints.of(links, targets, None, CAMERA, 0.3).of_problems(keypoint_skin(links), origin[None])
    width = pose.new_tensor([0.004])
    local = links.retract(pose, torch.full_like(pose, 0.01))[None]
    local[:, :3] -= origin
    found = given.linearized(local, width)
    torch.testing.assert_close(found.cost, given.cost(local, width))
    steps = 1e-6 * torch.eye(len(pose), dtype=pose.dtype)
    ahead, back = (
        torch.cat([given.cost(links.retract(local, sign * step[None]), width) for step in steps]) for sign in (1, -1)
    )
    torch.testing.assert_close(found.gradient[0], (ahead - back) / 2e-6, rtol=1e-5, atol=1e-6)
    assert float(found.gradient.abs().max()) > 1
    # A wrong one costs no more than its share.
    far = truth[None].clone()
    far[0, 0] += 10
    given = MeasuredKeypoints.of(links, far, 0.01, None, 0.3)
    given = given.of_problems(keypoint_skin(links), torch.zeros(1, 3, dtype=pose.dtype))
    assert float(given.cost(pose[None], 0.0)) == pytest.approx(math.log1p(math.exp(-4.5)) + 4.5)
    assert float(given.linearized(pose[None], 0.0).gradient.abs().max()) < 1e-12


def test_landmarks_tell_what_the_points_do_not(links, links_skin, pose):
    # Points of the first link alone, and the far joints where a detector saw them.
    part = links_skin.weights.argmax(-1)
    points = links_skin(pose)[part == 0]
    start = links.retract(pose, 0.15 * torch.ones_like(pose))
    config = tr.AlignConfig(search="never")
    truth = links.keypoints(pose)

    def error(**options):
        found = tr.align(links, points, start, model_points=links_skin, config=config, **options)
        return float((links.keypoints(found.pose) - truth).norm(dim=-1).max())

    alone = error()
    assert error(keypoints=truth, keypoint_std=0.005) < 0.3 * alone
    wrong = truth.clone()
    wrong[-1] += 0.5
    assert error(keypoints=wrong, keypoint_std=0.005) < 2 * alone


@pytest.mark.parametrize("pixels", [False, True], ids=["space", "picture"])
def test_keypoints_alone_place_a_hand_though_some_are_wrong(plain_hand, plain_hand_skin, pixels):
    truth = plain_hand.rest_pose()
    truth[:6] = torch.tensor([0.05, -0.03, 0.5, 0.4, 2.0, -1.0])
    truth[6:] = plain_hand.clamp(truth + 0.3)[6:]
    seen = plain_hand.keypoints(truth)
    measured = CAMERA.project(seen.double())[0].float() if pixels else seen.clone()
    generator = torch.Generator().manual_seed(0)
    measured += (0.5 if pixels else 0.002) * torch.randn(measured.shape, generator=generator)
    measured[6], measured[10] = torch.nan, measured[3]
    told = {"keypoints": measured, "keypoint_std": 0.5 if pixels else 0.002}
    found = tr.align(plain_hand, CAMERA if pixels else None, model_points=plain_hand_skin, **told)
    off = (found.keypoints - seen).norm(dim=-1)
    assert float(off.mean()) < (0.01 if pixels else 0.003)
    assert "1 of the seen keypoints do not agree" in found.doubt
    assert found.statuses[0].usable is (float(found.confidence) >= 0.5)
    assert len(found.distances) == 0
    starts = tr.find_pose(plain_hand, CAMERA if pixels else None, num_starts=2, model_points=plain_hand_skin, **told)
    torch.testing.assert_close(starts.best, found.pose)
    near = tr.align(plain_hand, None, found.pose, keypoints=seen, model_points=plain_hand_skin, keypoint_std=0.002)
    assert float((near.keypoints - seen).norm(dim=-1).mean()) < 1e-3


def test_one_keypoint_alone_is_too_little(links):
    one = torch.full((3, 3), torch.nan)
    one[0] = 0.1
    assert tr.align(links, None, keypoints=one).status is tr.Status.FEW_INLIERS
