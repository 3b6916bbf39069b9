"""Shapes from rigs and robots: trees, names, solids near the mesh, the file's own skin, and what is refused."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import nn

import torchreg as tr
from tests.shapes.kinds import D, at, robot, tube
from torchreg.geometry.mesh import unit_sphere
from torchreg.shapes import rigs
from torchreg.shapes.record import build_shape, record_shape

NAMES = ("shoulder", "elbow", "wrist", "end")


def arm(**options):
    return tr.ArticulatedShape.from_skinned_mesh(*tube(), [-1, 0, 1, 2], joint_names=NAMES, dtype=D, **options)


def test_ball_joints_become_three_stacked_axes_and_only_where_skin_moves():
    shape = arm()
    assert shape.part_names == ("shoulder", "elbow", "wrist")
    assert shape.dof_names[6:] == ("elbow_x", "elbow_y", "elbow_z", "wrist_x", "wrist_y", "wrist_z")
    assert float(shape.upper[6]) == pytest.approx(math.pi)
    assert shape.part_parents == (-1, 0, 1)


def test_axes_and_limits_can_be_chosen():
    shape = arm(
        axes={"elbow": ["x"], "wrist": [(0.0, 3.0, 4.0), "z"], "end": []},
        limits={"elbow": [(-0.1, 2.0)], "wrist": [(-1, 1), (0.5, 1)]},
    )
    assert shape.dof_names[6:] == ("elbow_x", "wrist_0", "wrist_z")
    assert shape.lower[6:].tolist() == [-0.1, -1.0, 0.5]
    pose = torch.zeros(9, dtype=D)
    pose[7] = 0.7
    turn = shape.part_transforms(pose)[2, :3, :3].detach().numpy()
    np.testing.assert_allclose(turn, Rotation.from_rotvec([0, 0.7 * 0.6, 0.7 * 0.8]).as_matrix(), atol=1e-12)


def test_joints_may_come_in_any_order_and_with_the_root_marked_as_in_smpl():
    vertices, faces, weights, joints = tube()
    order = [2, 0, 3, 1]
    shape = tr.ArticulatedShape.from_skinned_mesh(
        vertices.numpy(), faces.numpy(), weights[:, order].numpy(), joints[order].numpy(),
        np.array([3, 2**32 - 1, 0, 1], dtype=np.uint32), joint_names=[NAMES[index] for index in order],
    )  # fmt: skip
    assert shape.up == (0, 1, 0)
    assert shape.part_names == ("shoulder", "elbow", "wrist")


@torch.no_grad()
def test_the_file_skin_is_linear_blend_skinning():
    vertices, faces, weights, positions = tube()
    turns = [[0.3, 0.2, 0.1], [1.0, 0, 0], [0, -0.5, 2.0], [0, 0, 0]]
    frames = torch.stack([at(*place, turn=turn) for place, turn in zip(positions, turns, strict=True)])
    shape = tr.ArticulatedShape.from_skinned_mesh(vertices, faces, weights, frames, [-1, 0, 1, 2], dtype=D)
    skin = shape.file_skin()
    assert torch.equal(skin.faces, faces)
    torch.testing.assert_close(skin(shape.rest_pose()), vertices, atol=1e-14, rtol=0)
    angles = np.array([[0.4, -0.2, 0.1], [-0.3, 0.5, 0.9]])
    base = np.array([0.1, 0.2, -0.3, 0.5, -1.0, 0.2])
    world = [at(*base[:3], turn=base[3:]).numpy() @ frames[0].numpy()]
    for joint, angle in ((1, angles[0]), (2, angles[1])):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler("XYZ", angle).as_matrix()
        world.append(world[-1] @ np.linalg.inv(frames[joint - 1].numpy()) @ frames[joint].numpy() @ turn)
    points = np.concatenate([vertices.numpy(), np.ones((len(vertices), 1))], axis=1)
    expected = sum(
        weights[:, j : j + 1].numpy() * (points @ (world[j] @ np.linalg.inv(frames[j].numpy())).T) for j in range(3)
    )
    pose = torch.from_numpy(np.concatenate([base, angles.ravel()]))
    np.testing.assert_allclose(skin(pose).numpy(), expected[:, :3], atol=1e-13)


@torch.no_grad()
def test_the_file_skin_keeps_its_pose_when_limits_exclude_zero():
    vertices = tube()[0]
    shape = arm(axes={"elbow": ["x"]}, limits={"elbow": [(0.5, 1.0)]})
    assert float(shape.rest_pose()[6]) == 0.5
    skin = shape.file_skin()
    torch.testing.assert_close(skin(torch.zeros_like(shape.rest)), vertices, atol=1e-14, rtol=0)
    assert float((skin(shape.rest_pose()) - vertices).norm(dim=-1).max()) > 0.05
    sampled = tr.sample_skin(shape, 50)
    torch.testing.assert_close(sampled(torch.zeros_like(shape.rest)), sampled.points, atol=1e-14, rtol=0)


@torch.no_grad()
@pytest.mark.parametrize("kind", ["ellipsoid", "capsule", "cone", "superquadric", "auto"])
def test_solids_lie_near_the_mesh_and_their_length_is_along_the_bone(kind):
    vertices, shape = tube()[0], arm(primitive=kind)
    error = shape.distance(vertices, shape.rest_pose()).abs()
    assert float(error.mean()) < (0.004 if kind in ("capsule", "cone") else 0.002)
    assert 0.001 < shape.nu < 0.01
    if kind == "ellipsoid":
        # One ellipsoid is cut in three, and the parts together give it back.
        assert float(error.mean()) < 0.0006
        assert bool((shape.primitives.rotations[:, 2, 2].abs() > 0.8).all())


class Layer(nn.Module):
    """The distance of points from a shape, as a layer."""

    def __init__(self, shape):
        super().__init__()
        self.shape = shape

    def forward(self, points):
        return self.shape.distance(points, self.shape.rest_pose())


WAYS = {
    "as it is": Layer,
    "a copy": lambda shape: Layer(copy.deepcopy(shape)),
    "under a transform": lambda shape: lambda points: torch.func.vmap(Layer(shape))(points.unsqueeze(0))[0],
    "a record": lambda shape: Layer(build_shape(record_shape(shape))),
}


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
@pytest.mark.parametrize("way", WAYS)
def test_solids_of_a_rig_are_refined_once_they_are_needed(way, monkeypatch):
    spec, points = rigs.spec_from_arrays(*tube(), [-1, 0, 1, 2]), tube()[0]
    calls = []
    refine = rigs.refine_primitives
    monkeypatch.setattr(rigs, "refine_primitives", lambda *arguments: calls.append(1) or refine(*arguments))
    shape = tr.ArticulatedShape.from_spec(spec, dtype=D)
    shape.file_skin()(torch.zeros(shape.num_dofs, dtype=D))
    assert calls == []
    found = WAYS[way](shape)(points)
    eager = tr.ArticulatedShape.from_spec(replace(spec, primitives=tuple(spec.primitives)), dtype=D)
    torch.testing.assert_close(found, Layer(eager)(points), atol=1e-8, rtol=0)
    guess = tr.ArticulatedShape.from_spec(replace(spec, primitives=spec.primitives.guess), dtype=D)
    assert float(found.abs().mean()) < 0.5 * float(Layer(guess)(points).abs().mean())


GRIPPER = """<?xml version="1.0"?>
<robot name="gripper">
  <link name="world"/>
  <link name="palm"><visual><geometry><box size="0.2 0.1 0.4"/></geometry></visual></link>
  <link name="left">
    <visual><origin xyz="0 0 0.1"/><geometry><cylinder radius="0.03" length="0.2"/></geometry></visual>
    <visual><origin xyz="0 0 0.2"/><geometry><sphere radius="0.05"/></geometry></visual>
  </link>
  <link name="right">
    <visual><origin xyz="0 0 0.1"/><geometry><capsule radius="0.03" length="0.2"/></geometry></visual>
  </link>
  <joint name="mount" type="fixed"><parent link="world"/><child link="palm"/><origin xyz="0 0 1"/></joint>
  <joint name="open" type="revolute"><parent link="palm"/><child link="left"/><origin xyz="0.1 0 0.2"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="other" type="revolute"><parent link="palm"/><child link="right"/><origin xyz="-0.1 0 0.2"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/>
    <mimic joint="open" multiplier="-1" offset="0.3"/>
  </joint>
