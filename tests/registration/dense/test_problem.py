from dataclasses import replace

import pytest
import torch

from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import walking_figure
from torchreg.geometry.neighbors import k_nearest
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import se3_exp
from torchreg.registration.dense.config import ScanAlignConfig
from torchreg.registration.dense.problem import describe

CONFIG = ScanAlignConfig(num_samples=400, num_target_samples=800, num_nodes=30)


@pytest.fixture(scope="module")
def pair():
    return walking_figure(3, scanner=DepthScanner(num_points=1500)).pair(0, 1)


@pytest.fixture(scope="module")
def problem(pair):
    return describe(pair.source, pair.target, CONFIG)


def test_samples_are_normalized_and_belong_to_the_scans(pair, problem):
    assert problem.unit.scale == pytest.approx(pair.source.diagonal, rel=0.3)
    assert float(problem.source.points.mean(0).norm()) < 1e-6
    torch.testing.assert_close(problem.unit.normalize(pair.source.points[problem.samples]), problem.graph.points)
    torch.testing.assert_close(problem.graph.points[0], problem.source.points[0])
    assert len(problem.nodes) == problem.graph.num_nodes == 30
    torch.testing.assert_close(problem.unit.normalize(pair.source.points[problem.nodes]), problem.graph.centers)
    assert len(problem.target) == 800


def test_frames_and_units_change_nothing(pair, problem):
    motion = se3_exp(torch.tensor([0.3, 2.0, -1.0, 0.5, 1.0, 2.0], dtype=torch.float64))
    motion[:3] = 7 * motion[:3]
    source, target = (scan.to(torch.float64).transformed(motion) for scan in (pair.source, pair.target))
    moved = describe(source, target, CONFIG)
    assert moved.unit.scale == pytest.approx(7 * problem.unit.scale, rel=1e-5)
    assert torch.equal(moved.samples, problem.samples)
    assert torch.equal(moved.nodes, problem.nodes)
    torch.testing.assert_close(moved.target.features, problem.target.features, rtol=0, atol=1e-3)


def test_samples_beside_what_hides_the_rest_are_cut_off(pair, problem):
    target = pair.target
    assert target.viewpoint is not None
    cut = problem.target.cut_off
    assert 0.02 < float(cut.double().mean()) < 0.3
    # An arm before the body leaves a shadow on it; where the body turns away, nothing is cut off.
    near = k_nearest(problem.target.points[cut], problem.unit.normalize(target.points[target.boundary]), 1)[1]
    assert float(near.max()) < 0.1
    unknown = RangeScan(target.points, target.faces, target.normals)
    guessed = describe(pair.source, unknown, CONFIG).target.cut_off
    assert float((guessed == cut).double().mean()) > 0.85
    none = describe(pair.source, target, replace(CONFIG, occluder_reach=0.0)).target.cut_off
    assert not none.any()


def test_a_whole_surface_is_not_cut_off(pair):
    ball = torch.nn.functional.normalize(torch.randn(900, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    whole = describe(pair.source, RangeScan(ball, normals=ball), CONFIG)
    assert not whole.target.cut_off.any()
    # Nor is there a side from which it was seen.
    assert whole.free is None


def test_moved_samples_are_those_of_the_graph(problem):
    rest = problem.moved(problem.graph.rest(), 7)
    torch.testing.assert_close(rest.points, problem.source.points[:7])
    torch.testing.assert_close(rest.features, problem.source.features[:7])
    assert len(problem.moved(problem.graph.rest())) == len(problem.moved(problem.graph.rest(), 9999)) == 400
