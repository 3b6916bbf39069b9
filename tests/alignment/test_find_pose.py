"""Finding poses without a start: any rotation, batches, motions, padding, machines, sources, confidence."""

import math
from dataclasses import replace

import pytest
import torch

import torchreg.alignment.find_pose as find_pose_module
from torchreg.alignment.find_pose import FindPoseConfig, find_pose
from torchreg.alignment.problem import alignment_cost, centered_problem, masked_mean
from torchreg.alignment.results import PoseStarts
from torchreg.alignment.rough_poses import (
    PrincipalAxes,
    UniformRotations,
    UprightRotations,
    spread_rotations,
    typical_poses,
)
from torchreg.datasets.hand import make_hand_cloud
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.rotation import so3_exp, so3_log
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.skin import sample_skin
from torchreg.storage import load

QUICK = FindPoseConfig(num_candidates=16, num_placed=5, num_searched=2, search_rounds=1, num_model_points=200)
# Enough for most tests; the default is tried by the first ones.
FEW = (UniformRotations(80), PrincipalAxes())
TIPS = [4, 8, 12, 16, 20]


def offset(*place):
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor(place, dtype=torch.float64)
    return pose


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def truths(plain_hand):
    """Two hands half a metre away, turned in any way, the fingers bent up to a third of their range."""
    poses = plain_hand.rest_pose().repeat(2, 1)
    poses[:, 6:] = 0.35 * torch.rand(2, 21, generator=generator(4)) * plain_hand.upper[6:].clamp_min(0)
    poses[:, 3:6] = torch.tensor([[2.9, 0.3, -0.4], [-1.0, 1.9, 0.6]])
    poses[:, 2] = 0.5
    return poses


@pytest.fixture(scope="module")
def clouds(plain_hand, plain_hand_surface, truths):
    return torch.stack([
        make_hand_cloud(
            plain_hand, pose, num_points=400, noise=0.001, outlier_ratio=0.0, skin=plain_hand_surface,
            generator=generator(row),
        ).points
        for row, pose in enumerate(truths)
    ])  # fmt: skip


@pytest.fixture(scope="module")
def found(plain_hand, plain_hand_skin, clouds):
    return find_pose(plain_hand, clouds, num_starts=2, model_points=plain_hand_skin, config=QUICK)


def offsets(hand, poses, truths):
    """Return the distances of the keypoints from their true places."""
    return (hand.keypoints(poses) - hand.keypoints(truths)).norm(dim=-1)


# Hands


def test_hands_in_any_rotation_are_found(plain_hand, found, truths):
    assert isinstance(found, PoseStarts)
    assert found.poses.shape == (2, 2, 27)
    errors = offsets(plain_hand, found.best, truths)[:, TIPS]
    assert float(errors.mean(1).max()) < 0.005
    torch.testing.assert_close(found.best, found.poses[:, 0])
    assert bool(((found.poses >= plain_hand.lower) & (found.poses <= plain_hand.upper)).all())


def test_the_first_start_costs_least_and_confidence_is_a_share(found):
    assert found.costs.shape == (2, 2)
    assert bool((found.costs[:, :1] <= found.costs).all())
    assert found.confidence.shape == (2,)
    assert bool(((found.confidence >= 0) & (found.confidence <= 1)).all())
    # The hand's turned-over twin costs far more.
    assert bool((found.confidence > 0.5).all())


def test_one_cloud_is_a_batch_of_one(plain_hand, plain_hand_skin, clouds, found, truths):
    single = find_pose(plain_hand, clouds[0], num_starts=2, model_points=plain_hand_skin, config=QUICK)
    assert single.poses.shape == (2, 27)
    assert single.costs.shape == (2,)
    assert single.confidence.shape == ()
    # The same data are drawn for every cloud, alone or in a batch.
    torch.testing.assert_close(
        plain_hand.keypoints(single.best), plain_hand.keypoints(found.best[0]), rtol=0, atol=1e-4
    )
    row = found.row(0)
    torch.testing.assert_close(row.best, found.best[0])
    assert row.confidence.shape == ()


