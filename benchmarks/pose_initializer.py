"""How fast and how right `PoseInitializer` is on batches of hands, from starts and from scratch, and its gradients.

    python benchmarks/pose_initializer.py                  # every figure; half an hour or more on one core
    python benchmarks/pose_initializer.py --device cuda    # on a GPU, where there is one
    python benchmarks/pose_initializer.py --smoke          # a cloud of each, to see that it runs

Data: 512 points of the side of a hand that a camera half a metre away sees, 10 % of them outliers, 1 mm noise, any
rotation, each joint bent by up to half its range. A cloud is right if its fingertips are off by at most 10 mm on
average.

- start: from starts that are off by 0.1 rad in every joint and 5 mm in place; clouds per second by size of the batch.
- proposed: without starts, by the network that comes with torchreg: 600 points, 15 % of them outliers, fingers that
  curl (`random_hand_pose`), right within 15 mm; clouds per CPU second. Bars: 92 % right, 20 a second. Beside it by
  what the camera sees most of (palm, back, an edge, or along the fingers), and by how many last phalanges have fewer
  than 4 points.
- pictures: the same on SHARED/hand_depth, real depth pictures cut to what is within 19 cm of the marked middle
  fingertip, as in `depth_frames.py`; beside it by the search. ``--data SHARED``; skipped without.
- scratch: without starts, by a search alone. Bars: 85 % right, and confidence that ranks the failures, AUROC of 0.9.
  Beside it, without a bar, fingers bent over their full range. The second table says of how many clouds of a
  confidence are right.
- roofline: evaluations of a point against a solid per second, beside the exponentials per second that the device
  reaches, one of which each evaluation needs; and the operations that take most time.
- gradient: of a random function of the keypoints in the points of one whole hand, float64, against central differences
  of fourth order. Bar: 1e-5 relative.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import torch
from confidence import area_under_curve
from depth_frames import REACH, marked_tips
from find_pose import seen_tips
from torch import Tensor

import torchreg as tr
from torchreg.datasets.hand import HandCloud, make_hand_cloud, random_hand_pose, surface_skin
from torchreg.geometry.rotation import so3_log
from torchreg.geometry.rotation_representations import rotation_from_quaternion

Figures = dict[str, float]

NUM_POINTS, NOISE, OUTLIERS, DISTANCE = 512, 0.001, 0.1, 0.5
HALF, FULL = 0.5, 1.0
TIPS, RIGHT = [4, 8, 12, 16, 20], 0.01
JOINT_STD, PLACE_STD = 0.1, 0.005
BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
# Elements of the vector, and columns of the matrices, on which the device is measured; how often.
VECTOR, COLUMNS, REPEATS = {"cpu": 2**15, "cuda": 2**26}, {"cpu": 1024, "cuda": 8192}, 20
QUICK = tr.FindPoseConfig(num_candidates=8, num_placed=2, num_searched=1, search_rounds=1)
# Clouds of a profile.
PROFILED = {"cpu": 8, "cuda": 512}
BAR_RIGHT, BAR_AUROC, BAR_GRADIENT = 0.85, 0.9, 1e-5
PICTURE_POINTS = 2000
PROPOSED_POINTS, PROPOSED_OUTLIERS, PROPOSED_RIGHT, SURE = 510, 90, 0.015, 0.5
BAR_PROPOSED, BAR_RATE = 0.92, 20.0
# What a camera sees most of, along the positive and the negative axis of the palm's frame.
VIEWS = (("edge", "edge"), ("back", "palm"), ("along the fingers", "along the fingers"))


def draw(
    hand: tr.Hand,
    count: int,
    generator: torch.Generator,
    *,
    front: bool = True,
    num_points: int = NUM_POINTS,
    bend: float = HALF,
) -> tuple[Tensor, Tensor]:
    """Return clouds (count, M, 3) and their poses (count, num_dofs), each joint bent by up to a share of its range."""
    poses = hand.rest_pose().repeat(count, 1)
    share = bend * torch.rand(count, hand.num_dofs - 6, generator=generator).to(poses)
    poses[:, 6:] = share * hand.upper[6:].clamp_min(0)
    quaternions = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    poses[:, 3:6] = so3_log(rotation_from_quaternion(quaternions)).to(poses)
    poses[:, 2] = DISTANCE
    surface = surface_skin(hand)
    clouds = [
        make_hand_cloud(
            hand, pose, num_points=num_points, noise=NOISE, outlier_ratio=OUTLIERS if front else 0.0,
            camera=torch.zeros(3).to(pose) if front else None, skin=surface, generator=generator,
        ).points
        for pose in poses
    ]  # fmt: skip
    return torch.stack(clouds), poses


def disturbed(hand: tr.Hand, poses: Tensor, generator: torch.Generator) -> Tensor:
    """Return starts near the poses."""
    step = JOINT_STD * torch.randn(poses.shape, generator=generator)
    step[:, :3] *= PLACE_STD / JOINT_STD
    return hand.clamp(hand.retract(poses, step.to(poses)))


def tip_errors(hand: tr.Hand, found: Tensor, poses: Tensor) -> Tensor:
    """Return the mean distance (B,) of the fingertips, metres."""
    return (hand.keypoints(found) - hand.keypoints(poses))[:, TIPS].norm(dim=-1).mean(-1)


def auroc_error(area: float, num_right: int, num_wrong: int) -> float:
    """Return the standard error of an AUROC. References: Hanley and McNeil 1982."""
    if not num_right or not num_wrong:
        return math.nan
    first, second = area / (2 - area), 2 * area**2 / (1 + area)
    spread = area * (1 - area) + (num_right - 1) * (first - area**2) + (num_wrong - 1) * (second - area**2)
    return math.sqrt(max(spread, 0.0) / (num_right * num_wrong))


def now(device: torch.device) -> float:
    """Return the time in seconds, once the device has done all that it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


