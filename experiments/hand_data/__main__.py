"""``python -m experiments.hand_data -o hand_data.safetensors``: train the network of the hand's data.

Half of the batches are windows of made-up rooms with held things, on the seeds of the calibration, the others made-up
clouds of hands with forearms and held things. It starts as the network that proposes the hand's poses.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits
from tqdm import tqdm

import torchreg as tr
from torchreg.alignment.search.pose_proposer import HAND_WEIGHTS, PoseProposer
from torchreg.alignment.search.segmenter import Segmenter
from torchreg.capture.depth_segments import SurfaceGrid
from torchreg.datasets import cloud_batches
from torchreg.datasets.cloud_batches import random_clouds, random_poses
from torchreg.datasets.cloud_clutter import Clutter
from torchreg.geometry.rotation import so3_exp

from ..made_up.rooms import KINDS, TRAINING_SEEDS

BATCH, RATE, WARM_UP, SURFACE_POINTS = 40, 6e-4, 30, 3000
RADIUS, OFF, JITTER, STRETCH = (0.42, 0.55), 0.04, 0.002, 0.06  # of windows: shares of the hand's size
# Of made-up clouds: windows as a grid of a picture's surfaces gives them, nearly all with a held thing.
VARIETY = replace(
    cloud_batches._VARIETY, absent=0.05, scene=1.0, neighbor=0.0, thing=0.8, plane=0.35, whole=0.0,
    noise=(0.001, 0.006), outliers=0.15, forearm=0.7, thinned=0.3, hole=0.2,
)  # fmt: skip
STICKS, STICK_RADIUS, STICK_LENGTH, GRIPPED = 0.25, (0.013, 0.06), (0.2, 0.8), 0.75  # lengths: halves
Window = tuple[Tensor, Tensor]


class HeldThings(Clutter):
    """Things of which most are where the hand closes about them, and some are long and thin."""

    def held(self, surface: Tensor, normals: Tensor) -> Window:
        """Return oriented points of things in the middle of three of the hand's, or that touch it."""
        pick = (surface.shape[1] * torch.rand(len(surface), 3, 1, generator=self.generator)).long().expand(-1, -1, 3)
        gripped = self._things(self._sides(len(surface)), surface.gather(1, pick).mean(1))
        beside = super().held(surface, normals)
        is_gripped = torch.rand(len(surface), 1, 1, generator=self.generator) < GRIPPED
        points, facing = (torch.where(is_gripped, *each) for each in zip(gripped, beside, strict=True))
        return points, facing

    def _sides(self, batch: int) -> Tensor:
        radius, long, share = torch.rand(3, batch, 1, generator=self.generator)
        radius = STICK_RADIUS[0] * (STICK_RADIUS[1] / STICK_RADIUS[0]) ** radius
        long = STICK_LENGTH[0] + (STICK_LENGTH[1] - STICK_LENGTH[0]) * long
        return torch.where(share < STICKS, self.size * torch.cat([radius, radius, long], -1), super()._sides(batch))


def windows_of_room(seed: int, size: float, generator: torch.Generator, kind: str = "held") -> list[Window]:
    """Return windows of a room about a hand: points (M, 3) about their middle, metres, and which show the hand (M,)."""
    scene = KINDS[kind](seed, True)
    if scene.shown is None or scene.keypoints is None:
        raise ValueError(f"rooms of kind {kind!r} do not say what shows a hand")
    grid = SurfaceGrid.of(scene.frame, size).without_planes(size)
    points, found = grid.points.float(), []
    column, row = scene.frame.camera.project(grid.points.double())[0].round().long().unbind(-1)
    height, width = scene.shown.shape
    shown = scene.shown[row.clamp(0, height - 1), column.clamp(0, width - 1)]
    middle = scene.keypoints.mean(0)
    for off in (0.0, 0.1, 0.1):
        center = middle + off * size * torch.randn(3, generator=generator)
        inside = (points - center).norm(dim=-1) < RADIUS[1] * size
        if int(inside.sum()) > BATCH:
            found.append((points[inside] - center, shown[inside]))
    return found


