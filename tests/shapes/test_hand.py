"""The hand: its parts, its order of keypoints, its sides, its sizes, and fingers that touch without fusing."""

import math

import numpy as np
import pytest
import torch

from torchreg.errors import InputError
from torchreg.shapes.hand import FINGER_NAMES, Hand


@pytest.fixture(scope="module")
def hand():
    return Hand(dtype=torch.float64)


def posed(hand, **degrees):
    pose = hand.rest_pose()
    for name, value in degrees.items():
        pose[hand.dof_names.index(name)] = math.radians(value)
    return pose


def random_pose(hand, seed):
    generator = torch.Generator().manual_seed(seed)
    pose = torch.randn(27, dtype=torch.float64, generator=generator)
    lower, upper = hand.lower[6:], hand.upper[6:]
    pose[6:] = lower + (upper - lower) * torch.rand(21, dtype=torch.float64, generator=generator)
    return pose


def test_sixteen_parts_and_27_degrees_of_freedom(hand):
    assert hand.num_parts == 16
    assert hand.num_dofs == 27
    assert hand.part_names[:4] == ("palm", "thumb_metacarpal", "thumb_proximal", "thumb_distal")
    assert hand.part_names[-1] == "little_distal"
    per_finger = {finger: [name for name in hand.dof_names if name.startswith(finger)] for finger in FINGER_NAMES}
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
    across = points[[1, 5, 9, 13, 17], 0]
    assert across[1:].diff().lt(0).all()
    assert hand.keypoints(hand.rest_pose().expand(2, 3, 27)).shape == (2, 3, 21, 3)


def test_fingertips_lie_on_the_surface(hand):
    pose = random_pose(hand, 3)
    tips = hand.keypoints(pose)[[4, 8, 12, 16, 20]]
    parts = hand.part_distances(tips, pose)[range(5), list(hand.fingertip_parts)]
    torch.testing.assert_close(parts, torch.zeros(5, dtype=torch.float64), atol=1e-12, rtol=0)


def test_it_has_adult_proportions(hand):
    points = hand.keypoints(hand.rest_pose()) * 1000
    length = points[12].norm()
    assert 180 < length < 205
    assert 75 < 2000 * hand.radii[0, 0] < 100
    assert 24 < 2000 * hand.radii[0, 1] < 34
    tips = points[[8, 12, 16, 20]].norm(dim=-1)
    assert tips.argmax() == 1
    assert tips[3] == tips.min()
    bones = hand.bone_lengths[1:].unflatten(0, (5, 3))
    assert bool((bones.diff(dim=-1)[:4] < 0).all())
    assert bool((hand.radii[1:, :2].amax(-1) < 0.0131).all())


@pytest.mark.parametrize("seed", range(3))
def test_the_left_hand_is_the_mirror_image_of_the_right(hand, seed):
    left = Hand("left", dtype=torch.float64)
    pose = random_pose(hand, seed)
    mirrored = pose.clone()
    mirrored[[0, 4, 5]] *= -1
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(left.keypoints(mirrored), hand.keypoints(pose) * flip, atol=1e-12, rtol=0)
    points = hand.keypoints(pose).repeat(3, 1) + 0.01 * torch.randn(
        63, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)
    )
    torch.testing.assert_close(left.distance(points * flip, mirrored), hand.distance(points, pose))
    assert torch.equal(left.lower, hand.lower)


def test_flexion_closes_the_hand_and_abduction_moves_towards_the_thumb(hand):
    for side, sign in (("right", 1), ("left", -1)):
        own = Hand(side, dtype=torch.float64)
        rest = own.keypoints(own.rest_pose())
        for finger, tip in (("index", 8), ("middle", 12), ("ring", 16), ("little", 20)):
            for joint in ("mcp", "pip", "dip"):
                bent = own.keypoints(posed(own, **{f"{finger}_{joint}_flexion": 40}))[tip]
                assert bent[1] < rest[tip, 1] - 0.005
            spread = own.keypoints(posed(own, **{f"{finger}_mcp_abduction": 10}))[tip]
            assert sign * spread[0] > sign * rest[tip, 0] + 0.005
    thumb = hand.keypoints(posed(hand, thumb_mcp_flexion=40, thumb_ip_flexion=40))[4]
    little = hand.keypoints(hand.rest_pose())[17]
    assert (thumb - little).norm() < (hand.keypoints(hand.rest_pose())[4] - little).norm()


def test_joint_limits_hold_the_rest_pose_and_are_those_of_a_hand(hand):
    assert bool((hand.lower[6:] < 0).all())
    assert bool((hand.upper[6:] > 0).all())
    assert bool(torch.isinf(hand.lower[:6]).all())
    flexion = [i for i, name in enumerate(hand.dof_names) if name.endswith("pip_flexion")]
    assert bool((hand.upper[flexion] > math.radians(95)).all())
    assert float(hand.upper[6:].max()) < math.radians(120)
    wild = torch.full((27,), 9.0, dtype=torch.float64)
    assert torch.equal(hand.clamp(wild)[6:], hand.upper[6:])