@torch.no_grad()
def from_starts(
    hand: tr.Hand, batches: Sequence[int], generator: torch.Generator, device: torch.device
) -> dict[str, float]:
    """Return how good poses from starts are, and ``per_second_B`` for every size B of the batch."""
    count = min(max(batches), 512)
    clouds, poses = draw(hand, count, generator)
    starts = disturbed(hand, poses, generator)
    hand, clouds, poses, starts = (value.to(device) for value in (hand, clouds, poses, starts))
    layer = tr.PoseInitializer(hand)
    layer(clouds[:1], start=starts[:1])
    figures: dict[str, float] = {"start_mm": 1e3 * float(tip_errors(hand, starts, poses).mean())}
    for batch in batches:
        # A few small batches for one of the smallest would measure the clock.
        some = max(batch, min(count, 16))
        index = torch.arange(some, device=device) % count
        errors, begin = [], now(device)
        for rows in index.split(batch):
            errors.append(tip_errors(hand, layer(clouds[rows], start=starts[rows]).pose, poses[rows]))
        figures[f"per_second_{batch}"] = some / (now(device) - begin)
        error = torch.cat(errors)
    return figures | {"median_mm": 1e3 * float(error.median()), "right": float((error <= RIGHT).double().mean())}


@torch.no_grad()
def from_scratch(
    hand: tr.Hand,
    count: int,
    generator: torch.Generator,
    device: torch.device,
    bend: float,
    config: tr.PoseInitializerConfig,
) -> tuple[dict[str, float], Tensor, Tensor]:
    """Return figures, confidences (count,) and which clouds are right."""
    clouds, poses = draw(hand, count, generator, bend=bend)
    hand, clouds, poses = (value.to(device) for value in (hand, clouds, poses))
    layer = tr.PoseInitializer(hand, config)
    begin = now(device)
    found = layer(clouds)
    seconds, error = now(device) - begin, tip_errors(hand, found.pose, poses)
    right = error <= RIGHT
    area, num_right = area_under_curve(found.confidence, right), int(right.sum())
    share = num_right / count
    figures = {
        "clouds": float(count),
        "clouds_per_second": count / seconds,
        "median_mm": 1e3 * float(error.median()),
        "right": share,
        "right_error": math.sqrt(share * (1 - share) / count),
        "auroc": area,
        "auroc_error": auroc_error(area, num_right, count - num_right),
    }
    return figures, found.confidence.cpu(), right.cpu()


def view_of(hand: tr.Hand, pose: Tensor) -> str:
    """Return what a camera at the origin sees most of in a pose."""
    palm = hand.part_transforms(pose)[0]
    towards = -palm[:3, :3].mT @ palm[:3, 3]
    axis = int(towards.abs().argmax())
    return VIEWS[axis][int(towards[axis] < 0)]


def hidden_tips(hand: tr.Hand, cloud: HandCloud) -> str:
    """Return how many fingertips hardly any points of a cloud show."""
    hidden = int((~seen_tips(hand, cloud)).sum())
    return f"{hidden} hidden" if hidden < 2 else "2 or more hidden"


