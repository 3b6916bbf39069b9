"""Searching for better poses: when it is wanted, what its stages promise, and what it finds around a start."""

from dataclasses import replace

import pytest
import torch

from torchreg.alignment import local_search
from torchreg.alignment.clusters import clustered_data, leaves_clusters
from torchreg.alignment.local_search import explore, needs_search
from torchreg.alignment.pose_search import PoseSearch, fit_candidates, mean_distances, score_candidates
from torchreg.alignment.problem import PRIOR_SHARE, centered_problem, masked_mean
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.pose_algebra import shifted
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.skin import sample_skin
from torchreg.shapes.surface import FusedSurface

TIPS = [4, 8, 12, 16, 20]


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def truths(plain_hand):
    poses = plain_hand.rest_pose().repeat(2, 1)
    poses[:, 6:] = 0.5 * torch.rand(2, 21, generator=generator(4)) * plain_hand.upper[6:].clamp_min(0)
    poses[:, 3:6] = torch.tensor([[0.3, -0.4, 0.2], [-1.4, 0.5, 0.9]])
    return poses


@pytest.fixture(scope="module")
def problem(plain_hand, plain_hand_skin, truths):
    """Exact data of two hands; the prior's mean is the stretched hand."""
    data, valid = plain_hand_skin(truths), torch.ones(2, 400, dtype=torch.bool)
    origin = masked_mean(data, valid)
    mean = shifted(plain_hand.rest_pose().repeat(2, 1), origin)
    return centered_problem(plain_hand_skin, data, valid, mean, origin, prior_std=0.4, pose_atol=0.0)


@pytest.fixture(scope="module")
def exact(truths, plain_hand_skin):
    """The true poses in the coordinates of the problem."""
    return shifted(truths, -plain_hand_skin(truths).mean(1))


def tip_errors(hand, poses, truths):
    return (hand.keypoints(poses) - hand.keypoints(truths))[..., TIPS, :].norm(dim=-1)


def bent(hand, poses, row, finger, angle):
    """Return the poses with the middle joint of a finger of one hand bent further."""
    dofs = [index for index, dof in enumerate(hand.dof_names) if dof.startswith(finger)]
    moved = poses.clone()
    moved[row, dofs[1]] += angle
    return moved


# When a search is wanted


def test_a_descent_that_stayed_near_and_explains_all_is_trusted(problem, exact):
    near = exact.clone()
    near[:, 6:] += 0.03
    assert needs_search(problem, near, exact).tolist() == [False, False]


def test_a_descent_that_went_far_is_not_trusted(problem, exact):
    for row, dofs in ((0, slice(6, None)), (1, 3)):
        start = exact.clone()
        start[row, dofs] += 0.5
        assert needs_search(problem, start, exact).tolist() == [row == 0, row == 1]


def test_a_finger_off_the_surface_is_noticed(problem, exact, plain_hand):
    """Also when half of the data are padding, or many; thin clutter is no limb."""
    missed = bent(plain_hand, exact, 0, "index", 1.2)
    assert needs_search(problem, missed, missed).tolist() == [True, False]
    clutter = 0.4 * torch.rand(2, 400, 3, generator=generator()) - 0.2
    cluttered = replace(problem, data=torch.cat([problem.data, clutter], dim=1), valid=problem.valid.repeat(1, 2))
    assert needs_search(cluttered, exact, exact).tolist() == [False, False]
    padding = torch.cat([problem.valid, ~problem.valid], dim=1)
    padded = replace(cluttered, data=torch.cat([problem.data, problem.data + 0.02], dim=1), valid=padding)
    assert needs_search(padded, exact, exact).tolist() == [False, False]
    assert needs_search(padded, missed, missed).tolist() == [True, False]
    many = problem.data.repeat(1, 7, 1)
    many = many + 5e-4 * torch.randn(many.shape, generator=generator(1))
    large = replace(problem, data=many, valid=problem.valid.repeat(1, 7))
    assert needs_search(large, missed, missed).tolist() == [True, False]


def test_a_cloud_without_inliers_is_searched_without_failing(problem, exact):
    lost = replace(problem, data=problem.data + 5.0)
    assert needs_search(lost, exact, exact).shape == (2,)


