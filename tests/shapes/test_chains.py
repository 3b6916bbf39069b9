"""Shapes to and from chains of pytorch-kinematics, whose forward kinematics are the oracle of all part transforms."""

import math

import pytest
import pytorch_kinematics as pk
import torch
from pytorch_kinematics.frame import Visual

import torchreg as tr
from tests.shapes.kinds import ROBOT, D, at, compare, robot, seeded
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes.primitives import Primitive

MOVED = ["hand", "machine", "robot", "rig", "tube"]


def crane_chain(text=ROBOT):
    return pk.build_chain_from_urdf(text.encode())


def test_names_that_pytorch_kinematics_would_confuse_stay_apart():
    names = ["", "\n", "a\n", "a", "a_"]
    tree = KinematicTree(tuple(Joint(name, number - 1, at(), "prismatic") for number, name in enumerate(names)))
    chain = tr.ArticulatedShape(tree, names, [Primitive("capsule", (0.1, 0.1), at())] * 5, dtype=D).chain
    assert chain.get_frame_names(exclude_fixed=False) == ["", "_", "a", "a_", "a__"]
    heights = chain.forward_kinematics(torch.ones(1, 5, dtype=D))
    assert [float(heights[name].get_matrix()[0, 2, 3]) for name in ("", "_", "a", "a_", "a__")] == [1, 2, 3, 4, 5]


@torch.no_grad()
def test_the_chain_of_a_urdf_gives_the_shape_of_the_urdf(shapes):
    shape, expected = tr.ArticulatedShape.from_chain(crane_chain(), dtype=D), shapes["robot"]
    assert shape.dof_names == expected.dof_names
    assert shape.part_names == expected.part_names == ("base", "mast", "boom", "hook")
    assert shape.primitives.part_kinds == expected.primitives.part_kinds
    pose, points = 0.4 * seeded(9), 0.3 * seeded(50, 3, seed=1)
    # They read the file's numbers as float32, and unlimited joints as such.
    for name in ("lower", "upper"):
        compare([getattr(shape, name)], [getattr(expected, name)], atol=1e-7)
    compare([shape.distance(points, pose)], [expected.distance(points, pose)], atol=1e-6)
    compare([shape.surface.vertices], [expected.surface.vertices], atol=1e-6)
    pinned = tr.ArticulatedShape.from_chain(crane_chain(), free_base=False, nu=0.01)
    assert pinned.upper[:6].tolist() == [0.0] * 6
    assert pinned.nu == 0.01


@torch.no_grad()
@pytest.mark.parametrize("name", MOVED)
def test_a_shape_of_a_chain_moves_as_the_chain(shapes, name):
    chain = shapes[name].chain
    shape = tr.ArticulatedShape.from_chain(chain, dtype=D)
    assert list(shape.dof_names[6:]) == chain.get_joint_parameter_names()
    compare((shape.lower[6:], shape.upper[6:]), (chain.low, chain.high))
    pose = 0.5 * seeded(3, shape.num_dofs, seed=3)
    pose[:, :6] = 0.0
    found, again = chain.forward_kinematics(pose[:, 6:]), shape.chain.forward_kinematics(pose[:, 6:])
    frames = [part for part in shape.part_names if part in found]
    assert len(frames) >= 3
    index = [shape.part_names.index(part) for part in frames]
    compare(shape.part_transforms(pose)[:, index].unbind(1), (found[part].get_matrix() for part in frames))
    compare((again[part].get_matrix() for part in frames), (found[part].get_matrix() for part in frames))


def test_mimic_joints_are_joints_of_their_own(tmp_path):
    mimic = '<axis xyz="1 0 0"/><mimic joint="tilt" multiplier="0.5" offset="0.1"/>'
    shape = robot(tmp_path, ROBOT.replace('<axis xyz="1 0 0"/>', mimic))
    assert shape.dof_names[6:] == ("turn", "tilt")
    found = shape.chain.forward_kinematics({"turn": 0.3, "tilt": 0.2, "reach": 0.5 * 0.2 + 0.1})
    pose = torch.tensor([0.0] * 6 + [0.3, 0.2], dtype=D)
    compare([shape.part_transforms(pose)[3]], [found["hook"].get_matrix()[0]])


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
    return pk.Chain(root, dtype=D)


