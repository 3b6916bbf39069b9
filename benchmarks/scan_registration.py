"""Range scans registered by a reduced deformable model: how many, how well, how fast, and what each step adds.

A pair counts as registered when at least 90 % of its source points end within 2.5 % of the diagonal of their true
place, visible in the target or not; "seen" leaves out points on parts that were taken off before the target was
scanned, whose place nothing tells. Seconds are those of the paper's table 1: setup, initialization (here the dense
alignment), align (labels and motions) and refine (weights and motions).

Sets are a folder of NPZ files (source_points, source_faces, target_points, target_faces, source_truth, diagonal); the
walking figure's adjacent frames, and frames four apart; a toy, one part of which is missing in one scan of every pair.
For made-up pairs the adjusted Rand index compares parts found with parts that moved apart by more than 0.5 % of the
diagonal, about the sampling distance, and joints are right within 5 % of the diagonal.
Turned and made larger, both scans of a pair must end where they did: beside each set, "moved" counts that.
A sequence of the figure and one of the toy are registered together, and beside that chained: adjacent pairs, one after
the other. The last frame is compared with the first pair, whose motion is the least, and with the mean of the adjacent
pairs; parts and joints are judged by what moved apart in any frame. Several sequences, of figures, toys of random forms
and animals, tell how often the last frame is reached: registered like a pair. Captured motion, from files of meshes
that share vertices, is scanned by the same camera, from as many sides as there are sequences; its parts are not known.

    python benchmarks/scan_registration.py --data FOLDER --pairs 189 --ablations --moved --growth
    python benchmarks/scan_registration.py --pairs 0 --frames 10 --sequences 6 --captured samba.npz horse_gallop.npz
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from captured_scans import CapturedSequence, captured_sequences, scan_pairs
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchreg as tr
from experiments.made_up.moving_labels import moving_labels, moving_labels_over_time
from experiments.made_up.toys import random_toy
from experiments.made_up.walks import walking_animal, walking_figure
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import ScanPair, ScanSequence, jointed_toy
from torchreg.geometry.neighbors import nearest_neighbor
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.metrics import adjusted_rand
from torchreg.registration.dense.config import ScanAlignConfig

NEAR, REGISTERED, JOINT, APART = 0.025, 0.9, 0.05, 0.005
SCALE = 100
KINDS = ("figure", "toy", "animal")  # of sequences
CONFIDENCES = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 1.0)
SMOKE_POINTS = 300  # of each scan
STAGES = ("setup", "initialization", "align", "refine")


@dataclass(frozen=True)
class Problem:
    """Scans, the true places of the source's points, what errors are divided by, and all the truth if it is made up."""

    name: str
    source: tr.RangeScan
    target: tr.RangeScan
    truth: Tensor
    diagonal: float
    pair: ScanPair | None = None


@dataclass(frozen=True)
class Score:
    """How one pair went.

    Args:
        near: share of points near their true place.
        near_seen: the same of points whose part is there in the target.
        error: mean distance from it, share of the diagonal.
        rand: adjusted Rand index of the parts, NaN if they are not known.
        joints: distances of true joints from the nearest found one, shares of the diagonal.
        seconds: of the four stages.
        bones: found.
    """

    near: float
    near_seen: float
    error: float
    rand: float
    joints: tuple[float, ...]
    seconds: tuple[float, ...]
    bones: int


@dataclass(frozen=True)
class PartTruth:
    """What is known of the points of a made-up scan: parts that moved apart, all parts, and the joints between them."""

    moving: Tensor
    labels: Tensor
    joint_parts: Tensor
    joints: Tensor
    size: float

    @classmethod
    def of_pair(cls, pair: ScanPair) -> PartTruth:
        """Return the truth of a pair's source."""
        moving = moving_labels(pair, APART)
        return cls(moving, pair.labels, pair.joint_parts, pair.joints, pair.source.diagonal)

    @classmethod
    def of_sequence(cls, sequence: ScanSequence) -> PartTruth:
        """Return the truth of the first frame; parts moved apart if they did in any."""
        moving, size = moving_labels_over_time(sequence, 0, APART), sequence[0].diagonal
        return cls(moving, sequence.labels(0), sequence.joint_parts, sequence.joints(0), size)