def test_clusters_are_counted_beside_the_data_on_the_surface(problem, exact, plain_hand):
    clustered, near = clustered_data(problem, exact)
    assert clustered.tolist() == [0, 0]
    assert int(near.min()) > 380
    missed = bent(plain_hand, exact, 1, "ring", 1.0)
    clustered, near = clustered_data(problem, missed)
    assert clustered[0] == 0
    assert 15 < int(clustered[1]) < 60
    assert int((clustered + near).max()) <= 400
    assert leaves_clusters(problem, missed).tolist() == [False, True]


# The stages of a search


@pytest.fixture(scope="module")
def search(problem):
    return PoseSearch(problem, generator())


@pytest.fixture(scope="module")
def pool(plain_hand, exact):
    """Eight candidates: the base a little off, more and more, the fingers anywhere within half their range."""
    noise = torch.randn(2, 8, 6, generator=generator(5)) * torch.linspace(0.1, 1.0, 8).unsqueeze(-1)
    poses = exact.unsqueeze(1).repeat(1, 8, 1)
    poses[..., :3] += 0.02 * noise[..., :3]
    poses[..., 3:6] += 0.3 * noise[..., 3:]
    poses[..., 6:] = 0.5 * torch.rand(2, 8, 21, generator=generator(6)) * plain_hand.upper[6:].clamp_min(0)
    return poses


def independent_score(problem, poses, width):
    """Return the score by its definition, candidate by candidate."""
    shape, prior = problem.skin.shape, problem.prior
    scores = torch.empty(poses.shape[:2])
    for row, candidates in enumerate(poses):
        data = problem.data[row][problem.valid[row]]
        for number, pose in enumerate(candidates):
            explained = torch.exp(-((shape.distance(data, pose) / (width * problem.size)) ** 2))
            off = (pose - prior.mean[row])[6:]
            scores[row, number] = len(data) - explained.sum() + PRIOR_SHARE * (off**2).sum() / (2 * 0.4**2)
    return scores


def test_scores_count_unexplained_data_and_ask_the_prior(problem, pool):
    padded = replace(problem, valid=torch.arange(400) < torch.tensor([[400], [150]]))
    for each in (problem, padded):
        found = score_candidates(each, pool, 0.02)
        torch.testing.assert_close(found, independent_score(each, pool, 0.02), rtol=1e-4, atol=5e-3)


def test_candidates_fall_onto_the_data(plain_hand, problem, exact):
    near = exact.unsqueeze(1).repeat(1, 3, 1)
    near[..., 6:] += 0.15 * torch.randn(2, 3, 21, generator=generator(1))
    near = problem.clamp_candidates(near)
    fitted = fit_candidates(problem, near, (0.03, 0.02), 2)
    before, after = (tip_errors(plain_hand, poses, exact.unsqueeze(1)).mean() for poses in (near, fitted))
    assert float(after) < 0.25 * float(before)
    assert bool(((fitted >= plain_hand.lower) & (fitted <= plain_hand.upper)).all())
    torch.testing.assert_close(fit_candidates(problem, near, (), 2), near)
    for row in range(2):
        index = torch.tensor([row])
        alone = fit_candidates(problem.rows(index), near[index, :2], (0.03, 0.02), 2)
        torch.testing.assert_close(alone[0], fitted[row, :2], rtol=0, atol=1e-3)


def test_distances_of_candidates_are_those_of_their_points(search, pool):
    points = search.problem.skin(pool)[..., ::2, :]
    offset = points.unsqueeze(1) - points.unsqueeze(2)
    expected = offset.square().sum(-1).mean(-1).sqrt()
    torch.testing.assert_close(mean_distances(search.problem, pool), expected, rtol=0, atol=1e-4)


def test_coarsely_fitted_candidates_come_best_first(plain_hand, search, pool, exact):
    found = search.fit_coarsely(pool, 1)
    assert found.shape == pool.shape
    # The data that it ranks by are a draw; by all data the order is much the same.
    scores = independent_score(search.problem, found, 0.022)
    ranks = scores.argsort(1).argsort(1).float()
    assert float(torch.corrcoef(torch.cat([ranks, torch.arange(8.0).unsqueeze(0)]))[:2, 2].min()) > 0.7
    before, after = (tip_errors(plain_hand, poses, exact.unsqueeze(1)).mean((1, 2)) for poses in (pool, found))
    assert bool((after < before).all())


