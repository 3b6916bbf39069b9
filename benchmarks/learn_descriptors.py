"""Learn which numbers about a place of a scan stay the same while a thing moves, from made-up scans alone.

Random toys, people and animals of random proportions move at random; wherever two scans show one place, descriptors
should agree, elsewhere within reach they should not. This writes the file that comes with the package (8 minutes); what
it is worth is printed by `benchmarks/spin_images.py`.

    python benchmarks/learn_descriptors.py torchreg/registration/dense/learned_descriptors.safetensors
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from discriminants import difference_moments, linear_discriminants
from torch import Tensor
from tqdm import tqdm

from torchreg.datasets.bodies import Proportions
from torchreg.datasets.scan_sequences import ScanPair, ScanSequence, jointed_toy, walking_animal, walking_figure
from torchreg.datasets.toys import random_toy
from torchreg.geometry.neighbors import nearest_neighbor
from torchreg.io.tensors import save_tensors
from torchreg.registration.dense.config import ScanAlignConfig
from torchreg.registration.dense.learned_descriptors import BIN_SIZES, CURVATURE_RADII, IMAGE_SIZE, surface_descriptors
from torchreg.registration.dense.oriented_samples import OrientedSamples
from torchreg.registration.dense.problem import SCENE, describe

NUM_SEQUENCES, NUM_DIRECTIONS, RIDGE = 120, 32, 0.03
# Frames of a sequence; each is in one pair.
_FRAMES = 6
# Shares of the size: a target sample this near shows the same place; others are drawn from within reach.
SAME, REACH = 0.015, 0.35
# Standard deviation of logarithms of proportions.
_SPREAD = 0.25


def made_up_pairs(num_sequences: int, seed: int = 0) -> Iterator[ScanPair]:
    """Yield pairs of scans of toys, people and animals in turn, three pairs of each."""
    generator = torch.Generator().manual_seed(seed)
    kinds = (_toy, _person, _animal)
    for number in range(num_sequences):
        sequence = kinds[number % len(kinds)](generator, seed * 1000 + number)
        for frame in range(0, _FRAMES, 2):
            yield sequence.pair(frame, frame + 1)


def moments(pair: ScanPair, config: ScanAlignConfig, generator: torch.Generator) -> tuple[Tensor, Tensor, int]:
    """Return sums of squared differences (D, D) at one place and at two, and of how many places."""
    problem = describe(pair.source, pair.target, config, generator)
    source = problem.source.first(min(config.match.num_points, len(problem.samples)))
    target = problem.target.first(SCENE)
    truth = problem.unit.normalize(pair.truth.double())[problem.samples[: len(source)]]
    same, apart = nearest_neighbor(truth, target.points)
    seen = (apart < SAME).nonzero()[:, 0]
    here, there = (_described(samples, scan) for samples, scan in ((source, problem.source), (target, problem.target)))
    near = torch.cdist(source.points[seen], target.points) < REACH
    # A thing that leaped out of reach still has other places.
    other = torch.multinomial(near.double() + 1e-9, 1, generator=generator)[:, 0]
    within = difference_moments(here[seen], there[same[seen]])
    return within, difference_moments(here[seen], there[other]), len(seen)


def learn(
    num_sequences: int = NUM_SEQUENCES,
    count: int = NUM_DIRECTIONS,
    *,
    seed: int = 0,
    config: ScanAlignConfig | None = None,
    on_pair: Callable[[ScanPair], object] = lambda pair: None,
) -> tuple[Tensor, int]:
    """Return the best directions (D, count), and how many true matches they were learned from."""
    config, generator = config or ScanAlignConfig(), torch.Generator().manual_seed(seed)
    within, between, total = torch.zeros(()), torch.zeros(()), 0
    for pair in made_up_pairs(num_sequences, seed):
        one_place, two_places, number = moments(pair, config, generator)
        within, between, total = within + one_place, between + two_places, total + number
        on_pair(pair)
    return linear_discriminants(within / total, between / total, count, ridge=RIDGE), total


def main(arguments: list[str] | None = None) -> int:
    """Learn directions, in half precision, and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="to be written, ending in .safetensors")
    parser.add_argument("--sequences", type=int, default=NUM_SEQUENCES, help="of six frames each (default %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--smoke", action="store_true", help="learn from one toy, one person and one animal")
    options = parser.parse_args(arguments)
    options.sequences = 3 if options.smoke else options.sequences
    with tqdm(total=options.sequences * _FRAMES // 2, unit="pair") as bar:
        directions, total = learn(options.sequences, seed=options.seed, on_pair=lambda pair: bar.update())
    learned = {"sequences": options.sequences, "seed": options.seed, "matches": total, "ridge": RIDGE}
    seen = {"bin_sizes": BIN_SIZES, "image_size": IMAGE_SIZE, "curvature_radii": CURVATURE_RADII}
    save_tensors(options.file, {"directions": directions.half()}, learned | seen)
    return 0


def _described(samples: OrientedSamples, scan: OrientedSamples) -> Tensor:
    return surface_descriptors(samples, scan.first(SCENE))


def _uniform(generator: torch.Generator, low: float, high: float) -> float:
    return low + (high - low) * float(torch.rand((), generator=generator))


def _proportions(generator: torch.Generator) -> Proportions:
    names = [field.name for field in dataclasses.fields(Proportions)]
    factors = torch.exp(_SPREAD * torch.randn(len(names), generator=generator)).tolist()
    return Proportions(**dict(zip(names, factors, strict=True)))


def _toy(generator: torch.Generator, seed: int) -> ScanSequence:
    toy = random_toy(generator, int(_uniform(generator, 4, 10)))
    return jointed_toy(_FRAMES, seed, toy=toy, step=math.radians(_uniform(generator, 15, 50)))


def _person(generator: torch.Generator, seed: int) -> ScanSequence:
    cycles, turn = _pace(generator)
    proportions = _proportions(generator)
    return walking_figure(_FRAMES, seed, proportions=proportions, cycles_per_frame=cycles, turn=turn)


def _animal(generator: torch.Generator, seed: int) -> ScanSequence:
    cycles, turn = _pace(generator)
    gait, proportions = ("trot", "walk")[int(_uniform(generator, 0, 2))], _proportions(generator)
    return walking_animal(_FRAMES, seed, gait=gait, proportions=proportions, cycles_per_frame=cycles, turn=turn)


def _pace(generator: torch.Generator) -> tuple[float, float]:
    """Return strides and turns, radians, of up to five times what a camera's adjacent frames show."""
    return _uniform(generator, 0.1, 0.4), math.radians(_uniform(generator, 2, 12))


if __name__ == "__main__":
    sys.exit(main())
