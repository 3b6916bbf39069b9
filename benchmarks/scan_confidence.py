"""Whether the confidence of aligned scans tells the right ones from the wrong ones.

    python benchmarks/scan_confidence.py                       # kinds that nothing was trained on; --smoke: few
    python benchmarks/scan_confidence.py --data SHARED/data    # and those of its folder range_pairs
    python benchmarks/scan_confidence.py --calibrate           # fits the model anew, to pairs of the training's kinds

A pair is right if 90 % of its points end within 2.5 % of the target's diagonal of the truth. Printed: the area under
the curve of the confidence (.9 is asked), and by fifths of the confidence its mean and the share that is right.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from confidence import area_under_curve
from scan_matching import Pair, held_out, known, moved_points

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.made_up.matching_pairs import matching_pairs
from torchreg.registration.dense.align_scans import align_problem
from torchreg.registration.dense.config import ScanAlignConfig, ScanEvidence
from torchreg.registration.dense.problem import describe
from torchreg.registration.dense.reliability import confidence_of
from torchreg.solvers.calibration import fit_logistic

NEAR, SHARE, FIFTHS = 0.025, 0.9, 5


@dataclass(frozen=True)
class Case:
    """An alignment: whether it is right, and what speaks against it."""

    right: bool
    evidence: ScanEvidence


@torch.no_grad()
def aligned(pairs: Iterable[Pair]) -> list[Case]:
    """Return the cases of pairs."""
    found = []
    for pair in pairs:
        problem = describe(pair.source, pair.target, ScanAlignConfig())
        candidates = align_problem(problem, lambda _: None)
        moved = moved_points(problem, candidates[0].transforms, pair.source)
        error = (moved - pair.truth).norm(dim=1) / pair.target.diagonal
        right = float((error < NEAR).double().mean()) >= SHARE
        found.append(Case(right, candidates[0].hypothesis.evidence))
    return found


def training_kinds(count: int) -> Iterator[Pair]:
    """Yield so many pairs of the kinds that the matcher is trained on, of other creatures."""
    for found in itertools.islice(matching_pairs(77), 0, 6 * count, 6):
        yield Pair(found.kind, found.source, found.target, found.source_truth)


def report(name: str, cases: list[Case]) -> str:
    """Return the lines of a set of cases."""
    right = torch.tensor([case.right for case in cases])
    confidence = torch.tensor([confidence_of(case.evidence) for case in cases])
    area = area_under_curve(confidence, right)
    lines = [f"{name}: {int(right.sum())} of {len(cases)} right, area under the curve {area:.2f}"]
    for low in torch.arange(FIFTHS) / FIFTHS:
        chosen = (confidence >= low) & ((confidence < low + 1 / FIFTHS) | (low + 1 / FIFTHS >= 1))
        if bool(chosen.any()):
            share = float(right[chosen].double().mean())
            lines.append(
                f"  {int(chosen.sum()):4d} pairs, mean {float(confidence[chosen].mean()):.2f}, right {share:.2f}"
            )
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Print the tables, or the model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder that holds range_pairs; skipped without")
    parser.add_argument(
        "--pairs", type=int, default=10, help="of each kind never trained on; five times as many to fit"
    )
    parser.add_argument("--calibrate", action="store_true", help="fit the model to pairs of the training's kinds")
    parser.add_argument("--smoke", action="store_true", help="one pair of each kind")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    count = 1 if options.smoke else options.pairs
    if options.calibrate:
        cases = aligned(training_kinds(5 * count))
        table = torch.stack([case.evidence.table() for case in cases])
        print(fit_logistic(table, torch.tensor([case.right for case in cases])))
        print(report("the pairs it was fitted to", cases))
    print(report("kinds never trained on", aligned(held_out(count))))
    if options.data is None:
        print("known pairs: skipped; pass the folder that holds range_pairs as --data")
    else:
        print(report("known pairs", aligned(known(options.data / "range_pairs"))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