def test_pruning_keeps_the_best_with_their_limbs_placed(plain_hand, search, pool, exact):
    pruned = search.prune(pool, 3)
    assert pruned.shape == (2, 3, 27)
    assert bool(((pruned >= plain_hand.lower) & (pruned <= plain_hand.upper)).all())
    before, after = (independent_score(search.problem, poses, 0.022).amin(1) for poses in (pool, pruned))
    assert bool((after < 0.7 * before).all())
    assert search.prune(pool[:, :2], 5).shape == (2, 2, 27)
    # Limbs that fit are kept as they are.
    kept = search.prune(exact.unsqueeze(1), 1)
    assert float(tip_errors(plain_hand, kept[:, 0], exact).max()) < 0.012


def test_different_candidates_come_before_duplicates(search, exact, pool):
    """Duplicates of the best would crowd out every rival."""
    candidates = torch.cat([exact.unsqueeze(1).repeat(1, 3, 1), pool[:, -1:]], dim=1)
    for found in (search.prune(candidates, 2), search.fit_coarsely(candidates, 1)[:, :2]):
        apart = (search.problem.skin(found[:, 0]) - search.problem.skin(found[:, 1])).square().sum(-1).mean(-1).sqrt()
        assert bool((apart > 0.01 * search.problem.size).all())


def test_refining_finds_the_pose_and_is_never_worse_than_its_input(plain_hand, search, pool, exact):
    pruned = search.prune(pool, 3)
    poses, scores = search.refine(pruned, 2)
    assert poses.shape == (2, 3, 27)
    assert bool(((poses >= plain_hand.lower) & (poses <= plain_hand.upper)).all())
    errors = tip_errors(plain_hand, poses[:, 0], exact)
    assert float(errors.mean()) < 0.003
    assert float(errors.max()) < 0.01
    assert bool((scores.diff(dim=1) >= 0).all())
    torch.testing.assert_close(scores, independent_score(search.problem, poses, 0.018), rtol=1e-3, atol=2e-2)
    assert bool((scores[:, 0] <= independent_score(search.problem, pruned, 0.018).amin(1)).all())
    # Even the true pose comes out no worse than a fit makes it.
    _, best = search.refine(exact.unsqueeze(1), 1)
    assert bool((best[:, 0] <= independent_score(search.problem, exact.unsqueeze(1), 0.018)[:, 0] + 1.0).all())


def test_rows_of_a_search_are_searches(search, pool):
    index = torch.tensor([1])
    part = search.rows(index)
    assert len(search.problem.data) == 2
    torch.testing.assert_close(part.fit_coarsely(pool[1:], 1), search.fit_coarsely(pool, 1)[1:], rtol=0, atol=1e-3)
    assert part.prune(pool[1:], 2).shape == (1, 2, 27)


def test_large_clouds_are_thinned_and_skins_are_coarse(problem, plain_hand, truths):
    large = replace(problem, data=problem.data.repeat(1, 10, 1), valid=problem.valid.repeat(1, 10))
    found = PoseSearch(large, generator())
    assert found.problem.data.shape[1] < 1000
    assert isinstance(found.problem.surface, FusedSurface)
    coarse, fine = found.problem.skin, problem.skin
    assert len(coarse) < len(fine)
    # A coarse skin covers the fine one, in other poses too.
    assert float(torch.cdist(fine(truths[1]), coarse(truths[1])).amin(-1).max()) < 0.025
    assert float(torch.cdist(coarse(truths[1]), fine(truths[1])).amin(-1).max()) < 1e-4


def test_the_generator_decides_and_the_global_state_does_not(problem, pool):
    torch.manual_seed(9)
    state = torch.get_rng_state()
    found = [PoseSearch(problem, generator(3)).prune(pool[:, :3], 1) for _ in range(2)]
    torch.testing.assert_close(*found, rtol=0, atol=0)
    assert bool((torch.get_rng_state() == state).all())


def test_data_that_do_not_count_change_nothing(problem, pool):
    clutter = problem.skin(pool[:, 7])[:, :100]
    valid = torch.arange(500).expand(2, 500) < 400
    padded = replace(problem, data=torch.cat([problem.data, clutter], dim=1), valid=valid)
    searches = [PoseSearch(each, generator()) for each in (problem, padded)]
    fitted = [fit_candidates(each.problem, pool, (0.05, 0.03), 1) for each in searches]
    torch.testing.assert_close(*fitted, rtol=0, atol=1e-3)
    scores = [score_candidates(each.problem, pool, 0.02) for each in searches]
    torch.testing.assert_close(*scores, rtol=1e-5, atol=1e-2)


