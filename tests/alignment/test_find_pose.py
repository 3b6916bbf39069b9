"""Finding poses without a start: any rotation, batches, motions, padding, machines, people, sources, confidence."""

import math
from dataclasses import replace

import pytest
import torch

import torchreg as tr
from tests.alignment.made import TIPS, D, cloud, generator, joint, machine, off, shape_of, solid
from torchreg.alignment.search.multi_start import Candidates
from torchreg.alignment.search.rough_poses import PrincipalAxes, UniformRotations, UprightRotations
from torchreg.geometry.rotation import so3_exp, so3_log

QUICK = tr.FindPoseConfig(num_candidates=16, num_placed=5, num_searched=2, search_rounds=1, num_model_points=200)
TINY = tr.FindPoseConfig(num_candidates=4, num_placed=2, num_searched=2, search_rounds=1)
# Enough for most tests; the default is tried by the first ones.
FEW = (UniformRotations(80), PrincipalAxes())


@pytest.fixture(scope="module")
def find(plain_hand, plain_hand_skin):
    """A function that finds the hand, by default by few rough poses."""

    def searched(data, **options):
        options = {"model_points": plain_hand_skin, "sources": FEW, "config": QUICK} | options
        return tr.find_pose(plain_hand, data, **options)

    return searched


@pytest.fixture(scope="module")
def starts(find, two_clouds):
    return find(two_clouds, num_starts=2, sources=None)


def test_hands_in_any_rotation_are_found(plain_hand, starts, two_hands):
    assert starts.poses.shape == (2, 2, 27)
    assert float(off(plain_hand, starts.best, two_hands)[:, TIPS].mean(1).max()) < 0.005
    torch.testing.assert_close(starts.best, starts.poses[:, 0])
    assert bool(((starts.poses >= plain_hand.lower) & (starts.poses <= plain_hand.upper)).all())
    assert bool((starts.costs[:, :1] <= starts.costs).all())
    # The hand's turned-over twin costs far more.
    assert bool(((starts.confidence > 0.5) & (starts.confidence <= 1)).all())


def test_moving_the_data_moves_the_poses(plain_hand, find, two_clouds, starts):
    turn, shift = so3_exp(torch.tensor([0.9, -2.0, 0.7])), torch.tensor([3.0, -1.0, 0.2])
    moved = find(two_clouds @ turn.mT + shift)
    expected = plain_hand.keypoints(starts.best) @ turn.mT + shift
    torch.testing.assert_close(plain_hand.keypoints(moved.best), expected, rtol=0, atol=0.004)


def test_padding_and_non_finite_data_do_not_count(plain_hand, find, two_clouds, two_hands):
    data = torch.cat([two_clouds, two_clouds + torch.tensor([0.1, 0.0, 0.1])], dim=1)
    mask = torch.arange(800) < torch.tensor([[400], [380]])
    data[0, 30], data[1, 40:60] = torch.nan, torch.inf
    found = find(data, mask=mask, config=replace(QUICK, nan_policy="omit"))
    assert float(off(plain_hand, found.best, two_hands)[:, TIPS].mean(1).max()) < 0.005
    # A cloud of a batch may be empty.
    mask[1] = False
    found = find(data, mask=mask, config=replace(QUICK, nan_policy="omit"))
    assert bool(torch.isfinite(found.poses).all())
    assert float(off(plain_hand, found.best, two_hands)[0, TIPS].mean()) < 0.005
    assert float(found.confidence[1]) < 0.05


@pytest.mark.parametrize("count", [1, 5])
def test_few_points_are_doubtful_and_fewer_starts_than_asked_for_are_no_error(find, two_clouds, count):
    found = find(two_clouds[0, :count], num_starts=7, sources=[UniformRotations(8)], config=TINY)
    assert found.poses.shape == (2, 27)
    assert bool(torch.isfinite(found.poses).all())
    assert 0 <= float(found.confidence) < 0.7


