from dataclasses import replace

import pytest
import torch

from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import walking_figure
from torchreg.geometry.rigid import se3_exp
from torchreg.registration.dense.config import (
    ChoiceConfig,
    EMConfig,
    ScanAlignConfig,
)
from torchreg.registration.dense.oriented_samples import OrientedSamples
from torchreg.registration.dense.problem import describe
from torchreg.registration.dense.stages import (
    Reporter,
    agree,
    deviations,
    judge,
    mismatch,
    refine,
)

CONFIG = ScanAlignConfig(num_samples=400, num_target_samples=800, num_nodes=30)


@pytest.fixture(scope="module")
def pair():
    return walking_figure(3, scanner=DepthScanner(num_points=1500)).pair(0, 1)


@pytest.fixture(scope="module")
def problem(pair):
    return describe(pair.source, pair.target, CONFIG)


@pytest.fixture
def reporter():
    records = []
    return Reporter("some", 2.0, records.append), records


def residual(pair, problem, transforms):
    truth = problem.unit.normalize(pair.truth[problem.samples])
    return (problem.graph(transforms) - truth).norm(dim=-1)


def test_steps_come_nearer_and_report(pair, problem, reporter):
    rest = problem.graph.rest()
    moved = refine(problem, rest, EMConfig(num_steps=4), reporter[0])
    assert float(residual(pair, problem, moved).mean()) < float(residual(pair, problem, rest).mean())
    assert len(reporter[1]) == 4
    widths = [record.width for record in reporter[1]]
    assert widths == sorted(widths, reverse=True)
    assert (widths[0], widths[-1]) == pytest.approx((2 * 0.02, 2 * 0.006))
    assert all(record.hypothesis == "some" and record.stage == "refine" for record in reporter[1])


def test_small_sigmas_use_more_samples(problem):
    few = replace(problem, config=replace(CONFIG, density=0.1, least_samples=50))
    assert [few.num_used(sigma) for sigma in (0.1, 0.02, 0.001)] == [50, 250, 100000]
    assert len(few.moved(few.graph.rest(), few.num_used(0.001))) == 400


def test_a_near_start_begins_with_a_smaller_sigma(problem, reporter):
    refine(problem, problem.graph.rest(), EMConfig(num_steps=3), reporter[0], 0.01)
    assert [record.width for record in reporter[1]] == pytest.approx([0.02, 2 * 0.006**0.5 * 0.1, 0.012])


def test_samples_without_a_match_stay_about_where_they_are_expected(problem, reporter):
    rest = problem.graph.rest()
    shift = torch.tensor([0.02, -0.01, 0.03], dtype=torch.float64)
    waiting = replace(problem, expected=problem.graph(rest) + shift)
    # Nothing is matched by a sigma so small; when all is matched, next to nothing holds it.
    alone = EMConfig(num_steps=4, sigma=(1e-4, 1e-4))
    held = refine(waiting, rest, alone, reporter[0])
    torch.testing.assert_close(problem.graph(held), waiting.expected, rtol=0, atol=1e-3)
    free = problem.graph(refine(waiting, rest, replace(alone, expected=0.0), reporter[0]))
    assert float((free - problem.graph(rest)).norm(dim=-1).median()) < 0.1 * float(shift.norm())
    matched = EMConfig(num_steps=4)
    plain, aware = (problem.graph(refine(each, rest, matched, reporter[0])) for each in (problem, waiting))
    assert float((plain - aware).norm(dim=-1).median()) < 0.1 * float(shift.norm())


def test_leaps_cost_their_distance_up_to_a_cap(problem):
    config, rest = ChoiceConfig(deviation=2.0, deviation_cap=0.1), problem.graph.rest()
    places = problem.graph(rest)
    assert float(deviations(problem, places, config).max()) == 0
    for distance, cost in ((0.0, 0.0), (0.05, 0.5), (0.1, 2.0), (7.0, 2.0)):
        away = replace(problem, expected=places + distance * torch.tensor([0.6, 0.0, -0.8]))
        torch.testing.assert_close(deviations(away, places, config), torch.full_like(places[:, 0], cost))
        assert judge(away, "", rest, config).deviation == pytest.approx(cost)


def test_better_hypotheses_are_judged_better(problem, reporter):
    rest = problem.graph.rest()
    moved = refine(problem, rest, EMConfig(num_steps=4), reporter[0])
    config = ChoiceConfig()
    still, better = judge(problem, "still", rest, config), judge(problem, "better", moved, config)
    assert better.energy < still.energy
    assert still.smoothness == 0
    assert still.energy == pytest.approx(still.forward + still.backward)
    far = rest.clone()
    far[:, :3, 3] += 10
    lost = judge(problem, "lost", far, config)
    # Where nothing lies on the target, features are as unlike as they usually are.
    assert (lost.forward, lost.backward) == (pytest.approx(1 + 0.4 * config.feature_distance), 1)


def test_likeness_counts_where_surfaces_meet(problem):
    config, target = ChoiceConfig(), problem.target
    assert float(mismatch(problem, target, config)[0].max()) == 0
    other = OrientedSamples(target.points, target.normals, target.features + 0.05, target.boundary)
    alike = target.features.shape[1] * 0.05**2
    torch.testing.assert_close(mismatch(problem, other, config)[0], torch.full_like(target.points[:, 0], 2 * alike))
    # Neither what is unlike nor what is away costs more than what leaves the target.
    for features, places in ((10, 0), (0, 10), (10, 10)):
        outlier = OrientedSamples(target.points + places, target.normals, target.features + features, target.boundary)
        cost, _ = mismatch(problem, outlier, config)
        torch.testing.assert_close(cost, torch.full_like(cost, 1 + 0.4 * config.feature_distance))


def test_hypotheses_agree_where_nearly_all_samples_do(problem):
    rest, config = problem.graph.rest(), ChoiceConfig()
    whole = se3_exp(torch.tensor([0.003, 0, 0, 0, 0, 0], dtype=torch.float64)).expand_as(rest)
    assert agree(problem, rest, whole, config)
    one = rest.clone()
    one[3, 0, 3] += 0.05
    assert not agree(problem, rest, one, ChoiceConfig(same_share=1.0))
    assert not agree(problem, rest, 3 * whole - 2 * rest, config)
