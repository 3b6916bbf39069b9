"""Robots found in registered scans: kinds of joints, axes, limits, and the file that moves as the scans did."""

import math

import pytest
import pytorch_kinematics as pk
import torch
import trimesh

import torchreg as tr
from torchreg.geometry.rigid import se3_exp
from torchreg.registration.robots.model import find_robot, write_robot

NOISE = 0.0005
# Of each joint: its twist (translation, rotation) by one unit, about the base's origin, 0.3 above the one before.
JOINTS = ((0, 0, 0, 0, 0.6, 0.8), (0.8, 0, 0.6, 0, 0, 0), (0, 0, 0, 0, 0, 0), (0, 0, 0, 1, 0, 0))


@pytest.fixture(scope="module")
def scans(bones):
    """Points, faces, the same points in eight frames, and their parts: five boxes, two of which hold together."""
    box = trimesh.creation.box((0.1, 0.08, 0.24)).apply_translation((0, 0, 0.15)).subdivide().subdivide()
    local, triangles = torch.from_numpy(box.vertices.copy()), torch.from_numpy(box.faces.copy())
    values = 0.4 * bones.draw(8, 4)
    values[0] = 0
    values[:, 1] *= 0.2
    frame, frames = torch.eye(4, dtype=torch.float64).repeat(8, 1, 1), []
    for number in range(5):
        frames.append(frame)
        if number < 4:
            up = torch.eye(4, dtype=torch.float64)
            up[2, 3] = 0.3
            twist = torch.tensor(JOINTS[number], dtype=torch.float64)
            frame = frame @ up @ se3_exp(values[:, number, None] * twist)
    part = torch.arange(5).repeat_interleave(len(local))
    placed = torch.stack(frames, 1)[:, part]
    deformed = (placed[..., :3, :3] @ local.repeat(5, 1).unsqueeze(-1)).squeeze(-1) + placed[..., :3, 3]
    points = deformed[0].clone()
    faces = torch.cat([triangles + number * len(local) for number in range(5)])
    return points, faces, deformed + NOISE * bones.draw(*deformed.shape, seed=1), part, values


@pytest.fixture(scope="module")
def found(scans):
    points, faces, deformed, part, _ = scans
    # Registration cuts things into more bones than they have parts: the upper end of every box is a sliver here.
    height = points[:, 2] - torch.stack([points[part == number, 2].mean() for number in range(5)])[part]
    bones = part + 5 * (height > 0.08)
    return find_robot(points, tr.RangeScan(points, faces).normals, deformed, bones)


def rand_errors(first, second):
    """Return the share of points that a labeling puts elsewhere than most points of their true part."""
    counts = torch.zeros(int(first.max()) + 1, int(second.max()) + 1).index_put_(
        (first, second), torch.ones(len(first)), accumulate=True
    )
    return 1 - float(counts.amax(1).sum()) / len(first)


def test_kinds_axes_and_values_of_joints_are_found(scans, found):
    _, _, _, part, values = scans
    assert sorted(joint.kind for joint in found.tree.joints) == ["fixed", "prismatic", "revolute", "revolute"]
    # The plate and the part that slides are one link.
    assert found.part[part == 2].unique().tolist() == found.part[part == 3].unique().tolist()
    truth = {"revolute": [(0.0, 0.6, 0.8), (1.0, 0.0, 0.0)], "prismatic": [(0.8, 0.0, 0.6)]}
    for joint in found.tree.joints[1:]:
        axis = torch.tensor(joint.axis, dtype=torch.float64)
        best = max(abs(float(axis @ torch.tensor(known).double())) for known in truth[joint.kind])
        assert math.degrees(math.acos(min(best, 1.0))) < 1
        place = found.tree.joints.index(joint) - 1
        # 3.7 standard deviations bound .999 of two directions.
        assert math.acos(min(best, 1.0)) < 3.7 * float(found.axis_std[place]) < math.radians(5)
        assert 0 <= float(found.origin_std[place]) < 0.02
    assert rand_errors(torch.tensor([0, 1, 2, 2, 3])[part], found.part) < 0.01
    assert found.loose == found.undetermined == ()
    # Whatever the root, a joint's value is that of the truth but for its sign.
    spread = sorted(float((column - column[0]).abs().max()) for column in found.joint_values.mT)
    expected = sorted(float(values[:, k].abs().max()) for k in (0, 1, 3))
    assert spread == pytest.approx(expected, abs=0.02)
    assert float(found.residuals.max()) < 2 * NOISE
    for joint, column in zip(found.tree.joints[1:], found.joint_values.mT, strict=True):
        assert joint.lower < float(column.min())
        assert joint.upper > float(column.max())


