"""Motion of skeletons as BVH: a reader of its own, which knows the format alone, puts every joint where it was."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import torchreg as tr
from torchreg.datasets.hand import hand_motion
from torchreg.io.bvh import save_bvh
from torchreg.viz.track_bvh import save_track_bvh


def read(path):
    """Return the names of joints, their positions (T, J, 3) and rotations (T, J, 3, 3), and the seconds of a frame."""
    head, motion = path.read_text(encoding="utf-8").split("MOTION\n")
    names, parents, offsets, channels, open_joints = [], [], [], [], []
    for line in head.splitlines()[1:]:
        words = line.split()
        if words[0] in ("ROOT", "JOINT", "End"):
            names.append(words[1])
            parents.append(open_joints[-1] if open_joints else -1)
            channels.append([])
        elif words[0] == "{":
            open_joints.append(len(names) - 1)
        elif words[0] == "}":
            open_joints.pop()
        elif words[0] == "OFFSET":
            offsets.append(np.array(words[1:], float))
        else:
            channels[-1] = words[2:]
            assert int(words[1]) == len(words[2:])
    lines = motion.splitlines()
    rows = np.array([line.split() for line in lines[2:]], float)
    assert lines[0] == f"Frames: {len(rows)}"
    places, turns, used = [], [], 0
    for parent, offset, names_of in zip(parents, offsets, channels, strict=True):
        values = dict(zip(names_of, rows[:, used : used + len(names_of)].T, strict=True))
        used += len(names_of)
        shift = np.stack([values.get(f"{axis}position", np.zeros(len(rows))) for axis in "XYZ"], -1) + offset
        order = "".join(name[0] for name in names_of if name.endswith("rotation"))
        turn = np.tile(np.eye(3), (len(rows), 1, 1))
        if order:
            angles = np.stack([values[f"{axis}rotation"] for axis in order], -1)
            turn = Rotation.from_euler(order, angles, degrees=True).as_matrix()
        if parent < 0:
            places.append(shift)
            turns.append(turn)
        else:
            places.append(places[parent] + np.einsum("tij,tj->ti", turns[parent], shift))
            turns.append(turns[parent] @ turn)
    assert used == rows.shape[1]
    keep = [index for index, name in enumerate(names) if name != "Site"]
    places, turns = np.stack(places, 1)[:, keep], np.stack(turns, 1)[:, keep]
    return [names[index] for index in keep], places, turns, float(lines[1].split()[-1])


def track(shape, poses, seconds=0.05):
    count = len(poses)
    return tr.TrackResult(
        poses, torch.zeros_like(poses), shape.keypoints(poses.nan_to_num()), torch.ones(count), torch.ones(count),
        seconds * torch.arange(count), torch.ones(count), (tr.Status.CONVERGED,) * count, ("tracked",) * count,
    )  # fmt: skip


def test_a_hand_is_where_it_was_tracked(tmp_path):
    hand = tr.Hand()
    poses = hand_motion(hand, "rotate", 6)
    names, places, turns, seconds = read(save_track_bvh(tmp_path / "a.bvh", hand, track(hand, poses), up=(0, -1, 0)))
    assert names == list(hand.part_names)
    assert seconds == pytest.approx(0.05)
    flip = np.diag([1.0, -1.0, -1.0])  # from a camera's y, which is down
    expected = hand.part_transforms(poses).numpy() @ np.eye(4)
    np.testing.assert_allclose(places, expected[..., :3, 3] @ flip, atol=1e-5)
    relative = np.linalg.inv(hand.part_transforms(hand.rest_pose()).numpy())[..., :3, :3]
    np.testing.assert_allclose(turns, flip @ expected[..., :3, :3] @ relative @ flip, atol=1e-5)


def test_a_pose_that_is_not_known_is_held(tmp_path):
    hand = tr.Hand()
    poses = hand_motion(hand, "bend", 4)
    poses[[0, 2]] = torch.nan
    places = read(save_track_bvh(tmp_path / "a.bvh", hand, track(hand, poses)))[1]
    np.testing.assert_array_equal(places[0], places[1])
    np.testing.assert_array_equal(places[2], places[1])
    with pytest.raises(tr.errors.InputError, match="the shape was never found"):
        save_track_bvh(tmp_path / "b.bvh", hand, track(hand, torch.full_like(poses, torch.nan)))


def test_right_angles_are_no_trap(tmp_path):
    turns = Rotation.from_euler("ZXY", [[10, 90, 20], [30, -90, 40], [170, 89.99, 5], [-170, 90, 0]], degrees=True)
    moving = torch.eye(4, dtype=torch.float64).repeat(4, 2, 1, 1)
    moving[:, 1, :3, :3] = torch.from_numpy(turns.as_matrix())
    found = read(save_bvh(tmp_path / "a.bvh", ["a", "b c"], [-1, 0], torch.eye(4).repeat(2, 1, 1), moving, 30.0))
    assert found[0] == ["a", "b_c"]
    np.testing.assert_allclose(found[2][:, 1], turns.as_matrix(), atol=1e-6)


BOX = "<visual><geometry><box size='.1 .1 .2'/></geometry></visual>"


def sides(kind):
    """Return a robot with two arms on a base without a surface."""
    joints = "".join(
        f"<joint name='{name}' type='{kind}'><parent link='base'/><child link='{name}_arm'/><origin xyz='{x} 0 0'/>"
        "<axis xyz='0 1 0'/><limit lower='-2' upper='2' effort='1' velocity='1'/></joint>"
        for name, x in (("left", 0.3), ("right", -0.3))
    )
    return (
        f"<robot name='r'><link name='base'/><link name='left_arm'>{BOX}</link><link name='right_arm'>{BOX}</link>"
        f"{joints}</robot>"
    )


def test_parts_side_by_side_hang_on_one_root(tmp_path):
    (tmp_path / "r.urdf").write_text(sides("revolute"), encoding="utf-8")
    shape = tr.ArticulatedShape.from_urdf(tmp_path / "r.urdf")
    pose = shape.pose_from_dict({"left": 0.5, "right": -0.2})
    pose[:6] = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    poses = torch.stack((pose, 0.5 * pose))
    names, places, _, _ = read(save_track_bvh(tmp_path / "a.bvh", shape, track(shape, poses)))
    assert names == ["root", *shape.part_names]
    np.testing.assert_allclose(places[:, 1:], shape.keypoints(poses).detach(), atol=1e-5)


def test_what_the_format_cannot_hold_is_refused(tmp_path):
    (tmp_path / "r.urdf").write_text(sides("prismatic"), encoding="utf-8")
    shape = tr.ArticulatedShape.from_urdf(tmp_path / "r.urdf")
    poses = torch.stack((shape.rest_pose(), shape.pose_from_dict({"left": 0.5})))
    with pytest.raises(tr.errors.InputError, match=r"'left_arm' slides by 0.5 in its parent; write \.glb"):
        save_track_bvh(tmp_path / "a.bvh", shape, track(shape, poses))
    still = torch.eye(4).repeat(2, 1, 1)
    with pytest.raises(tr.errors.InputError, match=r"path must end in \.bvh"):
        save_bvh(tmp_path / "a.txt", ["a", "b"], [-1, 0], still, still[None], 20.0)
    with pytest.raises(tr.errors.InputError, match="parents must make one tree of 2 joints"):
        save_bvh(tmp_path / "a.bvh", ["a", "b"], [-1, -1], still, still[None], 20.0)
