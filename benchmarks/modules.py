"""What the library's modules learn by gradients: a hand's sizes and radii, its fusion length and its bending.

    python benchmarks/modules.py            # the table below, a few minutes
    python benchmarks/modules.py --smoke    # a few steps of each, to see that it runs

- sizes: the model's bone lengths and radii are 12 % too large. Six clouds of 500 points, each coordinate off by 1 mm,
  in known poses and in poses that are learnt with the sizes; 150 steps of Adam on `EMLoss` (sigma 2 mm). The error is
  the mean distance of the 21 keypoints from the true ones, before and after.
- fusion: the true hand has another fusion length nu and another sharpness of its skin. Marks on its skin, off by
  0.5 mm, in six poses; 150 steps of Adam on `EMLoss`, which is not told which mark is which.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

import torchreg as tr
from torchreg.datasets.hand import make_hand_cloud, random_hand_pose, surface_skin

Row = tuple[str, str]


@dataclass(frozen=True)
class Effort:
    """How much is done.

    Args:
        steps: of Adam.
        frames: clouds.
        points: per cloud.
    """

    steps: int = 150
    frames: int = 6
    points: int = 500


def make_poses(hand: tr.Hand, count: int, generator: torch.Generator) -> Tensor:
    """Return poses (T, 27) of the hand, with every joint anywhere in its range."""
    return torch.stack([random_hand_pose(hand, generator) for _ in range(count)])


def make_clouds(hand: tr.Hand, poses: Tensor, points: int, generator: torch.Generator) -> Tensor:
    """Return a cloud (T, N, 3) of the hand's whole surface in each pose, each coordinate off by 1 mm."""
    skin = surface_skin(hand)
    clouds = [
        make_hand_cloud(hand, pose, num_points=points, noise=1e-3, outlier_ratio=0.0, skin=skin, generator=generator)
        for pose in poses
    ]
    return torch.stack([cloud.points for cloud in clouds])


def keypoint_error(hand: tr.Hand, poses: Tensor, truth: Tensor) -> float:
    """Return the mean distance of keypoints from the true ones (T, 21, 3), millimeters."""
    with torch.no_grad():
        return 1e3 * float((hand.keypoints(poses) - truth).norm(dim=-1).mean())


def learn(hand: tr.Hand, poses: Tensor, clouds: Tensor, groups: list[dict[str, object]], steps: int) -> None:
    """Take steps of Adam on the EM loss of the hand's points in some poses and clouds of it."""
    loss, optimizer = tr.EMLoss(0.002, reduction="mean"), torch.optim.Adam(groups)
    for _ in range(steps):
        optimizer.zero_grad()
        loss(hand(poses).points, clouds).mean().backward()
        optimizer.step()


def sizes_rows(effort: Effort) -> list[Row]:
    """Learn bone lengths and radii that start 12 % too large."""
    truth, rows = tr.Hand(), []
    generator = torch.Generator().manual_seed(0)
    true_poses = make_poses(truth, effort.frames, generator)
    clouds = make_clouds(truth, true_poses, effort.points, generator)
    keypoints = truth.keypoints(true_poses)
    for kind in ("known", "learnt"):
        hand, poses = tr.Hand(), true_poses.clone()
        scales = [hand.log_length_scales, hand.log_radius_scales]
        for scale in scales:
            scale.fill_(math.log(1.12)).requires_grad_(True)
        groups: list[dict[str, object]] = [{"params": scales, "lr": 0.01}]
        if kind == "learnt":
            groups.append({"params": [poses.requires_grad_(True)], "lr": 0.003})
        before = keypoint_error(hand, poses, keypoints)
        learn(hand, poses, clouds, groups, effort.steps)
        after = keypoint_error(hand, poses, keypoints)
        rows.append((f"sizes, poses {kind}", f"{before:5.1f} mm -> {after:4.1f} mm, {after / before:.2f} of the first"))
    return rows


def fusion_rows(effort: Effort) -> list[Row]:
    """Learn nu and the sharpness of the bending skin from marks on the skin."""
    rows = []
    for nu, sharpness in ((0.004, 5.0), (0.002, 1.2)):
        generator = torch.Generator().manual_seed(1)
        truth, hand = tr.Hand(), tr.Hand()
        truth.log_nu.fill_(math.log(nu))
        truth.log_sharpness.fill_(math.log(sharpness))
        poses = make_poses(truth, effort.frames, generator)
        marks = truth(poses).points
        marks = marks + 5e-4 * torch.randn(marks.shape, generator=generator)
        learnt = [hand.log_nu.requires_grad_(True), hand.log_sharpness.requires_grad_(True)]
        learn(hand, poses, marks, [{"params": learnt, "lr": 0.03}], effort.steps)
        rows.append(("nu", f"  3.0 mm -> {1e3 * hand.nu:4.2f} mm, truth {1e3 * nu:.1f} mm"))
        rows.append(("sharpness", f"  2.0 -> {hand.sharpness:4.2f}, truth {sharpness:.1f}"))
    return rows


TABLES: dict[str, Callable[[Effort], list[Row]]] = {"sizes": sizes_rows, "fusion": fusion_rows}


def main(argv: Sequence[str] | None = None) -> dict[str, list[Row]]:
    """Run what is asked for, print the rows and return them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="a few steps of each")
    parser.add_argument("--only", choices=list(TABLES), help="one of the tables")
    arguments = parser.parse_args(argv)
    effort = Effort(steps=3, frames=2, points=100) if arguments.smoke else Effort()
    tables = {}
    for name in [arguments.only] if arguments.only else list(TABLES):
        tables[name] = TABLES[name](effort)
        for title, figure in tables[name]:
            print(f"{title:<24}{figure}", flush=True)
    return tables


if __name__ == "__main__":
    main()