def batch_of_rooms(windows: list[Window], net: Segmenter, size: float, generator: torch.Generator) -> Window:
    """Return points (B, M, 3), shares of the size, and labels (B, M): 1 on the hand, 0 off it, NaN for padding.

    Windows are drawn anew: of another radius and middle, turned about the line of sight, stretched, with noise.
    """
    points = torch.zeros(BATCH, net.size.points, 3)
    labels = torch.full(points.shape[:2], torch.nan)
    for number, drawn in enumerate(torch.randint(len(windows), (BATCH,), generator=generator).tolist()):
        cloud, shown = windows[drawn]
        radius, share, angle = torch.rand(3, generator=generator).tolist()
        center = OFF * size * torch.randn(3, generator=generator)
        kept = (cloud - center).norm(dim=-1) < size * (RADIUS[0] + (RADIUS[1] - RADIUS[0]) * radius)
        kept &= torch.rand(len(cloud), generator=generator) < 0.5 + 0.5 * share
        index = kept.nonzero()[:, 0]
        index = index[torch.randperm(len(index), generator=generator)[: net.size.points]]
        turn = so3_exp(torch.tensor([[0.0, 0.0, math.tau * angle]]))[0]
        stretched = cloud[index] / size * (1 + STRETCH * torch.randn(3, generator=generator))
        points[number, : len(index)] = stretched @ turn.mT + JITTER * torch.randn(len(index), 3, generator=generator)
        labels[number, : len(index)] = shown[index].float()
    return points, labels


def made_up_batch(
    hand: tr.Hand, skin: tr.LinearBlendSkin, net: Segmenter, size: float, generator: torch.Generator
) -> Window:
    """Return the same of made-up clouds."""
    with patch.multiple(cloud_batches, _VARIETY=VARIETY, Clutter=HeldThings), torch.no_grad():
        poses = random_poses(hand, BATCH, generator)
        batch = random_clouds(skin, size, poses, net.size.points, generator, in_scenes=True)
    return batch.points / size, torch.where(batch.mask, (batch.index >= 0).float(), torch.nan)


def loss_of(net: Segmenter, points: Tensor, labels: Tensor) -> Tensor:
    """Return the mean logarithmic loss () of tokens."""
    told, index = net(points, labels.isfinite())
    truth = labels.gather(1, index)
    return binary_cross_entropy_with_logits(told[truth.isfinite()], truth[truth.isfinite()])


def begun_as(proposer: PoseProposer) -> Segmenter:
    """Return a network whose tokens, and what of them is no outlier, are those of one that proposes poses."""
    net = Segmenter(replace(proposer.size, decoder=0, hypotheses=1))
    state = {name: value for name, value in proposer.state_dict().items() if name in net.state_dict()}
    state |= {"told.weight": -proposer.surface.weight[3:], "told.bias": -proposer.surface.bias[3:]}
    net.load_state_dict(net.state_dict() | state | {"queries": torch.zeros_like(net.queries)})
    return net


def train(output: Path, rooms: int, minutes: float, seed: int) -> Segmenter:
    """Train for some minutes on windows of ``rooms`` and on made-up clouds, and write the weights."""
    hand, generator = tr.Hand(), torch.Generator().manual_seed(seed)
    proposer = PoseProposer.load(HAND_WEIGHTS, hand)
    net, size, skin = begun_as(proposer), proposer.shape_size, tr.sample_skin(hand, SURFACE_POINTS)
    seeds = tqdm(range(TRAINING_SEEDS, TRAINING_SEEDS + 2 * rooms, 2), desc="rooms", leave=False, disable=None)
    windows = [window for number in seeds for window in windows_of_room(number, size, generator)]
    optimizer, step, begun = torch.optim.AdamW(net.parameters(), lr=RATE, weight_decay=0.01), 0, time.monotonic()
    while (share := (time.monotonic() - begun) / (60 * minutes)) < 1:
        for group in optimizer.param_groups:
            group["lr"] = RATE * min(1.0, (step + 1) / WARM_UP) * (0.5 + 0.5 * math.cos(math.pi * share))
        optimizer.zero_grad()
        arguments = net, size, generator
        drawn = made_up_batch(hand, skin, *arguments) if step % 2 else batch_of_rooms(windows, *arguments)
        loss = loss_of(net, *drawn)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        step += 1
    net.save(output, {"rooms": rooms, "minutes": minutes, "steps": step, "batch": BATCH, "rate": RATE, "seed": seed})
    return Segmenter.load(output)


def main() -> None:
    """Train and write the weights."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True, help="file of the weights, .safetensors")
    parser.add_argument("--rooms", type=int, default=300, help="made-up rooms, .6 s each")
    parser.add_argument("--minutes", type=float, default=25.0, help="of training")
    parser.add_argument("--seed", type=int, default=7)
    train(**vars(parser.parse_args()))


if __name__ == "__main__":
    main()
