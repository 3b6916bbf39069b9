"""Inverse kinematics: reachable handles are reached, joints hold where they are not, and dragging is smooth."""

import math
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

import torchreg as tr
from tests.geometry.draws import rand, randn
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.bones.sparse_grid import SparseGrid


@pytest.fixture(scope="module")
def limb(bones):
    """A limb registered in a bent pose, and four handles on it."""
    points, _ = bones.limb()
    model = bones.model_of(points)
    model.set_transforms_(bones.bent(0.6))
    handles = torch.tensor([[0.1, 0.15, 0], [0.5, -0.1, 0.05], [2.9, 0.4, 0.0], [2.5, 0.1, 0.1]], dtype=torch.float64)
    return model, handles


def joint_gaps(model, transforms):
    tree = model.skeleton()
    pairs = [(bone, parent) for bone, parent in enumerate(tree.parents) if parent >= 0]
    ends = [[transform_points(transforms[k], tree.origins[bone][None]) for k in (bone, up)] for bone, up in pairs]
    return [float((first - second).norm()) for first, second in ends]


@pytest.mark.parametrize("blend", ["linear", "dual_quaternion"])
def test_poses_that_joints_allow_are_reached(bones, blend):
    points, _ = bones.limb()
    model, wanted = bones.model_of(points, blend), bones.bent(1.3)
    model.set_transforms_(bones.bent(0.6))
    goal = model(points, wanted).detach()
    config = tr.SolvePoseConfig(rtol=1e-4, atol=1e-5, max_steps=50)
    solution = tr.solve_pose(model, points[::8], goal[::8], config=config)
    assert solution.status is tr.Status.CONVERGED
    assert float(solution.residuals.max()) < 0.01
    torch.testing.assert_close(solution.residuals, (solution.placed - goal[::8]).norm(dim=-1))
    assert float((model(points, solution.transforms) - goal).detach().norm(dim=-1).max()) < 0.05


def test_pieces_that_hidden_joints_cut_off_follow():
    points = rand(4000, 3) * torch.tensor([3.0, 0.5, 0.4])
    grid = SparseGrid.from_points(points[(points[:, 0] - 1.5).abs() > 0.3], 24)
    model = tr.GridLBS.from_labels(grid, (grid.cell_centers()[:, 0] > 1.5).long(), 2)
    handles = torch.tensor([[0.1, 0.1, 0.1], [0.1, 0.4, 0.3], [0.8, 0.3, 0.0]], dtype=torch.float64)
    shift, far = torch.tensor([0.3, 0.2, -0.1]).double(), torch.tensor([[1.9, 0.25, 0.2]]).double()
    solution = tr.solve_pose(model, handles, handles + shift)
    assert float(solution.residuals.max()) < 0.03
    torch.testing.assert_close(model(far, solution.transforms).detach(), far + shift, atol=0.1, rtol=0)


def test_a_dragged_end_moves_what_it_hangs_on(limb, bones):
    model, handles = limb
    before = model.transforms.detach().clone()
    targets = model(handles, bones.bent(0.9)).detach()
    solution = tr.solve_pose(model, handles, targets)
    assert solution.status is tr.Status.CONVERGED
    assert float(solution.residuals.max()) < 0.03
    assert max(joint_gaps(model, solution.transforms)) < 0.01
    assert sorted(solution.gaps.tolist()) == pytest.approx(sorted(joint_gaps(model, solution.transforms)), abs=1e-9)
    assert torch.equal(model.transforms, before)


def test_joints_hold_where_a_target_is_out_of_reach(limb):
    model, handles = limb
    targets = model(handles).detach()
    targets[2] = targets[2] + torch.tensor([20.0, 0.0, 0.0], dtype=torch.float64)
    solution = tr.solve_pose(model, handles, targets, config=tr.SolvePoseConfig(max_steps=100))
    assert float(solution.residuals[2]) > 5
    assert float(solution.gaps.max()) < 0.05 * float(solution.residuals[2])


def test_nothing_moves_without_a_reason(limb):
    model, handles = limb
    points = handles[:1]
    start = tr.solve_pose(model, points, model(points).detach()).transforms
    again = tr.solve_pose(model, points, model(points, start), start=start)
    assert again.num_steps <= 1
    torch.testing.assert_close(again.transforms, start, atol=2e-3, rtol=0)


def test_warm_starts_take_few_steps(limb, bones):
    model, handles = limb
    start, steps = None, []
    for k in range(10):
        targets = model(handles, bones.bent(0.6 + 0.05 * k)).detach()
        solution = tr.solve_pose(model, handles, targets, start=start)
        start = solution.transforms
        steps.append(solution.num_steps)
        assert float(solution.residuals.max()) < 0.03
    assert max(steps) <= 6


