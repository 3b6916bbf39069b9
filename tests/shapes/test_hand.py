"""The hand: its parts, its order of keypoints, its sides, its sizes, and fingers that touch without fusing."""

import math

import pytest
import torch

import torchreg as tr
from tests.shapes.kinds import D, around, poses_of

FINGERS = ("thumb", "index", "middle", "ring", "little")


def posed(hand, **degrees):
    return hand.pose_from_dict({name: math.radians(value) for name, value in degrees.items()})


def test_sixteen_parts_and_27_degrees_of_freedom(hand):
    assert (hand.num_parts, hand.num_dofs) == (16, 27)
    assert hand.part_names[:4] == ("palm", "thumb_metacarpal", "thumb_proximal", "thumb_distal")
    assert hand.part_names[-1] == "little_distal"
    per_finger = {finger: [name for name in hand.dof_names if name.startswith(finger)] for finger in FINGERS}
    assert [len(names) for names in per_finger.values()] == [5, 4, 4, 4, 4]
    assert per_finger["thumb"] == [
        "thumb_cmc_abduction", "thumb_cmc_flexion", "thumb_mcp_abduction", "thumb_mcp_flexion", "thumb_ip_flexion",
    ]  # fmt: skip
    assert per_finger["ring"] == ["ring_mcp_abduction", "ring_mcp_flexion", "ring_pip_flexion", "ring_dip_flexion"]


def test_keypoints_run_from_the_wrist_over_the_thumb_to_the_little_finger_base_to_tip(hand):
    points = hand.keypoints(hand.rest_pose())
    assert points.shape == (21, 3)
    assert points[0].tolist() == [0.0, 0.0, 0.0]
    for finger in range(5):
        chain = points[1 + 4 * finger : 5 + 4 * finger]
        lengths = (chain[1:] - chain[:-1]).norm(dim=-1)
        torch.testing.assert_close(lengths, hand.bone_lengths[1 + 3 * finger : 4 + 3 * finger])
        assert bool((chain[:, 2].diff() > 0).all())
    assert points[[5, 9, 13, 17], 0].diff().lt(0).all()
    pose = poses_of(hand, 1, seed=3)[0]
    tips = hand.keypoints(pose)[[4, 8, 12, 16, 20]]
    on_tips = hand.part_distances(tips, pose)[range(5), list(hand.fingertip_parts)]
    torch.testing.assert_close(on_tips, torch.zeros(5, dtype=D), atol=1e-12, rtol=0)


def test_it_has_adult_proportions_and_limits(hand):
    points = hand.keypoints(hand.rest_pose()) * 1000
    assert 180 < points[12].norm() < 205
    assert hand.length == pytest.approx(float(points[12].norm()) / 1000)
    assert 75 < 2000 * hand.radii[0, 0] < 100
    assert 24 < 2000 * hand.radii[0, 1] < 34
    tips = points[[8, 12, 16, 20]].norm(dim=-1)
    assert tips.argmax() == 1
    assert tips[3] == tips.min()
    bones = hand.bone_lengths[1:].unflatten(0, (5, 3))
    assert bool((bones.diff(dim=-1)[:4] < 0).all())
    assert bool((hand.radii[1:, :2].amax(-1) < 0.0131).all())
    assert bool((hand.lower[6:] < 0).all() and (hand.upper[6:] > 0).all())
    assert bool(torch.isinf(hand.lower[:6]).all())
    flexion = [i for i, name in enumerate(hand.dof_names) if name.endswith("pip_flexion")]
    assert bool((hand.upper[flexion] > math.radians(95)).all())
    assert float(hand.upper[6:].max()) < math.radians(120)


def test_the_left_hand_is_the_mirror_image_of_the_right(hand):
    left = tr.Hand("left", dtype=D)
    poses = poses_of(hand)
    mirrored = poses.clone()
    mirrored[:, [0, 4, 5]] *= -1
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=D)
    torch.testing.assert_close(left.keypoints(mirrored), hand.keypoints(poses) * flip, atol=1e-12, rtol=0)
    points = around(hand, poses)
    torch.testing.assert_close(left.distance(points * flip, mirrored), hand.distance(points, poses))
    assert torch.equal(left.lower, hand.lower)


