"""Joints between bones: known hinges and balls are found again, free axes fall back, strongest joints make the tree."""

import pytest
import torch

from torchreg.geometry.rigid import rigid_matrix, se3_exp, transform_points
from torchreg.geometry.rotation import so3_exp
from torchreg.registration.bones.joint_moments import JointMoments
from torchreg.registration.bones.joints import bone_tree, bridged, find_joints


def moments_at(pairs, centers, masses=None):
    count = len(pairs)
    centers = torch.as_tensor(centers, dtype=torch.float64)
    mass = torch.ones(count, dtype=torch.float64) if masses is None else torch.as_tensor(masses, dtype=torch.float64)
    return JointMoments(
        torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2), mass, centers, torch.zeros(count, 3, 3).double()
    )


def turned_about(point, rotation_vector):
    turn = so3_exp(torch.as_tensor(rotation_vector, dtype=torch.float64))
    point = torch.as_tensor(point, dtype=torch.float64)
    return rigid_matrix(turn, point - turn @ point)


def test_a_hinge_is_found_and_its_axis_left_at_the_region():
    whole = se3_exp(torch.tensor([1.0, -2, 3, 0.4, 0.2, -1], dtype=torch.float64))
    hinge = turned_about([1.0, 2.0, 0.0], [0, 0, 1.2])
    transforms = torch.stack([whole, whole @ hinge])
    joints = find_joints(moments_at([[0, 1]], [[1.3, 1.8, 0.7]]), transforms, regularization=1e-8)
    torch.testing.assert_close(joints.centers[0], torch.tensor([1.0, 2.0, 0.7], dtype=torch.float64))
    assert float(joints.gaps[0]) < 1e-6


def test_several_poses_find_a_ball_joint():
    ball = torch.tensor([0.5, -1.0, 2.0], dtype=torch.float64)
    poses = torch.stack(
        [
            torch.stack([torch.eye(4, dtype=torch.float64), turned_about(ball, vector)])
            for vector in ([0.5, 0, 0], [0, 0.5, 0.1], [0, 0, 0.4])
        ]
    )
    joints = find_joints(moments_at([[0, 1]], [[0.0, 0.0, 0.0]]), poses, regularization=1e-9)
    torch.testing.assert_close(joints.centers[0], ball, atol=1e-6, rtol=0)
    assert joints.gaps.shape == (3, 1)


def test_bones_that_turn_alike_meet_at_the_region():
    transforms = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    transforms[1, 0, 3] = 0.25
    joints = find_joints(moments_at([[0, 1]], [[1.0, 2.0, 3.0]]), transforms)
    assert joints.centers.tolist() == [[1.0, 2.0, 3.0]]
    assert joints.gaps.tolist() == [0.25]


def test_the_regularization_is_the_square_of_an_angle():
    region = [0.0, 0.0, 0.0]
    for angle in (0.1, 0.4):
        hinge = torch.stack([torch.eye(4, dtype=torch.float64), turned_about([1.0, 0.0, 0.0], [0, 0, angle])])
        found = find_joints(moments_at([[0, 1]], [region]), hinge, regularization=angle**2).centers[0]
        assert float(found[0]) == pytest.approx(0.5, abs=0.01)