@torch.no_grad()
def eq1(hand, points, pose):
    """Equations 1 and 2 literally, point by point."""
    distances = hand.part_distances(points, pose).detach().numpy()
    parents = [-1] + [0 if part % 3 == 1 else part - 1 for part in range(1, 16)]
    found = []
    for row in distances:
        fields = np.exp(-row / hand.nu)
        p = int(fields.argmax())
        near = [q for q in range(16) if q == p or parents[q] == p or parents[p] == q]
        found.append(-hand.nu * np.log(fields[near].sum()))
    return np.array(found)


def test_the_fused_distance_is_equation_1_with_neighbors_only(hand):
    pose = random_pose(hand, 8)
    points = hand.keypoints(pose).repeat(10, 1) + 0.008 * torch.randn(
        210, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    np.testing.assert_allclose(hand.distance(points, pose).detach().numpy(), eq1(hand, points, pose), atol=1e-12)


@torch.no_grad()
def test_fingers_that_touch_do_not_fuse(hand):
    pose = posed(hand, index_mcp_abduction=-8.0, middle_mcp_abduction=4.0)
    points = hand.keypoints(pose)
    first, second = (points[6] + points[7]) / 2, (points[10] + points[11]) / 2
    line = first + (second - first) * torch.linspace(0, 1, 2001, dtype=torch.float64)[:, None]
    parts = hand.part_distances(line, pose)
    index, middle = parts[:, 4:7], parts[:, 7:10]
    at = int((index.amin(-1) - middle.amin(-1)).abs().argmin())
    gap = float(index[at].min())
    assert abs(gap) < hand.nu
    one_finger = -hand.nu * float((-index[at] / hand.nu).logsumexp(-1))
    both_fingers = -hand.nu * float((-parts[at, 4:10] / hand.nu).logsumexp(-1))
    assert both_fingers < one_finger - 0.5 * hand.nu * math.log(2)
    distance = hand.distance(line, pose)
    assert abs(float(distance[at]) - one_finger) < 0.1 * hand.nu
    # Nor does the surface between them jump by more than what neighbors of one finger add.
    assert float(distance[500:1500].diff().abs().max()) < 0.1 * hand.nu


def test_sizes_follow_the_parameters(hand):
    own = Hand(dtype=torch.float64)
    with torch.no_grad():
        own.log_length_scales[4] = math.log(1.1)
        own.log_radius_scales[4] = math.log(0.9)
    assert own.part_names[4] == "index_proximal"
    torch.testing.assert_close(own.bone_lengths[4], 1.1 * hand.bone_lengths[4])
    torch.testing.assert_close(own.radii[4], hand.radii[4] * torch.tensor([0.9, 0.9, 1.1], dtype=torch.float64))
    assert torch.equal(own.bone_lengths[5:], hand.bone_lengths[5:])
    moved = (own.keypoints(own.rest_pose()) - hand.keypoints(hand.rest_pose())).norm(dim=-1)
    torch.testing.assert_close(moved[6:9], 0.1 * hand.bone_lengths[4].expand(3))
    assert bool((moved[:6] == 0).all())
    own.requires_grad_(True).keypoints(own.rest_pose()).sum().backward()
    assert own.log_length_scales.grad is not None


def test_scale_scales_everything(hand):
    half = Hand(scale=0.5, nu=0.0015, dtype=torch.float64)
    pose = random_pose(hand, 2)
    small = pose.clone()
    small[:3] *= 0.5
    points = hand.keypoints(pose) + 0.004
    torch.testing.assert_close(half.keypoints(small), 0.5 * hand.keypoints(pose))
    torch.testing.assert_close(half.distance(0.5 * points, small), 0.5 * hand.distance(points, pose))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"side": "both"}, "side must be one of right, left; got 'both'"),
        ({"scale": 0.0}, "scale must be positive and finite, got 0.0"),
        ({"nu": -1.0}, "nu must be positive and finite"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        Hand(**options)


def test_poses_of_the_wrong_size_are_refused(hand):
    with pytest.raises(InputError, match=r"pose must have shape \(\.\.\., 27\), got \(26,\)"):
        hand.keypoints(torch.zeros(26, dtype=torch.float64))


def test_length_is_from_the_wrist_to_the_middle_fingertip():
    points = Hand().keypoints(Hand().rest_pose()).detach()
    assert Hand().length == pytest.approx(float((points[12] - points[0]).norm()))
    assert 0.15 < Hand().length < 0.25
