"""The search around a start: when a search is wanted, what candidates are, and what it finds."""

from dataclasses import replace

import pytest
import torch

from torchreg.alignment import local_search as align_search
from torchreg.alignment.clusters import clustered_data, leaves_clusters
from torchreg.alignment.local_search import _scatter, explore, needs_search
from torchreg.alignment.objectives import GaussianPosePrior
from torchreg.alignment.pose_search import PoseSearch
from torchreg.alignment.problem import AlignProblem
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.rigid import rigid_matrix
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.skin import BendingSkin
from torchreg.shapes.surface import FusedSurface


def make_problem(skin, data, mean):
    shape = skin.shape
    return AlignProblem(
        skin=skin,
        surface=FusedSurface(shape),
        data=data,
        valid=torch.ones(data.shape[:2], dtype=torch.bool),
        size=float((skin.points.amax(0) - skin.points.amin(0)).norm()),
        lower=shape.lower,
        upper=shape.upper,
        prior=GaussianPosePrior(mean, torch.cat([torch.zeros(6), torch.full((shape.num_dofs - 6,), 8.0)])),
        pose_atol=1e-3,
    )


@pytest.fixture(scope="module")
def truths(plain_hand):
    poses = plain_hand.rest_pose().repeat(2, 1)
    flexion = torch.tensor([name.endswith("flexion") for name in plain_hand.dof_names])
    poses[0, flexion], poses[1, flexion] = 0.15, 0.35
    poses[1, 3:6] = torch.tensor([0.3, -0.2, 0.5])
    return poses


@pytest.fixture(scope="module")
def problem(plain_hand_skin, truths):
    """Two hands in two poses; the data are exact, and centered as in an alignment."""
    data = plain_hand_skin(truths)
    mean = data.mean(1)
    poses = torch.cat([truths[:, :3] - mean, truths[:, 3:]], dim=-1)
    return make_problem(plain_hand_skin, data - mean.unsqueeze(1), poses)


@pytest.fixture(scope="module")
def exact(problem):
    """The true poses in the coordinates of the problem."""
    return problem.prior.mean


def finger(shape, name):
    return [index for index, dof in enumerate(shape.dof_names) if dof.startswith(name)]


def offset(*place):
    return rigid_matrix(torch.eye(3, dtype=torch.float64), torch.tensor(place, dtype=torch.float64))


def test_a_descent_that_stayed_near_and_explains_all_is_trusted(problem, exact):
    near = exact.clone()
    near[:, 6:] += 0.03
    assert needs_search(problem, near, exact).tolist() == [False, False]


def test_a_descent_that_went_far_is_not_trusted(problem, exact):
    start = exact.clone()
    start[0, 6:] += 0.5
    assert needs_search(problem, start, exact).tolist() == [True, False]
    start = exact.clone()
    start[1, 3] += 0.5
    assert needs_search(problem, start, exact).tolist() == [False, True]


def test_a_finger_left_off_the_surface_is_noticed(problem, exact, plain_hand):
    """Also when half of the data are padding; and thin clutter is no limb."""
    missed = exact.clone()
    missed[0, finger(plain_hand, "index")[1]] += 1.2
    assert needs_search(problem, missed, missed).tolist() == [True, False]
    generator = torch.Generator().manual_seed(0)
    clutter = 0.4 * torch.rand(2, 400, 3, generator=generator) - 0.2
    cluttered = replace(problem, data=torch.cat([problem.data, clutter], dim=1), valid=problem.valid.repeat(1, 2))
    assert needs_search(cluttered, exact, exact).tolist() == [False, False]
    padded = replace(cluttered, data=cluttered.data.clone(), valid=cluttered.valid.clone())
    padded.data[:, 400:], padded.valid[:, 400:] = problem.data, False
    padded.data[:, 400:] += 0.02
    assert needs_search(padded, exact, exact).tolist() == [False, False]
    assert needs_search(padded, missed, missed).tolist() == [True, False]


def test_large_clouds_are_thinned_before_clusters_are_sought(problem, exact, plain_hand):
    many = problem.data.repeat(1, 7, 1)
    many = many + 5e-4 * torch.randn(many.shape, generator=torch.Generator().manual_seed(1))
    large = replace(problem, data=many, valid=problem.valid.repeat(1, 7))
    missed = exact.clone()
    missed[1, finger(plain_hand, "ring")[1]] += 1.0
    assert needs_search(large, missed, missed).tolist() == [False, True]


