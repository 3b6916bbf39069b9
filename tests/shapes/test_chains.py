"""Shapes to and from chains of pytorch-kinematics, whose forward kinematics are the oracle of all part transforms."""

import math

import pytest
import pytorch_kinematics as pk
import torch
from pytorch_kinematics.frame import Visual

import torchreg as tr
from torchreg.errors import InputTypeError, ModelError
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.mesh import unit_sphere
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation import so3_exp
from torchreg.io.gltf_write import save_animated_skin
from torchreg.shapes.kinematics import build_chain
from torchreg.shapes.record import build_shape, record_shape

D = torch.float64
ROBOT = """<?xml version="1.0"?>
<robot name="crane">
  <link name="base"><visual><geometry><box size="0.3 0.2 0.1"/></geometry></visual></link>
  <link name="mast"><visual><origin xyz="0 0 0.2"/><geometry><cylinder radius="0.04" length="0.4"/></geometry></visual>
  </link>
  <link name="boom"><visual><origin xyz="0.2 0 0" rpy="0 1.5 0"/><geometry><cylinder radius="0.03" length="0.4"/>
    </geometry></visual></link>
  <link name="hook"><visual><geometry><sphere radius="0.05"/></geometry></visual></link>
  <link name="camera"/>
  <joint name="turn" type="continuous"><parent link="base"/><child link="mast"/><origin xyz="0.05 0 0.05" rpy="0 0 1"/>
    <axis xyz="0 0 1"/></joint>
  <joint name="camera" type="fixed"><parent link="base"/><child link="camera"/><origin xyz="0.1 0 0"/></joint>
  <joint name="tilt" type="revolute"><parent link="mast"/><child link="boom"/><origin xyz="0 0 0.4" rpy="0.25 0 0"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="0.5" effort="1" velocity="1"/></joint>
  <joint name="reach" type="prismatic"><parent link="boom"/><child link="hook"/><origin xyz="0.4 0 0"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.25" effort="1" velocity="1"/></joint>
</robot>
"""


def seeded(*size, seed=0):
    return torch.randn(*size, dtype=D, generator=torch.Generator().manual_seed(seed))


def as_rigid(vector):
    """Return the transform of a translation and a rotation vector (6,)."""
    return rigid_matrix(so3_exp(vector[3:]), vector[:3])


def crane_chain():
    return pk.build_chain_from_urdf(ROBOT.encode())


def crane(path, **options):
    path.write_text(ROBOT)
    return tr.ArticulatedShape.from_urdf(path, dtype=D, **options)


def rig(path):
    """A bar with a ball joint and a hinge, whose joint frames are turned, read from a glTF file."""
    ball = unit_sphere(3, dtype=D)
    vertices = ball.vertices * torch.tensor([0.3, 0.05, 0.05], dtype=D)
    first, second = torch.sigmoid(40 * (vertices[:, 0] + 0.1)), torch.sigmoid(40 * (vertices[:, 0] - 0.1))
    weights = torch.stack([1 - first, first * (1 - second), first * second], dim=-1)
    frames = torch.stack([as_rigid(row) for row in seeded(3, 6, seed=1)])
    frames[:, :3, 3] = torch.tensor([[-0.3, 0, 0], [-0.1, 0, 0], [0.1, 0, 0]], dtype=D)
    save_animated_skin(
        path, vertices, ball.faces, weights / weights.sum(-1, keepdim=True), ["hip", "knee", "foot"], [-1, 0, 1],
        frames, frames[None], torch.zeros(1),
    )  # fmt: skip
    return tr.ArticulatedShape.from_gltf(path, axes={"foot": ["z"]}, dtype=D)


def built_shape(name, folder):
    if name == "hand":
        return tr.Hand(dtype=D)
    return crane(folder / "crane.urdf") if name == "urdf" else rig(folder / "rig.glb")


