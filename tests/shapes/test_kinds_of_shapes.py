"""What holds for every kind of shape: rotations of the base, derivatives, batches, invariances, dtypes, states."""

import copy
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.shapes.kinds import ROTATIONS, D, around, at, compare, machine, perturbed, poses_of, rotated, seeded
from torchreg.shapes.record import build_shape, record_shape

# torch builds its forward-mode rules with torch.jit.script, and warns about it.
JACFWD = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")


def test_the_base_turns_about_the_origin_and_then_moves(shape):
    pose = poses_of(shape, 1)[0]
    still = shape.part_transforms(rotated(pose, ["zero"])[0])
    still[:, :3, 3] -= pose[:3]
    for rotation, found in zip(ROTATIONS.values(), shape.part_transforms(rotated(pose)), strict=True):
        base = np.eye(4)
        base[:3, :3], base[:3, 3] = Rotation.from_rotvec(rotation).as_matrix(), pose[:3]
        np.testing.assert_allclose(found, base @ still.numpy(), atol=1e-12)


def test_retraction_composes_rotations_and_adds_the_rest_and_a_difference_is_its_inverse(shape):
    starts = rotated(poses_of(shape, 1)[0])
    ends = starts.roll(3, 0) + 0.1 * seeded(*starts.shape, seed=1)
    steps = 0.3 * torch.sin(torch.arange(starts.numel(), dtype=D)).reshape(starts.shape)
    others = [0, 1, 2, *range(6, shape.num_dofs)]
    found = shape.retract(starts, steps)
    expected = Rotation.from_rotvec(steps[:, 3:6]) * Rotation.from_rotvec(starts[:, 3:6])
    np.testing.assert_allclose(Rotation.from_rotvec(found[:, 3:6]).as_matrix(), expected.as_matrix(), atol=1e-9)
    compare([found[:, others]], [(starts + steps)[:, others]])
    assert float(found[:, 3:6].norm(dim=-1).max()) <= math.pi + 1e-9
    difference = shape.difference(starts, ends)
    compare([shape.part_transforms(shape.retract(starts, difference))], [shape.part_transforms(ends)], atol=1e-9)
    between = Rotation.from_rotvec(ends[:, 3:6]) * Rotation.from_rotvec(starts[:, 3:6]).inv()
    np.testing.assert_allclose(difference[:, 3:6].norm(dim=-1), between.magnitude(), atol=1e-9)
    compare([shape.difference(starts[1], ends)[2]], [shape.difference(starts[1], ends[2])])
    # Of a pose and itself, or its other rotation vector, nothing is left.
    turn = ends[3:5, 3:6].norm(dim=-1, keepdim=True)
    same = torch.cat([ends[3:5, :3], ends[3:5, 3:6] * (turn - 2 * math.pi) / turn, ends[3:5, 6:]], dim=-1)
    assert float(shape.difference(ends[3:5], same).abs().max()) < 1e-14
    gentle = (starts[:4].clone().requires_grad_(), starts[:4] + 0.1 * steps[:4])
    assert torch.autograd.gradcheck(shape.difference, gentle, fast_mode=True)
    assert torch.autograd.gradcheck(lambda pose: shape.difference(pose, pose + 1e-3), gentle[:1], fast_mode=True)
    assert shape.difference(starts.float(), ends.float()).dtype == torch.float32


@JACFWD
def test_jacobians_in_the_pose_equal_forward_mode(shape):
    names = tuple(ROTATIONS) if shape.num_dofs == 10 else ("zero", "ordinary")
    for pose in rotated(poses_of(shape, 1)[0], names):
        points = around(shape, pose)
        expected = torch.func.jacfwd(lambda p, x=points: shape.distance(x, p))(pose)
        compare(shape.distance_jacobian(points, pose), (shape.distance(points, pose), expected), atol=1e-10)

        def stacked(p):
            return shape.part_transforms(p)[..., :3, :].mT.flatten(0, 1)

        compare(shape.transform_jacobian(pose), (stacked(pose), torch.func.jacfwd(stacked)(pose)), atol=1e-10)


@torch.no_grad()
def test_jacobians_in_tangent_steps_equal_differences_through_the_retraction(shape):
    steps = 1e-6 * torch.eye(shape.num_dofs, dtype=D)
    for pose in rotated(poses_of(shape, 1, seed=1)[0]):
        points = around(shape, pose, 20)
        ahead, behind = (shape.retract(pose.expand_as(steps), sign * steps) for sign in (1, -1))
        slope = ((shape.distance(points, ahead) - shape.distance(points, behind)) / 2e-6).mT
        compare([shape.distance_jacobian(points, pose, chart="tangent")[1]], [slope], atol=1e-6)
        moved = ((shape.part_transforms(ahead) - shape.part_transforms(behind)) / 2e-6)[:, :, :3].permute(1, 3, 2, 0)
        compare([shape.transform_jacobian(pose, chart="tangent")[1]], [moved.flatten(0, 1)], atol=1e-7)


@torch.no_grad()
def test_all_moves_with_the_base(shape):
    pose = poses_of(shape, 1, seed=2)[0]
    points, motion = around(shape, pose), Rotation.from_rotvec([0.7, -1.9, 0.4])
    frame = at(3.0, -2.0, 1.0, motion.as_rotvec())
    moved = pose.clone()
    moved[3:6] = torch.from_numpy((motion * Rotation.from_rotvec(pose[3:6])).as_rotvec())
    moved[:3] = frame[:3, :3] @ pose[:3] + frame[:3, 3]
    compare([shape.distance(points @ frame[:3, :3].mT + frame[:3, 3], moved)], [shape.distance(points, pose)])
    compare([shape(moved).points], [shape(pose).points @ frame[:3, :3].mT + frame[:3, 3]], atol=1e-9)


