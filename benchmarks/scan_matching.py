"""How often the learnt matcher of scans is right, and what an alignment that keeps its matches makes of them.

Pairs of kinds that the matcher never saw in training, and with --data those of its folder ``range_pairs`` and of the
rigs of its folder ``library``, of eight kinds that are kept from training, from one side and from all. By group:

- right: share of visible tokens whose best match lies within 5 % of the diagonal of the truth,
- hidden: recall and precision of tokens called hidden, of all pairs together, where a probability of one half calls;
  and where as many are called as are, at which both are one number, their break-even,
- error and registered of the dense alignment (before bones), in which the matcher's posterior is the prior of matches:
  a pair counts as registered when 90 % of its points end within 2.5 % of the diagonal of the truth,
- the same with the matches of the truth, which tells what the matcher and what the alignment leave to be done.

    python benchmarks/scan_matching.py                       # --smoke: one pair of each kind, in seconds
    python benchmarks/scan_matching.py --data SHARED/data
"""

from __future__ import annotations

import argparse
import csv
import itertools
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchreg as tr
from experiments.made_up.creature_kinds import HELD_OUT_KINDS
from experiments.made_up.matching_pairs import matching_pairs
from experiments.matcher.rigs import HELD_OUT_RIGS, body_of_rig
from experiments.matcher.weights import load_weights
from torchreg.registration.blend import blend_linear
from torchreg.registration.dense.align_scans import align_problem
from torchreg.registration.dense.config import ScanAlignConfig
from torchreg.registration.dense.match_prior import MatchPrior
from torchreg.registration.dense.node_graph import spread_weights
from torchreg.registration.dense.problem import NORMAL_SCALE, ScanAlignProblem, describe
from torchreg.registration.dense.scan_matcher import ScanMatcher, match_probabilities
from torchreg.registration.dense.scan_tokens import SIZES, ScanTokens

# A match is right, and a place is visible, within these shares of the diagonal.
RIGHT, VISIBLE = 0.05, 0.03
# Logit of what is known for sure.
SURE = 30.0


# Mean motions of the points of rigs, in diagonals.
MOTION = (0.03, 0.15)
# Pairs of a rig of which the one counts that moves most nearly as far as is wanted.
TRIES = 12


@dataclass(frozen=True)
class Pair:
    """Two scans and the truth (N, 3) of the source's points."""

    group: str
    source: tr.RangeScan
    target: tr.RangeScan
    truth: Tensor


def moved_points(problem: ScanAlignProblem, transforms: Tensor, scan: tr.RangeScan) -> Tensor:
    """Return all points (N, 3) of the source where the graph takes them."""
    graph, points = problem.graph, problem.unit.normalize(scan.points)
    surface = (points, scan.normals.double(), graph.points, graph.normals)
    weights = spread_weights(*surface, graph.dense_weights, NORMAL_SCALE)
    return problem.unit.denormalize(blend_linear(points, weights, transforms), scan.points)


@dataclass(frozen=True)
class Figures:
    """Of one pair.

    Args:
        right: share of visible tokens.
        hidden: (S,) which tokens are.
        told: (S,) probabilities of it.
        errors: of the alignment by the matcher and by the truth, mean, per cent of the diagonal.
        registered: of both, whether it is.
        seconds: of all this.
    """

    right: float
    hidden: Tensor
    told: Tensor
    errors: list[float]
    registered: list[bool]
    seconds: float


@torch.no_grad()
def measured(pair: Pair, matcher: ScanMatcher) -> Figures:
    """Return the figures of one pair."""
    begin = time.process_time()
    problem = describe(pair.source, pair.target, ScanAlignConfig())
    scans = (problem.source, problem.target)
    logits = matcher(*(ScanTokens.from_even(scan.points, scan.normals, scan.boundary) for scan in scans))
    (probability,), (hidden,), _ = (value.double() for value in match_probabilities(logits))
    size = pair.target.diagonal / problem.unit.scale
    truth = problem.unit.normalize(pair.truth)[problem.samples[: SIZES.num_tokens]]
    places = problem.target.points[: SIZES.num_tokens]
    visible = torch.cdist(truth, problem.target.points).amin(1) < VISIBLE * size
    right = (places[probability.argmax(1)] - truth).norm(dim=1) < RIGHT * size
    errors, registered = [], []
    for known in (logits[0].double(), true_logits(truth, places, visible)):
        prior = MatchPrior.of_logits(known, problem.graph.points, problem.target.points)
        transforms = align_problem(replace(problem, prior=prior), lambda _: None)[0].transforms
        error = (moved_points(problem, transforms, pair.source) - pair.truth).norm(dim=1) / pair.target.diagonal
        errors.append(100 * float(error.mean()))
        registered.append(float((error < 0.025).double().mean()) >= 0.9)
    return Figures(
        right=float(right[visible].double().mean()),
        hidden=~visible,
        told=hidden,
        errors=errors,
        registered=registered,
        seconds=time.process_time() - begin,
    )