def capsule_distance(points, start, end, radius):
    share = ((points - start) @ (end - start) / (end - start).square().sum()).clamp(0, 1)
    return (points - start - share[:, None] * (end - start)).norm(dim=-1) - radius


@torch.no_grad()
def test_a_chain_without_geometry_becomes_bones():
    shape = tr.ArticulatedShape.from_chain(bare_leg(), dtype=D)
    assert shape.part_names == ("hip", "knee", "foot")
    assert shape.primitives.part_kinds == ("capsule", "capsule", "ellipsoid")
    assert shape.lower[6:].tolist() == [-math.inf, -math.inf]
    points = 0.5 * seeded(40, 3) + torch.tensor([0.1, 0, 0.5], dtype=D)
    hip, knee, foot = torch.tensor([[0, 0, 1.0], [0.3, 0, 0.6], [0.3, 0, 0.1]], dtype=D)
    # The root's offset of one counts among the distances 0.5 and 0.5, for it is none: no frame is above it.
    rows = [capsule_distance(points, *ends, 0.05) for ends in ((hip, knee), (knee, foot))]
    compare(shape.part_distances(points, shape.rest_pose()).unbind(-1)[:2], rows, atol=1e-9)
    on_ball = foot + 0.05 * torch.nn.functional.normalize(seeded(10, 3), dim=-1)
    assert float(shape.part_distances(on_ball, shape.rest_pose())[:, 2].abs().max()) < 1e-9


def test_frames_get_a_bone_to_each_frame_on_them_unless_the_geometry_is_given():
    root = frame("palm", [0.0, 0.0, 0.0], "fixed")
    for name, x in (("thumb", -0.1), ("index", 0.0), ("little", 0.1)):
        root.add_child(frame(name, [x, 0.0, 0.1]))
    shape = tr.ArticulatedShape.from_chain(pk.Chain(root, dtype=D))
    assert shape.part_names == ("palm", "palm_1", "palm_2", "thumb", "index", "little")
    assert shape.part_parents == (-1, 0, 0, 0, 0, 0)
    meshed = ROBOT.replace('<cylinder radius="0.04" length="0.4"/>', '<mesh filename="mast.obj"/>')
    shape = tr.ArticulatedShape.from_chain(crane_chain(meshed))
    assert shape.part_names == ("base", "mast", "boom", "hook")
    assert shape.primitives.part_kinds[1] == "capsule"
    known = tr.ArticulatedShape.from_chain(bare_leg([Visual(None, "sphere", 0.1)]), dtype=D)
    assert known.part_names == ("knee",)


def nan_axis(boom):
    boom.joint.axis[0] = math.nan


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda boom: setattr(boom.joint, "joint_type", "ball"),
         "joint 'tilt' of type 'ball'; supported: fixed, revolute, prismatic; stack several frames"),
        (lambda boom: setattr(boom, "name", "mast"), "frames of different names, several are called mast"),
        (lambda boom: setattr(boom.joint, "name", "turn"), "must be unique, these occur more than once: turn"),
        (nan_axis, "'tilt' has axis"),
    ],
)  # fmt: skip
def test_what_is_no_tree_of_known_joints_is_refused(change, message):
    chain = crane_chain()
    change(chain.find_frame("boom"))
    with pytest.raises(tr.errors.ModelError, match=message):
        tr.ArticulatedShape.from_chain(chain)
    with pytest.raises(tr.errors.InputTypeError, match=r"chain must be a pytorch_kinematics.Chain, got str"):
        tr.ArticulatedShape.from_chain("robot.urdf")
    with pytest.raises(tr.errors.ModelError, match="no link with geometry and no two frames apart: there is nothing"):
        tr.ArticulatedShape.from_chain(pk.Chain(frame("point", [1.0, 0.0, 0.0]), dtype=D))
