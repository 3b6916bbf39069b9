"""Forward kinematics against a plain numpy walk of the tree and against pytorch-kinematics, and the joints' twists."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import pytorch_kinematics as pk
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchreg.errors import InputError, ModelError
from torchreg.geometry.kinematic_tree import Joint, KinematicTree, stack_sizes
from torchreg.shapes.kinematics import ForwardKinematics, build_chain

ROBOT = """<?xml version="1.0"?>
<robot name="sample">
  <link name="base"/><link name="shoulder"/><link name="arm"/>
  <link name="flange"/><link name="left"/><link name="right"/>
  <joint name="turn" type="revolute">
    <parent link="base"/><child link="shoulder"/><origin xyz="0.25 0 0.5" rpy="0.5 -0.25 1.0"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/>
  </joint>
  <joint name="reach" type="prismatic">
    <parent link="shoulder"/><child link="arm"/><origin xyz="0 0.125 0" rpy="0 0 0"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="1" effort="1" velocity="1"/>
  </joint>
  <joint name="bolt" type="fixed">
    <parent link="arm"/><child link="flange"/><origin xyz="0 0 0.5" rpy="1.5 0 0"/>
  </joint>
  <joint name="grip" type="continuous">
    <parent link="flange"/><child link="left"/><origin xyz="0.0625 0 0" rpy="0 0 0.5"/><axis xyz="1 0 0"/>
  </joint>
  <joint name="other" type="revolute">
    <parent link="flange"/><child link="right"/><origin xyz="-0.0625 0 0" rpy="0 0.5 0"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
  </joint>
