"""Bones on a grid: the deformation from its definition, batches, gradients, transforms of torch, joints, skeleton."""

import copy
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import torchreg as tr
from tests.geometry.draws import D, rand, randn
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.blend import turn_about
from torchreg.registration.bones.sparse_grid import SparseGrid

InputError, InputTypeError = tr.errors.InputError, tr.errors.InputTypeError
# torch builds its forward-mode rules with torch.jit.script, and warns about it.
JACFWD = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
BLENDS = pytest.mark.parametrize("blend", ["linear", "dual_quaternion"])


def bar(count=300, seed=0):
    return rand(count, 3, seed=seed) * torch.tensor([3.0, 0.5, 0.4])


def random_model(blend="linear", num_bones=3, *batch, resolution=12):
    grid = SparseGrid.from_points(bar(), resolution)
    transforms = se3_exp(0.7 * randn(*batch, num_bones, 6, seed=1))
    return tr.GridLBS(grid, rand(grid.num_corners, num_bones), transforms, blend=blend)


@pytest.fixture(scope="module")
def elbow(bones):
    """A bar of two halves, hidden in the middle or not; the second turns about PIVOT."""

    def make(angle=1.0, hidden=0.0):
        points = bar(4000)
        grid = SparseGrid.from_points(points[(points[:, 0] - 1.5).abs() >= hidden], 24, frame="world")
        transforms = torch.stack([torch.eye(4, dtype=D), bones.turned_about(PIVOT, [0, 0, angle])])
        return tr.GridLBS.from_labels(grid, (grid.cell_centers()[:, 0] > 1.5).long(), 2, transforms)

    return make


PIVOT = torch.tensor([1.5, 0.25, 0.2], dtype=D)


def test_the_deformation_is_equation_1():
    model, points = random_model(), bar(20, 1)
    weights = model.grid.interpolate(model.corner_weights(), points)
    torch.testing.assert_close(weights.sum(-1), torch.ones(20, dtype=D))
    torch.testing.assert_close(model.weights_at(points), weights)
    torch.testing.assert_close(model.move(points, weights), model(points))
    expected = torch.einsum("nb,bni->ni", weights, transform_points(model.transforms, points))
    torch.testing.assert_close(model(points), expected)


def dual_quaternion_by_hand(x, row, transforms):
    """Kavan's algorithm with scipy's quaternions, scalar last."""
    real = Rotation.from_matrix(transforms[:, :3, :3].numpy()).as_quat()
    pivot, total, total_dual = real[int(row.argmax())], np.zeros(4), np.zeros(4)
    for w, q, t in zip(row.numpy(), real, transforms[:, :3, 3].numpy(), strict=True):
        w = -w if q @ pivot < 0 else w
        total += w * q
        total_dual += w * 0.5 * np.append(q[3] * t + np.cross(t, q[:3]), -t @ q[:3])
    total, total_dual = total / np.linalg.norm(total), total_dual / np.linalg.norm(total)
    shift = 2 * (total[3] * total_dual[:3] - total_dual[3] * total[:3] + np.cross(total[:3], total_dual[:3]))
    return Rotation.from_quat(total).apply(x.numpy()) + shift


def test_the_dual_quaternion_blend_is_kavans():
    model, points, weights = random_model("dual_quaternion"), bar(30, 1), randn(30, 3).abs()
    weights, transforms = weights / weights.sum(-1, keepdim=True), se3_exp(1.2 * randn(3, 6, seed=1))
    for x, row, found in zip(points, weights, model.move(points, weights, transforms), strict=True):
        np.testing.assert_allclose(found.detach(), dual_quaternion_by_hand(x, row, transforms), atol=1e-12)


@BLENDS
def test_no_motion_moves_nothing_and_one_motion_moves_all_rigidly(blend):
    model, points = random_model(blend), bar(50, 1)
    torch.testing.assert_close(tr.GridLBS(model.grid, model.weights, blend=blend)(points), points)
    for motion in (torch.eye(4, dtype=D), se3_exp(torch.tensor([1.0, 2, 3, 0.4, -0.3, 0.8], dtype=D))):
        torch.testing.assert_close(model(points, motion.expand(3, 4, 4)), transform_points(motion, points))
    origin = torch.tensor([3.0, -1.0, 0.5], dtype=D)
    torch.testing.assert_close(model.rescaled(7.0, origin)(origin + 7 * points), origin + 7 * model(points))


