"""The funnel from rough candidates to a few good poses: order, scores, gains, thinning, batches."""

from dataclasses import replace

import pytest
import torch

from torchreg.alignment.pose_search import PoseSearch, fit_candidates, mean_distances, score_candidates
from torchreg.alignment.problem import PRIOR_SHARE, centered_problem, masked_mean, shifted
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
    return shifted(truths, -plain_hand_skin(truths).mean(1))


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


def tip_errors(hand, poses, truths):
    return (hand.keypoints(poses) - hand.keypoints(truths))[..., TIPS, :].norm(dim=-1)


def test_scores_count_unexplained_data_and_ask_the_prior(search, problem, pool):
    padded = replace(problem, valid=torch.arange(400) < torch.tensor([[400], [150]]))
    for each in (problem, padded):
        found = score_candidates(each, pool, 0.02)
        torch.testing.assert_close(found, independent_score(each, pool, 0.02), rtol=1e-4, atol=5e-3)


def test_candidates_fall_onto_the_data(plain_hand, problem, exact):
    near = exact.unsqueeze(1).repeat(1, 3, 1)
    near[..., 6:] += 0.15 * torch.randn(2, 3, 21, generator=generator(1))
    near = problem.clamp(near.transpose(0, 1)).transpose(0, 1)
    fitted = fit_candidates(problem, near, (0.03, 0.02), 2)
    before, after = (tip_errors(plain_hand, poses, exact.unsqueeze(1)).mean() for poses in (near, fitted))
    assert float(after) < 0.25 * float(before)
    assert bool(((fitted >= plain_hand.lower) & (fitted <= plain_hand.upper)).all())
    torch.testing.assert_close(fit_candidates(problem, near, (), 2), near)


def test_a_batch_is_fitted_as_a_loop(problem, pool):
    fitted = fit_candidates(problem, pool, (0.05, 0.02), 1)
    for row in range(2):
        index = torch.tensor([row])
        single = fit_candidates(problem.rows(index), pool[index, :3], (0.05, 0.02), 1)
        torch.testing.assert_close(single[0], fitted[row, :3], rtol=0, atol=1e-3)


def test_problems_are_repeated_in_a_row(problem):
    wide = problem.repeated(3)
    torch.testing.assert_close(wide.data, problem.data[[0, 0, 0, 1, 1, 1]])
    torch.testing.assert_close(wide.prior.mean, problem.prior.mean[[0, 0, 0, 1, 1, 1]])


def test_attracted_candidates_come_best_first(plain_hand, search, pool, exact):
    found = search.fit_coarsely(pool, 1)
    assert found.shape == pool.shape
    # The data that it ranks by are a draw; by all data the order is much the same.
    scores = independent_score(search.problem, found, 0.022)
    ranks = scores.argsort(1).argsort(1).float()
    assert float(torch.corrcoef(torch.cat([ranks, torch.arange(8.0).unsqueeze(0)]))[:2, 2].min()) > 0.7
    before, after = (tip_errors(plain_hand, poses, exact.unsqueeze(1)).mean((1, 2)) for poses in (pool, found))
    assert bool((after < before).all())


def test_few_of_many_are_kept_and_their_limbs_are_placed(plain_hand, search, pool, exact):
    narrowed = search.prune(pool, 3)
    assert narrowed.shape == (2, 3, 27)
    assert bool(((narrowed >= plain_hand.lower) & (narrowed <= plain_hand.upper)).all())
    before, after = (independent_score(search.problem, poses, 0.022).amin(1) for poses in (pool, narrowed))
    assert bool((after < 0.7 * before).all())
    assert search.prune(pool[:, :2], 5).shape == (2, 2, 27)


def test_different_candidates_come_before_twins(search, exact, pool):
    """Twins of the best would crowd out every rival."""
    twins = torch.cat([exact.unsqueeze(1).repeat(1, 3, 1), pool[:, -1:]], dim=1)
    for found in (search.prune(twins, 2), search.fit_coarsely(twins, 1)[:, :2]):
        apart = (search.problem.skin(found[:, 0]) - search.problem.skin(found[:, 1])).square().sum(-1).mean(-1).sqrt()
        assert bool((apart > 0.01 * search.problem.size).all())


def test_distances_of_candidates_are_those_of_their_points(search, pool):
    points = search.problem.skin(pool)[..., ::2, :]
    offset = points.unsqueeze(1) - points.unsqueeze(2)
    expected = offset.square().sum(-1).mean(-1).sqrt()
    torch.testing.assert_close(mean_distances(search.problem, pool), expected, rtol=0, atol=1e-4)


def test_limbs_that_fit_are_kept_as_they_came(plain_hand, search, exact):
    narrowed = search.prune(exact.unsqueeze(1), 1)
    assert float(tip_errors(plain_hand, narrowed[:, 0], exact).max()) < 0.012


