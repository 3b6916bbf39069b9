"""Poses and keypoints in other models' words: a kinematic tree of MANO's kind built from the numbers alone, names."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.shapes.kinds import compare, poses_of, seeded
from torchreg.geometry.rotation import so3_exp
from torchreg.shapes import pose_conversions as conversions

# MANO's own table of parents, from its paper's kinematic tree.
MANO_PARENTS = [-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14]


@pytest.fixture
def hand(either_hand):
    return either_hand


def mano_joints(hand, mano):
    """Return the 16 joints by forward kinematics as MANO does it, with the hand's own joints put in MANO's axes."""
    side = 1 if hand.side == "left" else -1
    # Fingers (z) along -x for a right hand, the back (y) up, the thumb (x of a right hand, -x of a left one) on z.
    rest = hand.keypoints(hand.rest_pose() * 0).numpy()
    rest = rest[:, [2, 1, 0]] * [side, 1, -side]
    rest = conversions.reorder_keypoints(torch.from_numpy(rest.copy()), "torchreg", "mano")[:16].numpy()
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


def test_mano_kinematics_put_the_joints_where_the_hand_has_them_and_poses_come_back(hand):
    poses = poses_of(hand, 6)
    for pose in poses:
        ours = conversions.reorder_keypoints(hand.keypoints(pose), "torchreg", "mano")[:16]
        compare([mano_joints(hand, conversions.to_mano_pose(hand, pose))], [ours])
    for flat_pose in (None, poses[0]):
        mano = conversions.to_mano_pose(hand, poses.reshape(2, 3, 27), flat_pose=flat_pose)
        assert mano.hand_pose.shape == (2, 3, 15, 3)
        back = conversions.from_mano_pose(hand, mano, flat_pose=flat_pose)
        compare([back], [hand.clamp(poses).reshape(2, 3, 27)], atol=1e-9)


def test_gradients_pass_through_both_ways(hand):
    pose = poses_of(hand, 3)[2]
    there = conversions.to_mano_pose
    assert torch.autograd.gradcheck(
        lambda p: so3_exp(there(hand, p).hand_pose[:4]), pose.clone().requires_grad_(), fast_mode=True
    )
    for still in (pose, torch.zeros_like(pose)):
        mano = there(hand, still)
        turns = mano.hand_pose.clone().requires_grad_()
        joints = conversions.from_mano_pose(hand, conversions.ManoPose(mano.global_orient, turns, mano.wrist))
        assert torch.autograd.grad(joints.sum(), turns)[0].isfinite().all()


def test_keypoint_orders_are_permutations_that_undo_each_other():
    points = seeded(2, 21, 3)
    for source, names in conversions.KEYPOINT_ORDERS.items():
        assert sorted(names) == sorted(conversions.KEYPOINT_ORDERS["torchreg"])
        for target in conversions.KEYPOINT_ORDERS:
            there = conversions.reorder_keypoints(points, source, target)
            torch.testing.assert_close(conversions.reorder_keypoints(there, target, source), points)
    # MANO: wrist, index, middle, little, ring, thumb; tips last, as its users know them in OpenPose's order.
    known = [0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20]
    torch.testing.assert_close(conversions.reorder_keypoints(points, "mano", "openpose"), points[:, known])
    torch.testing.assert_close(
        conversions.reorder_keypoints(points, "interhand", "openpose")[:, :5], points[:, [20, 3, 2, 1, 0]]
    )


def test_xr_joints_have_parts_and_keypoints(hand):
    webxr, openxr = conversions.WEBXR_JOINTS, conversions.OPENXR_JOINTS
    assert (len(webxr), len(openxr)) == (25, 26)
    assert set(conversions.WEBXR_PARTS.values()) == set(conversions.OPENXR_PARTS.values()) == set(hand.part_names)
    bones = ("metacarpal", "phalanx-proximal", "phalanx-intermediate", "phalanx-distal", "tip")
    assert webxr[5:10] == tuple(f"index-finger-{bone}" for bone in bones)
    assert openxr[:4] == ("PALM", "WRIST", "THUMB_METACARPAL", "THUMB_PROXIMAL")
    bones = ("METACARPAL", "PROXIMAL", "INTERMEDIATE", "DISTAL", "TIP")
    assert openxr[-5:] == tuple(f"LITTLE_{bone}" for bone in bones)
    assert conversions.WEBXR_PARTS["ring-finger-phalanx-intermediate"] == "ring_middle"
    expected = [0, 1, 2, 3, 4, *range(6, 10), *range(11, 15), *range(16, 20), *range(21, 25)]
    assert conversions.keypoints_from_xr(torch.arange(25.0)[:, None])[:, 0].tolist() == expected
    found = conversions.keypoints_from_xr(torch.arange(26.0)[:, None], "openxr")
    assert found[:, 0].tolist() == [e + 1 for e in expected]