def test_a_cloud_without_inliers_is_searched_without_failing(problem, exact):
    lost = replace(problem, data=problem.data + 5.0)
    assert needs_search(lost, exact, exact).shape == (2,)


def test_clusters_are_counted_beside_the_data_on_the_surface(problem, exact, plain_hand):
    clustered, near = clustered_data(problem, exact)
    assert clustered.tolist() == [0, 0]
    assert int(near.min()) > 380
    missed = exact.clone()
    missed[1, finger(plain_hand, "ring")[1]] += 1.0
    clustered, near = clustered_data(problem, missed)
    assert clustered[0] == 0
    assert 15 < int(clustered[1]) < 60
    assert int((clustered + near).max()) <= 400
    assert leaves_clusters(problem, missed).tolist() == [False, True]


def test_candidates_stay_within_limits_and_the_first_is_the_center(problem, exact, plain_hand):
    search = PoseSearch(problem, torch.Generator().manual_seed(1))
    found = _scatter(search, exact, 40, torch.Generator().manual_seed(2))
    assert found.shape == (2, 40, 27)
    torch.testing.assert_close(found[:, 0], exact, rtol=0, atol=1e-6)
    assert bool((found >= plain_hand.lower).all())
    assert bool((found <= plain_hand.upper).all())
    # Every degree of freedom is tried.
    assert float((found[:, 1:] - exact.unsqueeze(1)).abs().amax(1).min()) > 1e-3


def test_some_candidates_have_a_limb_far_from_the_center(problem, exact, plain_hand):
    """Most fingers stay within a fraction of a radian; some are placed anew, the whole finger at once."""
    search = PoseSearch(problem, torch.Generator().manual_seed(1))
    found = _scatter(search, exact, 400, torch.Generator().manual_seed(3))
    moved = (found - exact.unsqueeze(1))[..., finger(plain_hand, "index")[1:]].abs().amax(-1)
    assert 0.1 < float((moved > 0.6).float().mean()) < 0.4


def test_candidates_of_shapes_without_limits_stay_near(problem):
    """Joints that turn freely are scattered by a fraction of a radian, fresh limbs by little more than one."""
    turn = ("revolute", (1.0, 0.0, 0.0))
    tree = KinematicTree((
        Joint("body", -1, offset(0, 0, 0)),
        Joint("left", 0, offset(0.05, 0, 0), *turn),
        Joint("right", 0, offset(-0.05, 0, 0), *turn),
    ))  # fmt: skip
    shape = ArticulatedShape(tree, ["body", "left", "right"], [Primitive("capsule", (0.04, 0.01), offset(0, 0, 0))] * 3)
    points = 0.05 * torch.randn(30, 3, generator=torch.Generator().manual_seed(0))
    center = torch.zeros(2, 8)
    alike = make_problem(BendingSkin(shape, points), problem.data, center)
    generator = torch.Generator().manual_seed(3)
    found = _scatter(PoseSearch(alike, generator), center, 200, generator)
    assert bool(torch.isfinite(found).all())
    assert 0.5 < float(found[..., 6:].abs().max()) < 3.0


def misled(exact, shape):
    """Return starts with a finger each that a descent would not find: folded flat against its truth, and neighbors."""
    start = exact.clone()
    start[0, finger(shape, "index")[1:]] += torch.tensor([1.2, 0.9, 0.5])
    start[1, finger(shape, "little")[1:]] += torch.tensor([0.9, 0.9, 0.5])
    return torch.minimum(start, shape.upper)


@pytest.fixture(scope="module")
def explored(problem, exact, plain_hand):
    start = misled(exact, plain_hand)
    around = replace(problem, prior=replace(problem.prior, mean=start))
    generator = torch.Generator().manual_seed(4)
    return start, around, explore(around, start, start, candidates=16, rounds=2, generator=generator)