</robot>
"""

# torch builds its forward-mode rules with torch.jit.script, and warns about it.
JACFWD = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")


def random_offset(rng):
    offset = torch.eye(4, dtype=torch.float64)
    offset[:3, :3] = torch.from_numpy(Rotation.random(random_state=rng).as_matrix())
    offset[:3, 3] = torch.from_numpy(rng.normal(size=3))
    return offset


def random_tree(seed, count=9, kinds=("revolute", "prismatic", "fixed"), mimics=False):
    rng = np.random.RandomState(seed)
    joints = [Joint("root", -1, random_offset(rng))]
    for index in range(1, count):
        axis = rng.normal(size=3)
        joint = Joint(
            f"j{index}", int(rng.randint(index)), random_offset(rng), kinds[rng.randint(len(kinds))],
            tuple(axis / np.linalg.norm(axis)),
        )  # fmt: skip
        moving = [at for at, other in enumerate(joints) if other.kind != "fixed"]
        if mimics and joint.kind != "fixed" and moving and rng.rand() < 0.5:
            joint = replace(joint, mimic=(int(rng.choice(moving)), float(rng.normal()), float(rng.normal())))
        joints.append(joint)
    return KinematicTree(tuple(joints))


def reference(tree, values):
    """Walk the tree joint by joint in numpy; ``values`` by name of the free joints."""
    memo = {}

    def value(index):
        joint = tree.joints[index]
        if joint.mimic is None:
            return values[joint.name]
        return joint.mimic[1] * value(joint.mimic[0]) + joint.mimic[2]

    def world(index):
        if index not in memo:
            joint = tree.joints[index]
            motion = np.eye(4)
            if joint.kind == "revolute":
                motion[:3, :3] = Rotation.from_rotvec(np.array(joint.axis) * value(index)).as_matrix()
            elif joint.kind == "prismatic":
                motion[:3, 3] = np.array(joint.axis) * value(index)
            above = np.eye(4) if joint.parent < 0 else world(joint.parent)
            memo[index] = above @ joint.offset.numpy() @ motion
        return memo[index]

    return np.stack([world(index) for index in range(len(tree))])


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 14))
def test_frames_equal_a_plain_walk_of_the_tree(seed, count):
    tree = random_tree(seed, count, mimics=True)
    kinematics = ForwardKinematics(tree)
    values = np.random.RandomState(seed).normal(size=kinematics.num_dofs)
    expected = reference(tree, dict(zip(kinematics.dof_names, values, strict=True)))
    np.testing.assert_allclose(kinematics(torch.from_numpy(values)).numpy(), expected, atol=1e-12)


def test_frames_equal_those_of_pytorch_kinematics_on_a_urdf(tmp_path):
    from torchreg.io.urdf import load_urdf

    path = tmp_path / "robot.urdf"
    path.write_text(ROBOT)
    tree, links = (record := load_urdf(path)).tree, record.link_names
    kinematics = ForwardKinematics(tree)
    assert kinematics.dof_names == ("turn", "reach", "grip", "other")
    values = torch.tensor([[0.3, 0.2, -2.5, 0.7], [-1.9, 0.0, 9.0, -0.4]], dtype=torch.float64)
    theirs = pk.build_chain_from_urdf(ROBOT.encode()).to(dtype=torch.float64)
    found = theirs.forward_kinematics({name: values[:, k] for k, name in enumerate(kinematics.dof_names)})
    ours = kinematics(values)
    for index, link in enumerate(links):
        # Their parser reads numbers as float32.
        torch.testing.assert_close(ours[:, index], found[link].get_matrix(), atol=1e-6, rtol=0)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 40))
def test_frames_equal_those_of_pytorch_kinematics_on_any_tree(seed, count):
    tree = random_tree(seed, count)
    kinematics = ForwardKinematics(tree)
    theirs = build_chain(tree, [joint.name for joint in tree.joints], torch.stack([j.offset for j in tree.joints]))
    values = torch.randn(3, kinematics.num_dofs, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    found = theirs.forward_kinematics({name: values[:, k] for k, name in enumerate(kinematics.dof_names)} or values)
    expected = torch.stack([found[joint.name].get_matrix() for joint in tree.joints], 1)
    torch.testing.assert_close(kinematics(values), expected, atol=1e-11, rtol=0)


@pytest.mark.parametrize("length", [2, 3, 4, 5, 8, 9, 33])
def test_frames_of_a_chain_of_any_length_hold_every_ancestor(length):
    values = torch.rand(length, dtype=torch.float64, generator=torch.Generator().manual_seed(length))
    torch.testing.assert_close(ForwardKinematics(line(length))(values)[:, 2, 3], values.cumsum(0), atol=1e-12, rtol=0)


def test_degrees_of_freedom_come_in_the_order_of_the_tree_not_depth_first():
    eye = torch.eye(4, dtype=torch.float64)
    parents = [-1, 0, 0, 1, 2]
    kinematics = ForwardKinematics(
        KinematicTree(tuple(Joint(f"j{i}", p, eye, "prismatic") for i, p in enumerate(parents)))
    )
    assert kinematics.dof_names == ("j0", "j1", "j2", "j3", "j4")
    heights = kinematics(torch.tensor([1.0, 2.0, 4.0, 8.0, 16.0], dtype=torch.float64))[:, 2, 3]
    assert heights.tolist() == [1.0, 3.0, 5.0, 11.0, 21.0]


def test_names_may_hold_any_character():
    eye = torch.eye(4, dtype=torch.float64)
    names = ["", "\n", "a\n", "a", "0", "ü"]
    tree = KinematicTree(tuple(Joint(name, at - 1, eye, "prismatic") for at, name in enumerate(names)))
    kinematics = ForwardKinematics(tree)
    assert kinematics.dof_names == tuple(names)
    assert kinematics(torch.ones(6, dtype=torch.float64))[-1, 2, 3] == 6.0


@pytest.mark.parametrize("batch", [(), (1,), (3,), (2, 3), (0,)])
def test_any_batch_dimensions(batch):
    kinematics = ForwardKinematics(random_tree(5, mimics=True))
    values = torch.randn(*batch, kinematics.num_dofs, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    frames = kinematics(values)
    assert frames.shape == (*batch, 9, 4, 4)
    for one, frame in zip(values.reshape(-1, kinematics.num_dofs), frames.reshape(-1, 9, 4, 4), strict=True):
        torch.testing.assert_close(frame, kinematics(one), atol=1e-14, rtol=0)


def test_a_tree_without_degrees_of_freedom():
    tree = random_tree(3, kinds=("fixed",))
    kinematics = ForwardKinematics(tree)
    assert kinematics.num_dofs == 0
    np.testing.assert_allclose(
        kinematics(torch.zeros(2, 0, dtype=torch.float64))[1].numpy(), reference(tree, {}), atol=1e-12
    )
    twists, moves = kinematics.joint_twists(kinematics(torch.zeros(0, dtype=torch.float64)))
    assert twists.shape == (0, 6)
    assert moves.shape == (9, 0)


def test_the_number_of_joint_values_is_checked():
    kinematics = ForwardKinematics(random_tree(5))
    # pytorch-kinematics would give one value to every joint.
    with pytest.raises(
        InputError, match=rf"joint_values must have shape \(\.\.\., {kinematics.num_dofs}\), got \(2, 1\)"
    ):
        kinematics(torch.zeros(2, 1, dtype=torch.float64))
    with pytest.raises(InputError, match="joint_values"):
        kinematics(torch.tensor(0.0))


def test_moving_the_module_moves_everything_and_nothing_is_in_the_state():
    kinematics = ForwardKinematics(random_tree(5, mimics=True))
    values = torch.randn(2, kinematics.num_dofs, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    exact = kinematics(values)
    single = kinematics.to(torch.float32)(values.float())
    assert single.dtype == torch.float32
    torch.testing.assert_close(single, exact.float(), atol=1e-5, rtol=0)
    assert kinematics.joint_twists(single)[0].dtype == torch.float32
    assert list(kinematics.state_dict()) == []


def test_copies_are_independent():
    kinematics = ForwardKinematics(random_tree(5))
    other = copy.deepcopy(kinematics).to(torch.float32)
    assert other(torch.zeros(other.num_dofs)).dtype == torch.float32
    assert kinematics(torch.zeros(kinematics.num_dofs, dtype=torch.float64)).dtype == torch.float64


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_stretched_offsets_equal_a_tree_with_longer_offsets(seed):
    tree = random_tree(seed)
    kinematics = ForwardKinematics(tree)
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(2, kinematics.num_dofs, dtype=torch.float64, generator=generator)
    scales = torch.rand(len(tree), dtype=torch.float64, generator=generator) + 0.5
    longer = []
    for joint, scale in zip(tree.joints, scales, strict=True):
        offset = joint.offset.clone()
        offset[:3, 3] *= scale
        longer.append(replace(joint, offset=offset))
    expected = ForwardKinematics(KinematicTree(tuple(longer)))(values)
    torch.testing.assert_close(kinematics(values, scales), expected, atol=1e-12, rtol=0)


@JACFWD
def test_twists_are_the_derivatives_of_the_frames():
    kinematics = ForwardKinematics(random_tree(11, 12, mimics=True))
    values = torch.randn(kinematics.num_dofs, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    frames = kinematics(values)
    twists, moves = kinematics.joint_twists(frames)
    per_dof = torch.einsum("fj,jc,jk->fkc", moves, twists, kinematics.couplings)
    point = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
    derivative = torch.func.jacfwd(lambda q: kinematics(q)[:, :3, :3] @ point + kinematics(q)[:, :3, 3])(values)
    world = (frames[:, :3, :3] @ point + frames[:, :3, 3]).unsqueeze(1)
    moved = per_dof[..., :3] + torch.linalg.cross(per_dof[..., 3:], world.expand_as(per_dof[..., 3:]))
    torch.testing.assert_close(moved.mT, derivative, atol=1e-10, rtol=0)
    assert kinematics.has_mimics


def test_gradients_to_second_order():
    kinematics = ForwardKinematics(random_tree(4, 5))
    values = torch.full((kinematics.num_dofs,), 0.3, dtype=torch.float64, requires_grad=True)
    scales = torch.full((5,), 1.1, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(kinematics, (values, scales))
    assert torch.autograd.gradgradcheck(kinematics, (values, scales))


def line(length):
    eye = torch.eye(4, dtype=torch.float64)
    return KinematicTree(tuple(Joint(f"{at}", at - 1, eye, "prismatic") for at in range(length)))


def test_deep_trees_within_the_limit_work_and_deeper_ones_are_refused():
    kinematics = ForwardKinematics(line(301)).to(torch.float32)
    assert kinematics(torch.ones(301))[-1, 2, 3] == 301.0
    with pytest.raises(ModelError, match="frame '301' lies 301 frames deep; at most 300 are supported"):
        ForwardKinematics(line(302))


def test_stack_sizes_count_the_axes_of_a_joint():
    eye = torch.eye(4, dtype=torch.float64)
    away = eye.clone()
    away[0, 3] = 0.1
    joints = (
        Joint("root", -1, eye),
        Joint("ball_x", 0, away, "revolute", (1.0, 0.0, 0.0)),
        Joint("ball_y", 1, eye, "revolute", (0.0, 1.0, 0.0)),
        Joint("ball_z", 2, eye, "revolute"),
        Joint("hinge", 3, away, "revolute"),
        Joint("slide", 4, eye, "prismatic"),
    )
    assert stack_sizes(KinematicTree(joints)) == [3, 3, 3, 1, 1]
