"""How fast and how right `PoseInitializer` is on batches of hands, from starts and from scratch, and its gradients.

    python benchmarks/pose_initializer.py            # every figure, some minutes
    python benchmarks/pose_initializer.py --smoke    # a few clouds, to see that it runs

Data: 512 points of the side of a hand that a camera half a metre away sees, 10 % of them outliers, 1 mm noise, any
rotation, each joint bent by up to half its range. A cloud is right if its fingertips are off by at most 10 mm on
average.

- start: from starts that are off by 0.1 rad in every joint and 5 mm in place, batch by batch.
- scratch: without starts. Bars: 85 % right, and confidence that ranks the failures, AUROC of 0.9.
- gradient: of a random function of the keypoints in the points of one whole hand, float64, against central differences
  of fourth order. Bar: 1e-5 relative.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import torch
from torch import Tensor

import torchreg as tr
from torchreg.datasets.hand import make_hand_cloud, surface_skin
from torchreg.geometry.rotation import so3_log
from torchreg.geometry.rotation_representations import rotation_from_quaternion

NUM_POINTS, NOISE, OUTLIERS, DISTANCE, BEND = 512, 0.001, 0.1, 0.5, 0.5
TIPS, RIGHT = [4, 8, 12, 16, 20], 0.01
JOINT_STD, PLACE_STD = 0.1, 0.005
BAR_RIGHT, BAR_AUROC, BAR_GRADIENT = 0.85, 0.9, 1e-5


def draw(
    hand: tr.Hand, count: int, generator: torch.Generator, *, front: bool = True, num_points: int = NUM_POINTS
) -> tuple[Tensor, Tensor]:
    """Return clouds (count, M, 3) and their poses (count, num_dofs)."""
    poses = hand.rest_pose().repeat(count, 1)
    share = BEND * torch.rand(count, hand.num_dofs - 6, generator=generator).to(poses)
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


def auroc(confidence: Tensor, right: Tensor) -> float:
    """Return how often a right cloud is surer than a wrong one; NaN where all are right or all wrong."""
    gaps = confidence[right].unsqueeze(-1) - confidence[~right]
    return float(((gaps > 0).double() + 0.5 * (gaps == 0)).mean())


@torch.no_grad()
def from_starts(hand: tr.Hand, count: int, batch: int, generator: torch.Generator) -> dict[str, float]:
    layer = tr.PoseInitializer(hand)
    clouds, poses = draw(hand, count, generator)
    starts = disturbed(hand, poses, generator)
    layer(clouds[:1], start=starts[:1])
    begin, errors = time.perf_counter(), []
    for rows in torch.arange(count).split(batch):
        errors.append(tip_errors(hand, layer(clouds[rows], start=starts[rows]).pose, poses[rows]))
    seconds, error = time.perf_counter() - begin, torch.cat(errors)
    return {
        "clouds_per_second": count / seconds,
        "start_mm": 1e3 * float(tip_errors(hand, starts, poses).mean()),
        "median_mm": 1e3 * float(error.median()),
        "right": float((error <= RIGHT).double().mean()),
    }


@torch.no_grad()
def from_scratch(hand: tr.Hand, count: int, generator: torch.Generator) -> dict[str, float]:
    layer = tr.PoseInitializer(hand)
    clouds, poses = draw(hand, count, generator)
    begin = time.perf_counter()
    found = layer(clouds)
    seconds, error = time.perf_counter() - begin, tip_errors(hand, found.pose, poses)
    right = error <= RIGHT
    return {
        "clouds_per_second": count / seconds,
        "median_mm": 1e3 * float(error.median()),
        "right": float(right.double().mean()),
        "auroc": auroc(found.confidence, right),
    }


def gradient_error(generator: torch.Generator, num_points: int = NUM_POINTS) -> dict[str, float]:
    """Return the relative difference of the implicit gradient from central differences along a random direction."""
    hand = tr.Hand(dtype=torch.float64).requires_grad_(False)
    points, poses = draw(hand, 1, generator, front=False, num_points=num_points)
    start = disturbed(hand, poses, generator)
    config = tr.PoseInitializerConfig(fit_steps=10, newton_steps=3, noise=0.002)
    layer = tr.PoseInitializer(hand, config)
    weights = torch.randn(1, 21, 3, generator=generator, dtype=torch.float64)
    direction = torch.randn(points.shape, generator=generator, dtype=torch.float64)

    def function(cloud: Tensor) -> Tensor:
        return (weights * layer(cloud.requires_grad_(), start=start).keypoints).sum()

    leaf = points.clone()
    value = function(leaf)
    begin = time.perf_counter()
    (gradient,) = torch.autograd.grad(value, leaf)
    seconds = time.perf_counter() - begin
    size = 1e-6
    values = [float(function(points + shift * size * direction).detach()) for shift in (-2, -1, 1, 2)]
    slope = (8 * (values[2] - values[1]) - (values[3] - values[0])) / (12 * size)
    return {"relative_error": abs(float((gradient * direction).sum()) / slope - 1), "backward_seconds": seconds}


def main(arguments: Sequence[str] | None = None) -> dict[str, dict[str, float]]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clouds", type=int, default=500, help="from starts, and from scratch (default 500)")
    parser.add_argument("--batch", type=int, default=64, help="of clouds from starts (default 64)")
    parser.add_argument("--threads", type=int, default=2, help="of torch (default 2)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--smoke", action="store_true", help="one cloud")
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    count, hand = 1 if options.smoke else options.clouds, tr.Hand().requires_grad_(False)
    generator = torch.Generator().manual_seed(options.seed)
    figures = {"gradient": gradient_error(generator, 150 if options.smoke else NUM_POINTS)}
    figures["start"] = from_starts(hand, count, options.batch, generator)
    figures["scratch"] = from_scratch(hand, count, generator)
    for case, row in figures.items():
        print(f"{case:9}" + "  ".join(f"{name} {value:.4g}" for name, value in row.items()))
    passed = {
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
