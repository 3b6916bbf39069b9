from dataclasses import replace

import pytest
import torch

from experiments.made_up.walks import walking_figure
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.geometry.rigid import se3_exp
from torchreg.registration.dense.config import ScanAlignConfig
from torchreg.registration.dense.fusion import _Energy, fuse_motions
from torchreg.registration.dense.graph_fit import GraphMatches, fit_graph
from torchreg.registration.dense.problem import describe
from torchreg.registration.dense.stages import judge

CONFIG = ScanAlignConfig(num_samples=400, num_nodes=30)


@pytest.fixture(scope="module")
def problem():
    pair = walking_figure(6, scanner=DepthScanner(num_points=1500)).pair(0, 5)
    return describe(pair.source, pair.target, CONFIG), pair


@pytest.fixture(scope="module")
def halves(problem):
    """The true motion, and two motions that are true in one half each and off in the other."""
    scans, pair = problem
    truth = scans.unit.normalize(pair.truth[scans.samples])
    matches = GraphMatches.of_places(truth)
    right = fit_graph(scans.graph, scans.graph.rest(), matches, 0.01, num_steps=8).transforms
    off = se3_exp(torch.tensor([0.0, 0.0, 0.1, 0.0, 0.0, 0.0], dtype=torch.float64)) @ right
    axis = (scans.graph.centers - scans.graph.centers.mean(0)).square().sum(0).argmax()
    upper = (scans.graph.centers[:, axis] > scans.graph.centers[:, axis].median())[:, None, None]
    return right, torch.stack([torch.where(upper, right, off), torch.where(upper, off, right)])


def test_each_part_moves_as_where_it_is_right(problem, halves):
    right, options = halves
    fused = fuse_motions(problem[0], options)
    assert float((fused == right).all((1, 2)).double().mean()) > 0.9
    least, energy, *energies = (judge(problem[0], "", motion).energy for motion in (right, fused, *options))
    # Nearly all that could be gained is, whatever the truth itself costs.
    assert energy - least < 0.1 * (min(energies) - least)
    assert energy < 0.7 * min(energies)


def test_the_order_of_the_hypotheses_hardly_matters(problem, halves):
    one, other = (fuse_motions(problem[0], options) for options in (halves[1], halves[1].flip(0)))
    assert float((one == other).all((1, 2)).double().mean()) > 0.9


def test_what_nothing_improves_is_left(problem, halves):
    right, options = halves
    assert torch.equal(fuse_motions(problem[0], right[None]), right)
    assert torch.equal(fuse_motions(problem[0], torch.stack([right, right])), right)
    assert torch.equal(fuse_motions(problem[0], torch.stack([right, *options])), right)


def test_of_one_hypothesis_alone_the_energy_is_that_of_the_choice(problem, halves):
    scans, options = problem[0], halves[1]
    for smoothness in (CONFIG.smoothness, 0.0):
        scans = replace(scans, config=replace(CONFIG, smoothness=smoothness))
        energy = _Energy.of(scans, options)
        labels = torch.arange(2)[:, None].expand(2, scans.graph.num_nodes)
        judged = [judge(scans, "", option).energy for option in options]
        # Of the targets only some are looked at.
        torch.testing.assert_close(energy(labels), torch.tensor(judged).to(options), rtol=0.05, atol=0)


def test_what_a_motion_leaves_uncovered_counts_once_however_far_it_is(problem, halves):
    scans, options = problem[0], halves[1]
    energy = _Energy.of(scans, options)
    assert float(energy.cover.max()) <= 1
    far = options.clone()
    far[:, :, :3, 3] += 100
    assert float(_Energy.of(scans, far).cover.min()) == 1