def true_logits(truth: Tensor, places: Tensor, visible: Tensor) -> Tensor:
    """Return logits (S + 1, T + 1) of who knows where tokens went (S, 3), among others (T, 3), and which are seen."""
    apart = torch.cdist(truth, places)
    logits = torch.full((len(truth) + 1, len(places) + 1), -SURE, dtype=torch.float64)
    logits[:-1, :-1] = -apart.square() / (2 * (RIGHT / 2) ** 2)
    logits[:-1, -1] = torch.where(visible, -SURE, SURE)
    logits[-1, :-1] = torch.where(apart.amin(0) < RIGHT, -SURE, 0.0)
    return logits


def held_out(count: int) -> Iterator[Pair]:
    """Yield so many creatures of each kind that is never trained on, in two poses each."""
    for number, (name, (kind, _)) in enumerate(HELD_OUT_KINDS.items()):
        stream = matching_pairs(1000 + number, {name: (kind, 1.0)})
        # Neighboring pairs show one creature.
        for found in itertools.islice(stream, 0, 6 * count, 6):
            yield Pair(name, found.source, found.target, found.source_truth)


def rigs(folder: Path, count: int, *, whole: bool = False) -> Iterator[Pair]:
    """Yield so many pairs of the rigs of kinds that are never trained on, their mean motions spread evenly."""
    with (folder / "index.csv").open(encoding="utf-8", newline="") as index:
        rows = [row for row in csv.DictReader(index) if row["kind"] in HELD_OUT_RIGS and row["torchreg"] == "ok"]
    for number, row in enumerate(itertools.islice(itertools.cycle(rows), count)):
        wanted = MOTION[0] + (MOTION[1] - MOTION[0]) * (number + 0.5) / count
        drawn = (row["kind"], body_of_rig(folder / row["file"]))
        stream = matching_pairs(2000 + number, bodies=lambda _, drawn=drawn: drawn, body_share=1.0, whole=float(whole))
        pairs = [
            Pair(row["kind"], each.source, each.target, each.source_truth) for each in itertools.islice(stream, TRIES)
        ]
        yield min(pairs, key=lambda pair, wanted=wanted: abs(mean_motion(pair) - wanted))


def mean_motion(pair: Pair) -> float:
    """Return how far the points of a pair move in the mean, in diagonals of the target."""
    return float((pair.truth - pair.source.points).norm(dim=1).mean()) / pair.target.diagonal


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
    parser.add_argument("--weights", type=Path, help="or checkpoint of a training run, instead of those of torchreg")
    parser.add_argument("--smoke", action="store_true", help="one pair of each kind")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    matcher = ScanMatcher()
    if options.weights is not None:
        matcher.load_state_dict(load_weights(options.weights))
    print(
        f"{'':10s} pairs  right  hidden recall, precision, break-even   error %  registered   of the truth: error %  "
        "registered   s"
    )
    print_rows([(pair.group, measured(pair, matcher)) for pair in held_out(1 if options.smoke else options.pairs)])
    if options.data is None:
        print("known pairs: skipped; pass the folder that holds range_pairs as --data")
        return 0
    print_rows([(pair.group, measured(pair, matcher)) for pair in known(options.data / "range_pairs")])
    if (options.data / "library").is_dir():
        found_rigs = rigs(options.data / "library", 8 if options.smoke else 10 * options.pairs)
        print_rows([(pair.group, measured(pair, matcher)) for pair in found_rigs])
        print("points of all sides:")
        all_sides = rigs(options.data / "library", 8 if options.smoke else 2 * options.pairs, whole=True)
        print_rows([(pair.group, measured(pair, matcher)) for pair in all_sides])
    return 0


def print_rows(found: list[tuple[str, Figures]]) -> None:
    """Print a row for each group, and one of all."""
    for group in [*dict.fromkeys(name for name, _ in found), "all"]:
        rows = [figures for name, figures in found if group in (name, "all")]
        hidden, told = (torch.cat([getattr(row, name) for row in rows]) for name in ("hidden", "told"))
        called = told > 0.5
        recall, precision = (float((called & hidden).sum() / of.sum().clamp_min(1)) for of in (hidden, called))
        even = hidden[told.argsort(descending=True)[: int(hidden.sum())]].double().mean()
        registered, by_truth = (f"{sum(row.registered[end] for row in rows):3d} / {len(rows):3d}" for end in (0, 1))
        error, by_truth_error = (np.mean([row.errors[end] for row in rows]) for end in (0, 1))
        print(
            f"{group:10s} {len(rows):5d}  {np.mean([row.right for row in rows]):.3f}  {recall:13.2f}  "
            f"{precision:9.2f}  {even:10.2f}   {error:7.2f}  "
            f"{registered}   {by_truth_error:21.2f}  {by_truth}   {np.mean([row.seconds for row in rows]):.2f}"
        )


if __name__ == "__main__":
    sys.exit(main())