def test_the_file_moves_as_the_scans_did(scans, found, tmp_path):
    points, faces, deformed, _, _ = scans
    write_robot(tmp_path / "robot.urdf", found, points, faces)
    shape = tr.ArticulatedShape.from_urdf(tmp_path / "robot.urdf", dtype=torch.float64)
    assert shape.part_names == tuple(f"link_{number}" for number in range(4))
    names = [joint.name for joint in found.tree.joints]
    chain = pk.build_chain_from_urdf((tmp_path / "robot.urdf").read_bytes()).to(dtype=torch.float64)
    for frame in (0, 5):
        values = found.joint_values[frame]
        pose = torch.cat([torch.zeros(6, dtype=torch.float64), values])
        placed = chain.forward_kinematics(dict(zip(names[1:], values, strict=True)))
        for link, frames in zip(shape.part_names, shape.part_transforms(pose), strict=True):
            torch.testing.assert_close(placed[link].get_matrix()[0], frames, rtol=0, atol=1e-6)
    skin = shape.file_skin()
    pose = torch.cat([torch.zeros(6, dtype=torch.float64), found.joint_values[5]])
    moved = skin(pose) @ found.base[5, :3, :3].mT + found.base[5, :3, 3]
    assert float(torch.cdist(moved, deformed[5]).amin(-1).max()) < 10 * NOISE


def test_things_that_do_not_move_are_one_link(scans, tmp_path):
    points, faces, _, part, _ = scans
    still = points.expand(3, -1, -1)
    found = find_robot(points, tr.RangeScan(points, faces).normals, still, part)
    assert len(found.tree) == 1
    write_robot(tmp_path / "rock.urdf", found, points, faces)
    assert float(found.residuals.max()) < 1e-9
    with pytest.raises(tr.errors.InputError, match="no triangles, which the meshes of links need"):
        write_robot(tmp_path / "rock.urdf", found, points, None)
    with pytest.raises(tr.errors.FormatError, match=r"must end in \.urdf"):
        write_robot(tmp_path / "rock.xml", found, points, faces)


@pytest.mark.parametrize("floats", [False, True])
def test_what_turns_about_an_axis_that_stands_still_has_a_base(scans, bones, floats):
    points, faces, _, part, _ = scans
    axis, point = torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64), torch.tensor([0.1, 0.2, 0.0], dtype=torch.float64)
    values = 0.4 * bones.draw(6, 1)
    values[0] = 0
    twists = values * torch.cat([torch.linalg.cross(point, axis), axis]) + floats * 0.3 * bones.draw(6, 6, seed=1)
    turns = se3_exp(twists - twists[0])
    moved = points @ turns[:, :3, :3].mT + turns[:, None, :3, 3] + NOISE * bones.draw(6, *points.shape, seed=2)
    found = find_robot(points, tr.RangeScan(points, faces).normals, moved, torch.zeros_like(part))
    if floats:
        assert len(found.tree) == 1
        torch.testing.assert_close(found.base, turns, atol=5e-3, rtol=0)
    else:
        assert [joint.kind for joint in found.tree.joints] == ["fixed", "revolute"]
        assert abs(float(torch.tensor(found.tree.joints[1].axis).double() @ axis)) > math.cos(math.radians(0.2))
        torch.testing.assert_close(found.base, torch.eye(4).double().expand_as(found.base))


def test_clouds_without_triangles_become_closed_links(scans, found, tmp_path):
    points, faces, deformed, _, _ = scans
    generator = torch.Generator().manual_seed(1)
    shares = torch.rand(len(deformed), len(faces), 3, generator=generator, dtype=torch.float64)
    places = (deformed[:, faces] * (shares / shares.sum(-1, keepdim=True)).unsqueeze(-1)).sum(-2)
    clouds = [tr.RangeScan(frame) for frame in places]
    write_robot(tmp_path / "robot.urdf", found, points, None, clouds)
    skin = tr.ArticulatedShape.from_urdf(tmp_path / "robot.urdf", dtype=torch.float64).file_skin()
    pose = torch.nn.functional.pad(found.joint_values[3], (6, 0))
    moved = skin(pose) @ found.base[3, :3, :3].mT + found.base[3, :3, 3]
    assert float(torch.cdist(deformed[3], moved).amin(-1).median()) < 0.02
    assert float(torch.cdist(moved, deformed[3]).amin(-1).median()) < 0.03