@torch.no_grad()
@pytest.mark.parametrize("name", ["hand", "urdf", "gltf"])
def test_parts_are_where_pytorch_kinematics_puts_them(name, tmp_path):
    shape = built_shape(name, tmp_path)
    shape.log_length_scales.copy_(0.2 * seeded(shape.num_parts, seed=2))
    pose = 0.5 * seeded(4, shape.num_dofs, seed=3)
    chain = shape.chain
    assert chain.dtype == D
    values = dict(zip(shape.dof_names[6:], pose[:, 6:].mT, strict=True))
    assert set(chain.get_joint_parameter_names()) == set(values)
    found = chain.forward_kinematics(values)
    base = rigid_matrix(so3_exp(pose[:, 3:6]), pose[:, :3])
    expected = torch.stack([base @ found[part].get_matrix() for part in shape.part_names], dim=1)
    torch.testing.assert_close(shape.part_transforms(pose), expected, atol=1e-12, rtol=0)
    limits = dict(zip(chain.get_joint_parameter_names(), zip(*chain.get_joint_limits(), strict=True), strict=True))
    assert [limits[joint] for joint in values] == list(
        zip(shape.lower[6:].tolist(), shape.upper[6:].tolist(), strict=True)
    )


def test_gradients_of_keypoints_equal_those_of_pytorch_kinematics():
    hand = tr.Hand(dtype=D).requires_grad_(False)
    pose = (0.3 * seeded(hand.num_dofs)).index_fill(0, torch.arange(6), 0.0).requires_grad_(True)
    names = hand.chain.get_joint_parameter_names()
    order = [hand.dof_names.index(name) for name in names]
    weights = seeded(hand.num_parts, 3, seed=1)
    found = hand.chain.forward_kinematics(pose[order].unsqueeze(0))
    theirs = torch.stack([found[part].get_matrix()[0, :3, 3] for part in hand.part_names])
    (expected,) = torch.autograd.grad((weights * theirs).sum(), pose)
    (gradient,) = torch.autograd.grad((weights * hand.part_transforms(pose)[:, :3, 3]).sum(), pose)
    torch.testing.assert_close(gradient[6:], expected[6:], atol=1e-12, rtol=0)


@torch.no_grad()
def test_a_chain_has_the_dtype_of_its_shape_and_does_not_follow_it():
    hand = tr.Hand()
    chain = hand.chain
    before = chain.forward_kinematics(torch.zeros(1, 21))["index_distal"].get_matrix()
    assert before.dtype == torch.float32
    hand.log_length_scales += 0.1
    assert torch.equal(chain.forward_kinematics(torch.zeros(1, 21))["index_distal"].get_matrix(), before)
    longer = hand.chain.forward_kinematics(torch.zeros(1, 21))["index_distal"].get_matrix()
    torch.testing.assert_close(longer[0, :3, 3], math.exp(0.1) * before[0, :3, 3])


def test_mimic_joints_are_joints_of_their_own(tmp_path):
    mimicking = ROBOT.replace(
        '<axis xyz="1 0 0"/>', '<axis xyz="1 0 0"/><mimic joint="tilt" multiplier="0.5" offset="0.1"/>'
    )
    path = tmp_path / "crane.urdf"
    path.write_text(mimicking)
    shape = tr.ArticulatedShape.from_urdf(path, dtype=D)
    assert shape.dof_names[6:] == ("turn", "tilt")
    found = shape.chain.forward_kinematics({"turn": 0.3, "tilt": 0.2, "reach": 0.5 * 0.2 + 0.1})
    pose = torch.tensor([0.0] * 6 + [0.3, 0.2], dtype=D)
    torch.testing.assert_close(shape.part_transforms(pose)[3], found["hook"].get_matrix()[0], atol=1e-12, rtol=0)


def test_names_that_pytorch_kinematics_would_confuse_stay_apart():
    eye = torch.eye(4, dtype=D)
    names = ["", "\n", "a\n", "a", "a_"]
    tree = KinematicTree(tuple(Joint(name, at - 1, eye, "prismatic") for at, name in enumerate(names)))
    chain = build_chain(tree, names, eye.repeat(5, 1, 1))
    assert chain.get_frame_names(exclude_fixed=False) == ["", "_", "a", "a_", "a__"]
    heights = chain.forward_kinematics(torch.ones(1, 5, dtype=D))
    assert [float(heights[name].get_matrix()[0, 2, 3]) for name in ("", "_", "a", "a_", "a__")] == [1, 2, 3, 4, 5]


