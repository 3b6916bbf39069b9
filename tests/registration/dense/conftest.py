"""Two scans of a walking figure, their alignment and the problem behind it; graphs of random points."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from experiments.made_up.walks import walking_figure
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.registration.dense.align_scans import align_scans
from torchreg.registration.dense.deformation_graph import DeformationGraph
from torchreg.registration.dense.node_graph import build_node_graph
from torchreg.registration.dense.problem import describe
from torchreg.registration.dense.sample_graph import sample_graph


@pytest.fixture(scope="session")
def scanner():
    return DepthScanner(num_points=1000)


@pytest.fixture(scope="session")
def quick():
    config = tr.RegisterConfig().align
    return replace(config, num_samples=400, num_nodes=40, refine=replace(config.refine, num_steps=12))


@pytest.fixture(scope="session")
def pair(scanner):
    return walking_figure(3, scanner=scanner).pair(0, 1)


@pytest.fixture(scope="session")
def aligned(pair, quick):
    return align_scans(pair.source, pair.target, quick)


@pytest.fixture(scope="session")
def problem(pair, quick):
    return describe(pair.source, pair.target, quick)


@pytest.fixture(scope="session")
def graph_of():
    """Return the function from points and normals to their graph of so many nodes."""

    def make(points, normals, num_nodes, nearest=3):
        joined = sample_graph(points, torch.arange(len(points)))
        return DeformationGraph(points, normals, build_node_graph(joined, 0, num_nodes, nearest))

    return make
