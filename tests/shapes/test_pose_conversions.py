"""Poses and keypoints in other models' words: a kinematic tree of MANO's kind built from the numbers alone, names."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchreg.errors import InputError
from torchreg.geometry.rotation import so3_exp
from torchreg.shapes.hand import Hand
from torchreg.shapes.pose_conversions import (
    KEYPOINT_ORDERS,
    OPENXR_JOINTS,
    OPENXR_PARTS,
    WEBXR_JOINTS,
    WEBXR_PARTS,
    ManoPose,
    from_mano_pose,
    keypoints_from_xr,
    reorder_keypoints,
    to_mano_pose,
)

D = torch.float64
# MANO's own table of parents, from its paper's kinematic tree.
MANO_PARENTS = [-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14]


@pytest.fixture(scope="module", params=["right", "left"])
def hand(request):
    return Hand(request.param, dtype=D).requires_grad_(False)


def some_poses(hand, count=6):
    generator = torch.Generator().manual_seed(3)
    poses = torch.randn(count, 27, generator=generator, dtype=D)
    share = torch.rand(count, 21, generator=generator, dtype=D)
    poses[:, 6:] = hand.lower[6:] + share * (hand.upper - hand.lower)[6:]
    return hand.clamp(poses)


def mano_joints(hand, mano):
    """Return the 16 joints by forward kinematics as MANO does it, with the hand's own joints put in MANO's axes."""
    side = 1 if hand.side == "left" else -1
    # Fingers (z) along -x for a right hand, the back (y) up, the thumb (x of a right hand, -x of a left one) on z.
    rest = hand.keypoints(hand.rest_pose() * 0).numpy()
    rest = rest[:, [2, 1, 0]] * [side, 1, -side]
    rest = reorder_keypoints(torch.from_numpy(rest.copy()), "torchreg", "mano")[:16].numpy()
    turns = Rotation.from_rotvec([mano.global_orient.numpy(), *mano.hand_pose.numpy()]).as_matrix()
    rotations, places = [], []
    for joint, parent in enumerate(MANO_PARENTS):
        if parent < 0:
            rotations.append(turns[joint])
            places.append(mano.wrist.numpy())
        else:
            rotations.append(rotations[parent] @ turns[joint])
            places.append(places[parent] + rotations[parent] @ (rest[joint] - rest[parent]))
    return torch.from_numpy(np.stack(places))


def test_mano_kinematics_put_the_joints_where_the_hand_has_them(hand):
    for pose in some_poses(hand):
        ours = reorder_keypoints(hand.keypoints(pose), "torchreg", "mano")[:16]
        torch.testing.assert_close(mano_joints(hand, to_mano_pose(hand, pose)), ours, atol=1e-12, rtol=0)


def test_poses_go_to_mano_and_back(hand):
    poses = some_poses(hand).reshape(2, 3, 27)
    flat = some_poses(hand)[0]
    for flat_pose in (None, flat):
        mano = to_mano_pose(hand, poses, flat_pose=flat_pose)
        assert mano.hand_pose.shape == (2, 3, 15, 3)
        back = from_mano_pose(hand, mano, flat_pose=flat_pose)
        torch.testing.assert_close(back, poses, atol=1e-9, rtol=0)


def test_zero_mano_is_the_flat_hand_and_its_axes_are_manos(hand):
    still = ManoPose(torch.zeros(3, dtype=D), torch.zeros(15, 3, dtype=D), torch.zeros(3, dtype=D))
    pose = from_mano_pose(hand, still)
    assert not pose[6:].abs().gt(1e-12).any()
    points = hand.keypoints(pose)
    along = points[12] - points[0]
    assert along[0] * (1 if hand.side == "left" else -1) > 0.15
    assert points[4, 2] > 0.05
    torch.testing.assert_close(hand.part_transforms(pose)[0, :3, 1], torch.tensor([0.0, 1, 0], dtype=D))


def test_rotations_that_no_joint_makes_go_to_the_nearest(hand):
    generator = torch.Generator().manual_seed(1)
    mano = to_mano_pose(hand, some_poses(hand)[1])
    noisy = ManoPose(
        mano.global_orient, mano.hand_pose + 0.1 * torch.randn(15, 3, generator=generator, dtype=D), mano.wrist
    )
    pose = from_mano_pose(hand, noisy)

    def gap(candidate):
        return (so3_exp(to_mano_pose(hand, candidate).hand_pose) - so3_exp(noisy.hand_pose)).square().sum()

    for dof in range(6, 27):
        for step in (-1e-3, 1e-3):
            moved = pose.clone()
            moved[dof] += step
            assert gap(moved) > gap(pose)


def test_gradients_pass_through_both_ways():
    hand = Hand(dtype=D).requires_grad_(False)
    pose = some_poses(hand)[2]
    mano = to_mano_pose(hand, pose)
    assert torch.autograd.gradcheck(lambda p: so3_exp(to_mano_pose(hand, p).hand_pose[:4]), pose.requires_grad_())
    for still in (pose.detach(), torch.zeros_like(pose)):
        mano = to_mano_pose(hand, still)
        turns = mano.hand_pose.clone().requires_grad_()
        joints = from_mano_pose(hand, ManoPose(mano.global_orient, turns, mano.wrist))
        assert torch.autograd.grad(joints.sum(), turns)[0].isfinite().all()


def test_keypoint_orders_are_permutations_that_undo_each_other():
    points = torch.randn(2, 21, 3, generator=torch.Generator().manual_seed(0))
    for source, names in KEYPOINT_ORDERS.items():
        assert sorted(names) == sorted(KEYPOINT_ORDERS["torchreg"])
        for target in KEYPOINT_ORDERS:
            there = reorder_keypoints(points, source, target)
            torch.testing.assert_close(reorder_keypoints(there, target, source), points)
    # MANO: wrist, index, middle, little, ring, thumb; tips last, as its users know them in OpenPose's order.
    known = [0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20]
    torch.testing.assert_close(reorder_keypoints(points, "mano", "openpose"), points[:, known])
    torch.testing.assert_close(reorder_keypoints(points, "interhand", "openpose")[:, :5], points[:, [20, 3, 2, 1, 0]])


def test_xr_joints_have_parts_and_keypoints():
    hand = Hand()
    assert len(WEBXR_JOINTS) == 25
    assert len(OPENXR_JOINTS) == 26
    assert set(WEBXR_PARTS.values()) == set(OPENXR_PARTS.values()) == set(hand.part_names)
    assert WEBXR_JOINTS[5:10] == (
        "index-finger-metacarpal", "index-finger-phalanx-proximal", "index-finger-phalanx-intermediate",
        "index-finger-phalanx-distal", "index-finger-tip",
    )  # fmt: skip
    assert OPENXR_JOINTS[:4] == ("PALM", "WRIST", "THUMB_METACARPAL", "THUMB_PROXIMAL")
    assert OPENXR_JOINTS[-5:] == (
        "LITTLE_METACARPAL",
        "LITTLE_PROXIMAL",
        "LITTLE_INTERMEDIATE",
        "LITTLE_DISTAL",
        "LITTLE_TIP",
    )
    assert WEBXR_PARTS["ring-finger-phalanx-intermediate"] == "ring_middle"
    index = torch.arange(25.0).unsqueeze(-1)
    expected = [0, 1, 2, 3, 4, *range(6, 10), *range(11, 15), *range(16, 20), *range(21, 25)]
    assert keypoints_from_xr(index)[:, 0].tolist() == expected
    assert keypoints_from_xr(torch.arange(26.0)[:, None], "openxr")[:, 0].tolist() == [e + 1 for e in expected]


def test_bad_input_is_told():
    hand, points = Hand(), torch.zeros(21, 3)
    with pytest.raises(InputError, match="target must be one of"):
        reorder_keypoints(points, "mano", "nyu")
    with pytest.raises(InputError, match="keypoints must have shape"):
        reorder_keypoints(points[:20], "mano", "openpose")
    with pytest.raises(InputError, match="joints must have shape"):
        keypoints_from_xr(points)
    with pytest.raises(InputError, match="leading dimensions"):
        from_mano_pose(hand, ManoPose(torch.zeros(2, 3), torch.zeros(15, 3), torch.zeros(3)))
    with pytest.raises(InputError, match="flat_pose must have shape"):
        to_mano_pose(hand, hand.rest_pose(), flat_pose=torch.zeros(2, 27))
