"""Problems of two scans: what they hold, how motions are judged, fused from several and trusted."""

import math
from dataclasses import replace

import pytest
import torch

from experiments.made_up.walks import walking_animal, walking_figure
from torchreg.geometry.rigid import se3_exp
from torchreg.registration.dense.align_scans import align_scans
from torchreg.registration.dense.fusion import fuse_motions
from torchreg.registration.dense.graph_fit import GraphMatches, fit_graph
from torchreg.registration.dense.problem import ExpectedPlaces, describe
from torchreg.registration.dense.reliability import SCAN_CALIBRATION, confidence_of, judge


def test_samples_are_normalized_and_belong_to_the_scans(pair, problem):
    assert problem.unit.scale == pytest.approx(pair.source.diagonal, rel=0.3)
    assert float(problem.source.points.mean(0).norm()) < 1e-6
    torch.testing.assert_close(problem.unit.normalize(pair.source.points[problem.samples]), problem.graph.points)
    torch.testing.assert_close(problem.unit.normalize(pair.source.points[problem.nodes]), problem.graph.centers)
    assert (len(problem.nodes), len(problem.target)) == (40, 800)
    rest = problem.moved(problem.graph.rest())
    torch.testing.assert_close(rest.points, problem.source.points[:400])
    torch.testing.assert_close(rest.normals, problem.source.normals[:400])


def test_frames_and_units_change_nothing(pair, problem, quick):
    motion = se3_exp(torch.tensor([0.3, 2.0, -1.0, 0.5, 1.0, 2.0], dtype=torch.float64))
    motion[:3] = 7 * motion[:3]
    moved = describe(*(scan.to(torch.float64).transformed(motion) for scan in (pair.source, pair.target)), quick)
    assert moved.unit.scale == pytest.approx(7 * problem.unit.scale, rel=1e-5)
    assert torch.equal(moved.samples, problem.samples)
    assert torch.equal(moved.nodes, problem.nodes)


def capped(prior, points, others, cap):
    """Return the mean of squared distances, in caps, at most one, of what is visible with a probability."""
    apart = torch.cdist(points, others).amin(1) / cap
    return float((prior * apart.clamp(max=1).square()).mean())


@pytest.mark.parametrize("shift", [0.0, 0.02, 10.0])
def test_judged_are_distances_both_ways_what_the_graph_bends_and_leaps(problem, quick, shift):
    motions = problem.graph.rest()
    motions[::3, 0, 3] += shift
    motions[..., 2, 3] += shift
    moved, prior = problem.moved(motions).points, problem.prior
    found = judge(problem, "some", motions)
    evidence, visible, shown = found.evidence, prior.visible[:400], prior.target_visible
    costs = (
        capped(visible, moved, problem.target.points, quick.cap),
        capped(shown, problem.target.points, moved, quick.cap),
    )
    for cost, of, seen in zip(costs, (evidence.forward, evidence.backward), (visible, shown), strict=True):
        assert of == pytest.approx(cost / float(seen.mean()))
    assert evidence.smoothness == pytest.approx(quick.smoothness * float(problem.graph.smoothness(motions)))
    nearest = torch.cdist(moved, problem.target.points).argmin(1)
    support = prior.logarithm(nearest[:, None], quick.doubt)[:, 0]
    assert evidence.unsupported == pytest.approx(-float((visible * support).sum() / visible.sum()))
    assert evidence.hidden == pytest.approx(1 - float(visible.mean()))
    assert (found.name, found.deviation) == ("some", 0)
    assert confidence_of(evidence) == pytest.approx(1 - 1 / (1 + math.exp(-found.energy)))
    # A leap costs its squared distance in three stds, at most one.
    for distance, cost in ((0.0, 0.0), (0.015, 0.25), (0.03, 1.0), (7.0, 1.0)):
        away = ExpectedPlaces(moved + distance * torch.tensor([0.6, 0.0, -0.8]).double(), 0.01)
        leap = judge(replace(problem, expected=away), "", motions)
        assert leap.deviation == pytest.approx(cost, rel=1e-6)
        assert leap.energy == pytest.approx(found.energy + SCAN_CALIBRATION.deviation * cost)


@pytest.fixture(scope="module")
def halves(scanner, quick):
    """A problem, the true motion, and two motions that are true in one half each and off in the other."""
    pair = walking_figure(6, scanner=scanner).pair(0, 5)
    problem = describe(pair.source, pair.target, quick)
    graph, truth = problem.graph, problem.unit.normalize(pair.truth[problem.samples])
    right = fit_graph(graph, graph.rest(), GraphMatches.of_places(truth), 0.01, num_steps=8).transforms
    off = se3_exp(torch.tensor([0.0, 0.0, 0.1, 0.0, 0.0, 0.0], dtype=torch.float64)) @ right
    axis = (graph.centers - graph.centers.mean(0)).square().sum(0).argmax()
    upper = (graph.centers[:, axis] > graph.centers[:, axis].median())[:, None, None]
    return problem, right, torch.stack([torch.where(upper, right, off), torch.where(upper, off, right)])


def test_each_part_moves_as_where_it_is_right(halves):
    problem, right, options = halves
    for given in (options, options.flip(0)):
        fused = fuse_motions(problem, given)
        assert float((fused == right).all((1, 2)).double().mean()) > 0.9
    least, energy, *energies = (judge(problem, "", motion).energy for motion in (right, fused, *options))
    # Nearly all that could be gained is, whatever the truth itself costs.
    assert energy - least < 0.1 * (min(energies) - least)
    for nothing_better in (right[None], torch.stack([right, right]), torch.stack([right, *options])):
        assert torch.equal(fuse_motions(problem, nothing_better), right)


def test_alignments_of_one_thing_are_trusted_and_of_two_are_not(pair, aligned, scanner, quick):
    other = walking_animal(2, scanner=scanner)[0]
    wrong = align_scans(pair.source, other, quick).confidence
    assert 0 < wrong < 0.3
    assert 0.7 < aligned.confidence < 1
    lifted = pair.target.shifted(torch.tensor([0.0, 0.0, 0.1]) * pair.source.diagonal)
    assert align_scans(pair.source, lifted, quick).confidence == pytest.approx(aligned.confidence, abs=0.2)
