from dataclasses import replace

import pytest
import torch

from experiments.made_up.walks import walking_figure
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.geometry.rigid import se3_exp
from torchreg.registration.dense.config import ScanAlignConfig
from torchreg.registration.dense.problem import ExpectedPlaces, describe
from torchreg.registration.dense.stages import (
    Reporter,
    agree,
    deviations,
    judge,
    mismatch,
    refine,
    uncovered,
)

CONFIG = ScanAlignConfig(num_samples=400, num_nodes=30)


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
    moved = refine(problem, rest, reporter[0])
    assert float(residual(pair, problem, moved).mean()) < float(residual(pair, problem, rest).mean())
    assert [record.step for record in reporter[1]] == list(range(20))
    widths = [record.width for record in reporter[1]]
    assert widths == sorted(widths, reverse=True)
    assert (widths[0], widths[-1]) == pytest.approx((2 * 0.02, 2 * 0.006))
    assert all(record.hypothesis == "some" and record.stage == "refine" for record in reporter[1])


def test_leaps_cost_their_distance_up_to_a_cap(problem):
    rest = problem.graph.rest()
    places = problem.graph(rest)
    assert float(deviations(problem, places).max()) == 0
    for distance, cost in ((0.0, 0.0), (0.015, 0.25), (0.03, 1.0), (7.0, 1.0)):
        away = replace(problem, expected=ExpectedPlaces(places + distance * torch.tensor([0.6, 0.0, -0.8]), 0.01))
        torch.testing.assert_close(deviations(away, places), torch.full_like(places[:, 0], cost))
        assert judge(away, "", rest).deviation == pytest.approx(cost)


def test_better_hypotheses_are_judged_better(problem, reporter):
    rest = problem.graph.rest()
    moved = refine(problem, rest, reporter[0])
    still, better = judge(problem, "still", rest), judge(problem, "better", moved)
    assert better.energy < still.energy
    assert still.smoothness == 0
    assert still.energy == pytest.approx(still.forward + still.backward)
    far = rest.clone()
    far[:, :3, 3] += 10
    lost = judge(problem, "lost", far)
    # As much as each scan shows the other.
    prior = problem.prior
    assert lost.forward == pytest.approx(float(prior.visible[: len(problem.samples)].mean()))
    assert lost.backward == pytest.approx(float(prior.target_visible.mean()))


def test_distances_from_the_target_count_up_to_a_cap(problem):
    visible = problem.prior.visible
    target = problem.target.first(len(visible))
    cost, index = mismatch(problem, target)
    assert float(cost.max()) == 0
    assert torch.equal(index, torch.arange(len(target)))
    assert float(uncovered(problem, problem.target).max()) == 0
    above = target.moved(target.points + torch.tensor([0.0, 0.0, 10.0]), target.normals)
    torch.testing.assert_close(mismatch(problem, above)[0], visible)
    torch.testing.assert_close(uncovered(problem, above), problem.prior.target_visible)


def test_hypotheses_agree_up_to_the_last_sigma(problem):
    rest = problem.graph.rest()
    whole = se3_exp(torch.tensor([0.003, 0, 0, 0, 0, 0], dtype=torch.float64)).expand_as(rest)
    assert agree(problem, rest, whole)
    assert not agree(problem, rest, 3 * whole - 2 * rest)
    one = rest.clone()
    one[3, 0, 3] += 0.3
    assert not agree(problem, rest, one)
