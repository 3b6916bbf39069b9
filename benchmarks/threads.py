"""Two Python threads at once: what each gives is, bit for bit, what it gives alone, and torch keeps its threads.

Every round starts two threads together, which extract a spine, align a hand and register two scans, each on data of
its own and in an order of its own. Data are made up, so that nothing is downloaded.
"""

from __future__ import annotations

import argparse
import math
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import torch
from torch import Tensor

import torchreg as tr
from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.hand import make_hand_cloud, random_hand_pose
from torchreg.datasets.scan_sequences import jointed_toy

Call = Callable[[], list[Tensor]]


def make_calls(seed: int, hand: tr.Hand, num_frames: int, num_points: int, workers: int) -> list[Call]:
    """Return calls of three systems on the data of one seed; all use the same hand."""
    meshes = creature_sequence(STARFISH, num_frames + seed, resolution=28).meshes[seed:]
    pose = random_hand_pose(hand, torch.Generator().manual_seed(seed))
    cloud = make_hand_cloud(hand, pose, num_points=400, camera=torch.zeros(3)).points
    pair = jointed_toy(2, seed=seed, scanner=DepthScanner(num_points=num_points), step=math.radians(20)).pair(0, 1)

    def spine() -> list[Tensor]:
        found = tr.extract_spine(meshes, workers=workers)
        return [found.curves, found.radii]

    def align() -> list[Tensor]:
        found = tr.align(hand, cloud, initial_pose=hand.rest_pose() + 0.02, config=tr.AlignConfig(seed=seed))
        return [found.pose, found.distances]

    def register() -> list[Tensor]:
        found = tr.register(pair.source, pair.target)
        return [found.deformed, found.weights]

    return [spine, align, register]


def run_round(pairs: Sequence[list[Call]], shift: int) -> list[list[list[Tensor]]]:
    """Return the outputs of each thread's calls, made side by side from call number ``shift`` on."""
    barrier = threading.Barrier(len(pairs))

    def run(number: int) -> list[list[Tensor]]:
        calls = pairs[number]
        order = [(shift + number + step) % len(calls) for step in range(len(calls))]
        barrier.wait()
        found = {call: calls[call]() for call in order}
        return [found[call] for call in range(len(calls))]

    with ThreadPoolExecutor(len(pairs)) as pool:
        return list(pool.map(run, range(len(pairs))))


def count_differences(alone: Sequence[list[list[Tensor]]], found: Sequence[list[list[Tensor]]]) -> int:
    """Return how many calls gave another result than alone."""
    pairs = [(a, b) for before, now in zip(alone, found, strict=True) for a, b in zip(before, now, strict=True)]
    return sum(not all(torch.equal(x, y) for x, y in zip(a, b, strict=True)) for a, b in pairs)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--smoke", action="store_true", help="a version of seconds")
    options = parser.parse_args(arguments)
    rounds = 1 if options.smoke else options.rounds
    hand = tr.Hand()
    frames, points, workers = (3, 200, 1) if options.smoke else (4, 1000, 2)
    pairs = [make_calls(seed, hand, frames, points, workers) for seed in (0, 1)]
    begin = time.perf_counter()
    alone = [[call() for call in calls] for calls in pairs]
    before = torch.get_num_threads()
    different = sum(count_differences(alone, run_round(pairs, number)) for number in range(rounds))
    with ThreadPoolExecutor(1) as pool:
        after = torch.get_num_threads(), pool.submit(torch.get_num_threads).result()
    print(f"2 threads x {rounds} rounds of extract_spine, align, register ({time.perf_counter() - begin:.0f} s)")
    print(f"calls that gave other bits than alone: {different} of {rounds * 6}")
    print(f"threads of torch: {before} before, {after[0]} after, {after[1]} in a new thread")


if __name__ == "__main__":
    main()
