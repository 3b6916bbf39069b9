import math

import pytest
import torch

from torchreg.errors import InputError
from torchreg.registration.dense.e_step import match_softly
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
    outlier = 0.3 * max(1.0, 2 * 15 * sigma**2)
    chosen = likelihood / (likelihood.sum(1, keepdim=True) + outlier)
    found = match_softly(source, target, sigma, normal_weight=3.0, outliers=0.3, num_candidates=20)
    torch.testing.assert_close(found.posterior, chosen.sum(1))
    torch.testing.assert_close(found.targets, chosen @ target.points / chosen.sum(1, keepdim=True))
    normals = torch.nn.functional.normalize(chosen @ target.normals, dim=-1)
    torch.testing.assert_close(found.normals, normals)


def test_few_candidates_are_nearly_all():
    source, target = samples(60, 0, 0.3), samples(80, 1, 0.3)
    few = match_softly(source, target, 0.03)
    every = match_softly(source, target, 0.03, num_candidates=80)
    torch.testing.assert_close(few.posterior, every.posterior, rtol=0, atol=2e-2)


def test_motion_and_order_change_nothing():
    source, target = samples(30, 0), samples(40, 1)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2), dtype=F64))[0]
    plain = match_softly(source, target, 0.04)
    moved = [each.moved(each.points @ turn.mT + 2, each.normals @ turn.mT) for each in (source, target)]
    turned = match_softly(*moved, 0.04)
    torch.testing.assert_close(turned.posterior, plain.posterior)
    torch.testing.assert_close(turned.targets, plain.targets @ turn.mT + 2)
    order = torch.randperm(40, generator=torch.Generator().manual_seed(3))
    shuffled = OrientedSamples(target.points[order], target.normals[order], target.boundary[order])
    torch.testing.assert_close(match_softly(source, shuffled, 0.04).posterior, plain.posterior)


def test_far_samples_are_outliers_that_stay():
    source = samples(5, 0)
    far = source.moved(source.points + 50, source.normals)
    found = match_softly(source, far, 0.02)
    assert float(found.posterior.max()) == 0
    torch.testing.assert_close(found.targets, source.points)
    assert bool(found.normals.isfinite().all())


def test_exact_matches_are_sure():
    source = samples(20, 0, 1.0)
    found = match_softly(source, source, 0.01, outliers=0.1)
    assert float(found.posterior.min()) > 0.9
    assert float(found.posterior.max()) <= 1
    torch.testing.assert_close(found.targets, source.points, rtol=0, atol=1e-3)


def test_bad_input_is_named():
    with pytest.raises(InputError, match="sigma must be positive"):
        match_softly(samples(4, 0), samples(4, 1), 0.0)


def test_hidden_samples_are_matched_by_their_odds():
    source, target = samples(60, 0), samples(80, 1)
    plain = match_softly(source, target, 0.05, outliers=0.3)
    sure = match_softly(source, target, 0.05, outliers=0.3, visible=torch.ones(60, dtype=torch.float64))
    torch.testing.assert_close(sure.posterior, plain.posterior)
    visible = torch.linspace(0, 1, 60, dtype=torch.float64)
    found = match_softly(source, target, 0.05, outliers=0.3, visible=visible)
    # Bayes' rule on the odds of an outlier, those of a surely visible sample being known.
    odds = (1 - plain.posterior) / plain.posterior
    expected = 1 / (1 + odds * ((1 + 0.3) / visible - 1) / 0.3)
    torch.testing.assert_close(found.posterior[1:], expected[1:])
    assert float(found.posterior[0]) < 1e-9
    assert bool(found.targets.isfinite().all())
