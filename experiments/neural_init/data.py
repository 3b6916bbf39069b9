"""Clouds of hands before a camera, their true poses, and the poses that torchreg finds without them."""

from __future__ import annotations

import functools
import hashlib
import json
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import safetensors.torch
import torch
from torch import Tensor

import torchreg as tr
from torchreg.datasets.hand import make_hand_cloud, placed, surface_skin
from torchreg.io.atomic import write_atomic

from ..schema import CloudScene

# Fingers up, palm to the camera at the origin, which looks along +z with -y up; half a metre away, up to 3 cm off.
FACING, DISTANCE, SPREAD = (math.pi / 2, 0.0, 0.0), 0.5, 0.03
_BATCH = 64


@dataclass(frozen=True)
class Clouds:
    """Clouds to learn from, or to be measured with.

    Args:
        points: (B, M, 3), metres.
        found: (B, num_dofs) poses by `torchreg.PoseInitializer`.
        confidence: (B,) from 0 to 1, of these.
        truth: (B, num_dofs) true poses; None where they must not be known.
    """

    points: Tensor
    found: Tensor
    confidence: Tensor
    truth: Tensor | None

    def __len__(self) -> int:
        return len(self.points)

    @property
    def centers(self) -> Tensor:
        """Medians (B, 3) of the clouds, which outliers hardly move, metres."""
        return self.points.median(dim=1).values

    def rows(self, rows: Tensor | slice) -> Clouds:
        """Return the clouds of given rows."""
        truth = None if self.truth is None else self.truth[rows]
        return Clouds(self.points[rows], self.found[rows], self.confidence[rows], truth)

    def without_truth(self) -> Clouds:
        """Return the clouds without their true poses."""
        return replace(self, truth=None)


def load_clouds(hand: tr.Hand, scene: CloudScene) -> tuple[Clouds, Clouds]:
    """Return the clouds to learn from and those held out.

    They are made at first, at about 15 clouds a second, and kept in the scene's folder, if it names one; further
    processes that make them meanwhile write the same.
    """
    every = _kept_clouds(hand, scene) if scene.folder else _made_clouds(hand, scene)
    return every.rows(slice(scene.train)), every.rows(slice(scene.train, None))


def _kept_clouds(hand: tr.Hand, scene: CloudScene) -> Clouds:
    settings = {**asdict(scene), "folder": "", "version": tr.__version__}
    name = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]
    path = Path(scene.folder) / f"clouds_{name}.safetensors"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        made = _made_clouds(hand, scene)
        tensors = {key: value.contiguous() for key, value in vars(made).items() if value is not None}
        write_atomic(path, safetensors.torch.save(tensors, {"settings": json.dumps(settings)}))
    return Clouds(**safetensors.torch.load_file(path))


def _made_clouds(hand: tr.Hand, scene: CloudScene) -> Clouds:
    generator = torch.Generator().manual_seed(scene.seed)
    truth = draw_poses(hand, scene, generator)
    points = draw_clouds(hand, truth, scene, generator)
    found, confidence = find_poses(hand, points)
    return Clouds(points, found, confidence, truth)


def draw_poses(hand: tr.Hand, scene: CloudScene, generator: torch.Generator) -> Tensor:
    """Return poses (B, num_dofs): tilted about any axis, every joint bent by its own share of its range."""
    count = scene.train + scene.held_out
    poses = hand.rest_pose().repeat(count, 1)
    poses[:, 6:] = scene.bend * torch.rand(count, hand.num_dofs - 6, generator=generator) * hand.upper[6:]
    poses[:, 3:6] = torch.tensor(FACING)
    axes = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    tilts = math.radians(scene.tilt_deg) * torch.rand(count, 1, generator=generator) * axes
    poses = hand.retract(poses, torch.nn.functional.pad(tilts, (3, hand.num_dofs - 6)))
    shift = SPREAD * (2 * torch.rand(count, 3, generator=generator) - 1)
    return placed(hand, poses, torch.tensor([0.0, 0.0, DISTANCE]) + shift)


def draw_clouds(hand: tr.Hand, poses: Tensor, scene: CloudScene, generator: torch.Generator) -> Tensor:
    """Return clouds (B, M, 3) of the side that the camera sees, outliers among them."""
    surface = _surface(hand)
    outliers = round(scene.num_points * scene.outlier_ratio)
    clouds = [
        make_hand_cloud(
            hand, pose, num_points=scene.num_points - outliers, noise=1e-3 * scene.noise_mm,
            outlier_ratio=outliers / scene.num_points, camera=torch.zeros(3), skin=surface, generator=generator,
        ).points
        for pose in poses
    ]  # fmt: skip
    return torch.stack(clouds)


@functools.lru_cache(maxsize=1)
def _surface(hand: tr.Hand) -> tr.LinearBlendSkin:
    return surface_skin(hand)


@torch.no_grad()
def find_poses(hand: tr.Hand, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return poses (B, num_dofs) and confidences (B,) of clouds (B, M, 3), without a search: some 20 a second."""
    layer = tr.PoseInitializer(hand, tr.PoseInitializerConfig(search="never"))
    found = [layer(part) for part in points.split(_BATCH)]
    return torch.cat([guess.pose for guess in found]), torch.cat([guess.confidence for guess in found])