@dataclass(frozen=True)
class Recipe:
    """How pairs are registered."""

    name: str
    bones: int = 20
    grid: int = 50
    config: tr.RegisterConfig = field(default_factory=tr.RegisterConfig)


def _ablations() -> list[Recipe]:
    plain = tr.RegisterConfig()
    return [
        Recipe("default"),
        Recipe("without joint term", config=replace(plain, joint_weight=(0.0, 0.0))),
        Recipe("joints 0.01 all along", config=replace(plain, joint_weight=(0.01, 0.01))),
        Recipe("joints 1 to 0.05", config=replace(plain, joint_weight=(1.0, 0.05))),
        Recipe("without turns held", config=replace(plain, turn_weight=0.0)),
        Recipe("borders anywhere", config=replace(plain, seam=0.0, smoothness=0.05)),
        Recipe("without refinement", config=replace(plain, refine_steps=0)),
        *(Recipe(f"grid {size}", grid=size) for size in (20, 35, 65, 80)),
        *(Recipe(f"bones {size}", bones=size) for size in (4, 6, 10, 15)),
    ]


def made_up_problems(kind: str, count: int, num_points: int = 4500, apart: int = 1) -> Iterator[Problem]:
    """Yield pairs of frames of the figure or the toy, ``apart`` from each other."""
    scanner = DepthScanner(num_points=num_points)
    frames = count + apart
    sequence = (
        walking_figure(frames, scanner=scanner)
        if kind == "figure"
        else jointed_toy(frames, missing=True, scanner=scanner)
    )
    for number, pair in enumerate(sequence.pairs(apart)):
        yield Problem(f"{kind} {number}", pair.source, pair.target, pair.truth, pair.source.diagonal, pair)


def moved(problem: Problem) -> Problem:
    """Return the problem turned about an oblique axis, shifted, and 100 times as large."""
    motion = se3_exp(torch.tensor([0.3, -0.7, 1.1, 0.4, 1.3, -2.0], dtype=torch.float64))
    motion[:3] = SCALE * motion[:3]
    source, target = (scan.transformed(motion.to(scan.points)) for scan in (problem.source, problem.target))
    truth = transform_points(motion.to(problem.truth), problem.truth)
    return Problem(problem.name, source, target, truth, SCALE * problem.diagonal)


def score(problem: Problem, recipe: Recipe) -> Score:
    """Register one pair and return how it went."""
    found = tr.register(problem.source, problem.target, recipe.bones, recipe.grid, recipe.config)
    errors = (found.deformed - problem.truth).norm(dim=-1) / problem.diagonal
    near, pair = (errors < NEAR).double(), problem.pair
    rand, joints, seen = float("nan"), (), near
    if pair is not None:
        seen = near[~pair.missing]
        rand, joints = parts_and_joints(found, PartTruth.of_pair(pair))
    seconds = tuple(found.seconds.tolist())
    return Score(
        float(near.mean()), float(seen.mean()), float(errors.mean()), rand, joints, seconds, len(found.transforms)
    )


@torch.no_grad()
def parts_and_joints(
    found: tr.ScanRegistration | tr.SequenceRegistration, truth: PartTruth
) -> tuple[float, tuple[float, ...]]:
    """Return the adjusted Rand index, and how far joints of parts that moved apart are from the nearest found one."""
    moving, labels = truth.moving, truth.labels
    part = {int(label): int(moving[labels == label][0]) for label in labels.unique()}
    centers, errors = found.model.joints().centers, []
    for (parent, child), place in zip(truth.joint_parts.tolist(), truth.joints, strict=True):
        if parent in part and child in part and part[parent] != part[child]:
            near = (centers - place).norm(dim=-1).min() if len(centers) else torch.tensor(torch.inf)
            errors.append(float(near) / truth.size)
    return float(adjusted_rand(found.parts(APART), moving)), tuple(errors)


