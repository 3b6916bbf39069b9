"""Searching for better poses: when it is wanted, what its stages promise, and what it finds around a start."""

from dataclasses import replace

import pytest
import torch

from tests.alignment.made import TIPS, generator, off, problem_of
from torchreg.alignment.search.local_search import explore, needs_search
from torchreg.alignment.search.multi_start import score_candidates
from torchreg.alignment.search.pose_search import PoseSearch


@pytest.fixture(scope="module")
def truths(plain_hand):
    poses = plain_hand.rest_pose().repeat(2, 1)
    poses[:, 6:] = 0.5 * torch.rand(2, 21, generator=generator(4)) * plain_hand.upper[6:].clamp_min(0)
    poses[:, 3:6] = torch.tensor([[0.3, -0.4, 0.2], [-1.4, 0.5, 0.9]])
    return poses


@pytest.fixture(scope="module")
def problem(plain_hand, plain_hand_skin, truths):
    """Exact data of two hands; the prior's mean is the stretched hand."""
    data = plain_hand_skin(truths)
    mean = plain_hand.rest_pose() + torch.nn.functional.pad(data.mean(1), (0, 24))
    return problem_of(plain_hand_skin, data, mean, origin=data.mean(1))


@pytest.fixture(scope="module")
def exact(truths, plain_hand_skin):
    """The true poses in the coordinates of the problem."""
    return truths - torch.nn.functional.pad(plain_hand_skin(truths).mean(1), (0, 24))


def tip_errors(hand, poses, truths):
    return off(hand, poses, truths)[..., TIPS]


def bent(hand, poses, row, finger, angle):
    """Return the poses with the middle joint of a finger of one hand bent further."""
    dofs = [index for index, dof in enumerate(hand.dof_names) if dof.startswith(finger)]
    moved = poses.clone()
    moved[row, dofs[1]] += angle
    return moved


# When a search is wanted


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
            scores[row, number] = len(data) - explained.sum() + 0.3 * (off**2).sum() / (2 * 0.4**2)
    return scores


def test_scores_count_unexplained_data_and_ask_the_prior(problem, pool):
    padded = replace(problem, valid=torch.arange(400) < torch.tensor([[400], [150]]))
    for each in (problem, padded):
        found = score_candidates(each, pool, 0.02)
        torch.testing.assert_close(found, independent_score(each, pool, 0.02), rtol=1e-4, atol=5e-3)


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