def test_moving_the_data_moves_the_poses(plain_hand, plain_hand_skin, clouds, found):
    turn, shift = so3_exp(torch.tensor([0.9, -2.0, 0.7])), torch.tensor([3.0, -1.0, 0.2])
    moved = find_pose(plain_hand, clouds @ turn.mT + shift, sources=FEW, model_points=plain_hand_skin, config=QUICK)
    expected = plain_hand.keypoints(found.best) @ turn.mT + shift
    torch.testing.assert_close(plain_hand.keypoints(moved.best), expected, rtol=0, atol=0.004)


def test_shifted_data_give_the_same_search(plain_hand, plain_hand_skin, clouds, found):
    shift = torch.tensor([0.5, 2.0, -1.0])
    moved = find_pose(plain_hand, clouds + shift, num_starts=2, model_points=plain_hand_skin, config=QUICK)
    expected = plain_hand.keypoints(found.best) + shift
    torch.testing.assert_close(plain_hand.keypoints(moved.best), expected, rtol=0, atol=2e-3)


def test_padding_and_non_finite_data_do_not_count(plain_hand, plain_hand_skin, clouds, truths):
    data = torch.cat([clouds, clouds + torch.tensor([0.1, 0.0, 0.1])], dim=1)
    mask = torch.arange(800) < torch.tensor([[400], [380]])
    data[0, 30], data[1, 40:60] = torch.nan, torch.inf
    omitting = replace(QUICK, nan_policy="omit")
    starts = find_pose(plain_hand, data, mask=mask, sources=FEW, model_points=plain_hand_skin, config=omitting)
    assert float(offsets(plain_hand, starts.best, truths)[:, TIPS].mean(1).max()) < 0.005


def test_a_cloud_of_a_batch_may_be_empty(plain_hand, plain_hand_skin, clouds, truths):
    mask = torch.ones(2, 400, dtype=torch.bool)
    mask[1] = False
    starts = find_pose(plain_hand, clouds, mask=mask, sources=FEW, model_points=plain_hand_skin, config=QUICK)
    assert bool(torch.isfinite(starts.poses).all())
    assert float(offsets(plain_hand, starts.best, truths)[0, TIPS].mean()) < 0.005
    assert float(starts.confidence[1]) < 0.05


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_points_are_doubtful(plain_hand, plain_hand_skin, clouds, count):
    tiny = FindPoseConfig(num_candidates=4, num_placed=2, num_searched=2, search_rounds=1)
    starts = find_pose(
        plain_hand, clouds[0, :count], sources=[UniformRotations(8)], model_points=plain_hand_skin, config=tiny
    )
    assert bool(torch.isfinite(starts.poses).all())
    assert 0 <= float(starts.confidence) < 0.7


def test_the_front_with_outliers_is_found(plain_hand, plain_hand_surface, plain_hand_skin, truths):
    """What a camera sees; fingertips that it does not see may be anywhere."""
    cloud = make_hand_cloud(
        plain_hand, truths[1], num_points=500, noise=0.0015, outlier_ratio=0.1, camera=torch.zeros(3),
        skin=plain_hand_surface, generator=generator(8),
    )  # fmt: skip
    starts = find_pose(plain_hand, cloud.points, sources=FEW, model_points=plain_hand_skin)
    seen = torch.bincount(cloud.part_labels[cloud.inliers], minlength=16)[list(plain_hand.fingertip_parts)] >= 8
    assert int(seen.sum()) >= 3
    assert float(offsets(plain_hand, starts.best, truths[1])[TIPS][seen].mean()) < 0.01


def test_the_seed_decides_and_the_global_state_does_not(plain_hand, plain_hand_skin, clouds):
    tiny = FindPoseConfig(num_candidates=8, num_placed=3, num_searched=2, search_rounds=1)
    options = {"sources": [UniformRotations(20)], "model_points": plain_hand_skin}
    torch.manual_seed(5)
    state = torch.get_rng_state()
    first = find_pose(plain_hand, clouds[0], config=tiny, **options)
    again = find_pose(plain_hand, clouds[0], config=tiny, **options)
    other = find_pose(plain_hand, clouds[0], config=replace(tiny, seed=1), **options)
    assert bool((torch.get_rng_state() == state).all())
    torch.testing.assert_close(first.poses, again.poses, rtol=0, atol=0)
    torch.testing.assert_close(first.confidence, again.confidence, rtol=0, atol=0)
    assert not torch.equal(first.poses, other.poses)


