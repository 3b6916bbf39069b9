"""Joints between bones: hinges and balls are found, gaps bridged, the strongest make the tree, stiffness."""

import pytest
import torch

import torchreg as tr
from tests.geometry.draws import rand, randn
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.bones.joint_moments import JointMoments
from torchreg.registration.bones.joint_prior import joint_weights, with_stiffness
from torchreg.registration.bones.sparse_grid import SparseGrid

BETA = 0.01


REST = torch.eye(4, dtype=torch.float64)


def joints_of(pairs, centers, transforms, **options):
    """The joints of pairs that share weight about given centers."""
    centers = torch.as_tensor(centers, dtype=torch.float64)
    grid = SparseGrid.from_points(rand(20, 3), 1)
    model = tr.GridLBS(grid, torch.ones(grid.num_corners, transforms.shape[-3], dtype=torch.float64))
    return model.joints_of(moments(pairs, centers), transforms, **options)


def moments(pairs, centers, spread=0.0):
    mass, spreads = torch.ones(len(pairs)).double(), torch.full((len(pairs), 3, 3), spread).double()
    return JointMoments(torch.tensor(pairs), mass, centers, spreads)


def test_hinges_and_balls_are_found(bones):
    whole, turned = se3_exp(torch.tensor([1.0, -2, 3, 0.4, 0.2, -1], dtype=torch.float64)), bones.turned_about
    transforms = torch.stack([whole, whole @ turned([1.0, 2.0, 0.0], [0, 0, 1.2])])
    joints = joints_of([[0, 1]], [[1.3, 1.8, 0.7]], transforms, regularization=1e-8)
    torch.testing.assert_close(joints.centers[0], torch.tensor([1.0, 2.0, 0.7], dtype=torch.float64))
    assert float(joints.gaps[0]) < 1e-6
    ball, vectors = torch.tensor([0.5, -1.0, 2.0], dtype=torch.float64), ([0.5, 0, 0], [0, 0.5, 0.1], [0, 0, 0.4])
    poses = torch.stack([torch.stack([REST, turned(ball, vector)]) for vector in vectors])
    joints = joints_of([[0, 1]], [[0.0, 0.0, 0.0]], poses, regularization=1e-9)
    torch.testing.assert_close(joints.centers[0], ball, atol=1e-6, rtol=0)
    assert joints.gaps.shape == (3, 1)


def test_bones_that_turn_alike_meet_at_the_region_and_regularization_is_a_squared_angle(bones):
    transforms = REST.repeat(2, 1, 1)
    transforms[1, 0, 3] = 0.25
    joints = joints_of([[0, 1]], [[1.0, 2.0, 3.0]], transforms)
    assert joints.centers.tolist() == [[1.0, 2.0, 3.0]]
    assert joints.gaps.tolist() == [0.25]
    for angle in (0.1, 0.4):
        hinge = torch.stack([REST, bones.turned_about([1.0, 0.0, 0.0], [0, 0, angle])])
        found = joints_of([[0, 1]], [[0.0, 0.0, 0.0]], hinge, regularization=angle**2).centers[0]
        assert float(found[0]) == pytest.approx(0.5, abs=0.01)


def test_joints_move_with_the_space_and_have_gradients():
    transforms = se3_exp(randn(3, 6))
    pairs, centers = [[0, 1], [1, 2]], torch.tensor([[0.1, 0.2, 0.3], [1.0, 0.0, -1.0]]).double()
    found = joints_of(pairs, centers, transforms).centers
    start = se3_exp(torch.tensor([0.3, 2, 1, 1, -0.5, 0.2], dtype=torch.float64))
    moved = joints_of(pairs, transform_points(start, centers), transforms @ torch.linalg.inv(start)).centers
    torch.testing.assert_close(moved, transform_points(start, found))
    assert torch.autograd.gradcheck(lambda t: joints_of(pairs, centers, t).centers, (transforms.requires_grad_(),))


def blocks(*boxes):
    """The model of boxes of cells, one bone each, from ((x, x), (y, y)), ends included, and one cell deep."""
    owner = {
        (x, y): bone
        for bone, ((left, right), (low, high)) in enumerate(boxes)
        for x in range(left, right + 1)
        for y in range(low, high + 1)
    }
    cells = torch.tensor([(*cell, 0) for cell in sorted(owner)])
    shape = tuple((cells.amax(0) + 1).tolist())
    grid = SparseGrid.from_cells(cells, shape, torch.zeros(3).double(), torch.eye(3).double(), 1.0)
    return tr.GridLBS.from_labels(grid, torch.tensor([owner[cell] for cell in sorted(owner)]), len(boxes))


def test_the_tree_takes_the_strongest_joints():
    # Three boxes about a corner, the smallest of whose three joints closes a circle; a fourth that touches nothing.
    model = blocks(((0, 6), (0, 3)), ((7, 10), (0, 5)), ((2, 6), (4, 5)))
    moments = model.joint_moments()
    assert moments.pairs.tolist() == [[0, 1], [0, 2], [1, 2]]
    assert int(moments.mass.argmin()) == 2
    tree = model.skeleton()
    heaviest = int(model.corner_weights().sum(0).argmax())
    assert (heaviest, tree.parents) == (0, (-1, 0, 0))
    torch.testing.assert_close(tree.origins[1:], model.joints().centers[:2])
    torch.testing.assert_close(tree.origins[0], model.middles[0])