def by_case(names: Sequence[str], error: Tensor, sure: Tensor) -> str:
    """Return how many clouds of each case are right, a line per case."""
    lines = []
    for name in sorted(set(names)):
        of_case = torch.tensor([each == name for each in names])
        right = (error <= PROPOSED_RIGHT)[of_case].double().mean()
        median = 1e3 * float(error[of_case].median())
        lines.append(
            f"  {name:18} {int(of_case.sum()):5} clouds, right {right:6.1%}, median {median:4.1f} mm, "
            f"sure {sure[of_case].double().mean():6.1%}"
        )
    return "\n".join(lines)


@torch.no_grad()
def proposed(hand: tr.Hand, count: int, generator: torch.Generator, device: torch.device) -> tuple[Figures, str]:
    """Return how good and how fast poses are that a network proposes, and how good by view and by hidden tips."""
    surface, share = surface_skin(hand), PROPOSED_OUTLIERS / (PROPOSED_POINTS + PROPOSED_OUTLIERS)
    poses = torch.stack([random_hand_pose(hand, generator) for _ in range(count)])
    seen = [
        make_hand_cloud(hand, pose, num_points=PROPOSED_POINTS, outlier_ratio=share, camera=torch.zeros(3).to(pose),
                        skin=surface, generator=generator) for pose in poses
    ]  # fmt: skip
    views, hidden = [view_of(hand, pose) for pose in poses], [hidden_tips(hand, cloud) for cloud in seen]
    clouds = torch.stack([cloud.points for cloud in seen])
    hand, clouds, poses = hand.to(device), clouds.to(device), poses.to(device)
    layer = tr.PoseInitializer(hand, tr.PoseInitializerConfig(search="never"))
    layer(clouds[:2])
    wall, cpu = now(device), time.process_time()
    found = layer(clouds)
    wall, cpu = now(device) - wall, time.process_time() - cpu
    error = tip_errors(hand, found.pose, poses)
    right, sure = error <= PROPOSED_RIGHT, found.confidence >= SURE
    figures = {
        "clouds": float(count),
        "per_cpu_second": count / cpu,
        "per_second": count / wall,
        "median_mm": 1e3 * float(error.median()),
        "right": float(right.double().mean()),
        "auroc": area_under_curve(found.confidence, right),
        "sure": float(sure.double().mean()),
        "right_if_sure": float(right[sure].double().mean()),
    }
    return figures, "\n".join(by_case(names, error.cpu(), sure.cpu()) for names in (views, hidden))


@torch.no_grad()
def real_pictures(hand: tr.Hand, folder: Path, search: str) -> dict[str, float]:
    """Return errors of the marked fingertips of real pictures, cut to the hand."""
    layer, errors = tr.PoseInitializer(hand, tr.PoseInitializerConfig(search=search)), []
    begin = time.process_time()
    for name, marks in json.loads((folder / "fingertips_px.json").read_text(encoding="utf-8")).items():
        frame = tr.DepthFrame.load(folder / f"{name}.png", folder / "camera.json")
        tips = marked_tips(frame, marks)
        points = frame.camera.unproject(frame.camera.pixel_grid(), frame.depth.double())
        cut = points[(frame.depth > 0) & ((points - tips[2]).norm(dim=-1) < REACH)]
        some = cut[torch.randperm(len(cut), generator=torch.Generator().manual_seed(0))[:PICTURE_POINTS]]
        errors.append((layer(some).keypoints[TIPS] - tips.to(hand.rest)).norm(dim=-1))
    error = torch.stack(errors)
    return {
        "pictures": float(len(error)),
        "tips_right": float((error <= PROPOSED_RIGHT).double().mean()),
        "whole": float((error <= PROPOSED_RIGHT).all(1).sum()),
        "largest_mm": 1e3 * float(error.max()),
        "seconds": (time.process_time() - begin) / len(error),
    }


def reliability(confidence: Tensor, right: Tensor) -> str:
    """Return of how many clouds of a confidence are right, a line per bin."""
    lines = [f"  {'confidence':12} {'clouds':>6} {'right':>6}"]
    for low, high in pairwise(BINS):
        inside = (confidence >= low) & ((confidence < high) | (high == BINS[-1]))
        if bool(inside.any()):
            lines.append(f"  {low:.1f} to {high:.1f}   {int(inside.sum()):6} {right[inside].double().mean():6.1%}")
    return "\n".join(lines)