@BLENDS
def test_batches_equal_loops(blend):
    model, points, apart = random_model(blend, 3, 4, 2), bar(10, 1), bar(20, 2).reshape(2, 10, 3)
    found, transforms = model(points), model.transforms
    assert model.twists.shape == (4, 2, 3, 6)
    assert found.shape == (4, 2, 10, 3)
    for index in np.ndindex(4, 2):
        torch.testing.assert_close(found[index], model(points, transforms[index]))
    torch.testing.assert_close(model(apart)[3, 1], model(apart[1], transforms[3, 1]))
    torch.testing.assert_close(torch.func.vmap(lambda t: model(points, t))(transforms[:, 0]), found[:, 0])
    per_point = torch.func.vmap(lambda x: model(x[None], transforms[0, 0])[0])(points)
    torch.testing.assert_close(per_point, found[0, 0])


@JACFWD
@BLENDS
def test_the_jacobian_equals_automatic_differentiation(blend):
    model, points = random_model(blend, 3, 2), bar(6, 1)
    moved, jacobian = model.jacobian(points)
    torch.testing.assert_close(moved, model(points))
    transforms = model.transforms.detach()
    centers = transform_points(transforms, model.middles.unsqueeze(-2)).squeeze(-2)
    for differentiate in (torch.func.jacfwd, torch.func.jacrev):
        expected = differentiate(lambda t: model(points, turn_about(transforms[1], t, centers[1])))(
            torch.zeros(3, 6).double()
        )
        torch.testing.assert_close(jacobian[1], expected, atol=1e-12, rtol=1e-10)


@BLENDS
def test_gradients(blend):
    model, points = random_model(blend, resolution=3), bar(3, 1)

    def posed(points, transforms, weights, twists):
        values = {"weights": weights, "twists": twists}
        own = torch.func.functional_call(model, values, (points,))
        return own + torch.func.functional_call(model, values, (points, transforms))

    inputs = (points, model.transforms, model.weights, model.twists)
    inputs = tuple(value.detach().clone().requires_grad_() for value in inputs)
    assert torch.autograd.gradcheck(posed, inputs, fast_mode=True)


def test_twists_turn_bones_about_their_middles(elbow):
    model, shift = elbow(0.0), torch.tensor([0, 0.1, 0]).double()
    left, right = model.weights_at(torch.tensor([[0.5, 0.2, 0.2], [2.5, 0.2, 0.2]]).double()).tolist()
    assert (left, right) == ([1.0, 0.0], [0.0, 1.0])
    with torch.no_grad():
        model.twists[1] = torch.tensor([0, 0.1, 0, 0, 0, 0.5])
    fixed, middle = model.transforms.detach(), model.middles[1:]
    torch.testing.assert_close(transform_points(fixed[1], middle), middle + shift)
    model.set_transforms_(fixed)
    assert bool((model.twists == 0).all())
    torch.testing.assert_close(model.transforms, fixed)
    model.set_transforms_(fixed.expand(5, 2, 4, 4))
    assert model.twists.shape == (5, 2, 6)
    assert model.twists.requires_grad


def test_weights_for_files_keep_the_largest():
    model, points = random_model(num_bones=6), bar(30, 1)
    weights, four = model.vertex_weights(points), model.vertex_weights(points, most=4)
    kept = weights * (weights >= weights.sort(dim=1).values[:, 2:3])
    torch.testing.assert_close(four, kept / kept.sum(-1, keepdim=True))
    torch.testing.assert_close(model.vertex_weights(points, most=6), weights)


@pytest.mark.parametrize(("angle", "hidden"), [(0.5, 0.0), (1.5, 0.0), (math.pi, 0.0), (1.0, 0.4)])
def test_the_elbow_is_found_also_across_a_gap(angle, hidden, elbow):
    model = elbow(angle, hidden)
    joints, tree = model.joints(), model.skeleton()
    assert joints.pairs.tolist() == [[0, 1]]
    torch.testing.assert_close(joints.centers[0, : 2 if hidden else 3], PIVOT[: 2 if hidden else 3], atol=0.03, rtol=0)
    assert len(model.joint_moments().pairs) == (0 if hidden else 1)
    assert (joints.mass.tolist() == [0.0]) == bool(hidden)
    assert sorted(tree.parents) in ([-1, 0], [-1, 1])
    child = tree.parents.index(max(tree.parents))
    torch.testing.assert_close(tree.origins[child], joints.centers[0])
    torch.testing.assert_close(tree.origins[1 - child], model.middles[1 - child])