def test_flexion_closes_the_hand_and_abduction_moves_towards_the_thumb(either_hand):
    hand, sign = either_hand, 1 if either_hand.side == "right" else -1
    rest = hand.keypoints(hand.rest_pose())
    for finger, tip in (("index", 8), ("middle", 12), ("ring", 16), ("little", 20)):
        for joint in ("mcp", "pip", "dip"):
            bent = hand.keypoints(posed(hand, **{f"{finger}_{joint}_flexion": 40}))[tip]
            assert bent[1] < rest[tip, 1] - 0.005
        spread = hand.keypoints(posed(hand, **{f"{finger}_mcp_abduction": 10}))[tip]
        assert sign * spread[0] > sign * rest[tip, 0] + 0.005
    thumb = hand.keypoints(posed(hand, thumb_mcp_flexion=40, thumb_ip_flexion=40))[4]
    assert (thumb - rest[17]).norm() < (rest[4] - rest[17]).norm()


@torch.no_grad()
def test_fingers_that_touch_do_not_fuse(hand):
    pose = posed(hand, index_mcp_abduction=-8.0, middle_mcp_abduction=4.0)
    points = hand.keypoints(pose)
    first, second = (points[6] + points[7]) / 2, (points[10] + points[11]) / 2
    line = first + (second - first) * torch.linspace(0, 1, 2001, dtype=D)[:, None]
    parts = hand.part_distances(line, pose)
    index, middle = parts[:, 4:7], parts[:, 7:10]
    at = int((index.amin(-1) - middle.amin(-1)).abs().argmin())
    assert abs(float(index[at].min())) < hand.nu
    one_finger = -hand.nu * float((-index[at] / hand.nu).logsumexp(-1))
    both_fingers = -hand.nu * float((-parts[at, 4:10] / hand.nu).logsumexp(-1))
    assert both_fingers < one_finger - 0.5 * hand.nu * math.log(2)
    distance = hand.distance(line, pose)
    assert abs(float(distance[at]) - one_finger) < 0.1 * hand.nu
    # Nor does the surface between them jump by more than what neighbors of one finger add.
    assert float(distance[500:1500].diff().abs().max()) < 0.1 * hand.nu


def test_sizes_follow_the_parameters_and_the_scale(hand):
    own = tr.Hand(dtype=D)
    with torch.no_grad():
        own.log_length_scales[4] = math.log(1.1)
        own.log_radius_scales[4] = math.log(0.9)
    assert own.part_names[4] == "index_proximal"
    torch.testing.assert_close(own.bone_lengths[4], 1.1 * hand.bone_lengths[4])
    torch.testing.assert_close(own.radii[4], hand.radii[4] * torch.tensor([0.9, 0.9, 1.1], dtype=D))
    assert torch.equal(own.bone_lengths[5:], hand.bone_lengths[5:])
    moved = (own.keypoints(own.rest_pose()) - hand.keypoints(hand.rest_pose())).norm(dim=-1)
    torch.testing.assert_close(moved[6:9], 0.1 * hand.bone_lengths[4].expand(3))
    assert bool((moved[:6] == 0).all())
    half, pose = tr.Hand(scale=0.5, nu=0.0015, dtype=D), poses_of(hand, 1)[0]
    small = torch.cat([0.5 * pose[:3], pose[3:]])
    points = hand.keypoints(pose) + 0.004
    torch.testing.assert_close(half.keypoints(small), 0.5 * hand.keypoints(pose))
    torch.testing.assert_close(half.distance(0.5 * points, small), 0.5 * hand.distance(points, pose))


def test_what_is_not_named_stays_at_rest_in_the_precision_of_the_values(plain_hand):
    angle = torch.tensor(0.3, requires_grad=True)
    pose = plain_hand.pose_from_dict({"index_pip_flexion": angle, "base_z": 0.5})
    assert pose[[2, plain_hand.dof_names.index("index_pip_flexion")]].tolist() == pytest.approx([0.5, 0.3])
    assert int((pose != plain_hand.rest_pose()).sum()) == 2
    pose.sum().backward()
    assert float(angle.grad) == 1.0
    far = torch.zeros(27, dtype=D)
    far[0] = 431_234.5678
    assert plain_hand.pose_to_dict(far)["base_x"] == 431_234.5678