def print_row(name: str, scores: list[Score]) -> None:
    """Print one line of a table."""
    ok = sum(one.near >= REGISTERED for one in scores)
    seen = sum(one.near_seen >= REGISTERED for one in scores)
    error = 100 * np.mean([one.error for one in scores])
    seconds = np.median([one.seconds for one in scores], axis=0)
    total = np.median([sum(one.seconds) for one in scores])
    bones = np.mean([one.bones for one in scores])
    stages = " ".join(f"{value:6.2f}" for value in (*seconds, total))
    print(f"{name:24s} {ok:4d} {seen:4d} /{len(scores):4d} {error:7.2f} {bones:6.1f} {stages}", end="")
    known = [one.rand for one in scores if not np.isnan(one.rand)]
    if known:
        joints = np.array([error for one in scores for error in one.joints])
        right = np.mean(joints < JOINT) if len(joints) else float("nan")
        print(f" {np.mean(known):6.2f} {np.mean(np.array(known) >= 0.8):6.0%} {right:6.0%}", end="")
    print(flush=True)


def print_header(title: str) -> None:
    columns = " ".join(f"{name[:6]:>6s}" for name in (*STAGES, "total"))
    print(f"\n{title}\n{'':24s}   ok seen / all  mean %  bones {columns}   rand  >= .8 joints", flush=True)


def print_set(title: str, problems: list[Problem], recipes: list[Recipe], verbose: bool = False) -> None:
    """Print a line per recipe, and with ``verbose`` one per pair."""
    print_header(title)
    for recipe in recipes:
        scores = []
        for problem in problems:
            scores.append(score(problem, recipe))
            if verbose:
                print_row(f"  {problem.name}", scores[-1:])
        print_row(recipe.name, scores)


def adjacent(scans: list[tr.RangeScan], recipe: Recipe) -> list[Tensor]:
    """Return where each scan's points but the last one's go in the next frame, registered in pairs."""
    return [
        tr.register(source, target, recipe.bones, recipe.grid, recipe.config).deformed
        for source, target in pairwise(scans)
    ]


def chained(scans: list[tr.RangeScan], pairs: list[Tensor]) -> list[Tensor]:
    """Return where the first scan's points go in every frame by pairs alone: each carries what is nearest to it."""
    places = [scans[0].points]
    for source, moved in zip(scans[:-1], pairs, strict=True):
        near, _ = nearest_neighbor(places[-1], source.points)
        places.append(places[-1] + (moved - source.points)[near])
    return places


def place_errors(
    sequence: ScanSequence | CapturedSequence, places: Tensor, source: int, target: int, size: float
) -> Tensor:
    """Return how far moved points (N, 3) of a frame are from the truth in another, shares of a size."""
    return (places - sequence.truth(source, target)).norm(dim=-1) / size


def print_sequence(kind: str, sequence: ScanSequence, recipe: Recipe) -> None:
    """Print mean errors of the first frame's points in every frame, shares of the diagonal, and parts and joints."""
    scans = list(sequence)
    found = tr.register_sequence(scans, recipe.bones, recipe.grid, recipe.config)
    pairs = adjacent(scans, recipe)
    ways, size = (found.deformed, chained(scans, pairs)), scans[0].diagonal

    def error(places: Tensor, source: int, target: int) -> float:
        return 100 * float(place_errors(sequence, places, source, target, size).mean())

    print(f"\n{kind}, sequence of {len(scans)} frames, mean % from the first, and of the pair that ends there")
    print(f"{'frame':>6s} together chained   pair")
    alone = [error(moved, frame, frame + 1) for frame, moved in enumerate(pairs)]
    errors = [[error(way[frame], 0, frame) for way in ways] for frame in range(1, len(scans))]
    for frame, (row, pair) in enumerate(zip(errors, alone, strict=True), 1):
        print(f"{frame:6d} {row[0]:8.2f} {row[1]:7.2f} {pair:6.2f}")
    last, mean = errors[-1], float(np.mean(alone))
    print(f"last over the mean pair: {last[0] / mean:.2f} together, {last[1] / mean:.2f} chained")
    print(f"last over the first: {last[0] / errors[0][0]:.2f} together, {last[1] / errors[0][1]:.2f} chained")
    rand, joints = parts_and_joints(found, PartTruth.of_sequence(sequence))
    right = np.mean(np.array(joints) < JOINT)
    print(f"parts: adjusted Rand index {rand:.2f}; joints within {JOINT:.0%}: {right:.0%} of {len(joints)}", flush=True)


