"""Soft matches of oriented samples against the full table, and the learnt prior against loops."""

import math

import pytest
import torch

import torchreg as tr
from torchreg.registration.dense.e_step import match_softly
from torchreg.registration.dense.match_prior import MatchPrior
from torchreg.registration.dense.oriented_samples import OrientedSamples

F64 = torch.float64


def samples(count, seed, spread=0.05):
    generator = torch.Generator().manual_seed(seed)
    points, normals = (torch.randn(count, 3, generator=generator, dtype=F64) for _ in range(2))
    normals = torch.nn.functional.normalize(normals + torch.tensor([0.0, 0.0, 2.0]), dim=-1)
    return OrientedSamples(spread * points, normals, torch.arange(count) % 3 == 0)


def table(source, target, sigma, normal_weight):
    """Return the likelihoods of all pairs, in a loop over them."""
    rows = torch.zeros(len(source), len(target), dtype=F64)
    for i in range(len(source)):
        for j in range(len(target)):
            square = float((source.points[i] - target.points[j]).square().sum()) / (2 * sigma**2)
            turned = normal_weight * (1 - float(source.normals[i] @ target.normals[j]))
            rows[i, j] = math.exp(-square - turned)
    return rows


def test_posteriors_are_those_of_the_full_table():
    sigma = 0.04
    source, target = samples(12, 0), samples(15, 1)
    likelihood = table(source, target, sigma, 3.0)
    chosen = likelihood / (likelihood.sum(1, keepdim=True) + 0.3 * max(1.0, 2 * 15 * sigma**2))
    found = match_softly(source, target, sigma, normal_weight=3.0, outliers=0.3, num_candidates=20)
    torch.testing.assert_close(found.posterior, chosen.sum(1))
    torch.testing.assert_close(found.targets, chosen @ target.points / chosen.sum(1, keepdim=True))
    torch.testing.assert_close(found.normals, torch.nn.functional.normalize(chosen @ target.normals, dim=-1))
    with pytest.raises(tr.errors.InputError, match="sigma must be positive"):
        match_softly(source, target, 0.0)


def test_few_candidates_are_nearly_all():
    source, target = samples(60, 0, 0.3), samples(80, 1, 0.3)
    few, every = match_softly(source, target, 0.03), match_softly(source, target, 0.03, num_candidates=80)
    torch.testing.assert_close(few.posterior, every.posterior, rtol=0, atol=2e-2)


def test_motion_and_order_change_nothing():
    source, target = samples(30, 0), samples(40, 1)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2), dtype=F64))[0]
    plain = match_softly(source, target, 0.04)
    turned = match_softly(*(each.moved(each.points @ turn.mT + 2, each.normals @ turn.mT) for each in (source, target)),
                          0.04)  # fmt: skip
    torch.testing.assert_close(turned.posterior, plain.posterior)
    torch.testing.assert_close(turned.targets, plain.targets @ turn.mT + 2)
    order = torch.randperm(40, generator=torch.Generator().manual_seed(3))
    shuffled = OrientedSamples(target.points[order], target.normals[order], target.boundary[order])
    torch.testing.assert_close(match_softly(source, shuffled, 0.04).posterior, plain.posterior)


def test_far_samples_are_outliers_that_stay_and_exact_matches_are_sure():
    source = samples(20, 0, 1.0)
    lost = match_softly(source, source.moved(source.points + 50, source.normals), 0.02)
    assert float(lost.posterior.max()) == 0
    torch.testing.assert_close(lost.targets, source.points)
    assert bool(lost.normals.isfinite().all())
    sure = match_softly(source, source, 0.01, outliers=0.1)
    assert 0.9 < float(sure.posterior.min()) <= float(sure.posterior.max()) <= 1
    torch.testing.assert_close(sure.targets, source.points, rtol=0, atol=1e-3)