@pytest.fixture(scope="module")
def settled(search, pool):
    narrowed = search.prune(pool, 3)
    return narrowed, *search.refine(narrowed, 2)


def test_a_thorough_search_finds_the_pose(plain_hand, settled, exact):
    _, poses, _ = settled
    assert poses.shape == (2, 3, 27)
    errors = tip_errors(plain_hand, poses[:, 0], exact)
    assert float(errors.mean()) < 0.003
    assert float(errors.max()) < 0.01
    assert bool(((poses >= plain_hand.lower) & (poses <= plain_hand.upper)).all())


def test_settled_poses_come_best_first_with_their_scores(search, settled):
    _, poses, scores = settled
    assert bool((scores.diff(dim=1) >= 0).all())
    width = 0.018
    torch.testing.assert_close(scores, score_candidates(search.problem, poses, width), rtol=1e-4, atol=1e-2)
    torch.testing.assert_close(scores, independent_score(search.problem, poses, width), rtol=1e-3, atol=2e-2)


def test_the_best_is_never_worse_than_what_came_in(search, settled, exact):
    narrowed, _, scores = settled
    came = independent_score(search.problem, narrowed, 0.018)
    assert bool((scores[:, 0] <= came.amin(1)).all())
    more = search.refine(narrowed, 3)[1]
    assert bool((more[:, 0] <= scores[:, 0] + 1.0).all())
    # Even the true pose comes out no worse than a fit makes it.
    _, best = search.refine(exact.unsqueeze(1), 1)
    assert bool((best[:, 0] <= independent_score(search.problem, exact.unsqueeze(1), 0.018)[:, 0] + 1.0).all())


def test_a_search_ends_when_a_round_gains_nothing(problem, exact, monkeypatch):
    rounds = []
    searched = PoseSearch._best_options

    def counted(search, problem, candidates, stage, number):
        rounds.append(candidates.shape[1])
        return searched(search, problem, candidates, stage, number)

    monkeypatch.setattr(PoseSearch, "_best_options", counted)
    PoseSearch(problem, generator()).refine(exact.unsqueeze(1).repeat(1, 2, 1), 6)
    # The candidates first, then the best alone.
    assert rounds[0] == 2
    assert set(rounds[1:]) == {1}
    assert len(rounds) < 6


def test_rows_of_a_search_are_searches(search, pool):
    index = torch.tensor([1])
    part = search.rows(index)
    torch.testing.assert_close(part.problem.data, search.problem.data[1:])
    torch.testing.assert_close(part.coarse_problem.data, search.coarse_problem.data[1:])
    assert part.limbs is search.limbs
    assert len(search.problem.data) == 2
    torch.testing.assert_close(part.fit_coarsely(pool[1:], 1), search.fit_coarsely(pool, 1)[1:], rtol=0, atol=1e-3)
    assert part.prune(pool[1:], 2).shape == (1, 2, 27)


def test_large_clouds_are_thinned_and_skins_are_coarse(problem, plain_hand, truths):
    large = replace(problem, data=problem.data.repeat(1, 10, 1), valid=problem.valid.repeat(1, 10))
    found = PoseSearch(large, generator())
    assert found.problem.data.shape[1] < 1000
    assert found.coarse_problem.data.shape[1] < found.problem.data.shape[1]
    assert isinstance(found.problem.surface, FusedSurface)
    coarse, fine = found.problem.skin, problem.skin
    assert len(coarse) < len(fine)
    # A coarse skin covers the fine one, in other poses too.
    gaps = torch.cdist(fine(truths[1]), coarse(truths[1])).amin(-1)
    assert float(gaps.max()) < 0.025
    assert float(torch.cdist(coarse(truths[1]), fine(truths[1])).amin(-1).max()) < 1e-4
    again = PoseSearch(replace(problem, skin=coarse), generator()).problem.skin
    assert len(again) == len(coarse)


def test_the_generator_decides_and_the_global_state_does_not(problem, pool):
    torch.manual_seed(9)
    state = torch.get_rng_state()
    found = [PoseSearch(problem, generator(3)).prune(pool[:, :3], 1) for _ in range(2)]
    torch.testing.assert_close(*found, rtol=0, atol=0)
    assert bool((torch.get_rng_state() == state).all())


def test_data_that_do_not_count_change_nothing(problem, pool):
    clutter = problem.skin(pool[:, 7])[:, :100]
    padded = replace(
        problem,
        data=torch.cat([problem.data, clutter], dim=1),
        valid=torch.arange(500).expand(2, 500) < 400,
    )
    searches = [PoseSearch(each, generator()) for each in (problem, padded)]
    fitted = [fit_candidates(each.problem, pool, (0.05, 0.03), 1) for each in searches]
    torch.testing.assert_close(*fitted, rtol=0, atol=1e-3)
    scores = [score_candidates(each.problem, pool, 0.02) for each in searches]
    torch.testing.assert_close(*scores, rtol=1e-5, atol=1e-2)
