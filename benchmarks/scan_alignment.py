"""How many pairs of range scans `align_scans` registers, how well and how fast.

A pair counts as registered when at least 90 % of its source points end within 2.5 % of the diagonal of their true
place, visible in the target or not. Seconds are those of the alignment alone, of a process with one thread.

Pairs are those of a folder of NPZ files (source_points, source_faces, target_points, target_faces, source_truth,
diagonal), and made-up ones: a person walking, another animal of random proportions galloping, a robot whose joints are
turned, one and three frames apart.

    python benchmarks/scan_alignment.py --data FOLDER
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from captured_scans import scan_pairs
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchreg as tr
from experiments.made_up.bodies import Proportions
from experiments.made_up.walks import walking_animal, walking_figure
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import ScanSequence, jointed_toy
from torchreg.registration.dense.align_scans import align_scans
from torchreg.registration.dense.config import ScanAlignConfig

NEAR, REGISTERED = 0.025, 0.9


@dataclass(frozen=True)
class Pair:
    """One problem: scans, the true places of the source's points, and the diagonal by which errors are divided."""

    name: str
    source: tr.RangeScan
    target: tr.RangeScan
    truth: Tensor
    diagonal: float


@dataclass(frozen=True)
class Score:
    """How one pair went.

    Args:
        name: of the pair.
        near: share of the points near their true place.
        error: mean distance from it, share of the diagonal.
        seconds: of the alignment.
        chosen: name of the hypothesis.
    """

    name: str
    near: float
    error: float
    seconds: float
    chosen: str

    @property
    def registered(self) -> bool:
        """Whether the pair counts."""
        return self.near >= REGISTERED


def made_up_pairs(name: str, sequence: ScanSequence, count: int, apart: int) -> Iterator[Pair]:
    """Yield pairs of frames ``apart``, spread over the sequence."""
    for start in torch.linspace(0, len(sequence) - 1 - apart, count).long().tolist():
        pair = sequence.pair(start, start + apart)
        yield Pair(f"{name} {start}-{start + apart}", pair.source, pair.target, pair.truth, pair.source.diagonal)


def groups(folder: Path | None, count: int, smoke: bool) -> Iterator[tuple[str, Iterator[Pair]]]:
    """Yield names and pairs."""
    if folder is not None and any(folder.glob("*.npz")):
        yield folder.name, (Pair(*pair) for pair in scan_pairs(folder))
    animal = Proportions.random(torch.Generator().manual_seed(1), 0.2)
    scanner = DepthScanner(num_points=800) if smoke else DepthScanner()
    sequences = {
        "person": walking_figure(60, scanner=scanner),
        "animal": walking_animal(60, gait="gallop", proportions=animal, scanner=scanner),
        "robot": jointed_toy(30, scanner=scanner),
    }
    for name, sequence in sequences.items():
        for apart in (1, 3):
            yield f"{name}, {apart} apart", made_up_pairs(name, sequence, count, apart)


def score(pair: Pair, config: ScanAlignConfig) -> Score:
    begin = time.perf_counter()
    result = align_scans(pair.source, pair.target, config)
    seconds = time.perf_counter() - begin
    error = (result.points - pair.truth.to(result.points)).norm(dim=-1) / pair.diagonal
    return Score(pair.name, float((error < NEAR).float().mean()), float(error.mean()), seconds, result.chosen.name)


def print_group(name: str, pairs: Iterator[Pair], config: ScanAlignConfig) -> list[Score]:
    """Print one line per pair and one for all; return the scores."""
    print(f"{name}\n  {'':18s} {'near':>7s} {'error':>7s} {'s':>6s}  chosen")
    scores = []
    for pair in pairs:
        one = score(pair, config)
        scores.append(one)
        mark = " " if one.registered else "*"
        print(f"{mark} {one.name:18s} {one.near:7.1%} {one.error:7.2%} {one.seconds:6.2f}  {one.chosen}", flush=True)
    near, error, seconds = torch.tensor([(one.near, one.error, one.seconds) for one in scores]).unbind(-1)
    number = sum(one.registered for one in scores)
    line = f"{number} of {len(scores)}"
    print(f"  {line:18s} {near.mean():7.1%} {error.mean():7.2%} {seconds.median():6.2f}  (mean, mean, median)")
    return scores


def main(arguments: list[str] | None = None) -> int:
    """Print the tables; return 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of NPZ pairs; without it, made-up pairs only")
    parser.add_argument("--pairs", type=int, default=5, help="made-up pairs per group; 0 for files alone")
    parser.add_argument("--smoke", action="store_true", help="small scans and a coarse graph, for a quick look")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    if options.data is None or not options.data.is_dir():
        print("skipped: pairs from files; name their folder with --data")
    print(f"* marks pairs with fewer than {REGISTERED:.0%} of the points within {NEAR:.1%} of the diagonal")
    config = ScanAlignConfig()
    if options.smoke:
        config = ScanAlignConfig(num_samples=300, num_nodes=25)
    for name, pairs in groups(options.data, options.pairs, options.smoke):
        if options.pairs or "apart" not in name:
            print_group(name, pairs, config)
        if options.smoke:
            break
    return 0


if __name__ == "__main__":
    sys.exit(main())