def test_a_gap_is_bridged_where_bones_come_nearest():
    model = blocks(((0, 4), (0, 0)), ((5, 9), (0, 0)), ((12, 15), (0, 0)), ((12, 15), (8, 8)))
    found = model.bridged_moments()
    assert found.pairs.tolist() == [[0, 1], [1, 2], [2, 3]]
    assert float(found.mass[0]) > 0
    assert found.mass[1:].tolist() == [0.0, 0.0]
    assert float(found.center[1, 0]) == 11
    assert float(found.center[2, 1]) == 4.5
    assert float(found.spread[1:].abs().max()) == 0.0
    # The root of the chain is the bone of most weight, of two alike the first.
    assert model.skeleton().parents == (-1, 0, 1, 2)


@pytest.mark.parametrize("batch", [(), (3,)])
def test_a_gap_is_bridged_to_what_moves_alike_though_another_bone_is_nearer(batch, bones):
    # Two shins side by side; the thigh of the second is hidden, and its hip is on the trunk above.
    model = blocks(((0, 19), (0, 0)), ((0, 9), (2, 2)), ((0, 19), (5, 5)), ((20, 21), (0, 5)))
    turned = bones.turned_about([0.0, 0, 0], [0, 0, 1.0]), bones.turned_about([0.0, 4.0, 0], [0, 0, -1.0])
    moving = torch.stack([turned[0], turned[1], REST, REST]).expand(*batch, 4, 4, 4)
    assert model.bridged_moments(moving).pairs.tolist() == [[0, 3], [1, 2], [2, 3]]
    assert model.bridged_moments(REST.repeat(4, 1, 1)).pairs.tolist() == [[0, 1], [0, 3], [2, 3]]


def test_bridges_move_and_grow_with_the_space():
    model = blocks(((0, 4), (0, 0)), ((8, 12), (1, 3)), ((0, 4), (7, 8)))
    transforms, origin = se3_exp(0.1 * randn(3, 6, seed=1)), torch.tensor([1.0, -2.0, 0.5]).double()
    found, wide = model.bridged_moments(transforms), model.rescaled(50.0, origin)
    model.set_transforms_(transforms)
    scaled = wide.bridged_moments(model.rescaled(50.0, origin).transforms.detach())
    assert torch.equal(scaled.pairs, found.pairs)
    torch.testing.assert_close(scaled.center, origin + 50 * found.center)


@pytest.fixture(scope="module")
def spread(bones):
    """The spread (3, 3) of a joint whose second bone turns by a rotation vector in each frame."""

    def of(*vectors, **settings):
        turned = [torch.stack([REST, bones.turned_about(torch.zeros(3), vector)])[:, :3, :3] for vector in vectors]
        joint = moments([[0, 1]], torch.zeros(1, 3).double(), 1.0)
        return with_stiffness(joint, torch.stack(turned), tr.RegisterConfig(**settings), BETA).spread[0]

    return of


@pytest.fixture(scope="module")
def cost(bones):
    """The cost of a turn by a rotation vector at a joint of a spread."""

    def of(spread, *vector):
        turn = bones.turned_about(torch.zeros(3), vector)[:3, :3] - torch.eye(3)
        return BETA * float(((turn @ spread) * turn).sum())

    return of


@pytest.mark.parametrize("vector", [(0.1, 0.0, 0.0), (0.0, -0.05, 0.08)])
def test_a_turn_costs_its_squared_angle(vector, spread, cost):
    stiff = spread([0.0, 0.0, 0.0], turn_weight=0.3, turn_scale=1e3)
    assert cost(stiff, *vector) == pytest.approx(0.3 * sum(x * x for x in vector), rel=1e-2)
    assert cost(spread([0.0, 0.0, 0.0], turn_weight=0.0), *vector) == 0


def test_turns_cost_less_the_wider_they_were_and_gaps_too(spread):
    widths = [float(spread([0.0, 0.0, angle], turn_weight=1.0, turn_scale=0.1)[0, 0]) for angle in (0, 0.1, 1)]
    # Cauchy's weight: a half at the scale.
    assert widths[1] == pytest.approx(widths[0] / 2, rel=0.01)
    assert widths[2] < 0.02 * widths[0]
    gaps = torch.tensor([[0.0, 0.1, 0.1, 1.0], [0.0, 0.1, 0.0, 1.0]], dtype=torch.float64)
    # Geman and McClure's weight of mean squares: a quarter at the scale.
    expected = torch.tensor([1.0, 1 / 4, 1 / 1.5**2, 1 / 101**2], dtype=torch.float64)
    torch.testing.assert_close(joint_weights(gaps, 0.1), expected)


def test_a_hinge_costs_turns_about_other_axes_alone_and_needs_three_frames(spread, cost):
    bends = [[0.0, 0.0, angle] for angle in (0.0, 0.5, -0.4, 0.7)]
    hinge = spread(*bends, turn_weight=0.0, hinge_weight=0.2)
    assert cost(hinge, 0.0, 0.0, 0.5) == pytest.approx(0, abs=1e-12)
    for other in ((0.1, 0.0, 0.0), (0.0, 0.1, 0.0)):
        # By how clear the axis is, of at most the weight.
        assert 0.95 * 0.2 * 0.01 < cost(hinge, *other) < 0.2 * 0.01
    assert not spread(*bends[:2], turn_weight=0.0, hinge_weight=0.2).any()
    ball = [[0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.5]]
    for vectors in (ball, [[0.0, 0.0, 0.0]] * 3):
        assert float(spread(*vectors, turn_weight=0.0, hinge_weight=1.0).abs().max()) < 1e-6 / BETA