</robot>
"""


@torch.no_grad()
def test_a_robot_keeps_its_own_solids_and_names(tmp_path):
    shape = robot(tmp_path, GRIPPER)
    assert shape.dof_names[6:] == ("open",)
    assert shape.part_names == ("palm", "left", "left_1", "right")
    assert shape.primitives.part_kinds == ("superquadric", "cone", "ellipsoid", "capsule")
    pose = torch.zeros(7, dtype=D)
    pose[6] = 0.5
    transforms = shape.part_transforms(pose)
    assert torch.equal(transforms[1], transforms[2])
    points = torch.tensor([[0.0, 0.0, 0.2]], dtype=D)
    tip = points @ transforms[1, :3, :3].mT + transforms[1, :3, 3]
    # The center of the sphere at the end of the left finger, 0.05 from its surface.
    assert float(shape.part_distances(tip, pose)[0, 2]) == pytest.approx(-0.05)
    angle = math.atan2(float(transforms[3, 0, 2]), float(transforms[3, 2, 2]))
    assert angle == pytest.approx(0.3 - 0.5)


@torch.no_grad()
def test_a_robots_surface_is_that_of_its_solids_with_every_joint_at_zero(tmp_path):
    shape = robot(tmp_path, GRIPPER)
    zero = torch.zeros(7, dtype=D)
    skin = shape.file_skin()
    torch.testing.assert_close(skin(zero), shape.surface.vertices, atol=1e-12, rtol=0)
    owner = shape.surface.weights.argmax(-1)
    assert sorted(owner.unique().tolist()) == [0, 1, 3]
    distance = shape.part_distances(shape.surface.vertices, zero)
    near = torch.stack([distance[:, 0], distance[:, 1:3].abs().amin(-1), distance[:, 2], distance[:, 3]], dim=-1)
    own = near.gather(-1, owner.unsqueeze(-1)).abs()
    # Corners of the box lie where its superquadric is rounded.
    assert float(own[owner != 0].max()) < 1e-9
    assert float(own[owner == 0].max()) < 0.02
    sampled = tr.sample_skin(shape, 100)
    assert float(shape.distance(sampled.points, zero).abs().quantile(0.8)) < 0.01


@torch.no_grad()
def test_one_kind_can_be_fitted_to_every_link(tmp_path):
    shape = robot(tmp_path, GRIPPER, primitive="ellipsoid", free_base=False, nu=0.01)
    assert shape.part_names == ("palm", "left", "right")
    assert set(shape.primitives.part_kinds) == {"ellipsoid"}
    assert shape.nu == 0.01
    assert shape.lower[:6].tolist() == [0.0] * 6
    sizes = shape.primitives.sizes[0]
    assert torch.equal(sizes.argmax(-1), torch.full((3,), 2))


def test_names_of_further_solids_avoid_those_that_are_taken(tmp_path):
    shape = robot(tmp_path, GRIPPER.replace('name="other"', 'name="open_1"'))
    assert shape.num_parts == 4
    assert {joint.name for joint in shape.kinematics.tree.joints} >= {"open", "open_1", "open_1_"}


@torch.no_grad()
def test_a_link_mesh_gets_a_fitted_solid(tmp_path):
    sphere = unit_sphere(2, dtype=D)
    lines = [f"v {x} {y} {z}" for x, y, z in (sphere.vertices * torch.tensor([0.1, 0.1, 0.3])).tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in sphere.faces.tolist()]
    (tmp_path / "egg.obj").write_text("\n".join(lines))
    visual = '<visual><geometry><mesh filename="egg.obj"/></geometry></visual>'
    ball = '<visual><origin xyz="0 0 0.3"/><geometry><sphere radius="0.05"/></geometry></visual>'
    path = tmp_path / "egg.urdf"
    path.write_text(f'<robot name="egg"><link name="egg">{visual}{ball}</link></robot>')
    shape = tr.ArticulatedShape.from_urdf(path, primitive="auto", dtype=D)
    assert shape.part_names == ("egg", "egg_1")
    assert shape.primitives.part_kinds == ("ellipsoid", "ellipsoid")
    np.testing.assert_allclose(shape.primitives.sizes[0][0].numpy(), [0.1, 0.1, 0.3], rtol=0.05)
    path.write_text(f'<robot name="egg"><link name="egg">{visual.replace("egg.obj", "none.obj")}{ball}</link></robot>')
    with pytest.raises(tr.errors.FormatError, match=r"none.obj.* was not found"):
        tr.ArticulatedShape.from_urdf(path, meshes="require")
    with pytest.warns(tr.errors.FileWarning, match=r"none.obj.* was not found"):
        assert tr.ArticulatedShape.from_urdf(path).part_names == ("egg",)
    assert tr.ArticulatedShape.from_urdf(path, meshes="skip").part_names == ("egg",)


SOLIDS = {
    'box size="0.2 0.3 0.4"': (0.024, 0.4),
    'sphere radius="0.3"': (4 / 3 * math.pi * 0.027, 0.6),
    'cylinder radius="0.3" length="0.5"': (math.pi * 0.09 * 0.5, 0.5),
    'capsule radius="0.3" length="0.5"': (math.pi * 0.09 * 0.5 + 4 / 3 * math.pi * 0.027, 1.1),
}


@pytest.mark.parametrize("solid", SOLIDS)
def test_meshes_of_solids_face_outwards_and_hold_their_volume(solid, tmp_path):
    visual = f"<visual><geometry><{solid}/></geometry></visual>"
    surface = robot(tmp_path, f'<robot name="one"><link name="one">{visual}</link></robot>').surface
    volume, height = SOLIDS[solid]
    a, b, c = surface.vertices[surface.faces].unbind(1)
    assert 0.96 * volume < float((a * torch.linalg.cross(b, c)).sum() / 6) <= volume * (1 + 1e-12)
    assert 2 * float(surface.vertices[:, 2].max()) == pytest.approx(height)
