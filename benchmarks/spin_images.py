"""How many matches of spin images are right, on pairs of range scans whose truth is known.

A match is right if it lies within 5 % of the diagonal of the true place of its source point. 500 source points are
matched with 1,000 target points, all spread evenly; bins are shares of the longest side of the source's box, images
15 x 15, the support angle 90 degrees. The first row is what closest points would give. "RANSAC": kept are the inliers,
within 4 % of the diagonal, of one rigid motion for each of ten regions. "isometry": of six candidates the one is kept
that agrees with those around it on distances along the surface, if its support is above one half. "learned" are 32
numbers by which registration matches, learned from images of two sizes and curvatures of other made-up scans.

Pairs are those of a folder of NPZ files (source_points, source_faces, target_points, target_faces, source_truth,
diagonal), and made-up ones: a person walking, another animal of random proportions, a robot whose joints are turned,
one and three frames apart.

    python benchmarks/spin_images.py --data FOLDER
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
from torchreg.datasets.bodies import Proportions
from torchreg.datasets.scan_sequences import ScanSequence, jointed_toy, walking_animal, walking_figure
from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.neighbors import nearest_neighbor
from torchreg.geometry.sampling import farthest_points
from torchreg.registration.dense.curvature import curvature_features
from torchreg.registration.dense.descriptor_matching import DescriptorMatches, match_descriptors
from torchreg.registration.dense.isometry import consistent_matches
from torchreg.registration.dense.learned_descriptors import CURVATURE_RADII, learned_descriptors
from torchreg.registration.dense.oriented_samples import OrientedSamples, scaled_together
from torchreg.registration.dense.spin_images import spin_images
from torchreg.registration.normalization import Normalization
from torchreg.solvers.ransac import ransac_rigid

RIGHT = 0.05
NUM_SOURCE, NUM_TARGET, NUM_SCENE = 500, 1000, 1500
NUM_REGIONS, INLIER, NUM_NEIGHBORS = 10, 0.04, 8


@dataclass(frozen=True)
class Pair:
    """One problem: scans, the true places of the source's points, and the diagonal by which errors are divided."""

    source: tr.RangeScan
    target: tr.RangeScan
    truth: Tensor
    diagonal: float


@dataclass(frozen=True)
class Recipe:
    """One way to match; ``divisions`` is the number of bins along the longest side of the source, None if learned."""

    label: str
    divisions: float | None = 50
    similarity: str = "correlation"
    num_candidates: int = 1
    mutual: bool = False
    max_ratio: float | None = None
    max_distance: float | None = None
    prune: str = ""


RECIPES = (
    Recipe("bin 1/100", 100),
    Recipe("bin 1/50 (the paper)", 50),
    Recipe("bin 1/15", 15),
    Recipe("bin 1/25", 25),
    Recipe("bin 1/25, l2", 25, "l2"),
    Recipe("bin 1/25, overlap", 25, "overlap"),
    Recipe("bin 1/25, 5 candidates", 25, num_candidates=5),
    Recipe("bin 1/25, within 30 %", 25, max_distance=0.3),
    Recipe("bin 1/25, mutual", 25, mutual=True),
    Recipe("bin 1/25, ratio 0.8", 25, max_ratio=0.8),
    Recipe("bin 1/25, mutual, ratio 0.8", 25, mutual=True, max_ratio=0.8),
    Recipe("bin 1/25, RANSAC", 25, prune="ransac"),
    Recipe("bin 1/25, within 30 %, RANSAC", 25, prune="ransac", max_distance=0.3),
    Recipe("bin 1/25, isometry", 25, num_candidates=6, prune="isometry"),
    Recipe("bin 1/25, within 30 %, isometry", 25, num_candidates=6, prune="isometry", max_distance=0.3),
    Recipe("learned, within 30 %", None, "distance", max_distance=0.3),
    Recipe("learned, within 30 %, isometry", None, "distance", 6, max_distance=0.3, prune="isometry"),
)


def file_pairs(folder: Path) -> Iterator[Pair]:
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as file:
            source = tr.RangeScan(file["source_points"], file["source_faces"])
            target = tr.RangeScan(file["target_points"], file["target_faces"])
            yield Pair(source, target, torch.from_numpy(file["source_truth"]), float(file["diagonal"]))


