"""Forward kinematics against a plain numpy walk of the tree and against pytorch-kinematics, and the joints' twists."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import torchreg as tr
from tests.shapes.kinds import D, at, compare, seeded
from torchreg.geometry.kinematic_tree import Joint, KinematicTree, stack_sizes
from torchreg.shapes.kinematics import ForwardKinematics
from torchreg.shapes.primitives import Primitive

# torch builds its forward-mode rules with torch.jit.script, and warns about it.
JACFWD = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")


def random_tree(seed, count=9, kinds=("revolute", "prismatic", "fixed"), mimics=False):
    rng = np.random.RandomState(seed)
    joints = [Joint("root", -1, at(*rng.normal(size=3), turn=rng.normal(size=3)))]
    for index in range(1, count):
        axis, kind, parent = rng.normal(size=3), kinds[rng.randint(len(kinds))], int(rng.randint(index))
        offset = at(*rng.normal(size=3), turn=2 * rng.normal(size=3))
        joint = Joint(f"j{index}", parent, offset, kind, tuple(axis / np.linalg.norm(axis)))
        moving = [number for number, other in enumerate(joints) if other.kind != "fixed"]
        if mimics and joint.kind != "fixed" and moving and rng.rand() < 0.5:
            joint = replace(joint, mimic=(int(rng.choice(moving)), float(rng.normal()), float(rng.normal())))
        joints.append(joint)
    return KinematicTree(tuple(joints))


def slides(names, parents=None):
    """A tree of slides along z without offsets; a line by default."""
    parents = range(-1, len(names) - 1) if parents is None else parents
    return KinematicTree(
        tuple(Joint(name, parent, at(), "prismatic") for name, parent in zip(names, parents, strict=True))
    )


def reference(tree, values):
    """Walk the tree joint by joint in numpy; ``values`` by name of the free joints."""

    def value(joint):
        if joint.mimic is None:
            return values[joint.name]
        return joint.mimic[1] * value(tree.joints[joint.mimic[0]]) + joint.mimic[2]

    world = []
    for joint in tree.joints:
        motion = np.eye(4)
        if joint.kind == "revolute":
            motion[:3, :3] = Rotation.from_rotvec(np.array(joint.axis) * value(joint)).as_matrix()
        elif joint.kind == "prismatic":
            motion[:3, 3] = np.array(joint.axis) * value(joint)
        above = np.eye(4) if joint.parent < 0 else world[joint.parent]
        world.append(above @ joint.offset.numpy() @ motion)
    return np.stack(world)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 14))
def test_frames_equal_a_plain_walk_of_the_tree(seed, count):
    tree = random_tree(seed, count, mimics=True)
    kinematics = ForwardKinematics(tree)
    values = np.random.RandomState(seed).normal(size=kinematics.num_dofs)
    expected = reference(tree, dict(zip(kinematics.dof_names, values, strict=True)))
    found = kinematics(torch.from_numpy(values).expand(2, 1, -1))
    np.testing.assert_allclose(found.numpy(), np.tile(expected, (2, 1, 1, 1, 1)), atol=1e-12)
    assert kinematics(torch.zeros(0, kinematics.num_dofs, dtype=D)).shape == (0, count, 4, 4)
    assert not kinematics.state_dict()


@torch.no_grad()
@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 40))
def test_parts_of_any_tree_are_where_pytorch_kinematics_puts_them(seed, count):
    tree = random_tree(seed, count)
    solids = [Primitive("ellipsoid", (0.1,) * 3, at())] * count
    shape = tr.ArticulatedShape(tree, [joint.name for joint in tree.joints], solids, nu=0.01, dtype=D)
    values = seeded(3, shape.num_dofs - 6, seed=seed)
    found = shape.chain.forward_kinematics(dict(zip(shape.dof_names[6:], values.mT, strict=True)) or values)
    expected = torch.stack([found[joint.name].get_matrix() for joint in tree.joints], 1)
    compare([shape.part_transforms(torch.cat([torch.zeros(3, 6, dtype=D), values], -1))], [expected], atol=1e-11)


@pytest.mark.parametrize("length", [2, 3, 4, 5, 8, 9, 33])
def test_frames_of_a_chain_of_any_length_hold_every_ancestor(length):
    values = seeded(length, seed=length)
    heights = ForwardKinematics(slides([str(number) for number in range(length)]))(values)[:, 2, 3]
    torch.testing.assert_close(heights, values.cumsum(0), atol=1e-12, rtol=0)


def test_degrees_of_freedom_have_any_names_and_come_in_the_order_of_the_tree_not_depth_first():
    names = ["", "\n", "a\n", "a", "ü"]
    kinematics = ForwardKinematics(slides(names, [-1, 0, 0, 1, 2]))
    assert kinematics.dof_names == tuple(names)
    heights = kinematics(torch.tensor([1.0, 2.0, 4.0, 8.0, 16.0], dtype=D))[:, 2, 3]
    assert heights.tolist() == [1.0, 3.0, 5.0, 11.0, 21.0]


def test_a_tree_without_degrees_of_freedom():
    tree = random_tree(3, kinds=("fixed",))
    kinematics = ForwardKinematics(tree)
    assert kinematics.num_dofs == 0
    np.testing.assert_allclose(kinematics(torch.zeros(2, 0, dtype=D))[1].numpy(), reference(tree, {}), atol=1e-12)
    twists, moves = kinematics.joint_twists(kinematics(torch.zeros(0, dtype=D)))
    assert (twists.shape, moves.shape) == ((0, 6), (9, 0))


@pytest.mark.parametrize("values", [torch.zeros(2, 1, dtype=D), torch.tensor(0.0)])
def test_the_number_of_joint_values_is_checked(values):
    # pytorch-kinematics would give one value to every joint.
    with pytest.raises(tr.errors.InputError, match=r"joint_values must have shape \(\.\.\., \d+\), got"):
        ForwardKinematics(random_tree(5))(values)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_stretched_offsets_equal_a_tree_with_longer_offsets(seed):
    tree = random_tree(seed)
    kinematics = ForwardKinematics(tree)
    values, scales = seeded(2, kinematics.num_dofs, seed=seed), 0.3 * seeded(len(tree), seed=seed) + 1
    longer = [
        replace(joint, offset=joint.offset @ at(*((scale - 1) * joint.offset[:3, :3].mT @ joint.offset[:3, 3])))
        for joint, scale in zip(tree.joints, scales, strict=True)
    ]
    expected = ForwardKinematics(KinematicTree(tuple(longer)))(values)
    torch.testing.assert_close(kinematics(values, scales), expected, atol=1e-12, rtol=0)


@JACFWD
def test_twists_are_the_derivatives_of_the_frames():
    kinematics = ForwardKinematics(random_tree(11, 12, mimics=True))
    assert kinematics.has_mimics
    values, point = seeded(kinematics.num_dofs, seed=2), torch.tensor([0.3, -0.2, 0.5], dtype=D)
    frames = kinematics(values)
    twists, moves = kinematics.joint_twists(frames)
    per_dof = torch.einsum("fj,jc,jk->fkc", moves, twists, kinematics.couplings)
    derivative = torch.func.jacfwd(lambda q: kinematics(q)[:, :3, :3] @ point + kinematics(q)[:, :3, 3])(values)
    world = (frames[:, :3, :3] @ point + frames[:, :3, 3]).unsqueeze(1)
    moved = per_dof[..., :3] + torch.linalg.cross(per_dof[..., 3:], world.expand_as(per_dof[..., 3:]))
    torch.testing.assert_close(moved.mT, derivative, atol=1e-10, rtol=0)


def test_gradients_to_second_order():
    kinematics = ForwardKinematics(random_tree(4, 5))
    values = torch.full((kinematics.num_dofs,), 0.3, dtype=D, requires_grad=True)
    scales = torch.full((5,), 1.1, dtype=D, requires_grad=True)
    assert torch.autograd.gradcheck(kinematics, (values, scales))
    assert torch.autograd.gradgradcheck(kinematics, (values, scales))


def test_deep_trees_within_the_limit_work_and_deeper_ones_are_refused():
    names = [str(number) for number in range(302)]
    kinematics = ForwardKinematics(slides(names[:-1])).to(torch.float32)
    assert kinematics(torch.ones(301))[-1, 2, 3] == 301.0
    with pytest.raises(tr.errors.ModelError, match="frame '301' lies 301 frames deep; at most 300 are supported"):
        ForwardKinematics(slides(names))


def test_stack_sizes_count_the_axes_of_a_joint():
    away = at(0.1)
    joints = (
        Joint("root", -1, at()),
        Joint("ball_x", 0, away, "revolute", (1.0, 0.0, 0.0)),
        Joint("ball_y", 1, at(), "revolute", (0.0, 1.0, 0.0)),
        Joint("ball_z", 2, at(), "revolute"),
        Joint("hinge", 3, away, "revolute"),
        Joint("slide", 4, at(), "prismatic"),
    )
    assert stack_sizes(KinematicTree(joints)) == [3, 3, 3, 1, 1]