# Around a start


@pytest.fixture(scope="module")
def misled(problem, exact, plain_hand):
    """Starts with a finger each that a descent would not find, folded flat, and the problem with a prior about them."""
    start = exact.clone()
    for row, finger, angles in ((0, "index", [1.2, 0.9, 0.5]), (1, "little", [0.9, 0.9, 0.5])):
        dofs = [index for index, dof in enumerate(plain_hand.dof_names) if dof.startswith(finger)]
        start[row, dofs[1:]] += torch.tensor(angles)
    start = torch.minimum(start, plain_hand.upper)
    return replace(problem, prior=replace(problem.prior, mean=start)), start


@pytest.fixture(scope="module")
def explored(misled):
    return explore(*misled, misled[1], candidates=16, rounds=2, generator=generator(4))


def test_a_lost_finger_is_found(exact, plain_hand, misled, explored):
    before, after = (tip_errors(plain_hand, poses, exact) for poses in (misled[1], explored))
    assert float(before.amax(-1).min()) > 0.02
    assert float(after.max()) < 0.015
    assert bool((explored >= plain_hand.lower).all() & (explored <= plain_hand.upper).all())


def test_a_search_depends_on_its_generator_only(misled, explored):
    torch.manual_seed(77)
    state = torch.get_rng_state()
    again = explore(*misled, misled[1], candidates=16, rounds=2, generator=generator(4))
    torch.testing.assert_close(again, explored, rtol=0, atol=0)
    assert bool((torch.get_rng_state() == state).all())


def test_a_search_that_improves_nothing_returns_the_descent(problem, exact, plain_hand):
    found = explore(problem, exact, exact, candidates=3, rounds=4, generator=generator(5))
    assert float(tip_errors(plain_hand, found, exact).max()) < 0.008


def test_something_dense_beside_the_shape_misleads_no_search(misled, plain_hand, exact):
    """It remains an unexplained cluster, for which further candidates are refined in vain."""
    problem, start = misled
    middle = problem.data.mean(1, keepdim=True) + torch.tensor([0.0, 0.0, 0.12])
    ball = middle + 0.012 * torch.nn.functional.normalize(torch.randn(2, 60, 3, generator=generator(2)), dim=-1)
    data = torch.cat([problem.data, ball], dim=1)
    cluttered = replace(problem, data=data, valid=torch.ones(2, 460, dtype=torch.bool))
    assert leaves_clusters(cluttered, exact).all()
    found = explore(cluttered, start, start, candidates=16, rounds=1, generator=generator(4))
    assert float(tip_errors(plain_hand, found, exact).max()) < 0.015


def test_searched_in_parts_a_batch_ends_where_it_ends_as_a_whole(misled, plain_hand, exact, monkeypatch):
    monkeypatch.setattr(local_search, "_AROUND", replace(local_search._AROUND, entries=1))
    found = explore(*misled, misled[1], candidates=16, rounds=2, generator=generator(4))
    assert float(tip_errors(plain_hand, found, exact).max()) < 0.015


def test_joints_without_limits_are_searched(make_problem):
    """Candidates of joints that turn freely stay within about a radian of the start: two arms come back from there."""

    def offset(*place):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = torch.tensor(place, dtype=torch.float64)
        return pose

    turn = ("revolute", (1.0, 0.0, 0.0))
    tree = KinematicTree((
        Joint("body", -1, offset(0, 0, 0)),
        Joint("left", 0, offset(0.05, 0, 0), *turn),
        Joint("right", 0, offset(-0.05, 0, 0), *turn),
    ))  # fmt: skip
    solids = [Primitive("ellipsoid", (0.05, 0.03, 0.02), offset(0, 0, 0))]
    solids += [Primitive("capsule", (0.04, 0.01), offset(0, 0, 0.04))] * 2
    shape = ArticulatedShape(tree, ["body", "left", "right"], solids, nu=0.005).requires_grad_(False)
    truth = torch.tensor([[0.0] * 6 + [0.9, -0.7]])
    skin, start = sample_skin(shape, 200), torch.zeros(1, 8)
    problem = make_problem(skin, skin(truth))
    found = explore(problem, start, start, candidates=16, rounds=1, generator=generator(3))
    torch.testing.assert_close(found[:, 6:], truth[:, 6:], rtol=0, atol=0.1)