def sequences_of(
    kind: str | Path, count: int, frames: int, scanner: DepthScanner | None = None
) -> Iterator[ScanSequence | CapturedSequence]:
    """Yield sequences of one kind with seeds from 0 on; toys are of random forms, captured motion comes from a file."""
    if isinstance(kind, Path):
        yield from captured_sequences(kind, count, frames, scanner)
        return
    for seed in range(count):
        if kind == "toy":
            yield jointed_toy(frames, seed, toy=random_toy(torch.Generator().manual_seed(seed)), scanner=scanner)
        else:
            yield {"figure": walking_figure, "animal": walking_animal}[kind](frames, seed, scanner=scanner)


def print_many_sequences(
    kinds: Sequence[str | Path], count: int, frames: int, recipe: Recipe, scanner: DepthScanner | None = None
) -> None:
    """Print mean errors of the first frame's points in all frames and in the last, and how often they are there.

    Beside that errors of adjacent pairs, and parts and joints where they are known.
    """
    print(f"\n{count} sequences of {frames} frames, registered together")
    print(f"{'':12s} mean %  last %  pair %  last/pair  frames  last registered   rand joints")
    sure, right = [], []
    for kind in kinds:
        rows, rands, joints = [], [], []
        for sequence in sequences_of(kind, count, frames, scanner):
            scans = list(sequence)
            size = scans[0].diagonal
            found = tr.register_sequence(scans, recipe.bones, recipe.grid, recipe.config)
            errors = torch.stack(
                [place_errors(sequence, found.deformed[frame], 0, frame, size) for frame in range(1, frames)]
            )
            alone = [
                float(place_errors(sequence, moved, frame, frame + 1, size).mean())
                for frame, moved in enumerate(adjacent(scans, recipe))
            ]
            rows.append((errors.mean(1), (errors < NEAR).double().mean(1) >= REGISTERED, torch.tensor(alone).mean()))
            sure.append(found.confidence[1:])
            right.append(rows[-1][1])
            if isinstance(sequence, ScanSequence):
                rand, near = parts_and_joints(found, PartTruth.of_sequence(sequence))
                rands.append(rand)
                joints.extend(near)
        error, there, pair = (torch.stack(each) for each in zip(*rows, strict=True))
        last = error[:, -1].mean()
        print(
            f"{Path(kind).stem:12s} {100 * error.mean():6.2f} {100 * last:7.2f} {100 * pair.mean():7.2f}"
            f" {last / pair.mean():10.2f}"
            f" {there.double().mean():7.0%} {int(there[:, -1].sum()):9d} /{count:4d}"
            + (f" {np.mean(rands):6.2f} {np.mean(np.array(joints) < JOINT):6.0%}" if rands else ""),
            flush=True,
        )
    print_reliability(torch.cat(sure), torch.cat(right))


def print_reliability(confidence: Tensor, right: Tensor) -> None:
    """Print of how many frames (N,) with a confidence, from 0 to 1, 90 % of the points are near their true place."""
    print("confidence    frames  mean  registered")
    for low, high in pairwise(CONFIDENCES):
        within = (confidence >= low) & ((confidence < high) | (high == 1))
        if within.any():
            mean, share = confidence[within].mean(), right[within].double().mean()
            print(f"{low:.1f} to {high:.1f} {int(within.sum()):9d} {mean:5.2f} {share:11.0%}", flush=True)


def grown(num_points: int) -> tuple[int, float, float, float, float]:
    """Return points of a scan of the figure, CPU seconds of `register`, MB before and at most, and the mean error."""
    torch.set_num_threads(1)
    (problem,) = made_up_problems("figure", 1, num_points)
    before, begin = peak_memory(), time.process_time()
    error = score(problem, Recipe("default")).error
    return len(problem.source), time.process_time() - begin, before, peak_memory(), error