def test_joints_move_with_the_space_and_have_gradients():
    transforms = se3_exp(torch.randn(3, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    moments = moments_at([[0, 1], [1, 2]], [[0.1, 0.2, 0.3], [1.0, 0.0, -1.0]])
    found = find_joints(moments, transforms).centers
    start = se3_exp(torch.tensor([0.3, 2, 1, 1, -0.5, 0.2], dtype=torch.float64))
    back = torch.linalg.inv(start)
    moved = moments_at([[0, 1], [1, 2]], moments.center @ start[:3, :3].mT + start[:3, 3])
    there = find_joints(moved, transforms @ back).centers
    torch.testing.assert_close(there, found @ start[:3, :3].mT + start[:3, 3])
    scaled = transforms.clone()
    scaled[:, :3, 3] *= 50
    wide = find_joints(moments_at([[0, 1], [1, 2]], 50 * moments.center), scaled).centers
    torch.testing.assert_close(wide, 50 * found)
    assert torch.autograd.gradcheck(lambda t: find_joints(moments, t).centers, (transforms.requires_grad_(),))


def test_the_tree_takes_the_strongest_joints():
    centers = [[1.0, 0, 0], [2.0, 0, 0], [3.0, 0, 0], [4.0, 0, 0]]
    moments = moments_at([[0, 1], [0, 2], [1, 2], [3, 4]], centers, [5.0, 1.0, 4.0, 0.5])
    joints = find_joints(moments, torch.eye(4, dtype=torch.float64).repeat(6, 1, 1))
    middles = torch.full((6, 3), 9.0, dtype=torch.float64)
    tree = bone_tree(joints, middles, [1.0, 3.0, 2.0, 1.0, 2.0, 0.0])
    assert tree.parents == (1, -1, 1, 4, -1, -1)
    assert tree.origins[:, 0].tolist() == [1.0, 9.0, 3.0, 4.0, 9.0, 9.0]


def test_bones_without_joints_are_roots():
    moments = moments_at([], torch.zeros(0, 3))
    joints = find_joints(moments, torch.eye(4, dtype=torch.float64).repeat(2, 1, 1))
    assert bone_tree(joints, torch.zeros(2, 3), torch.ones(2)).parents == (-1, -1)


def rows_of_corners(*spans):
    """Corners in rows along x, one row per bone from ``(first, last, y)``, and their weights."""
    corners, owner = [], []
    for bone, (first, last, y) in enumerate(spans):
        corners += [[float(x), float(y), 0.0] for x in range(first, last + 1)]
        owner += [bone] * (last - first + 1)
    weights = torch.nn.functional.one_hot(torch.tensor(owner)).double()
    return torch.tensor(corners, dtype=torch.float64), weights


REST = torch.eye(4, dtype=torch.float64)


def test_a_gap_is_bridged_where_bones_come_nearest():
    corners, weights = rows_of_corners((0, 4, 0), (5, 9, 0), (12, 15, 0), (12, 15, 8))
    found = bridged(moments_at([[0, 1]], [[4.5, 0, 0]], [3.0]), corners, weights, REST.repeat(4, 1, 1))
    assert found.pairs.tolist() == [[0, 1], [1, 2], [2, 3]]
    assert found.mass.tolist() == [3.0, 0.0, 0.0]
    torch.testing.assert_close(found.center[1], torch.tensor([10.5, 0, 0], dtype=torch.float64))
    assert float(found.center[2, 1]) == 4.0
    assert float(found.spread.abs().max()) == 0.0
    joints = find_joints(found, REST.repeat(4, 1, 1))
    assert bone_tree(joints, torch.zeros(4, 3, dtype=torch.float64), [1.0, 4.0, 1.0, 1.0]).parents == (1, -1, 1, 2)


@pytest.mark.parametrize("batch", [(), (3,)])
def test_a_gap_is_bridged_to_what_moves_alike_though_another_bone_is_nearer(batch):
    # Two shins side by side; the thigh of the second is hidden, and its hip is on the trunk above.
    corners, weights = rows_of_corners((0, 9, 0), (0, 9, 2), (0, 9, 5))
    trunk, near = REST, turned_about([0.0, 0, 0], [0, 0, 1.0])
    transforms = torch.stack([near, turned_about([0.0, 3.5, 0], [0, 0, -1.0]), trunk]).expand(*batch, 3, 4, 4)
    moments = moments_at([[0, 2]], [[0.0, 0, 0]])
    assert bridged(moments, corners, weights, transforms).pairs.tolist() == [[0, 2], [1, 2]]
    still = REST.repeat(3, 1, 1)
    assert bridged(moments, corners, weights, still).pairs.tolist() == [[0, 1], [0, 2]]


def test_bridges_move_and_grow_with_the_space():
    corners, weights = rows_of_corners((0, 4, 0), (8, 12, 1), (0, 4, 7))
    # No two distances alike.
    corners = corners + 0.3 * torch.rand(corners.shape, generator=torch.Generator().manual_seed(0)).double()
    transforms = se3_exp(0.1 * torch.randn(3, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64))
    none = moments_at([], torch.zeros(0, 3))
    found = bridged(none, corners, weights, transforms)
    start = se3_exp(torch.tensor([0.3, 2, 1, 1, -0.5, 0.2], dtype=torch.float64))
    moved = bridged(none, transform_points(start, corners), weights, transforms @ torch.linalg.inv(start))
    assert torch.equal(moved.pairs, found.pairs)
    torch.testing.assert_close(moved.center, transform_points(start, found.center))
    wide = transforms.clone()
    wide[:, :3, 3] *= 50
    scaled = bridged(none, 50 * corners, weights, wide)
    assert torch.equal(scaled.pairs, found.pairs)
    torch.testing.assert_close(scaled.center, 50 * found.center)


def test_one_group_and_bones_without_weight_are_left_alone():
    corners, weights = rows_of_corners((0, 4, 0), (5, 9, 0))
    weights = torch.nn.functional.pad(weights, (0, 1))
    moments = moments_at([[0, 1]], [[4.5, 0, 0]])
    assert bridged(moments, corners, weights, REST.repeat(3, 1, 1)) is moments