def test_a_lost_finger_is_found(exact, plain_hand, explored):
    start, _, found = explored
    before, after = ((plain_hand.keypoints(each) - plain_hand.keypoints(exact)).norm(dim=-1) for each in (start, found))
    assert float(before.amax(-1).min()) > 0.05
    assert float(after.amax(-1).max()) < 0.015
    assert bool((found >= plain_hand.lower).all() & (found <= plain_hand.upper).all())


def test_a_search_is_the_same_for_the_same_seed_and_leaves_the_global_state_alone(explored):
    start, around, found = explored
    torch.manual_seed(77)
    state = torch.get_rng_state()
    again = explore(around, start, start, candidates=16, rounds=2, generator=torch.Generator().manual_seed(4))
    torch.testing.assert_close(again, found, rtol=0, atol=0)
    assert bool((torch.get_rng_state() == state).all())


def test_a_search_that_improves_nothing_ends_and_returns_the_descent(problem, exact, monkeypatch):
    rounds = []
    searched = PoseSearch._best_options

    def counted(*arguments):
        rounds.append(1)
        return searched(*arguments)

    monkeypatch.setattr(PoseSearch, "_best_options", counted)
    generator = torch.Generator().manual_seed(5)
    found = explore(problem, exact, exact, candidates=3, rounds=4, generator=generator)
    assert len(rounds) <= 2
    off = (problem.skin.shape.keypoints(found) - problem.skin.shape.keypoints(exact)).norm(dim=-1)
    assert float(off.max()) < 0.008


def test_only_lost_problems_are_searched_all_around(problem, exact, plain_hand, monkeypatch):
    sizes = []

    def spied(search, center, count, generator):
        sizes.append(len(center))
        return _scatter(search, center, count, generator)

    monkeypatch.setattr(align_search, "_scatter", spied)
    start = exact.clone()
    start[1] = misled(exact, plain_hand)[1]
    found = explore(problem, start, start, candidates=8, rounds=1, generator=torch.Generator().manual_seed(5))
    assert set(sizes) == {1}
    off = (plain_hand.keypoints(found) - plain_hand.keypoints(exact)).norm(dim=-1)
    assert float(off.max()) < 0.015


def test_further_candidates_are_searched_where_the_best_leaves_clusters(problem, exact, plain_hand, monkeypatch):
    """The rows that do not need it stay as they are."""
    sizes = []
    settle = PoseSearch.refine

    def spied(search, candidates, rounds):
        sizes.append(tuple(candidates.shape[:2]))
        return settle(search, candidates, rounds)

    start = misled(exact, plain_hand)
    monkeypatch.setattr(PoseSearch, "refine", spied)
    monkeypatch.setattr(align_search, "leaves_clusters", lambda problem, pose: torch.arange(len(pose)) == 0)
    search = PoseSearch(problem, torch.Generator().manual_seed(5))
    poses, scores = align_search._search_around(search, start, start, 8, 1, torch.Generator().manual_seed(6))
    assert sizes[0] == (2, 1)
    assert [batch for batch, _ in sizes[1:]] == [1]
    # What comes back with a pose is its score.
    torch.testing.assert_close(search.refine(poses.unsqueeze(1), 1)[1][:, 0], scores, rtol=0.1, atol=3.0)


def test_large_batches_are_searched_in_parts(problem, exact, monkeypatch):
    sizes = []

    def spied(part, start, descended, candidates, rounds, generator):
        sizes.append(len(start))
        return descended + 1

    monkeypatch.setattr(align_search, "_explore", spied)
    monkeypatch.setattr(align_search, "_SEARCH", replace(align_search._SEARCH, entries=1))
    generator = torch.Generator().manual_seed(6)
    found = explore(problem, exact, exact, candidates=2, rounds=1, generator=generator)
    assert sizes == [1, 1]
    torch.testing.assert_close(found, exact + 1)


def test_searched_in_parts_a_batch_ends_where_it_ends_as_a_whole(problem, plain_hand, explored, exact, monkeypatch):
    start, around, _ = explored
    monkeypatch.setattr(align_search, "_SEARCH", replace(align_search._SEARCH, entries=1))
    found = explore(around, start, start, candidates=16, rounds=2, generator=torch.Generator().manual_seed(4))
    off = (plain_hand.keypoints(found) - plain_hand.keypoints(exact)).norm(dim=-1)
    assert float(off.max()) < 0.015
