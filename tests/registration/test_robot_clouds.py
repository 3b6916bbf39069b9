"""Robots in clouds all around that know neither normals nor an order."""

import math

import pytest
import torch
import trimesh

import torchreg as tr
from torchreg.geometry.rigid import se3_exp
from torchreg.registration.frame_tree import FrameTree
from torchreg.registration.robots.model import find_robot
from torchreg.registration.robots.surfaces import Target

AXIS = torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
END = torch.tensor([0.0, 0.0, 0.3], dtype=torch.float64)


@pytest.fixture(scope="module")
def scans():
    """Clouds of two boxes on a hinge, new points in each; how far it turned; and the first cloud's points in all."""
    draw = torch.Generator().manual_seed(0)
    box = trimesh.creation.box((0.1, 0.08, 0.28))
    values = torch.tensor([0.0, -0.5, 0.6, 0.3, -0.2], dtype=torch.float64)
    turns = se3_exp(values.unsqueeze(-1) * torch.cat([torch.linalg.cross(END, AXIS), AXIS]))
    clouds = []
    for turn in turns:
        low, high = (torch.from_numpy(trimesh.sample.sample_surface(box, 700, seed=int(seed))[0].copy())
                     for seed in torch.randint(10**6, (2,), generator=draw))  # fmt: skip
        low, high = low + END / 2, high + 1.5 * END
        clouds.append(torch.cat([low, high @ turn[:3, :3].mT + turn[:3, 3]]))
        if len(clouds) == 1:
            moved = torch.stack([torch.cat([low, high @ frame[:3, :3].mT + frame[:3, 3]]) for frame in turns])
    return clouds, values, moved


@pytest.mark.parametrize("flipped", [False, True])
def test_a_hinge_is_found_to_a_degree_in_points_a_tenth_of_the_thing_apart(scans, flipped):
    clouds, values, moved = scans
    ranged = [tr.RangeScan(cloud) for cloud in clouds]
    # What registration leaves: parts placed by some millimeters wrong in every frame.
    rough = moved.clone()
    rough[1:, 700:] += torch.tensor([0.004, -0.004, 0.002])
    part = torch.arange(2).repeat_interleave(700)
    targets = [Target(scan.points, scan.normals) for scan in ranged]
    if flipped:
        # Signs of estimated normals are right on a link or wrong on all of it.
        targets[2].normals[700:] *= -1
        targets[3].normals[:] *= -1
    found = find_robot(ranged[0].points, ranged[0].normals, rough, part, targets, sparse=True)
    (joint,) = found.tree.joints[1:]
    axis, origin = torch.tensor(joint.axis, dtype=torch.float64), found.origins()[1]
    assert math.degrees(math.acos(min(1.0, abs(float(axis @ AXIS))))) < 1
    assert torch.linalg.cross(origin - END, AXIS).norm() < 0.002
    torch.testing.assert_close(found.joint_values[:, 0].abs(), values.abs(), atol=0.01, rtol=0)


def test_frames_are_reached_from_those_most_like_them_whatever_their_order():
    places = torch.tensor([0.0, 1.0, 2.1, 3.3, 9.0], dtype=torch.float64)
    cloud = torch.rand(200, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.1
    order = [3, 0, 2, 4, 1]
    tree = FrameTree.alike([cloud + torch.tensor([float(places[k]), 0, 0]) for k in order])
    above = {order[frame]: order[parent] if parent >= 0 else None for frame, parent in enumerate(tree.parents)}
    # The one in the middle is nearest to all.
    assert above == {2: None, 1: 2, 0: 1, 3: 2, 4: 3}
    assert [order[frame] for frame in tree.path(order.index(4))] == [2, 3, 4]
    assert sorted(tree.order) == list(range(5))
    assert all(tree.order.index(p) < tree.order.index(f) for f, p in enumerate(tree.parents) if p >= 0)
    assert FrameTree.in_turn(2, 5) == FrameTree((1, 2, -1, 2, 3), (2, 3, 4, 1, 0))


@pytest.mark.slow
def test_links_that_moved_too_far_to_be_registered_are_found_from_the_base_outward():
    draw = torch.Generator().manual_seed(3)
    # Boxes with a knob on one side, whose half turns differ.
    box = trimesh.util.concatenate(
        [
            trimesh.creation.box((0.1, 0.08, 0.28)),
            trimesh.creation.box((0.05, 0.05, 0.08)).apply_translation((0.02, 0.06, 0.05)),
        ]
    )
    axes = [torch.nn.functional.normalize(torch.randn(3, generator=draw).double(), dim=0) for _ in range(2)]
    twists = [torch.cat([torch.linalg.cross((k + 1) * END, axis), axis]) for k, axis in enumerate(axes)]
    values = 2.4 * torch.rand(5, 2, generator=draw).double() - 1.2
    clouds = []
    for row in values:
        frame, placed = torch.eye(4, dtype=torch.float64), []
        for number in range(3):
            if number:
                frame = frame @ se3_exp(row[number - 1] * twists[number - 1])
            seed = int(torch.randint(10**6, (1,), generator=draw))
            points = (
                torch.from_numpy(trimesh.sample.sample_surface(box, 700, seed=seed)[0].copy()) + (number + 0.5) * END
            )
            placed.append(points @ frame[:3, :3].mT + frame[:3, 3])
        clouds.append(torch.cat(placed))
    scans = [tr.RangeScan(cloud) for cloud in clouds]
    targets = [Target(scan.points, scan.normals) for scan in scans]
    # Registration is of no help: nothing moved, all points are one part.
    still, part = clouds[0].expand(5, -1, 3), torch.zeros(len(clouds[0]), dtype=torch.long)
    found = find_robot(scans[0].points, scans[0].normals, still, part, targets, sparse=True)
    assert [joint.kind for joint in found.tree.joints[1:]] == ["revolute", "revolute"]
    # The first cloud's pose is the zero pose: the second axis is where the first joint had moved it.
    first = se3_exp(values[0, 0] * twists[0])
    true = [(axes[0], END), (first[:3, :3] @ axes[1], first[:3, :3] @ (2 * END) + first[:3, 3])]
    for joint, origin, (axis, place) in zip(found.tree.joints[1:], found.origins()[1:], true, strict=True):
        assert abs(float(torch.tensor(joint.axis, dtype=torch.float64) @ axis)) > math.cos(math.radians(1))
        assert torch.linalg.cross(origin - place, axis).norm() < 0.003
    torch.testing.assert_close(found.joint_values.abs(), (values - values[0]).abs(), atol=0.02, rtol=0)
