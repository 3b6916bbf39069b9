"""Scans from files: pairs, and captured motion of meshes that share vertices before a made-up depth camera."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import torchreg as tr
from torchreg.datasets.depth_scanner import DepthScanner, SurfaceScan
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rotation import so3_exp

DIAGONAL, DISTANCE, REACH = 1.8, 1.7, 0.45  # meters; in diagonals; tangent of half the angle of view


@dataclass(frozen=True, eq=False)
class CapturedSequence(Sequence[tr.RangeScan]):
    """Scans of frames of captured motion, and the true places of their points.

    Args:
        vertices: (T, V, 3) float64 of closed meshes before the camera, which is at the origin and looks along +z.
        faces: (F, 3) int64, those of all frames.
        scanner: the camera.
        seed: of noise and holes.
    """

    vertices: Tensor
    faces: Tensor
    scanner: DepthScanner = field(default_factory=DepthScanner)
    seed: int = 0

    def __len__(self) -> int:
        return len(self.vertices)

    def __getitem__(self, frame: int) -> tr.RangeScan:  # type: ignore[override]
        return self._found[frame].scan

    def truth(self, source: int, target: int) -> Tensor:
        """Return the true positions (N, 3) of a frame's scanned points in another frame."""
        return self._found[source].transferred(self.vertices[target], self.faces).float()

    @cached_property
    def _found(self) -> list[SurfaceScan]:
        meshes = [TriangleMesh(vertices, self.faces) for vertices in self.vertices]
        view, generator = self.scanner.view(meshes[0], REACH), torch.Generator().manual_seed(self.seed)
        return [self.scanner.scan(mesh, view, generator, torch.float32) for mesh in meshes]


def scan_pairs(folder: Path) -> Iterator[tuple[str, tr.RangeScan, tr.RangeScan, Tensor, float]]:
    """Yield the pairs of NPZ files by name: source, target, true positions (N, 3) of the source's points, diagonal."""
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as file:
            source, target = (tr.RangeScan(file[f"{end}_points"], file[f"{end}_faces"]) for end in ("source", "target"))
            yield path.stem, source, target, torch.from_numpy(file["source_truth"]), float(file["diagonal"])


def captured_sequences(
    path: Path, count: int, frames: int, scanner: DepthScanner | None = None
) -> Iterator[CapturedSequence]:
    """Yield sequences of a file, NPZ with vertices (T, V, 3), y up, and faces: each of another side and another time.

    Raises:
        ValueError: if the file holds fewer frames.
    """
    with np.load(path) as file:
        vertices, faces = torch.from_numpy(file["vertices"]).double(), torch.from_numpy(file["faces"]).long()
    if len(vertices) < frames:
        raise ValueError(f"{path} holds {len(vertices)} frames; {frames} are asked for")
    low, high = vertices[0].amin(0), vertices[0].amax(0)
    vertices = (vertices - (low + high) / 2) * (DIAGONAL / (high - low).norm())
    for number in range(count):
        angle = 2 * math.pi * number / count
        begin = number * (len(vertices) - frames) // max(count - 1, 1)
        turned = vertices[begin : begin + frames] @ _before_camera(angle).T
        away = vertices.new_tensor([0, 0, DISTANCE * DIAGONAL])
        yield CapturedSequence(turned + away, faces, scanner or DepthScanner(), number)


def _before_camera(angle: float) -> Tensor:
    """Return the rotation (3, 3) that turns about y, which is up, and then y down, as cameras have it."""
    turn = so3_exp(torch.tensor([0.0, angle, 0.0], dtype=torch.float64))
    return torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)) @ turn
