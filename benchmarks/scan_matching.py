"""How often the learnt matcher of scans is right, and what an alignment that keeps its matches makes of them.

Pairs of kinds that the matcher never saw in training, and with --data those of its folder ``range_pairs``. By group:

- right: share of visible tokens whose best match lies within 5 % of the diagonal of the truth,
- hidden: recall and precision of tokens called hidden,
- error and registered of a dense alignment (before bones) by one EM in which the matcher's posterior is the prior of
  every match: a pair counts as registered when 90 % of its points end within 2.5 % of the diagonal of the truth,
- the same with the matches of the truth, which tells what the matcher and what the alignment leave to be done.

    python benchmarks/scan_matching.py                       # --smoke: one pair of each kind, in seconds
    python benchmarks/scan_matching.py --data SHARED/data
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import torchreg as tr
from torchreg.datasets.creature_kinds import HELD_OUT_KINDS
from torchreg.datasets.matching_pairs import matching_pairs
from torchreg.geometry.neighbors import k_nearest
from torchreg.registration.annealing import geometric_at
from torchreg.registration.blend import blend_linear
from torchreg.registration.dense.config import ScanAlignConfig
from torchreg.registration.dense.graph_fit import GraphMatches, fit_graph
from torchreg.registration.dense.node_graph import spread_weights
from torchreg.registration.dense.problem import NORMAL_SCALE, ScanAlignProblem, describe
from torchreg.registration.dense.scan_matcher import ScanMatcher, match_probabilities
from torchreg.registration.dense.scan_tokens import SIZES, ScanTokens

# A match is right, and a place is visible, within these shares of the diagonal.
RIGHT, VISIBLE = 0.05, 0.03


@dataclass(frozen=True)
class Pair:
    """Two scans and the truth (N, 3) of the source's points."""

    group: str
    source: tr.RangeScan
    target: tr.RangeScan
    truth: Tensor


@dataclass(frozen=True)
class KeptMatches:
    """An EM that keeps the matcher's posterior as the prior of matches; first and last values, lengths in sizes."""

    num_steps: int = 24
    sigma: tuple[float, float] = (0.35, 0.006)  # from the motion of a limb to the noise
    stiffness: tuple[float, float] = (1.0, 0.006)  # of the deformation graph
    give: tuple[float, float] = (0.03, 0.01)  # by which joints may disagree
    slide: tuple[float, float] = (1.0, 0.03)  # along the surface, in the second half
    normal_weight: float = 3.0  # exponent lost at right angles, at the end
    floor: tuple[float, float] = (4e-4, 0.02)  # prior of any match of a visible point: the matcher may err
    outlier: float = 0.03  # of the mass of a sample in the middle of its matches

    def align(self, problem: ScanAlignProblem, probability: Tensor, hidden: Tensor) -> Tensor:
        """Return motions (J, 4, 4) from probabilities (S, T) of token pairs and of hidden tokens (S,)."""
        source, target = problem.source, problem.target
        to_tokens = shares(source.points[: len(problem.samples)], source.points[: len(probability)])
        from_tokens = shares(target.points, target.points[: probability.shape[1]])
        prior, visible = to_tokens @ probability, to_tokens @ (1 - hidden)
        transforms = problem.graph.rest()
        for step in range(self.num_steps):
            share = step / (self.num_steps - 1)
            sigma = geometric_at(self.sigma, share)
            count = min(len(problem.samples), max(300, round(0.3 / sigma**2)))
            seen = min(len(target), max(500, round(0.6 / sigma**2)))
            floor = geometric_at(self.floor, share) * visible[:count, None]
            pair_prior = prior[:count] @ from_tokens[:seen].mT + floor
            matches = self._matches(problem, transforms, pair_prior, sigma, share)
            stiffness, give = geometric_at(self.stiffness, share), geometric_at(self.give, share)
            transforms = fit_graph(problem.graph, transforms, matches, stiffness, give=give).transforms
        return transforms

    def _matches(
        self, problem: ScanAlignProblem, transforms: Tensor, prior: Tensor, sigma: float, share: float
    ) -> GraphMatches:
        """Return the expected matches of the first samples: the E-step."""
        (count, seen), target = prior.shape, problem.target
        moved, normals = problem.graph.move_with_normals(transforms, slice(0, count))
        exponent = -torch.cdist(moved, target.points[:seen]).square() / (2 * sigma**2)
        exponent = exponent - self.normal_weight * share * (1 - normals @ target.normals[:seen].mT)
        mass = prior * exponent.exp()
        if sigma < ScanAlignConfig().refine.boundary_above:
            mass = mass * ~target.boundary[:seen]
        # In the middle of a surface a sample has about this many others within its reach.
        outlier = self.outlier * min(max(1.0, 2 * seen * sigma**2), seen / 20)
        choice = mass / (mass.sum(1, keepdim=True) + outlier)
        if sigma > ScanAlignConfig().refine.both_ways_above:
            choice = choice + mass / (mass.sum(0) + outlier) * (count / seen)
        weights = choice.sum(1)
        targets = torch.where(weights[:, None] > 0, choice @ target.points[:seen] / weights[:, None], moved)
        facing = torch.nn.functional.normalize(choice @ target.normals[:seen], dim=1)
        slide = geometric_at(self.slide, max(0.0, 2 * share - 1))
        return GraphMatches(slice(0, count), targets, weights, facing, slide)