def test_clouds_and_gradients_are_left_alone(plain_hand_skin, clouds):
    tiny = FindPoseConfig(num_candidates=4, num_placed=2, num_searched=1, search_rounds=1, num_model_points=100)
    data = clouds[0].clone().requires_grad_()
    starts = find_pose(Hand(), data, sources=[UniformRotations(8)], config=tiny)
    assert not starts.poses.requires_grad
    assert data.grad is None
    torch.testing.assert_close(data.detach(), clouds[0], rtol=0, atol=0)


def test_double_precision_stays_double_precision(clouds, truths):
    hand = Hand(dtype=torch.float64).requires_grad_(False)
    starts = find_pose(hand, clouds[0].double(), sources=FEW, config=QUICK)
    assert starts.poses.dtype == starts.costs.dtype == starts.confidence.dtype == torch.float64
    assert float(offsets(hand, starts.best, truths[0].double())[TIPS].mean()) < 0.005


# Sources


@pytest.mark.parametrize("sources", [[UniformRotations(150)], [PrincipalAxes()]])
def test_either_source_alone_finds_a_hand(plain_hand, plain_hand_skin, clouds, truths, sources):
    starts = find_pose(plain_hand, clouds[:1], sources=sources, model_points=plain_hand_skin, config=QUICK)
    assert float(offsets(plain_hand, starts.best, truths[:1])[:, TIPS].mean()) < 0.005


def test_sources_may_be_of_ones_own(plain_hand, plain_hand_skin, clouds, truths):
    """One that knows roughly how a hand is held; it is asked once, in the coordinates of the problem's data."""
    asked = []

    def upside_down(problem, generator):
        asked.append((problem, generator))
        poses = typical_poses(plain_hand).repeat(len(problem.data), 1, 1)
        poses[..., 3:6] = truths[0, 3:6] + 0.3
        return poses

    starts = find_pose(plain_hand, clouds[0], sources=[upside_down], model_points=plain_hand_skin, config=QUICK)
    assert float(offsets(plain_hand, starts.best, truths[0])[TIPS].mean()) < 0.005
    assert len(asked) == 1
    assert isinstance(asked[0][1], torch.Generator)
    assert float(masked_mean(asked[0][0].data, asked[0][0].valid).abs().max()) < 1e-5


def problem_at(skin, data, valid=None):
    valid = torch.ones(data.shape[:2], dtype=torch.bool) if valid is None else valid
    origin = masked_mean(data, valid)
    pose = skin.shape.rest_pose().repeat(len(data), 1)
    return centered_problem(skin, data, valid, pose, origin, prior_std=0.4, pose_atol=0.0)


def test_uniform_rotations_are_typical_poses_amid_the_data(plain_hand, plain_hand_skin, clouds):
    poses = UniformRotations(7)(problem_at(plain_hand_skin, clouds), generator())
    kinds = typical_poses(plain_hand)
    assert poses.shape == (2, 7 * len(kinds), 27)
    assert len(poses[0, :, 6:].unique(dim=0)) == len(kinds)
    assert len(poses[0, :, 3:6].unique(dim=0)) == 7
    torch.testing.assert_close(poses[0, :, 3:], poses[1, :, 3:])
    middle = plain_hand_skin(poses).mean(-2)
    assert float(middle.std(1).max()) < 1e-5
    assert float(middle.norm(dim=-1).max()) < 0.05


def test_upright_rotations_turn_about_the_vertical_alone(plain_hand, plain_hand_skin, clouds):
    up = torch.tensor([1.0, -2.0, 0.5])
    problem = problem_at(plain_hand_skin, clouds)
    poses = UprightRotations(tuple(up.tolist()), 8)(problem, generator())
    kinds = len(typical_poses(plain_hand))
    assert poses.shape == (2, 8 * kinds, 27)
    turns = so3_exp(poses[0, :8, 3:6])
    own = torch.tensor(plain_hand.up)
    torch.testing.assert_close(turns @ own, (up / up.norm()).expand(8, 3), atol=1e-5, rtol=0)
    steps = so3_log(turns[1:] @ turns[:-1].mT)
    torch.testing.assert_close(steps, (up / up.norm() * math.tau / 8).expand(7, 3), atol=1e-5, rtol=0)
    middle = plain_hand_skin(poses).mean(-2)
    assert float(middle.std(1).max()) < 1e-5


