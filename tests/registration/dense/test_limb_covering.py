import pytest
import torch

from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import walking_animal, walking_figure
from torchreg.registration.dense.align_scans import align_scans
from torchreg.registration.dense.config import ScanAlignConfig
from torchreg.registration.dense.graph_limbs import Limbs, shift_onto
from torchreg.registration.dense.limb_covering import covering_limbs
from torchreg.registration.dense.problem import describe

CONFIG = ScanAlignConfig(num_samples=600, num_target_samples=1200, num_nodes=40)


@pytest.fixture(scope="module")
def pair():
    """A walking person with the legs apart, seen twice in about the same pose."""
    return walking_figure(14, scanner=DepthScanner(num_points=4500)).pair(0, 1)


@pytest.fixture(scope="module")
def problem(pair):
    return describe(pair.source, pair.target, CONFIG)


def legs_together(problem, left, right):
    """Return motions (J, 4, 4) that lay the left leg on the right one."""
    limbs, points = Limbs.of(problem.graph), problem.graph.points
    ends = [int(limbs.levels[:, leg].mean(1).argmin()) for leg in (left, right)]
    shift = shift_onto(points, limbs.levels[ends[0]], points, limbs.levels[ends[1]], 0.35)
    return limbs.laid(problem.graph.rest(), points + shift)


def test_a_leg_laid_on_the_other_returns_to_its_own(problem, pair, lower_legs):
    left, right = lower_legs(problem, pair)
    wrong = legs_together(problem, left, right)
    places, truth = problem.graph(wrong), problem.unit.normalize(pair.truth)[problem.samples]
    astray = (places - truth)[left].mean(0).norm()
    assert float((places - truth)[right].mean(0).norm()) < 0.2 * float(astray)
    options = [problem.graph(motion) for motion in covering_limbs(problem, wrong, CONFIG.choice)]
    # One leg or the other may cover what is bare; that one does, and all else stays, is what starts must offer.
    off = torch.stack([(option - truth)[left].mean(0).norm() for option in options])
    assert float(off.min()) < 0.4 * float(astray)
    others = ~(left | right)
    assert float((options[int(off.argmin())] - places)[others].norm(dim=-1).median()) < 0.01


def test_what_is_covered_needs_no_limb(problem, pair):
    same = describe(pair.source, pair.source, CONFIG)
    assert covering_limbs(same, same.graph.rest(), CONFIG.choice) == []


def test_limbs_that_are_far_away_stay_there(problem):
    away = problem.graph.rest()
    away[:, 0, 3] = 2.0
    assert covering_limbs(problem, away, CONFIG.choice) == []


def test_legs_that_lay_on_one_leg_of_the_target_come_apart():
    pair = walking_animal(12, scanner=DepthScanner(num_points=4500)).pair(7, 11)
    found = align_scans(pair.source, pair.target)
    assert found.chosen.name == "covering"
    off = (found.points - pair.truth).norm(dim=-1) / pair.source.diagonal
    assert float((off < 0.025).double().mean()) > 0.95