def peak_memory() -> float:
    """Return the most memory that this process has held, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def print_growth(counts: tuple[int, ...]) -> None:
    """Print what scans of so many points cost, each in a process of its own."""
    print(f"\nfigure, growing\n{'points':>8s} CPU s   MB before  at most  mean %")
    for count in counts:
        # A process that did anything else before has held more already.
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            points, seconds, before, most, error = pool.submit(grown, count).result()
        print(f"{points:8d} {seconds:5.2f} {before:11.0f} {most:8.0f} {100 * error:7.2f}", flush=True)


def main(arguments: list[str] | None = None) -> int:
    """Print the tables; return 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of NPZ pairs; without it, made-up pairs only")
    parser.add_argument("--pairs", type=int, default=20, help="made-up pairs per set; 189 as in the paper; 0 for none")
    parser.add_argument("--sets", nargs="+", help="names of the sets to be run, such as toy; all by default")
    parser.add_argument("--ablations", action="store_true", help="leave out one step after the other")
    parser.add_argument("--moved", action="store_true", help="each set also turned and 100 times as large")
    parser.add_argument("--growth", action="store_true", help="CPU seconds and memory from 2,000 to 200,000 points")
    parser.add_argument(
        "--frames", type=int, default=0, help="length of a sequence to be registered together, 2 or more"
    )
    parser.add_argument("--sequences", type=int, default=0, help="of --frames frames, of each kind")
    parser.add_argument(
        "--captured", type=Path, nargs="+", default=(), help="NPZ files of captured motion for --sequences"
    )
    parser.add_argument("--verbose", action="store_true", help="a line per pair")
    parser.add_argument("--smoke", action="store_true", help="one small pair, for a quick look")
    options = parser.parse_args(arguments)
    if options.sequences and not options.frames:
        parser.error("--sequences needs --frames, how long they are")
    if options.smoke:
        align = ScanAlignConfig(num_samples=200, num_nodes=20)
        small = [Recipe("default", 6, 20, tr.RegisterConfig(num_samples=200, align=align))]
        toys = list(made_up_problems("toy", 1, SMOKE_POINTS))
        print_set("toy", toys, small, options.verbose)
        print_set("toy, moved", [moved(toy) for toy in toys], small, options.verbose)
        scanner = DepthScanner(num_points=SMOKE_POINTS)
        print_sequence("figure", walking_figure(2, scanner=scanner), small[0])
        print_many_sequences(KINDS[-1:], 1, 2, small[0], scanner)
        return 0
    sets: dict[str, list[Problem]] = {}
    if options.data is None or not options.data.is_dir():
        print("skipped: pairs from files; name their folder with --data")
    else:
        sets[options.data.name] = [Problem(*pair) for pair in scan_pairs(options.data)]
    if options.pairs:
        sets |= {kind: list(made_up_problems(kind, options.pairs)) for kind in ("figure", "toy")}
        # Between adjacent frames many parts hardly move: parts can be told where they do.
        sets["figure, 4 apart"] = list(made_up_problems("figure", options.pairs, apart=4))
    for title, problems in sets.items():
        if options.sets and title not in options.sets:
            continue
        print_set(title, problems, _ablations() if options.ablations else _ablations()[:1], options.verbose)
        if options.moved:
            print_set(f"{title}, moved", [moved(problem) for problem in problems], _ablations()[:1], options.verbose)
    if options.frames:
        print_sequence("figure", walking_figure(options.frames), Recipe("default"))
        print_sequence("toy", jointed_toy(options.frames), Recipe("default"))
        if options.sequences:
            kinds = (*KINDS, *options.captured)
            print_many_sequences(kinds, options.sequences, options.frames, Recipe("default"))
    if options.growth:
        print_growth((2000, 10_000, 50_000, 200_000))
    return 0


if __name__ == "__main__":
    sys.exit(main())