def test_moments_are_those_of_the_normalized_weights():
    model = random_model()
    with torch.no_grad():
        model.weights.mul_(3)
    mass = model.joint_moments().mass
    torch.testing.assert_close(mass, random_model().joint_moments().mass)
    torch.testing.assert_close(model.joint_moments(pairs=torch.tensor([[1, 2]])).mass, mass[2:])


def test_moves_between_dtypes_and_into_records():
    model, points = random_model("dual_quaternion", 3, 2), bar(10, 1)
    single = copy.deepcopy(model).float()
    assert single(points.float()).dtype == single.grid.origin.dtype == torch.float32
    torch.testing.assert_close(single(points.float()).double(), model(points), atol=1e-4, rtol=0)
    again = tr.GridLBS.from_record(model.record())
    assert torch.equal(again(points), model(points))
    assert torch.equal(again.weights, model.weights)


def test_one_bone_and_bones_without_cells():
    grid = SparseGrid.from_points(bar(), 4)
    one = tr.GridLBS(grid, torch.ones(grid.num_corners, 1))
    torch.testing.assert_close(one(bar()), bar())
    assert one.skeleton().parents == (-1,)
    idle = tr.GridLBS.from_labels(grid, torch.zeros(grid.num_cells).long(), 3)
    assert idle.skeleton().parents == (-1, -1, -1)
    torch.testing.assert_close(idle.middles[1:], grid.corner_points().mean(0).expand(2, 3))
    assert len(idle.joints().pairs) == 0


MODEL = random_model(num_bones=2, resolution=4)
GRID = MODEL.grid
ONES, EYES = torch.ones(GRID.num_corners, 2), torch.eye(4).repeat(2, 1, 1)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: tr.GridLBS(GRID, ONES[:3]), InputError, "weights must have shape"),
        (lambda: tr.GridLBS(GRID, -ONES), InputError, "weights must not be negative"),
        (lambda: tr.GridLBS(GRID, 0 * ONES), InputError, "must have a positive entry"),
        (lambda: tr.GridLBS(GRID, math.nan * ONES), InputError, "weights must be finite"),
        (lambda: tr.GridLBS(GRID, ONES, torch.eye(4)), InputError, "transforms must have shape"),
        (lambda: tr.GridLBS(GRID, ONES, 2 * EYES), InputError, "rigid motions"),
        (lambda: tr.GridLBS(GRID, ONES, EYES * torch.tensor([1.0, 1, -1, 1])), InputError, "rigid motions"),
        (lambda: tr.GridLBS(GRID, ONES, math.inf * EYES), InputError, "transforms must be finite"),
        (lambda: tr.GridLBS(GRID, ONES, blend="cubic"), InputError, "blend must be one of"),
        (lambda: tr.GridLBS.from_labels(GRID, torch.full((GRID.num_cells,), 2), 2), InputError, "labels must be 0"),
        (lambda: tr.GridLBS.from_labels(GRID, torch.zeros(2).long(), 2), InputError, "shape"),
        (lambda: tr.GridLBS.from_labels(GRID, torch.zeros(GRID.num_cells), 2), InputTypeError, "must hold integers"),
        (lambda: MODEL.vertex_weights(bar(3), most=0), InputError, "most must be at least 1"),
        (lambda: MODEL.joints(EYES[0].double()), InputError, "transforms must have shape"),
        (lambda: MODEL.skeleton(EYES[0].double()), InputError, "transforms must have shape"),
        (lambda: MODEL.joints(min_mass=0.0), InputError, "min_mass must be positive"),
        (lambda: MODEL.skeleton(min_mass=0.0), InputError, "min_mass must be positive"),
        (lambda: MODEL.joints(regularization=-math.pi), InputError, "regularization must be positive"),
        (lambda: MODEL.set_transforms_(torch.ones(2, 4, 4)), InputError, "transforms must hold rigid motions"),
    ],
)
def test_bad_input_is_named(call, error, words):
    with pytest.raises(error, match=words):
        call()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@BLENDS
def test_on_a_graphics_card(blend):
    model, points = random_model(blend), bar(50, 1)
    there = copy.deepcopy(model).to("cuda")
    moved = there(points.cuda())
    assert moved.is_cuda
    torch.testing.assert_close(moved.cpu(), model(points))