def test_what_stands_is_sought_standing(plain_hand, plain_hand_skin, truths):
    truth = truths[0].clone()
    truth[3:6] = torch.tensor([0.0, 0.0, 2.0])
    data = plain_hand_skin(truth)
    upright = replace(QUICK, upright=plain_hand.up)
    found = find_pose(plain_hand, data, model_points=plain_hand_skin, config=upright)
    assert float(offsets(plain_hand, found.best, truth)[TIPS].mean()) < 0.005


def test_principal_axes_find_an_unbent_shape_at_once(plain_hand, plain_hand_skin):
    """For data in a typical pose, one of the four ways is the truth, whatever the rotation, the shift and padding."""
    truth = typical_poses(plain_hand)[:1].repeat(2, 1)
    truth[:, :6] = torch.tensor([[0.3, 1.0, 0.2, 1.9, -0.7, 1.2], [0.0, 0.0, 0.0, -0.4, 2.5, 0.1]])
    data = torch.cat([plain_hand_skin(truth), torch.rand(2, 50, 3, generator=generator())], dim=1)
    problem = problem_at(plain_hand_skin, data, torch.arange(450).expand(2, 450) < 400)
    poses = PrincipalAxes()(problem, generator())
    assert poses.shape == (2, 4 * len(typical_poses(plain_hand)), 27)
    turned = so3_exp(poses[..., 3:6]) @ so3_exp(truth[:, None, 3:6]).mT
    nearest = so3_log(turned).norm(dim=-1)[:, :4].amin(1)
    assert float(nearest.max()) < 0.02


def test_typical_poses_lie_between_rest_and_the_middle(plain_hand):
    poses = typical_poses(plain_hand)
    assert len(poses) >= 2
    assert bool((poses[:, :6] == 0).all())
    middle = 0.5 * (plain_hand.lower + plain_hand.upper)[6:]
    assert bool((poses[:, 6:].abs() <= middle.abs() + 1e-6).all())
    assert bool(torch.isfinite(poses).all())


def geodesic(rotations):
    """Return the angles between all pairs, from quaternion products, the diagonal set to pi."""
    traces = torch.einsum("aij,bij->ab", rotations, rotations)
    angles = torch.acos(((traces - 1) / 2).clamp(-1, 1))
    return angles.fill_diagonal_(math.pi)


@pytest.mark.parametrize("count", [1, 2, 30, 400])
def test_spread_rotations_are_rotations(count):
    rotations = spread_rotations(count)
    assert rotations.shape == (count, 3, 3)
    assert rotations.dtype == torch.float64
    eye = torch.eye(3, dtype=torch.float64).expand(count, 3, 3)
    torch.testing.assert_close(rotations @ rotations.mT, eye)
    torch.testing.assert_close(torch.linalg.det(rotations), torch.ones(count, dtype=torch.float64))


def test_spread_rotations_are_evener_than_random_ones():
    """By the distance of the nearest other one, and by how far any rotation is from the nearest."""
    spread = spread_rotations(400)
    normal = torch.randn(400, 4, generator=generator(), dtype=torch.float64)
    quaternion = torch.nn.functional.normalize(normal, dim=-1)
    angle = 2 * torch.atan2(quaternion[:, 1:].norm(dim=-1), quaternion[:, 0])
    axis = torch.nn.functional.normalize(quaternion[:, 1:], dim=-1)
    drawn = so3_exp(angle.unsqueeze(-1) * axis)
    apart, random = geodesic(spread).amin(1), geodesic(drawn).amin(1)
    assert float(apart.min()) > 4 * float(random.min())
    assert float(apart.std()) < 0.5 * float(random.std())
    # No direction is preferred: the mean of uniform rotations is zero.
    assert float(spread.mean(0).abs().max()) < 0.02


