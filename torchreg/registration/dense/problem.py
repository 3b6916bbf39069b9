"""Two scans made comparable: one size and middle, even samples, and the graph that moves one."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.sampling import even_order
from torchreg.registration.dense.config import ScanAlignConfig
from torchreg.registration.dense.deformation_graph import DeformationGraph
from torchreg.registration.dense.match_prior import MatchPrior
from torchreg.registration.dense.node_graph import build_node_graph
from torchreg.registration.dense.oriented_samples import OrientedSamples
from torchreg.registration.dense.sample_graph import sample_graph
from torchreg.registration.normalization import Normalization

# What opposite normals count as where a point takes over from the samples around it, length.
NORMAL_SCALE = 0.03


@dataclass(frozen=True, eq=False)
class ExpectedPlaces:
    """Where points are expected.

    Args:
        places: (N, 3).
        std: how far each coordinate may be off, root mean square, in the unit of the places.
    """

    places: Tensor
    std: float


@dataclass(frozen=True, eq=False)
class ScanAlignProblem:
    """What alignment works on: float64 on the CPU, the source's middle at the origin and its size one.

    Args:
        graph: of the source's first samples, which it moves.
        source: samples of the source, evenly spread in any first few of them.
        target: samples of the target.
        config: how they are aligned.
        prior: what the matcher says of matches of the graph's samples and those of the target.
        samples: (S,) source points that are samples of the graph.
        nodes: (J,) source points that are nodes.
        unit: in which coordinates are given.
        expected: where the samples of the graph are expected; None if that is not known.
    """

    graph: DeformationGraph
    source: OrientedSamples
    target: OrientedSamples
    config: ScanAlignConfig
    prior: MatchPrior
    samples: Tensor
    nodes: Tensor
    unit: Normalization
    expected: ExpectedPlaces | None = None

    def moved(self, transforms: Tensor) -> OrientedSamples:
        """Return the samples of the graph where its nodes take them."""
        return self.source.first(len(self.samples)).moved(*self.graph.move_with_normals(transforms))


def describe(
    source: RangeScan,
    target: RangeScan,
    config: ScanAlignConfig,
    generator: torch.Generator | None = None,
    expected: ExpectedPlaces | None = None,
) -> ScanAlignProblem:
    """Return the problem of aligning two scans."""
    source_index, target_index = (
        scan.uniform_subsample(2 * config.num_samples, generator=generator) for scan in (source, target)
    )
    source_index, target_index = (
        source_index[even_order(source.points[source_index])],
        target_index[even_order(target.points[target_index])],
    )
    unit = Normalization.from_points(source.points[source_index])
    source_samples, target_samples = (
        OrientedSamples(
            unit.normalize(scan.points[which]), scan.normals[which].detach().cpu().double(), scan.boundary[which].cpu()
        )
        for scan, which in ((source, source_index), (target, target_index))
    )
    samples = source_index[: config.num_samples].cpu()
    faces = None if source.faces is None else source.faces.cpu()
    normals = source.normals.detach().cpu().double()
    geodesics = sample_graph(unit.normalize(source.points), samples, faces, normals=normals, normal_scale=NORMAL_SCALE)
    nodes = build_node_graph(geodesics, 0, config.num_nodes)
    graph = DeformationGraph(source_samples.points[: len(samples)], source_samples.normals[: len(samples)], nodes)
    at_samples = None
    if expected is not None:
        # The last sigma is as near as samples can be told apart.
        std = max(expected.std / unit.scale, config.refine.sigma[1])
        at_samples = ExpectedPlaces(unit.normalize(expected.places)[samples], std)
    return ScanAlignProblem(
        graph=graph, source=source_samples, target=target_samples, config=config,
        prior=MatchPrior.of_samples(source_samples, target_samples, len(samples)),
        samples=samples, nodes=samples[nodes.nodes], unit=unit, expected=at_samples,
    )  # fmt: skip