def test_hidden_samples_are_matched_by_their_odds():
    source, target = samples(60, 0), samples(80, 1)
    plain = match_softly(source, target, 0.05, outliers=0.3)
    sure = match_softly(source, target, 0.05, outliers=0.3, visible=torch.ones(60, dtype=F64))
    torch.testing.assert_close(sure.posterior, plain.posterior)
    visible = torch.linspace(0, 1, 60, dtype=F64)
    found = match_softly(source, target, 0.05, outliers=0.3, visible=visible)
    # Bayes' rule on the odds of an outlier, those of a surely visible sample being known.
    odds = (1 - plain.posterior) / plain.posterior
    expected = 1 / (1 + odds * ((1 + 0.3) / visible - 1) / 0.3)
    torch.testing.assert_close(found.posterior[1:], expected[1:])
    assert float(found.posterior[0]) < 1e-9
    assert bool(found.targets.isfinite().all())


def test_embedded_distances_are_sums_and_shapes_must_fit():
    both = samples(6, 0)
    rows = both.embedded(0.5)
    squares = torch.cdist(both.points, both.points).square() + 0.25 * 2 * (1 - both.normals @ both.normals.mT)
    torch.testing.assert_close(torch.cdist(rows, rows).square(), squares)
    for normals, boundary, error, message in (
        (both.normals[:2], both.boundary, tr.errors.InputError, "normals must have shape"),
        (both.normals, both.boundary[:2], tr.errors.InputError, "boundary must have shape"),
        (both.normals.float(), both.boundary, tr.errors.InputTypeError, "normals is torch.float32"),
    ):
        with pytest.raises(error, match=message):
            OrientedSamples(both.points, normals, boundary)


TOKENS, OTHERS = 20, 24


@pytest.fixture(scope="module")
def prior():
    generator = torch.Generator().manual_seed(0)
    source, target = (torch.rand(size, 3, generator=generator, dtype=F64) for size in (60, 90))
    return MatchPrior.of_logits(3 * torch.randn(TOKENS + 1, OTHERS + 1, generator=generator, dtype=F64), source, target)


def test_tables_share_out_what_is_visible(prior):
    torch.testing.assert_close(prior.source.sum(1), torch.ones(60, dtype=F64))
    assert int((prior.source > 0).sum(1).max()) == int((prior.target > 0).sum(1).max()) == 3
    assert torch.equal(prior.source[:TOKENS].argmax(1), torch.arange(TOKENS))
    by_source, by_target = prior.tables
    assert by_source.shape == by_target.shape == (TOKENS, 2 * OTHERS)
    torch.testing.assert_close(by_source.sum(1), prior.visible[:TOKENS])
    torch.testing.assert_close(by_target.sum(0), prior.target_visible[: 2 * OTHERS])
    assert 0 < float(prior.visible.min()) <= float(prior.visible.max()) <= 1


def test_support_is_that_of_the_tokens_about(prior):
    index = torch.randint(90, (7, 5), generator=torch.Generator().manual_seed(1))
    chance = prior.source[:7] @ prior.by_source @ prior.target.mT
    expected = ((3 * chance.gather(1, index) + 0.1) / 1.1).log()
    torch.testing.assert_close(prior.logarithm(index, 0.1), expected)
    # Doubt bounds what impossible matches lose.
    every = torch.arange(90).expand(60, -1)
    assert float(prior.logarithm(every, 0.1).min()) >= math.log(0.1 / 1.1)
    assert float(prior.logarithm(every, 1e9).abs().max()) < 1e-8


def test_tokens_that_repeat_samples_count_together():
    generator = torch.Generator().manual_seed(2)
    source, target = (torch.rand(size, 3, generator=generator, dtype=F64) for size in (4, 5))
    alone = torch.randn(5, 6, generator=generator, dtype=F64)
    # Twice each token, with half its odds: hidden tokens stay as likely.
    rows, columns = torch.tensor([0, 1, 2, 3] * 2 + [4]), torch.tensor([0, 1, 2, 3, 4] * 2 + [5])
    doubled = alone[rows][:, columns] - math.log(2.0)
    doubled[:, -1], doubled[-1] = alone[rows, -1], alone[-1, columns]
    doubled[-1, -1] = alone[-1, -1]
    once, twice = (MatchPrior.of_logits(logits, source, target) for logits in (alone, doubled))
    torch.testing.assert_close(twice.by_source, once.by_source)
    torch.testing.assert_close(twice.by_target, once.by_target)
    assert twice.source.shape == (4, 4)