def shares(points: Tensor, tokens: Tensor) -> Tensor:
    """Return by how much points (N, 3) belong to tokens (T, 3), (N, T): to the three nearest, rows sum to one."""
    index, distance = k_nearest(points, tokens, 3)
    weights = 1 / (distance + 0.25 * distance.mean())
    weights = (weights / weights.sum(1, keepdim=True)).to(points)
    return points.new_zeros(len(points), len(tokens)).scatter_(1, index, weights)


def moved_points(problem: ScanAlignProblem, transforms: Tensor, scan: tr.RangeScan) -> Tensor:
    """Return all points (N, 3) of the source where the graph takes them."""
    graph, points = problem.graph, problem.unit.normalize(scan.points)
    surface = (points, scan.normals.double(), graph.points, graph.normals)
    weights = spread_weights(*surface, graph.dense_weights, NORMAL_SCALE)
    return problem.unit.denormalize(blend_linear(points, weights, transforms), scan.points)


@torch.no_grad()
def measured(pair: Pair, matcher: ScanMatcher) -> list[float]:
    """Return the figures of one pair, in the order of the columns; NaN where there is nothing hidden or called so."""
    begin = time.process_time()
    problem = describe(pair.source, pair.target, ScanAlignConfig())
    tokens = [
        ScanTokens.from_even(scan.points, scan.normals, scan.boundary) for scan in (problem.source, problem.target)
    ]
    (probability,), (hidden,), _ = (value.double() for value in match_probabilities(matcher(*tokens)))
    size = pair.target.diagonal / problem.unit.scale
    truth = problem.unit.normalize(pair.truth)[problem.samples[: SIZES.num_tokens]]
    places = problem.target.points[: SIZES.num_tokens]
    visible = torch.cdist(truth, problem.target.points).amin(1) < VISIBLE * size
    right = (places[probability.argmax(1)] - truth).norm(dim=1) < RIGHT * size
    called = hidden > 0.5
    true_matches = (-torch.cdist(truth, places).square() / (2 * 0.025**2)).softmax(1) * visible[:, None]
    figures = [share(right[visible]), share(called[~visible]), share(~visible[called])]
    for matches, lost in ((probability, hidden), (true_matches, 1 - visible.double())):
        transforms = KeptMatches().align(problem, matches, lost)
        error = (moved_points(problem, transforms, pair.source) - pair.truth).norm(dim=1) / pair.target.diagonal
        figures += [100 * float(error.mean()), float((error < 0.025).double().mean() >= 0.9)]
    return [*figures, time.process_time() - begin]


def share(flags: Tensor) -> float:
    """Return the share that is True; NaN of none."""
    return float(flags.double().mean())


def held_out(count: int) -> Iterator[Pair]:
    """Yield so many creatures of each kind that is never trained on, in two poses each."""
    for number, (name, (kind, _)) in enumerate(HELD_OUT_KINDS.items()):
        stream = matching_pairs(1000 + number, {name: (kind, 1.0)})
        # Neighboring pairs show one creature.
        for found in itertools.islice(stream, 0, 6 * count, 6):
            yield Pair(name, found.source, found.target, found.source_truth)


def known(folder: Path) -> Iterator[Pair]:
    """Yield the pairs of files."""
    for file in sorted(folder.glob("*.npz")):
        with np.load(file) as data:
            values = {name: torch.from_numpy(data[name]) for name in data.files if data[name].ndim == 2}
        scans = [tr.RangeScan(values[f"{side}_points"], values[f"{side}_faces"]) for side in ("source", "target")]
        yield Pair(file.stem.split("_")[0], scans[0], scans[1], values["source_truth"].float())


def main(arguments: list[str] | None = None) -> int:
    """Print a row for each group, and one for all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder that holds range_pairs; skipped without")
    parser.add_argument("--pairs", type=int, default=20, help="of each kind never trained on")
    parser.add_argument("--weights", type=Path, help="checkpoint of a training run, instead of the weights of torchreg")
    parser.add_argument("--smoke", action="store_true", help="one pair of each kind")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    matcher = ScanMatcher()
    if options.weights is not None:
        matcher.load_state_dict(torch.load(options.weights, weights_only=True)["net"])
    print(
        f"{'':10s} pairs  right  hidden recall, precision   error %  registered   of the truth: error %  registered   s"
    )
    print_rows([(pair.group, measured(pair, matcher)) for pair in held_out(1 if options.smoke else options.pairs)])
    if options.data is None:
        print("known pairs: skipped; pass the folder that holds range_pairs as --data")
        return 0
    print_rows([(pair.group, measured(pair, matcher)) for pair in known(options.data / "range_pairs")])
    return 0


def print_rows(found: list[tuple[str, list[float]]]) -> None:
    """Print means by group and of all."""
    for group in [*dict.fromkeys(name for name, _ in found), "all"]:
        rows = np.array([figures for name, figures in found if group in (name, "all")])
        with np.errstate(all="ignore"):
            mean = [np.nanmean(column) if np.isfinite(column).any() else np.nan for column in rows.T]
        registered, by_truth = (f"{rows[:, column].sum():3.0f} / {len(rows):3d}" for column in (4, 6))
        print(
            f"{group:10s} {len(rows):5d}  {mean[0]:.3f}  {mean[1]:13.2f}  {mean[2]:9.2f}   {mean[3]:7.2f}  {registered}"
            f"   {mean[5]:21.2f}  {by_truth}   {mean[7]:.2f}"
        )


if __name__ == "__main__":
    sys.exit(main())