def test_fixed_bones_weightless_handles_and_joints_of_touching_parts(limb):
    model, handles = limb
    targets = model(handles).detach() + 0.3
    fixed = tr.solve_pose(model, handles, targets, fixed=torch.tensor([True, False, False]))
    torch.testing.assert_close(fixed.transforms[0], model.transforms[0].detach())
    weights = torch.tensor([0.0, 0.0, 1.0, 0.0], dtype=torch.float64)
    one = tr.solve_pose(model, handles, targets, handle_weights=weights)
    alone = tr.solve_pose(model, handles[2:3], targets[2:3])
    torch.testing.assert_close(one.transforms, alone.transforms)
    assert alone.gaps.shape == (2,)
    every = tr.solve_pose(model, handles, targets, config=tr.SolvePoseConfig(joints="all"))
    assert every.gaps.shape == (len(model.joints().pairs),)


def test_batches_equal_loops(limb):
    model, handles = limb
    targets = model(handles).detach() + 0.1 * randn(2, 3, 4, 3)
    config = tr.SolvePoseConfig(max_steps=5, rtol=0.0, atol=0.0)
    batch, one = (tr.solve_pose(model, handles, goal, config=config) for goal in (targets, targets[1, 2]))
    assert batch.transforms.shape == (2, 3, 3, 4, 4)
    assert batch.status == (tr.Status.MAX_STEPS,) * 6
    torch.testing.assert_close(batch.transforms[1, 2], one.transforms)
    torch.testing.assert_close(batch.residuals[1, 2], one.residuals)


def test_turning_and_scaling_everything_changes_nothing_else(limb):
    model, handles = limb
    targets = model(handles).detach() + 0.1
    expected = tr.solve_pose(model, handles, targets)
    motion = se3_exp(torch.tensor([3.0, 1, -2, 1, 2, 0.5], dtype=torch.float64))
    turned = tr.GridLBS(model.grid, model.weights, motion @ model.transforms)
    found = tr.solve_pose(turned, handles, transform_points(motion, targets))
    torch.testing.assert_close(found.transforms, motion @ expected.transforms)


def test_single_precision_and_one_bone(limb):
    model, handles = limb
    single, targets = tr.GridLBS.from_record(model.record()).float(), model(handles).detach() + 0.1
    solution = tr.solve_pose(single, handles.float(), targets.float())
    assert solution.transforms.dtype == solution.placed.dtype == solution.residuals.dtype == torch.float32
    double = tr.solve_pose(model, handles, targets)
    torch.testing.assert_close(solution.transforms.double(), double.transforms, atol=1e-2, rtol=0)
    rigid = tr.GridLBS(model.grid, torch.ones(model.grid.num_corners, 1))
    moved = se3_exp(torch.tensor([0.5, 0.1, 0.2, 0.4, -0.3, 0.8], dtype=torch.float64))
    config = tr.SolvePoseConfig(stay=1e-9, rtol=1e-8, atol=0.0)
    alone = tr.solve_pose(rigid, handles, transform_points(moved, handles), config=config)
    torch.testing.assert_close(alone.transforms[0], moved, atol=1e-5, rtol=0)
    assert alone.gaps.shape == (0,)


def test_the_solution_is_saved_and_earlier_files_hold_residuals_as_misses(limb, tmp_path):
    model, handles = limb
    solution = tr.solve_pose(model, handles, model(handles).detach() + 0.1)
    solution.save(tmp_path / "pose.safetensors")
    again = tr.load(tmp_path / "pose.safetensors")
    assert isinstance(again, tr.PoseSolution)
    assert torch.equal(again.transforms, solution.transforms)
    assert again.status is solution.status
    assert torch.equal(again.misses, solution.residuals)
    path = Path(__file__).parents[1] / "saved" / "0.1.0" / "PoseSolution.safetensors"
    assert torch.equal(tr.load(path).residuals, load_file(path)["misses"])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"hold": 0.0}, "hold must be positive"),
        ({"bend": -1.0}, "bend must be zero or positive"),
        ({"stay": 0.0}, "stay must be positive"),
        ({"joints": "none"}, "joints must be one of"),
        ({"max_steps": 0}, "max_steps must be at least 1"),
        ({"rtol": -1.0}, "rtol must be"),
        ({"atol": -1.0}, "atol must be"),
    ],
)
def test_bad_settings_are_named(change, words):
    with pytest.raises(tr.errors.InputError, match=words):
        tr.SolvePoseConfig(**change)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda model, points: {"handles": points[:0], "targets": points[:0]}, "handles must hold at least 1"),
        (lambda model, points: {"targets": points[1:]}, "targets must have shape"),
        (lambda model, points: {"targets": points * math.nan}, "targets must be finite"),
        (lambda model, points: {"handle_weights": -torch.ones(4)}, "handle_weights must not be negative"),
        (lambda model, points: {"start": 2 * model.transforms}, "start must hold rigid motions"),
        (lambda model, points: {"fixed": torch.ones(5).bool()}, "fixed must have shape"),
        (lambda m, _: {"model": tr.GridLBS(m.grid, m.weights, m.transforms.expand(2, 3, 4, 4))}, "start must be given"),
    ],
)
def test_bad_input_is_named(limb, change, words):
    model, handles = limb
    with pytest.raises(tr.errors.InputError, match=words):
        tr.solve_pose(**{"model": model, "handles": handles, "targets": handles, **change(model, handles)})