def call(shape, points, pose, *values):
    """The forward pass and the distances of points under other parameters."""

    class Both(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.shape = shape

        def forward(self):
            return *self.shape(pose)[:2], self.shape.distance(points, pose)

    names = (f"shape.{name}" for name, _ in shape.named_parameters())
    return torch.func.functional_call(Both(), dict(zip(names, values, strict=True)), ())


def test_gradients_in_points_pose_and_all_parameters(shape):
    shape = perturbed(copy.deepcopy(shape))
    for name in ("points", "weights", "partners"):
        value = getattr(shape.surface_points, name)
        shape.surface_points.register_buffer(name, None if value is None else value[::20])
    pose = poses_of(shape, 1)[0]
    inputs = (around(shape, pose, 5), pose, *(value.detach().clone() for value in shape.parameters()))
    inputs = tuple(value.requires_grad_() for value in inputs)
    assert torch.autograd.gradcheck(lambda *values: call(shape, *values), inputs, atol=1e-6, fast_mode=True)


@torch.no_grad()
def test_another_dtype_or_device_moves_everything(shape):
    pose = poses_of(shape, 1)[0]
    points = around(shape, pose)
    single = copy.deepcopy(shape).to(torch.float32)
    assert {value.dtype for value in single.state_dict().values()} == {torch.float32}
    found = (*single(pose.float()), *single.distance_jacobian(points.float(), pose.float()))
    assert {value.dtype for value in found} == {torch.float32}
    expected = (*shape(pose), *shape.distance_jacobian(points, pose))
    compare((value.double() for value in found), expected, atol=1e-4, rtol=2e-4)
    device = "cuda" if torch.cuda.is_available() else "meta"
    moved = copy.deepcopy(shape).to(device)
    assert {value.device.type for value in (*moved.parameters(), *moved.buffers())} == {device}
    assert {value.device.type for value in moved(pose.to(device))} == {device}


@torch.no_grad()
def test_states_and_records_make_the_same_shape_and_share_nothing(shape):
    own, fresh = perturbed(copy.deepcopy(shape)), copy.deepcopy(shape)
    own.log_radius_scales.requires_grad_(True)
    record = record_shape(own)
    built = build_shape(record)
    fresh.load_state_dict(own.state_dict())
    poses = poses_of(own)
    points = around(own, poses)
    for other in (fresh, built):
        assert all(torch.equal(a, b) for a, b in zip(other(poses), own(poses), strict=True))
        assert torch.equal(other.distance(points, poses), own.distance(points, poses))
    assert type(built) is type(own)
    for name in ("part_names", "part_parents", "dof_names", "nu", "sharpness", "up", "coefficient_names"):
        assert getattr(built, name) == getattr(own, name)
    for a, b in zip((*own.parameters(), *own.buffers()), (*built.parameters(), *built.buffers()), strict=True):
        assert (a.dtype, a.requires_grad) == (b.dtype, b.requires_grad)
    before = own.distance(points, poses)
    perturbed(built)
    assert torch.equal(own.distance(points, poses), before)
    assert torch.equal(build_shape(record).distance(points, poses), before)


@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_records_keep_the_order_of_parts_their_names_and_what_is_upright(dtype):
    shape = machine(dtype, (1, 0, 4, 2, 3), part_names=list("abcde"), up=(0.0, -1.0, 0.0), free_base=False)
    built = build_shape(record_shape(shape))
    assert (built.part_names, built.up, built.rest.dtype) == (tuple("abcde"), (0, -1, 0), dtype)
    pose = poses_of(shape, 1)[0]
    assert torch.equal(built.part_distances(around(shape, pose), pose), shape.part_distances(around(shape, pose), pose))
    assert built.upper[:6].tolist() == [0.0] * 6
    assert machine().up == (0, 0, 1)


def test_poses_are_clamped_and_named(shape):
    wild = torch.full((shape.num_dofs,), 50.0, dtype=D)
    wild[:6] = torch.tensor([1.0, 2.0, 3.0, 0.0, 0.0, 5.0])
    tame = shape.clamp(wild)
    assert tame[:3].tolist() == [1.0, 2.0, 3.0]
    compare([tame[3:6]], [torch.tensor([0.0, 0.0, 5.0 - 2 * math.pi], dtype=D)])
    compare([tame[6:]], [shape.upper[6:].clamp_max(50.0)])
    rest = shape.rest_pose()
    assert bool(((rest >= shape.lower) & (rest <= shape.upper)).all())
    shape.rest_pose()[:] = 9.0
    assert torch.equal(shape.rest_pose(), rest)
    poses = poses_of(shape, 2)
    named = shape.pose_to_dict(poses)
    assert list(named) == list(shape.dof_names)
    assert torch.equal(shape.pose_from_dict(named), poses)
    single = shape.pose_to_dict(poses[0])
    assert all(type(value) is float for value in single.values())
    compare([shape.pose_from_dict(single)], poses[:1], atol=1e-6)
    lines = repr(shape).splitlines()
    assert len(lines) == 3
    assert lines[0].endswith(f": {shape.num_parts} parts, {shape.num_dofs} degrees of freedom")
