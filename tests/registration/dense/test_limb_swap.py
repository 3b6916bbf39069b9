import pytest
import torch

from torchreg.datasets.bodies import Proportions
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import walking_figure
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.dense.align_scans import align_scans
from torchreg.registration.dense.config import ScanAlignConfig
from torchreg.registration.dense.limb_swap import exchanged_limbs
from torchreg.registration.dense.problem import describe

CONFIG = ScanAlignConfig(num_samples=600, num_target_samples=1200, num_nodes=40)


@pytest.fixture(scope="module")
def pair():
    """A walking person whose legs pass each other between two scans."""
    return walking_figure(12, scanner=DepthScanner(num_points=4500)).pair(3, 7)


@pytest.fixture(scope="module")
def problem(pair):
    return describe(pair.source, pair.target, CONFIG)


def test_limbs_lie_where_the_others_lay(problem, pair, lower_legs):
    rest = problem.graph.rest()
    left, right = lower_legs(problem, pair)
    assert int(left.sum()) > 10
    assert int(right.sum()) > 10
    places = problem.graph(rest)
    middles = places[left].mean(0), places[right].mean(0)
    apart = (middles[0] - middles[1]).norm()
    off = [
        max((moved[left].mean(0) - middles[1]).norm(), (moved[right].mean(0) - middles[0]).norm()) / apart
        for moved in (problem.graph(motion) for motion in exchanged_limbs(problem, rest))
    ]
    assert float(min(off)) < 0.4
    # All else stays about where it was.
    moved = problem.graph(exchanged_limbs(problem, rest)[int(torch.stack(off).argmin())])
    others = ~(left | right)
    assert float((moved - places)[others].norm(dim=-1).median()) < 0.01


def test_turning_everything_turns_the_exchange(problem):
    whole = se3_exp(torch.tensor([0.3, -0.2, 0.1, 0.5, 0.4, -0.6], dtype=torch.float64))
    rest = problem.graph.rest()
    plain, turned = exchanged_limbs(problem, rest), exchanged_limbs(problem, whole @ rest)
    assert len(plain) > 0
    for one, other in zip(plain, turned, strict=True):
        expected = transform_points(whole, problem.graph(one))
        torch.testing.assert_close(problem.graph(other), expected, rtol=0, atol=1e-6)


def test_limbs_that_lie_far_from_each_other_keep_their_places(problem):
    spread = problem.graph.rest()
    spread[:, :3, 3] = 20 * problem.graph.centers
    assert exchanged_limbs(problem, spread) == []


def test_legs_that_passed_each_other_find_their_places(pair):
    found = align_scans(pair.source, pair.target)
    assert found.chosen.name == "exchanged"
    off = (found.points - pair.truth).norm(dim=-1) / pair.source.diagonal
    assert float((off < 0.025).double().mean()) > 0.95


def test_limbs_are_chosen_as_matches_pull_them_not_as_they_are_laid():
    # Long legs: laid roughly, the right exchange of this one looks worse than a wrong one.
    build = Proportions(legs=1.23, arms=1.02, trunk=0.78, shoulders=0.96, hips=1.3, belly=0.95, limbs=1.12, head=0.91)
    pair = walking_figure(8, seed=105, proportions=build, scanner=DepthScanner(num_points=4500)).pair(1, 6)
    found = align_scans(pair.source, pair.target)
    assert found.chosen.name == "exchanged"
    assert float((pair.error(found.points) < 0.025).double().mean()) > 0.9


def test_without_limbs_there_is_nothing_to_exchange():
    across = torch.linspace(-1, 1, 20)
    x, y = (value.flatten() for value in torch.meshgrid(across, across, indexing="ij"))
    points = torch.stack((x, y, 0.5 * (x.square() + y.square())), dim=1)
    scan = RangeScan(points, normals=torch.nn.functional.normalize(torch.stack((-x, -y, torch.ones_like(x)), 1), dim=1))
    few = describe(scan, scan, ScanAlignConfig(num_samples=200, num_target_samples=200, num_nodes=1))
    assert exchanged_limbs(few, few.graph.rest()) == []
    # Limbs of a sample or two are none.
    tiny = describe(scan, scan, ScanAlignConfig(num_samples=12, num_target_samples=200, num_nodes=6))
    assert exchanged_limbs(tiny, tiny.graph.rest()) == []
