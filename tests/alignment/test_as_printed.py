"""Alignment with the printed settings, and the outlier constant as a number."""

import math
from itertools import pairwise

import pytest
import torch

import torchreg as tr
from torchreg.datasets.hand import make_hand_cloud, random_hand_pose
from torchreg.datasets.sequences import hand_sequence


@pytest.fixture(scope="module")
def scene(plain_hand):
    hand = plain_hand
    pose = random_hand_pose(hand, torch.Generator().manual_seed(0))
    cloud = make_hand_cloud(hand, pose, num_points=400, noise=0.001, outlier_ratio=0.2, generator=torch.Generator())
    start = hand.clamp(pose + torch.cat([torch.zeros(6), torch.full((hand.num_dofs - 6,), math.radians(8))]))
    return hand, pose, cloud, start


def tip_error(hand, pose, truth):
    return float((hand.keypoints(pose) - hand.keypoints(truth)).norm(dim=-1).mean())


def test_the_printed_alignment_finds_a_hand_near_its_start(scene):
    hand, pose, cloud, start = scene
    records = []
    found = tr.align(hand, cloud.points, start, config=tr.AlignConfig.paper(), on_step=records.append)
    assert tip_error(hand, found.pose, pose) < 0.4 * tip_error(hand, start, pose)
    em = [record for record in records if record.stage == "em"]
    # About five steps of sigma, one E-step each.
    assert len(em) == 5
    ratios = [float(b.sigma[0] / a.sigma[0]) for a, b in pairwise(em)]
    assert ratios == pytest.approx([ratios[0]] * 4)


def test_c_may_be_given_as_a_number(scene):
    hand, _, cloud, start = scene
    poses = {
        outlier: tr.align(hand, cloud.points, start, config=tr.AlignConfig.paper(outlier=outlier, surface_steps=0)).pose
        for outlier in ("limit", 3 * math.sqrt(math.pi / 2), 50.0)
    }
    limit, same, other = poses.values()
    assert torch.allclose(limit, same, atol=1e-5)
    assert not torch.allclose(limit, other, atol=1e-5)


def test_the_printed_tracker_follows_slow_fingers(plain_hand):
    clouds = hand_sequence("bending_palm", 6, 20.0, shape=plain_hand, seed=0)
    tracker = tr.Tracker(plain_hand, clouds[0].pose, config=tr.TrackConfig.paper())
    for cloud in clouds[1:]:
        result = tracker.step(cloud.points)
    assert tip_error(plain_hand, result.pose, clouds[-1].pose) < 0.006
