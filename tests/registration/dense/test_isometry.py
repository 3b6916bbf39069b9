import math
from dataclasses import replace

import pytest
import torch

from torchreg.errors import InputError
from torchreg.registration.dense.descriptor_matching import DescriptorMatches
from torchreg.registration.dense.isometry import consistent_matches

OPTIONS = {"radius": 0.4, "slack": 0.02}


@pytest.fixture
def sheet():
    """120 points of a sheet, which is bent but not stretched: distances along it are those in the plane."""
    generator = torch.Generator().manual_seed(0)
    places = torch.rand(120, 2, generator=generator, dtype=torch.float64)
    return torch.cdist(places, places)


def candidates(wrong_first, count=120, k=5, seed=1):
    """Matches to the point itself and to k - 1 random others; in ``wrong_first`` of the rows one of those leads."""
    generator = torch.Generator().manual_seed(seed)
    index = torch.randint(count, (count, k), generator=generator)
    index[:, 0] = torch.arange(count)
    swap = torch.rand(count, generator=generator) < wrong_first
    index[swap] = index[swap].roll(1, dims=1)
    score = 0.9 - 0.02 * torch.arange(k, dtype=torch.float64).expand(count, k)
    return DescriptorMatches(index, score.clone())


def plain_step(matches, here, there, radius, slack):
    """The first supports, one number at a time, with every point within the radius voting."""
    count, k = matches.index.shape
    belief = torch.softmax(10 * matches.score, 1)
    support = torch.zeros(count, k, dtype=here.dtype)
    for i in range(count):
        voters = [j for j in range(count) if j != i and here[i, j] <= radius]
        for a in range(k):
            for j in voters:
                width = slack + 0.1 * here[i, j]
                miss = (there[matches.index[i, a], matches.index[j]] - here[i, j]) / width
                fits = [float(belief[j, b]) * math.exp(-0.5 * float(miss[b]) ** 2) for b in range(k)]
                support[i, a] += max(fits) / len(voters)
    return support


def test_one_step_is_that_of_a_plain_loop(sheet):
    small = sheet[:20, :20]
    matches = candidates(0.5, 20, 3)
    found = consistent_matches(matches, small, small, num_voters=30, steps=1, **OPTIONS)
    support = plain_step(matches, small, small, **OPTIONS)
    belief = torch.softmax(10 * matches.score, 1) * support.square()
    choice = belief.argmax(1, keepdim=True)
    assert torch.equal(found.index, matches.index.gather(1, choice)[:, 0])
    torch.testing.assert_close(found.support, support.gather(1, choice)[:, 0])


@pytest.mark.parametrize("wrong_first", [0.0, 0.5, 0.8])
def test_the_right_candidates_are_found_among_wrong_ones(sheet, wrong_first):
    found = consistent_matches(candidates(wrong_first), sheet, sheet, **OPTIONS)
    right = found.index == torch.arange(120)
    assert float(right.double().mean()) > 0.95
    assert float(found.support[right].mean()) > 0.8


def test_support_tells_points_whose_candidates_are_all_wrong(sheet):
    matches = candidates(0.3)
    matches.index[:30] = torch.randint(120, (30, 5), generator=torch.Generator().manual_seed(5))
    found = consistent_matches(matches, sheet, sheet, **OPTIONS)
    assert float((found.support[30:] > 0.5).double().mean()) > 0.9
    # By chance a random point may lie beside the right one.
    assert float((found.support[:30] > 0.5).double().mean()) < 0.25


def test_units_and_order_change_nothing(sheet):
    matches = candidates(0.5)
    found = consistent_matches(matches, sheet, sheet, **OPTIONS)
    scaled = consistent_matches(matches, 1e3 * sheet, 1e3 * sheet, radius=400.0, slack=20.0)
    assert torch.equal(found.index, scaled.index)
    torch.testing.assert_close(found.support, scaled.support)
    order = torch.randperm(120, generator=torch.Generator().manual_seed(7))
    shuffled = DescriptorMatches(matches.index[order], matches.score[order])
    turned = consistent_matches(shuffled, sheet[order][:, order], sheet, **OPTIONS)
    assert torch.equal(turned.index, found.index[order])
    torch.testing.assert_close(turned.support, found.support[order])
    single = consistent_matches(matches, sheet.float(), sheet.float(), **OPTIONS)
    assert single.support.dtype == torch.float32
    assert float((single.index == found.index).double().mean()) > 0.98


def test_pieces_that_no_way_joins(sheet):
    apart = sheet.clone()
    apart[:60, 60:] = apart[60:, :60] = math.inf
    found = consistent_matches(candidates(0.5), apart, apart, **OPTIONS)
    assert float((found.index == torch.arange(120)).double().mean()) > 0.9
    assert bool(found.support.isfinite().all())


def test_points_alone_keep_their_first_candidate(sheet):
    matches = candidates(0.5)
    found = consistent_matches(matches, sheet, sheet, radius=1e-9, slack=0.01)
    assert torch.equal(found.index, matches.index[:, 0])
    assert float(found.support.abs().max()) == 0


def test_rows_without_candidates(sheet):
    matches = candidates(0.2)
    index, score = matches.index.clone(), matches.score.clone()
    index[::10], score[::10] = -1, -math.inf
    index[1::10, 3:], score[1::10, 3:] = -1, -math.inf
    found = consistent_matches(replace(matches, index=index, score=score), sheet, sheet, **OPTIONS)
    assert bool((found.index[::10] == -1).all())
    assert float(found.support[::10].max()) == 0
    some = torch.arange(120) % 10 != 0
    assert float((found.index[some] == torch.arange(120)[some]).double().mean()) > 0.9
    empty = DescriptorMatches(torch.zeros(120, 0, dtype=torch.int64), torch.zeros(120, 0))
    nothing = consistent_matches(empty, sheet, sheet, **OPTIONS)
    assert bool((nothing.index == -1).all())


def test_bad_arguments_are_named(sheet):
    matches = candidates(0.0)
    with pytest.raises(InputError, match="source_distances must have shape"):
        consistent_matches(matches, sheet[:5], sheet, **OPTIONS)
    with pytest.raises(InputError, match="target_distances must have shape"):
        consistent_matches(matches, sheet, sheet[:, :5], **OPTIONS)
    with pytest.raises(InputError, match="target_distances must cover the matches"):
        consistent_matches(matches, sheet, sheet[:5, :5], **OPTIONS)
    for name in ("radius", "slack", "num_voters", "steps"):
        with pytest.raises(InputError, match=name):
            consistent_matches(matches, sheet, sheet, **{**OPTIONS, name: 0})