def made_up_pairs(sequence: ScanSequence, count: int, apart: int) -> Iterator[Pair]:
    """Yield pairs of frames ``apart``, spread over the sequence."""
    for start in torch.linspace(0, len(sequence) - 1 - apart, count).long().tolist():
        pair = sequence.pair(start, start + apart)
        yield Pair(pair.source, pair.target, pair.truth, pair.source.diagonal)


def groups(folder: Path | None, count: int) -> Iterator[tuple[str, list[Pair]]]:
    """Yield names and pairs."""
    if folder is not None and any(folder.glob("*.npz")):
        yield folder.name, list(file_pairs(folder))[: 10 * count]
    animal = Proportions.random(torch.Generator().manual_seed(1), 0.2)
    for name, sequence in (
        ("person", walking_figure(60)),
        ("animal", walking_animal(60, gait="gallop", proportions=animal)),
        ("robot", jointed_toy(30)),
    ):
        for apart in (1, 3):
            yield f"{name}, {apart} apart", list(made_up_pairs(sequence, count, apart))


@dataclass(frozen=True)
class Described:
    """Points ``here`` of the source and ``there`` of the target, their descriptors, and the seconds these took."""

    here: Tensor
    there: Tensor
    descriptors: tuple[Tensor, Tensor]
    seconds: float


def described(pair: Pair, divisions: float | None) -> Described:
    """Return descriptors of points of a pair, see `Recipe`."""
    begin = time.perf_counter()
    here, there = pair.source.uniform_subsample(NUM_SOURCE), pair.target.uniform_subsample(NUM_TARGET)
    both = learned(pair, here, there) if divisions is None else images(pair, here, there, divisions)
    return Described(here, there, both, time.perf_counter() - begin)


def images(pair: Pair, here: Tensor, there: Tensor, divisions: float) -> tuple[Tensor, Tensor]:
    """Return spin images (Q, 15, 15) of source and target points."""
    size = float((pair.source.points.amax(0) - pair.source.points.amin(0)).max()) / divisions

    def seen(scan: tr.RangeScan, which: Tensor) -> Tensor:
        scene = scan.uniform_subsample(NUM_SCENE)
        return spin_images(
            scan.points[which], scan.normals[which], scan.points[scene], scan.normals[scene], bin_size=size
        )

    return seen(pair.source, here), seen(pair.target, there)


def learned(pair: Pair, here: Tensor, there: Tensor) -> tuple[Tensor, Tensor]:
    """Return learned descriptors (Q, 32) of source and target points."""
    unit = Normalization.from_points(pair.source.points[pair.source.uniform_subsample(NUM_SCENE)])
    few, scenes = [], []
    for scan, which in ((pair.source, here), (pair.target, there)):
        for samples, rows in ((few, which), (scenes, scan.uniform_subsample(NUM_SCENE))):
            samples.append((unit.normalize(scan.points[rows]), scan.normals[rows].double()))
    curvature = [curvature_features(*one, *scene, CURVATURE_RADII) for one, scene in zip(few, scenes, strict=True)]
    features = scaled_together(*curvature)
    first, second = (
        learned_descriptors(_samples(*one, feature), _samples(*scene, feature[:1].expand(len(scene[0]), -1)))
        for one, scene, feature in zip(few, scenes, features, strict=True)
    )
    return first, second


def _samples(points: Tensor, normals: Tensor, features: Tensor) -> OrientedSamples:
    return OrientedSamples(points, normals, features, torch.zeros(len(points), dtype=torch.bool))


def shares(pair: Pair, recipe: Recipe, found: Described) -> tuple[float, float, float]:
    """Return the share of right matches, of source points with one that is right, and the seconds it took."""
    source, target, truth = pair.source.points[found.here], pair.target.points[found.there], pair.truth[found.here]
    begin = time.perf_counter()
    matches = match_descriptors(
        *found.descriptors,
        num_candidates=recipe.num_candidates,
        similarity=recipe.similarity,
        mutual=recipe.mutual,
        max_ratio=recipe.max_ratio,
        separation=RIGHT * pair.diagonal if recipe.max_ratio else 0.0,
        source_points=source,
        target_points=target,
        max_distance=None if recipe.max_distance is None else recipe.max_distance * pair.diagonal,
    )
    row, match = matches.pairs()
    if recipe.prune:
        row, match = (regions_agree if recipe.prune == "ransac" else surroundings_agree)(pair, found, matches)
    seconds = found.seconds + time.perf_counter() - begin
    right = (target[match] - truth[row]).norm(dim=-1) < RIGHT * pair.diagonal
    return float(right.float().mean()), row[right].unique().numel() / len(source), seconds