@torch.no_grad()
def test_the_chain_of_a_urdf_gives_the_shape_of_the_urdf(tmp_path):
    shape, expected = tr.ArticulatedShape.from_chain(crane_chain(), dtype=D), crane(tmp_path / "crane.urdf")
    assert shape.dof_names == expected.dof_names
    assert shape.part_names == expected.part_names == ("base", "mast", "boom", "hook")
    # They read the file's numbers as float32, and unlimited joints as such.
    torch.testing.assert_close(shape.lower, expected.lower, atol=1e-7, rtol=0)
    torch.testing.assert_close(shape.upper, expected.upper, atol=1e-7, rtol=0)
    assert shape.primitives.part_kinds == expected.primitives.part_kinds
    pose = 0.4 * seeded(9)
    points = 0.3 * seeded(50, 3, seed=1)
    torch.testing.assert_close(shape.distance(points, pose), expected.distance(points, pose), atol=1e-6, rtol=0)
    torch.testing.assert_close(shape.surface.vertices, expected.surface.vertices, atol=1e-6, rtol=0)
    pinned = tr.ArticulatedShape.from_chain(crane_chain(), free_base=False, nu=0.01)
    assert pinned.upper[:6].tolist() == [0.0] * 6
    assert pinned.nu == 0.01


@torch.no_grad()
@pytest.mark.parametrize("name", ["hand", "urdf", "gltf"])
def test_a_shape_of_a_chain_moves_as_the_chain(name, tmp_path):
    chain = built_shape(name, tmp_path).chain
    shape = tr.ArticulatedShape.from_chain(chain, dtype=D)
    assert list(shape.dof_names[6:]) == chain.get_joint_parameter_names()
    torch.testing.assert_close(shape.lower[6:], chain.low)
    torch.testing.assert_close(shape.upper[6:], chain.high)
    pose = 0.5 * seeded(3, shape.num_dofs, seed=3)
    pose[:, :6] = 0.0
    found = chain.forward_kinematics(pose[:, 6:])
    frames = [part for part in shape.part_names if part in found]
    assert len(frames) >= 3
    index = [shape.part_names.index(part) for part in frames]
    expected = torch.stack([found[part].get_matrix() for part in frames], dim=1)
    torch.testing.assert_close(shape.part_transforms(pose)[:, index], expected, atol=1e-12, rtol=0)
    again = shape.chain.forward_kinematics(pose[:, 6:])
    for part in frames:
        torch.testing.assert_close(again[part].get_matrix(), found[part].get_matrix(), atol=1e-12, rtol=0)


def test_a_serial_chain_starts_at_its_root():
    whole = crane_chain()
    serial = pk.SerialChain(whole, "boom", "mast")
    shape = tr.ArticulatedShape.from_chain(serial, dtype=D)
    assert shape.dof_names[6:] == ("tilt",)
    pose = torch.tensor([0.0] * 6 + [0.3], dtype=D)
    expected = serial.forward_kinematics(torch.tensor([0.3]), end_only=True).get_matrix()[0].double()
    torch.testing.assert_close(shape.part_transforms(pose)[-1], expected, atol=1e-6, rtol=0)


def frame(name, translation, joint_type="revolute", visuals=(), **options):
    offset = pk.Transform3d(pos=torch.tensor(translation, dtype=D), dtype=D)
    link = pk.Link(name, visuals=visuals)
    return pk.Frame(name, link=link, joint=pk.Joint(f"{name}_turn", offset, joint_type, dtype=D, **options))


def bare_leg(visuals=()):
    """A hip, a knee 0.4 below and 0.3 to the front, and a foot 0.5 below that, without geometry by default."""
    root = frame("hip", [0.0, 0.0, 1.0], "fixed")
    knee, foot = frame("knee", [0.3, 0.0, -0.4], visuals=visuals, axis=(0.0, 1.0, 0.0)), frame("foot", [0.0, 0.0, -0.5])
    root.add_child(knee)
    knee.add_child(foot)
    return root


def capsule_distance(points, start, end, radius):
    """The distance of points (N, 3) to a capsule, from the definition."""
    share = ((points - start) @ (end - start) / (end - start).square().sum()).clamp(0, 1)
    return (points - start - share[:, None] * (end - start)).norm(dim=-1) - radius


