import pytest
import torch

from experiments.made_up.walks import walking_figure
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.geometry.rigid import se3_exp
from torchreg.registration.dense.config import ScanAlignConfig
from torchreg.registration.dense.problem import describe

CONFIG = ScanAlignConfig(num_samples=400, num_nodes=30)


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


def test_moved_samples_are_those_of_the_graph(problem):
    rest = problem.moved(problem.graph.rest())
    torch.testing.assert_close(rest.points, problem.source.points[:400])
    torch.testing.assert_close(rest.normals, problem.source.normals[:400])