@contextmanager
def counted(hand: tr.Hand) -> Iterator[list[int]]:
    """Count the evaluations of a point against a solid: their number is in the list."""
    solids, total = hand.primitives, [0]
    distance, gradient = solids.plane_distance, solids.plane_gradient

    def counting_distance(*args: object) -> Tensor:
        result = distance(*args)
        total[0] += result.numel()
        return result

    def counting_gradient(*args: object) -> tuple[Tensor, ...]:
        result = gradient(*args)
        total[0] += result[0].numel()
        return result

    solids.plane_distance, solids.plane_gradient = counting_distance, counting_gradient
    try:
        yield total
    finally:
        del solids.plane_distance, solids.plane_gradient


def device_limits(device: torch.device) -> dict[str, float]:
    """Return exponentials, and floating-point operations of a matrix product, per second that the device reaches."""
    vector = torch.rand(VECTOR[device.type], device=device)
    columns = COLUMNS[device.type]
    matrix = torch.rand(columns, columns, device=device)
    out, product = torch.empty_like(vector), torch.empty_like(matrix)
    rates = {}
    for name, run, work in (
        ("exp", lambda: torch.exp(vector, out=out), vector.numel()),
        ("flop", lambda: torch.mm(matrix, matrix, out=product), 2 * columns**3),
    ):
        run()
        times = []
        for _ in range(REPEATS):
            begin = now(device)
            run()
            times.append(now(device) - begin)
        rates[name] = work / min(times)
    return rates


@torch.no_grad()
def roofline(
    hand: tr.Hand,
    batch: int,
    generator: torch.Generator,
    device: torch.device,
    cases: Sequence[str],
    config: tr.PoseInitializerConfig,
) -> tuple[dict[str, float], list[str]]:
    """Return evaluations per second in the cases "start" and "scratch" beside the limits, and where the time goes."""
    clouds, poses = draw(hand, batch, generator)
    starts = disturbed(hand, poses, generator)
    hand, clouds, starts = hand.to(device), clouds.to(device), starts.to(device)
    layer = tr.PoseInitializer(hand, config)
    activities = [torch.profiler.ProfilerActivity.CPU]
    if device.type == "cuda":
        activities.append(torch.profiler.ProfilerActivity.CUDA)
    figures, lines = device_limits(device), []
    few = clouds[: 1 if device.type == "cpu" else batch]
    runs = {"start": lambda: layer(clouds, start=starts), "scratch": lambda: layer(few)}
    for name in cases:
        run = runs[name]
        with torch.profiler.profile(activities=activities) as profile:
            run()
        lines.append(f"  {name:8} {top_operations(profile, device)}")
        with counted(hand) as total:
            begin = now(device)
            run()
            seconds = now(device) - begin
        figures[f"{name}_evaluations"] = total[0] / seconds
        figures[f"{name}_share"] = total[0] / seconds / figures["exp"]
    return figures, lines


def top_operations(profile: torch.profiler.profile, device: torch.device) -> str:
    """Return the operations that take most time of the device itself, with their shares."""
    own = "self_device_time_total" if device.type == "cuda" else "self_cpu_time_total"
    averages = sorted(profile.key_averages(), key=lambda item: -getattr(item, own))
    total = sum(getattr(item, own) for item in averages)
    return ", ".join(f"{item.key.removeprefix('aten::')} {getattr(item, own) / total:.0%}" for item in averages[:6])


def gradient_error(generator: torch.Generator, num_points: int = NUM_POINTS) -> dict[str, float]:
    """Return the relative difference of the implicit gradient from central differences along a random direction."""
    hand = tr.Hand(dtype=torch.float64).requires_grad_(False)
    points, poses = draw(hand, 1, generator, front=False, num_points=num_points)
    start = disturbed(hand, poses, generator)
    config = tr.PoseInitializerConfig(fit_steps=10, noise=0.002)
    layer = tr.PoseInitializer(hand, config)
    weights = torch.randn(1, 21, 3, generator=generator, dtype=torch.float64)
    direction = torch.randn(points.shape, generator=generator, dtype=torch.float64)

    leaf = points.clone().requires_grad_()
    value = (weights * layer(leaf, start=start).keypoints).sum()
    begin = time.perf_counter()
    (gradient,) = torch.autograd.grad(value, leaf)
    seconds = time.perf_counter() - begin
    size = 1e-6
    # Side by side, as a batch takes hardly longer than one.
    shifts = torch.tensor([-2.0, -1.0, 1.0, 2.0], dtype=torch.float64).view(-1, 1, 1)
    moved = layer((points + size * shifts * direction).requires_grad_(), start=start.expand(4, -1))
    values = (weights * moved.keypoints).sum((-2, -1)).tolist()
    slope = (8 * (values[2] - values[1]) - (values[3] - values[0])) / (12 * size)
    return {"relative_error": abs(float((gradient * direction).sum()) / slope - 1), "backward_seconds": seconds}