def test_the_front_with_outliers_is_found(plain_hand, plain_hand_surface, find, two_hands):
    """What a camera sees; fingertips that it does not see may be anywhere."""
    options = {"num_points": 500, "noise": 0.0015, "outlier_ratio": 0.1, "camera": torch.zeros(3)}
    front = cloud(plain_hand, two_hands[1], 8, skin=plain_hand_surface, **options)
    found = find(front.points, config=None)
    seen = torch.bincount(front.part_labels[front.inliers], minlength=16)[list(plain_hand.fingertip_parts)] >= 8
    assert int(seen.sum()) >= 3
    assert float(off(plain_hand, found.best, two_hands[1])[TIPS][seen].mean()) < 0.01


def test_the_seed_decides_and_the_global_state_does_not(find, two_clouds):
    state = torch.get_rng_state()
    first, again, other = (
        find(two_clouds[0], sources=[UniformRotations(20)], config=replace(TINY, seed=seed)) for seed in (0, 0, 1)
    )
    assert bool((torch.get_rng_state() == state).all())
    torch.testing.assert_close(first.poses, again.poses, rtol=0, atol=0)
    torch.testing.assert_close(first.confidence, again.confidence, rtol=0, atol=0)
    assert not torch.equal(first.poses, other.poses)


def test_sources_may_be_of_ones_own(plain_hand, find, two_clouds, two_hands):
    """One that knows roughly how a hand is held; it is asked once, in the coordinates of the problem's data."""
    asked = []

    def upside_down(problem, generator):
        asked.append(problem)
        poses = plain_hand.rest_pose().repeat(len(problem.data), 1, 1)
        poses[..., 3:6] = two_hands[0, 3:6] + 0.3
        return poses

    found = find(two_clouds[0], sources=[upside_down])
    assert float(off(plain_hand, found.best, two_hands[0])[TIPS].mean()) < 0.005
    (problem,) = asked
    assert float(problem.data[problem.valid].mean(0).abs().max()) < 1e-5


def rough(shape, skin, data, source):
    """Return the rough poses of a source that `find_pose` gets for data; the middle of the shape lies amid these."""
    kept = []

    def asked(problem, generator):
        kept.append((source(problem, generator), problem.skin))
        return kept[0][0]

    tr.find_pose(shape, data, sources=[asked], model_points=skin, config=TINY)
    poses, skin = kept[0]
    middle = skin(poses).mean(-2)
    assert float((middle - middle[:, :1]).abs().max()) < 1e-3
    assert float(middle.norm(dim=-1).max()) < 0.05
    return poses


def test_uniform_rotations_are_even_and_of_several_poses_amid_the_data(plain_hand, plain_hand_skin, two_clouds):
    """Evener than random ones by the angle to the nearest other one, from traces of their products."""
    poses = rough(plain_hand, plain_hand_skin, two_clouds, UniformRotations(100))
    assert 1 < len(poses[0, :, 6:].unique(dim=0)) == poses.shape[1] // 100
    torch.testing.assert_close(poses[0, :, 3:], poses[1, :, 3:])
    quaternion = torch.nn.functional.normalize(torch.randn(100, 4, generator=generator(), dtype=D), dim=-1)
    angle = 2 * torch.atan2(quaternion[:, 1:].norm(dim=-1), quaternion[:, 0])
    drawn = so3_exp(angle.unsqueeze(-1) * torch.nn.functional.normalize(quaternion[:, 1:], dim=-1))
    spread, apart = so3_exp(poses[0, :, 3:6].unique(dim=0).double())[:100], []
    for rotations in (spread, drawn):
        angles = torch.acos(((torch.einsum("aij,bij->ab", rotations, rotations) - 1) / 2).clamp(-1, 1))
        apart.append(angles.fill_diagonal_(math.pi).amin(1))
    assert float(apart[0].min()) > 3 * float(apart[1].min())
    assert float(apart[0].std()) < 0.5 * float(apart[1].std())
    # No direction is preferred: the mean of uniform rotations is zero.
    assert float(spread.mean(0).abs().max()) < 0.06


