"""Alignments per second: one at a time, in a batch, with a search, and where the time goes.

500 model points, 1,000 data points (a third of them outliers), 27 degrees of freedom, five sigma steps, then the
surface fit. Starts are 5 degrees off per joint, as in tracking; the cost of a search, which far starts trigger, is
shown beside it. On a CPU seconds are those of the process, so that other programs hardly count. On a GPU: ``--device
cuda``. Hands without a start, alone and in a batch, of 600 points: ``--without-start``; two trees side by side:

    for tree in BEFORE AFTER; do PYTHONPATH=$tree OMP_NUM_THREADS=1 python benchmarks/speed.py --without-start; done
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

import torchreg as tr
from torchreg.datasets.hand import make_hand_cloud, random_hand_pose, surface_skin

BAR_PER_SECOND = 30.0


def make_problems(
    hand: tr.Hand, count: int, start_deg: float, seed: int = 0, points: int = 1000
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return ``count`` clouds (B, points, 3) and starts (B, 27) that are ``start_deg`` off per joint."""
    generator = torch.Generator().manual_seed(seed)
    skin = surface_skin(hand)
    clouds, starts = [], []
    for _ in range(count):
        pose = random_hand_pose(hand, generator)
        cloud = make_hand_cloud(
            hand, pose, num_points=round(2 * points / 3), outlier_ratio=0.333, camera=torch.zeros(3), skin=skin,
            generator=generator,
        )  # fmt: skip
        signs = 2 * torch.randint(0, 2, (21,), generator=generator) - 1
        start = pose.clone()
        start[6:] += signs * torch.deg2rad(torch.tensor(start_deg))
        clouds.append(cloud.points[torch.arange(points) % len(cloud.points)])
        starts.append(hand.clamp(start))
    return torch.stack(clouds), torch.stack(starts)


def best_time(run: Callable[[], object], repeats: int) -> float:
    """Return the shortest of several times, seconds: the one least disturbed by other programs."""
    clock, times = time.perf_counter if torch.cuda.is_available() else time.process_time, []
    for _ in range(repeats):
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        begin = clock()
        run()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        times.append(clock() - begin)
    return min(times)


def rate_singly(
    hand: tr.Hand, clouds: torch.Tensor, starts: torch.Tensor, config: tr.AlignConfig, repeats: int
) -> float:
    """Return alignments per second, one call each."""
    skin = tr.sample_skin(hand, 500)

    def run() -> None:
        for cloud, start in zip(clouds, starts, strict=True):
            tr.align(hand, cloud, start, model_points=skin, config=config)

    return len(clouds) / best_time(run, repeats)


def rate_batched(hand: tr.Hand, clouds: torch.Tensor, starts: torch.Tensor, repeats: int) -> float:
    """Return alignments per second, all in one call."""
    skin, config = tr.sample_skin(hand, 500), tr.AlignConfig(search="never")
    return len(clouds) / best_time(lambda: tr.align(hand, clouds, starts, model_points=skin, config=config), repeats)


def print_without_start(hand: tr.Hand, clouds: torch.Tensor, repeats: int) -> None:
    """Print alignments per second without a start, one call each and all in one call."""
    skin, few = tr.sample_skin(hand, 500), clouds[: max(len(clouds) // 4, 1)]
    tr.align(hand, clouds[:1], model_points=skin)
    alone = len(few) / best_time(lambda: [tr.align(hand, cloud, model_points=skin) for cloud in few], repeats)
    batch = len(clouds) / best_time(lambda: tr.align(hand, clouds, model_points=skin), repeats)
    print(
        f"without a start, {clouds.shape[1]} points: alone {alone:.2f}, batch of {len(clouds)} {batch:.2f} per second"
    )


def print_profile(hand: tr.Hand, clouds: torch.Tensor, starts: torch.Tensor, config: tr.AlignConfig) -> None:
    """Print which operations the time of single alignments goes to."""
    skin = tr.sample_skin(hand, 500)
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        for cloud, start in zip(clouds, starts, strict=True):
            tr.align(hand, cloud, start, model_points=skin, config=config)
    averages = sorted(profile.key_averages(), key=lambda item: -item.self_cpu_time_total)
    total = sum(item.self_cpu_time_total for item in averages)
    print(f"\n{sum(item.count for item in averages) // len(clouds)} operations per alignment; most time goes to")
    for item in averages[:10]:
        print(f"  {item.key:28s} {item.self_cpu_time_total / total:6.1%}  {item.count // len(clouds):5d} calls")


def main(argv: Sequence[str] | None = None) -> None:
    """Run the measurements and print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="a seconds-long version")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--without-start", action="store_true", help="hands of 600 points without a start alone")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(arguments.threads)
    hand = tr.Hand()
    count, repeats = (1, 1) if arguments.smoke else (32, 5)
    if arguments.without_start:
        print_without_start(hand, make_problems(hand, count, 5.0, points=600)[0], min(repeats, 2))
        return
    clouds, starts = make_problems(hand, count, 5.0)
    hand = hand.to(arguments.device)
    clouds, starts = clouds.to(arguments.device), starts.to(arguments.device)
    descent = tr.AlignConfig(search="never")
    rate_singly(hand, clouds[:2], starts[:2], descent, 1)
    single_steps = rate_singly(hand, clouds, starts, replace(descent, em_steps=1), repeats)
    print(f"{'one EM step per sigma':24s} {single_steps:7.1f} alignments/s (bar {BAR_PER_SECOND:.0f})")
    singly = rate_singly(hand, clouds, starts, descent, repeats)
    print(f"{'two, the default':24s} {singly:7.1f} alignments/s (bar {BAR_PER_SECOND:.0f})")
    automatic = rate_singly(hand, clouds, starts, replace(descent, search="auto"), repeats)
    print(f"{'search where needed':24s} {automatic:7.1f} alignments/s")
    few = slice(0, max(count // 4, 1))
    searched = rate_singly(hand, clouds[few], starts[few], replace(descent, search="always"), 1)
    print(f"{'search always':24s} {searched:7.1f} alignments/s")
    for size in (1, 8, 32) if not arguments.smoke else (1,):
        batched = rate_batched(hand, clouds[:size], starts[:size], repeats)
        print(
            f"{f'batch of {size}':24s} {batched:7.1f} alignments/s, {batched / singly:.2f} of the default one at a time"
        )
    # A profile of few operations is quickly evaluated.
    profiled = replace(descent, schedule=tr.SigmaSchedule.geometric(0.01, 0.005, 2), surface_steps=0)
    print_profile(hand, clouds[:2], starts[:2], profiled if arguments.smoke else descent)


if __name__ == "__main__":
    main()