def show(case: str, row: dict[str, float]) -> None:
    print(f"{case:9} " + "  ".join(f"{name} {value:.4g}" for name, value in row.items()), flush=True)


def main(arguments: Sequence[str] | None = None) -> dict[str, dict[str, float]]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clouds", type=int, default=500, help="from scratch, bent half (default 500)")
    parser.add_argument("--full-clouds", type=int, default=100, help="from scratch, bent fully (default 100)")
    parser.add_argument("--proposed-clouds", type=int, default=200, help="from scratch, by the network (default 200)")
    parser.add_argument("--only-proposed", action="store_true", help="the parts by the network alone")
    parser.add_argument("--data", type=Path, help="folder that holds hand_depth; skipped without")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 8, 64, 512, 4096], help="sizes, from starts")
    parser.add_argument("--threads", type=int, default=2, help="of torch (default 2)")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--smoke", action="store_true", help="one cloud of each")
    options = parser.parse_args(arguments)
    device = torch.device(options.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        print("skipped: this machine has no CUDA device")
        return {}
    torch.set_num_threads(options.threads)
    counts = (1, 1) if options.smoke else (options.clouds, options.full_clouds)
    config = tr.PoseInitializerConfig(search="always")
    config = replace(config, find_pose=QUICK) if options.smoke else config
    batches = [1, 2] if options.smoke else options.batches
    print(
        f"device {device.type}, {options.threads} threads, seed {options.seed}; right: tips within {1e3 * RIGHT:g} mm"
    )

    def generator(case: int) -> torch.Generator:
        return torch.Generator().manual_seed(10 * options.seed + case)

    def hand() -> tr.Hand:
        return tr.Hand().requires_grad_(False)

    figures: dict[str, Figures] = {}
    count = 4 if options.smoke else options.proposed_clouds
    figures["proposed"], table = proposed(hand(), count, generator(5), device)
    show("proposed", figures["proposed"])
    print(table)
    if options.data is None:
        print("pictures: skipped; pass the folder that holds hand_depth as --data")
    else:
        for search in ("never", "doubtful", "always"):
            show(f"pictures, search {search}", real_pictures(hand(), options.data / "hand_depth", search))
    if options.only_proposed:
        return tell_bars(figures)
    figures["gradient"] = gradient_error(generator(0), 150 if options.smoke else NUM_POINTS)
    show("gradient", figures["gradient"])
    figures["start"] = from_starts(hand(), batches, generator(1), device)
    show("start", figures["start"])
    # Profiles of many operations take long to evaluate: a smoke run leaves out that of a search, and most steps.
    cases = ("start",) if options.smoke else ("start", "scratch")
    batch = 2 if options.smoke else PROFILED[device.type]
    profiled = replace(config, sigma_steps=1, em_steps=1, surface_steps=0, fit_steps=1) if options.smoke else config
    figures["roofline"], profile = roofline(hand(), batch, generator(2), device, cases, profiled)
    show("roofline", figures["roofline"])
    print("\n".join(profile), flush=True)
    for case, count, bend, number in (("scratch", counts[0], HALF, 3), ("full", counts[1], FULL, 4)):
        figures[case], confidence, right = from_scratch(hand(), count, generator(number), device, bend, config)
        show(case, figures[case])
        print(reliability(confidence, right), flush=True)
    return tell_bars(figures)


def tell_bars(figures: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Print which bars are reached, and return the figures."""
    passed = {
        f"right by the network >= {BAR_PROPOSED:.0%}": figures["proposed"]["right"] >= BAR_PROPOSED,
        f"clouds per CPU second >= {BAR_RATE:g}": figures["proposed"]["per_cpu_second"] >= BAR_RATE,
    }
    if "scratch" in figures:
        passed |= {
            f"gradient within {BAR_GRADIENT:g}": figures["gradient"]["relative_error"] <= BAR_GRADIENT,
            f"right from scratch >= {BAR_RIGHT:.0%}": figures["scratch"]["right"] >= BAR_RIGHT,
            # Without a failure there is nothing to rank.
            f"AUROC >= {BAR_AUROC:g}": not figures["scratch"]["auroc"] < BAR_AUROC,
        }
    for bar, reached in passed.items():
        print(f"{bar}: {'pass' if reached else 'FAIL'}")
    return figures


if __name__ == "__main__":
    main()