# Other shapes


def machine(**options):
    """A body of unlike radii with a slide and a hinge."""
    tree = KinematicTree((
        Joint("mast", -1, offset(0.0, 0.0, 0.0)),
        Joint("carriage", 0, offset(0.15, 0.0, 0.2), "prismatic", (0.0, 0.0, 1.0), 0.0, 0.5),
        Joint("arm", 1, offset(0.1, 0.0, 0.0), "revolute", (0.0, 1.0, 0.0), -1.5, 1.5),
    ))  # fmt: skip
    solids = [
        Primitive("superquadric", (0.06, 0.09, 0.5, 0.5, 0.5), offset(0, 0, 0.5)),
        Primitive("ellipsoid", (0.12, 0.1, 0.08), offset(0, 0, 0)),
        Primitive("cone", (0.2, 0.07, 0.04), offset(0, 0, 0.2)),
    ]
    return ArticulatedShape(tree, ["mast", "carriage", "arm"], solids, nu=0.01, **options).requires_grad_(False)


def test_joints_of_a_bolted_machine_are_found():
    shape = machine(free_base=False)
    truth = shape.rest_pose().repeat(2, 1)
    truth[:, 6:] = torch.tensor([[0.41, 1.1], [0.07, -0.8]])
    data = sample_skin(shape, 400, seed=3)(truth)
    data = data + 0.003 * torch.randn(2, 400, 3, generator=generator())
    starts = find_pose(shape, data, config=QUICK)
    assert bool((starts.poses[..., :6] == 0).all())
    torch.testing.assert_close(starts.best[:, 6:], truth[:, 6:], rtol=0, atol=0.03)


def test_a_free_machine_is_found():
    shape = machine()
    truth = shape.rest_pose()
    truth[:] = torch.tensor([1.0, 2.0, -0.5, 1.2, -1.9, 0.4, 0.3, 0.9])
    data = sample_skin(shape, 400, seed=3)(truth)
    starts = find_pose(shape, data, config=QUICK)
    assert float(offsets(shape, starts.best, truth).max()) < 0.03


def test_joints_without_limits_are_found():
    """Far from the rest pose: nothing says what is typical."""
    turn = ("revolute", (1.0, 0.0, 0.0))
    tree = KinematicTree((
        Joint("body", -1, offset(0, 0, 0)),
        Joint("left", 0, offset(0.15, 0, 0.05), *turn),
        Joint("right", 0, offset(-0.12, 0.05, 0), *turn),
    ))  # fmt: skip
    solids = [
        Primitive("ellipsoid", (0.2, 0.12, 0.07), offset(0, 0, 0)),
        Primitive("capsule", (0.15, 0.03), offset(0, 0, 0.15)),
        Primitive("capsule", (0.1, 0.02), offset(0, 0, 0.1)),
    ]
    shape = ArticulatedShape(tree, ["body", "left", "right"], solids, nu=0.01).requires_grad_(False)
    truth = torch.tensor([0.1, 0.0, 0.3, 2.0, 1.0, -0.5, 2.2, -1.4])
    data = sample_skin(shape, 400, seed=3)(truth)
    config = FindPoseConfig(num_candidates=32, num_placed=8, num_searched=3, prior_std=None)
    starts = find_pose(shape, data, config=config)
    places = [
        (shape.part_transforms(pose)[1:] @ torch.tensor([0.0, 0.0, 0.3, 1.0]))[:, :3] for pose in (starts.best, truth)
    ]
    assert float((places[0] - places[1]).norm(dim=-1).max()) < 0.03


def test_a_shape_without_joints_is_turned_into_place_as_far_as_can_be_told():
    """A lopsided stone of two solids on one frame each, fixed; its mirror twins explain less."""
    tree = KinematicTree((Joint("stone", -1, offset(0, 0, 0)), Joint("bump", 0, offset(0.12, 0.04, 0.03))))
    solids = [
        Primitive("ellipsoid", (0.2, 0.12, 0.07), offset(0, 0, 0)),
        Primitive("ellipsoid", (0.05, 0.06, 0.09), offset(0, 0, 0)),
    ]
    shape = ArticulatedShape(tree, ["stone", "bump"], solids, nu=0.01).requires_grad_(False)
    truth = torch.tensor([1.0, 0.0, 0.3, 2.0, 1.0, -0.5])
    skin = sample_skin(shape, 400, seed=3)
    starts = find_pose(shape, skin(truth), config=QUICK)
    torch.testing.assert_close(skin(starts.best), skin(truth), rtol=0, atol=0.015)