@torch.no_grad()
def test_a_chain_without_geometry_becomes_bones():
    shape = tr.ArticulatedShape.from_chain(pk.Chain(bare_leg(), dtype=D), dtype=D)
    assert shape.part_names == ("hip", "knee", "foot")
    assert shape.primitives.part_kinds == ("capsule", "capsule", "ellipsoid")
    assert shape.lower[6:].tolist() == [-math.inf, -math.inf]
    points = 0.5 * seeded(40, 3) + torch.tensor([0.1, 0, 0.5], dtype=D)
    hip, knee, foot = (torch.tensor(row, dtype=D) for row in ([0, 0, 1.0], [0.3, 0, 0.6], [0.3, 0, 0.1]))
    # The root's offset of one counts among the distances 0.5 and 0.5, for it is none: no frame is above it.
    rows = [capsule_distance(points, *ends, 0.05) for ends in ((hip, knee), (knee, foot))]
    distances = shape.part_distances(points, shape.rest_pose())
    torch.testing.assert_close(distances[:, :2], torch.stack(rows, dim=-1), atol=1e-9, rtol=0)
    on_ball = foot + 0.05 * torch.nn.functional.normalize(seeded(10, 3), dim=-1)
    assert float(shape.part_distances(on_ball, shape.rest_pose())[:, 2].abs().max()) < 1e-9


def test_a_frame_with_several_frames_on_it_gets_a_bone_to_each():
    root = frame("palm", [0.0, 0.0, 0.0], "fixed")
    for name, x in (("thumb", -0.1), ("index", 0.0), ("little", 0.1)):
        root.add_child(frame(name, [x, 0.0, 0.1]))
    shape = tr.ArticulatedShape.from_chain(pk.Chain(root, dtype=D))
    assert shape.part_names == ("palm", "palm_1", "palm_2", "thumb", "index", "little")
    assert shape.part_parents == (-1, 0, 0, 0, 0, 0)


def test_bones_stand_in_for_meshes_that_a_chain_only_names():
    meshed = ROBOT.replace('<cylinder radius="0.04" length="0.4"/>', '<mesh filename="mast.obj"/>')
    shape = tr.ArticulatedShape.from_chain(pk.build_chain_from_urdf(meshed.encode()))
    assert shape.part_names == ("base", "mast", "boom", "hook")
    assert shape.primitives.part_kinds[1] == "capsule"
    known = tr.ArticulatedShape.from_chain(pk.Chain(bare_leg([Visual(None, "sphere", 0.1)]), dtype=D))
    assert known.part_names == ("knee",)


def test_a_shape_of_a_chain_aligns_and_is_stored():
    shape = tr.ArticulatedShape.from_chain(crane_chain(), free_base=False).requires_grad_(False)
    truth = torch.tensor([0.0] * 6 + [0.4, -0.3, 0.1])
    result = tr.align(shape, tr.sample_skin(shape, 300)(truth), shape.rest_pose())
    torch.testing.assert_close(result.pose, truth, atol=0.02, rtol=0)
    again = build_shape(record_shape(shape))
    assert torch.equal(again.part_transforms(truth), shape.part_transforms(truth))


def test_what_is_no_tree_of_known_joints_is_refused():
    with pytest.raises(InputTypeError, match=r"chain must be a pytorch_kinematics.Chain, got str"):
        tr.ArticulatedShape.from_chain("robot.urdf")
    chain = crane_chain()
    chain.find_frame("boom").joint.joint_type = "ball"
    message = "joint 'tilt' of type 'ball'; supported: fixed, revolute, prismatic; stack several frames"
    with pytest.raises(ModelError, match=message):
        tr.ArticulatedShape.from_chain(chain)
    chain = crane_chain()
    chain.find_frame("boom").name = "mast"
    with pytest.raises(ModelError, match="frames of different names, several are called mast"):
        tr.ArticulatedShape.from_chain(chain)
    chain = crane_chain()
    chain.find_frame("boom").joint.name = "turn"
    with pytest.raises(ModelError, match="must be unique, these occur more than once: turn"):
        tr.ArticulatedShape.from_chain(chain)
    chain = crane_chain()
    chain.find_frame("boom").joint.axis[0] = math.nan
    with pytest.raises(ModelError, match="'tilt' has axis"):
        tr.ArticulatedShape.from_chain(chain)
    with pytest.raises(ModelError, match="no link with geometry and no two frames apart: there is nothing to align"):
        tr.ArticulatedShape.from_chain(pk.Chain(frame("point", [1.0, 0.0, 0.0]), dtype=D))