def test_upright_rotations_turn_about_the_vertical_alone(plain_hand, plain_hand_skin, find, two_clouds, two_hands):
    up = torch.tensor([1.0, -2.0, 0.5])
    poses = rough(plain_hand, plain_hand_skin, two_clouds, UprightRotations(tuple(up.tolist()), 8))
    turns, axis = so3_exp(poses[0, :8, 3:6]), up / up.norm()
    torch.testing.assert_close(turns @ torch.tensor(plain_hand.up), axis.expand(8, 3), atol=1e-5, rtol=0)
    steps = so3_log(turns[1:] @ turns[:-1].mT)
    torch.testing.assert_close(steps, (axis * math.tau / 8).expand(7, 3), atol=1e-5, rtol=0)
    truth = two_hands[0].clone()
    truth[3:6] = torch.tensor([0.0, 0.0, 2.0])
    found = find(plain_hand_skin(truth), sources=None, config=replace(QUICK, upright=plain_hand.up))
    assert float(off(plain_hand, found.best, truth)[TIPS].mean()) < 0.005


FREE = ("revolute", (1.0, 0.0, 0.0))
ROOM = {
    "a bolted machine": (machine(free_base=False), [[0, 0, 0, 0, 0, 0, 0.41, 1.1], [0, 0, 0, 0, 0, 0, 0.07, -0.8]]),
    # Far from the rest pose: nothing says what is typical.
    "joints without limits": (
        shape_of(
            [joint("body", -1), joint("left", 0, (0.15, 0, 0.05), *FREE), joint("right", 0, (-0.12, 0.05, 0), *FREE)],
            [solid("ellipsoid", (0.2, 0.12, 0.07)), solid("capsule", (0.15, 0.03), 0, 0, 0.15),
             solid("capsule", (0.1, 0.02), 0, 0, 0.1)],
        ),
        [[0.1, 0.0, 0.3, 2.0, 1.0, -0.5, 2.2, -1.4]],
    ),
    "a lopsided stone": (
        shape_of([joint("stone", -1), joint("bump", 0, (0.12, 0.04, 0.03))],
                 [solid("ellipsoid", (0.2, 0.12, 0.07)), solid("ellipsoid", (0.05, 0.06, 0.09))]),
        [[1.0, 0.0, 0.3, 2.0, 1.0, -0.5]],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ROOM)
def test_other_shapes_are_found(name):
    shape, truths = ROOM[name]
    skin, truths = tr.sample_skin(shape, 400, seed=3), torch.tensor(truths)
    data = skin(truths) + 0.003 * torch.randn(len(truths), 400, 3, generator=generator())
    config = tr.FindPoseConfig(num_candidates=32, num_placed=8, num_searched=3, prior_std=None)
    found = tr.find_pose(shape, data, config=config)
    assert float((skin(found.best) - skin(truths)).norm(dim=-1).max()) < 0.03
    assert bool((found.poses[..., :6] == 0).all()) is name.startswith("a bolted")


def test_skinned_rigs_are_found_in_any_rotation_and_alone_as_in_a_batch(person):
    config = tr.FindPoseConfig(num_placed=5, num_searched=2, num_model_points=200)
    poses = person.rest_pose().repeat(2, 1)
    poses[:, 6:] = math.radians(15) * torch.randn(2, person.num_dofs - 6, generator=generator(1))
    poses[:, :6] = torch.tensor([[0.4, -0.3, 1.0, 1.6, -0.4, 0.8], [0.4, -0.3, 1.0, 0.1, 0.2, -2.0]])
    points = person.vertices(poses)
    data = points[:, torch.randint(points.shape[1], (500,), generator=generator(2))]
    data = data + 0.003 * torch.randn(2, 500, 3, generator=generator(3))
    both = tr.find_pose(person, data, config=config).poses[:, 0]
    rest = person.vertices(person.rest_pose())
    error = (person.vertices(both) - person.vertices(poses)).norm(dim=-1).mean(-1)
    assert bool((error < 0.02 * (rest.amax(0) - rest.amin(0)).norm()).all())
    alone = tr.find_pose(person, data[1], config=config).poses[0]
    torch.testing.assert_close(person.vertices(alone), person.vertices(both[1]), rtol=0, atol=1e-3)


@pytest.mark.parametrize("num_searched", [2, 3])
def test_a_symmetric_object_is_doubtful_and_its_other_poses_stand_in_the_result(num_searched):
    """An ellipsoid looks the same turned half a turn about any of its axes: its rotation group."""
    egg = shape_of([joint("egg", -1)], [solid("ellipsoid", (0.2, 0.12, 0.07))])
    data = tr.sample_skin(egg, 300, seed=3)(torch.tensor([0.3, 0.0, 0.5, 1.0, 0.4, -0.8]))
    found = tr.find_pose(egg, data, config=replace(QUICK, num_searched=num_searched))
    assert float(found.confidence) < 0.3
    assert found.poses.shape == (num_searched, 6)
    assert float(found.costs.max() - found.costs.min()) < 3.0
    if num_searched == 2:
        return
    aligned = tr.align(egg, data)
    assert aligned.rivals.shape == (3, 6)
    assert "another pose explains nearly as much, its base turned by 180, 180, 180 deg" in aligned.doubt
    local = so3_exp(aligned.pose[None, 3:6]).mT @ so3_exp(aligned.rivals[:, 3:6])
    half_turns = torch.stack([torch.tensor(row).diag() for row in ((1.0, -1, -1), (-1.0, 1, -1), (-1.0, -1, 1))])
    apart = (local[:, None] - half_turns).abs().amax((-2, -1))
    assert float(apart.amin(1).max()) < 0.02
    assert sorted(apart.argmin(1).tolist()) == [0, 1, 2]


def test_both_ends_of_a_snake_may_be_its_head():
    """Three capsules in a row that are alike, end to end: with the joints in the other order they lie as before."""
    bends = [joint(f"bend{n}", n, (0.0, 0.0, 0.3), "revolute", (1.0, 0.0, 0.0), -1.5, 1.5) for n in range(2)]
    snake = shape_of([joint("head", -1), *bends], [solid("capsule", (0.15, 0.03), 0, 0, 0.15)] * 3)
    truth = torch.tensor([0.3, 0.0, 0.5, 1.0, 0.4, -0.8, 0.9, -0.3])
    points = tr.sample_skin(snake, 400, seed=3)(truth)
    aligned = tr.align(snake, points)
    assert "another pose explains nearly as much" in aligned.doubt
    poses = torch.cat([aligned.pose[None], aligned.rivals])
    found = sorted(poses[:, 6:].tolist())
    expected = [[-0.9, 0.3], [-0.3, 0.9], [0.3, -0.9], [0.9, -0.3]]  # either end, and rolled by half a turn
    torch.testing.assert_close(torch.tensor(found), torch.tensor(expected), atol=0.02, rtol=0)
    assert float(snake.distance(points.expand(4, -1, -1), poses).abs().mean()) < 0.001


def test_noise_is_doubtful(find, starts):
    found = find(0.2 * torch.rand(400, 3, generator=generator(2)))
    assert 0 <= float(found.confidence) < float(starts.confidence.min())


def test_misfits_are_searched_for_again(find, two_clouds, two_hands, monkeypatch):
    """A cloud whose first searches went wrong is saved by one with other draws; the other cloud is left alone."""
    searched = []

    def fail_twice(proposed, source, config):
        problem = proposed.problem
        searched.append((config.seed, len(problem.data)))
        shift = torch.nn.functional.pad(two_clouds.mean(1), (0, 24))
        poses = (two_hands - shift)[-len(problem.data) :].unsqueeze(1).repeat(1, 2, 1)
        poses[:, 1, 2] += 0.01
        if len(searched) < 3:
            poses[-1, :, 2] += 0.02
        away = (problem.surface.distance(problem.data.unsqueeze(1), poses).abs() > 0.004).sum(-1)
        return Candidates(problem, poses, away.to(poses))

    monkeypatch.setattr("torchreg.alignment.find_pose._search", fail_twice)
    found = find(two_clouds, config=replace(QUICK, num_retries=5, seed=7))
    assert searched == [(7, 2), (8, 1), (9, 1)]
    torch.testing.assert_close(found.best, two_hands, atol=1e-5, rtol=0)
    assert bool((found.costs[:, :1] <= found.costs).all())