# Doubt


@pytest.fixture(scope="module")
def egg():
    """An ellipsoid, and points on it: it looks the same turned half a turn about any of its axes."""
    tree = KinematicTree((Joint("egg", -1, offset(0, 0, 0)),))
    shape = ArticulatedShape(tree, ["egg"], [Primitive("ellipsoid", (0.2, 0.12, 0.07), offset(0, 0, 0))], nu=0.01)
    skin = sample_skin(shape.requires_grad_(False), 300, seed=3)
    return shape, skin(torch.tensor([0.3, 0.0, 0.5, 1.0, 0.4, -0.8]))


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("num_searched", [2, 3])
def test_a_symmetric_object_is_doubtful(egg, num_searched, seed):
    starts = find_pose(*egg, config=replace(QUICK, num_searched=num_searched, seed=seed))
    assert float(starts.confidence) < 0.3
    assert starts.poses.shape == (num_searched, 6)
    assert float(starts.costs.max() - starts.costs.min()) < 3.0


def test_a_symmetric_object_is_doubtful_by_default(egg):
    starts = find_pose(*egg)
    assert float(starts.confidence) < 0.3
    assert starts.poses.shape == (4, 6)


def test_noise_is_doubtful(plain_hand, plain_hand_skin, found):
    cloud = 0.2 * torch.rand(400, 3, generator=generator(2))
    starts = find_pose(plain_hand, cloud, model_points=plain_hand_skin, config=QUICK)
    assert 0 <= float(starts.confidence) < float(found.confidence.min())


def test_misfits_are_searched_for_again(plain_hand, plain_hand_skin, clouds, truths, monkeypatch):
    """A cloud whose first searches went wrong is saved by one with other draws; the other cloud is left alone."""
    searched = []

    def fail_twice(problem, source, config, proposed):
        searched.append((config.seed, len(problem.data)))
        shift = torch.nn.functional.pad(masked_mean(clouds, torch.ones_like(clouds[..., 0])), (0, 24))
        poses = (truths - shift)[-len(problem.data) :].unsqueeze(1).repeat(1, 2, 1)
        poses[:, 1, 2] += 0.01
        if len(searched) < 3:
            poses[-1, :, 2] += 0.02
        costs = torch.stack([alignment_cost(problem, poses[:, number]) for number in range(2)], dim=1)
        return poses, costs

    monkeypatch.setattr(find_pose_module, "_search", fail_twice)
    config = replace(QUICK, num_retries=5, seed=7)
    starts = find_pose(plain_hand, clouds, sources=FEW, model_points=plain_hand_skin, config=config)
    assert searched == [(7, 2), (8, 1), (9, 1)]
    torch.testing.assert_close(starts.best, truths, atol=1e-5, rtol=0)
    assert bool((starts.costs[:, :1] <= starts.costs).all())


def test_fewer_starts_than_asked_for_are_no_error(plain_hand, plain_hand_skin, clouds):
    tiny = FindPoseConfig(num_candidates=4, num_placed=2, num_searched=1, search_rounds=1)
    starts = find_pose(
        plain_hand, clouds[0], num_starts=7, sources=[PrincipalAxes()], model_points=plain_hand_skin, config=tiny
    )
    assert starts.poses.shape == (1, 27)
    # With no rival nothing speaks against the only one but clusters of data left over.
    assert 0 <= float(starts.confidence) <= 1


def test_starts_are_saved_and_loaded(tmp_path, found):
    found.save(tmp_path / "starts.safetensors")
    loaded = load(tmp_path / "starts.safetensors")
    assert type(loaded) is PoseStarts
    for name in ("poses", "costs", "confidence", "best"):
        torch.testing.assert_close(getattr(loaded, name), getattr(found, name), rtol=0, atol=0)