def regions_agree(pair: Pair, found: Described, matches: DescriptorMatches) -> tuple[Tensor, Tensor]:
    """Return the first candidates that are inliers of the motion of their region, as in the paper."""
    match, points = matches.index[:, 0], pair.source.points[found.here]
    region = torch.cdist(points, points[farthest_points(points, NUM_REGIONS)]).argmin(1)
    own = torch.nn.utils.rnn.pad_sequence(
        [(region == number).nonzero()[:, 0] for number in range(NUM_REGIONS)], batch_first=True, padding_value=-1
    )
    rows, mask = own.clamp(min=0), own >= 0
    there = found.there[match]
    result = ransac_rigid(
        points[rows],
        pair.target.points[there][rows],
        threshold=INLIER * pair.diagonal,
        source_normals=pair.source.normals[found.here][rows],
        target_normals=pair.target.normals[there][rows],
        mask=mask,
    )
    row = rows[result.inliers[:, 0] & mask]
    return row, match[row]


def surroundings_agree(pair: Pair, found: Described, matches: DescriptorMatches) -> tuple[Tensor, Tensor]:
    """Return the candidates with which those around them agree."""
    distances = [ways(scan.points[which]) for scan, which in ((pair.source, found.here), (pair.target, found.there))]
    result = consistent_matches(matches, *distances, radius=0.2 * pair.diagonal, slack=0.02 * pair.diagonal)
    row = (result.support > 0.5).nonzero()[:, 0]
    return row, result.index[row]


def ways(points: Tensor) -> Tensor:
    """Return distances (N, N) along the graph of nearest neighbors, float32."""
    return GeodesicGraph.from_points(points, NUM_NEIGHBORS).distances().float()


def closest_share(pair: Pair) -> float:
    """Return the share of source points whose closest target point is right."""
    found, _ = nearest_neighbor(pair.source.points, pair.target.points)
    return float(((pair.target.points[found] - pair.truth).norm(dim=-1) < RIGHT * pair.diagonal).float().mean())


def print_table(name: str, pairs: list[Pair], recipes: tuple[Recipe, ...]) -> None:
    """Print one line per recipe."""
    print(f"{name}: {len(pairs)} pairs")
    print(f"  {'':31s} {'right':>6s} {'worst':>6s} {'points':>7s} {'s':>6s}")
    closest = torch.tensor([closest_share(pair) for pair in pairs])
    print(f"  {'closest points':31s} {closest.mean():6.1%} {closest.min():6.1%} {closest.mean():7.1%}")
    for divisions, alike in itertools.groupby(recipes, key=lambda recipe: recipe.divisions):
        descriptors = [described(pair, divisions) for pair in pairs]
        for recipe in alike:
            rows = [shares(pair, recipe, found) for pair, found in zip(pairs, descriptors, strict=True)]
            right, reached, seconds = torch.tensor(rows).nan_to_num(0.0).unbind(-1)
            line = f"  {recipe.label:31s} {right.mean():6.1%} {right.min():6.1%}"
            print(f"{line} {reached.mean():7.1%} {seconds.median():6.2f}", flush=True)


def main(arguments: list[str] | None = None) -> int:
    """Print the tables; return 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of NPZ pairs; without it, made-up pairs only")
    parser.add_argument("--pairs", type=int, default=5, help="made-up pairs per group")
    parser.add_argument("--smoke", action="store_true", help="two pairs and two recipes, for a quick look")
    options = parser.parse_args(arguments)
    if options.data is None or not options.data.is_dir():
        print("skipped: pairs from files; name their folder with --data")
    print(f"right: matches within {RIGHT:.0%} of the diagonal; points: source points with at least one right match")
    for name, pairs in groups(options.data, options.pairs):
        print_table(name, pairs[:2] if options.smoke else pairs, RECIPES[-1:] if options.smoke else RECIPES)
        if options.smoke:
            break
    return 0


if __name__ == "__main__":
    sys.exit(main())
