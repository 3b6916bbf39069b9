"""Range scans of a walking person or animal, with exact truth."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchreg._checks import check_count, check_positive
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.figures import Figure
from torchreg.datasets.scan_sequences import ScanSequence, facing_camera

from ..made_up.bodies import Proportions, person, quadruped
from ..made_up.gaits import animal_walk, person_walk

Gait = Callable[[Figure, Tensor, torch.Generator], tuple[Tensor, Tensor]]


def walking_figure(
    frames: int = 190,
    seed: int = 0,
    *,
    proportions: Proportions | None = None,
    cycles_per_frame: float = 0.08,
    turn: float = math.radians(2),
    scanner: DepthScanner | None = None,
    dtype: torch.dtype = torch.float32,
) -> ScanSequence:
    """Return scans of a person who walks on the spot while turning before a depth camera.

    At 0.08 cycles a frame (12 frames a second) the knees turn by up to about 28 degrees between adjacent frames and
    the hips by 13.

    Args:
        frames: number of frames; 190 give 189 adjacent pairs, as in the paper.
        seed: of the walk, of its first phase, and of the noise.
        proportions: of the `person`; all 1 by default.
        cycles_per_frame: share of two steps from frame to frame.
        turn: rotation of the person from frame to frame, radians: 2 degrees show every side in 180 frames.
        scanner: the camera; `DepthScanner` by default, 4,500 points.
        dtype: of scans and truth.

    References: Chang and Zwicker 2009, section 5, "walking figure": 189 pairs of about 4,502 vertices.

    Cost: 1 s for the figure.
    """
    return _walk(person(proportions), person_walk, frames, seed, cycles_per_frame, turn, scanner, dtype)


def walking_animal(
    frames: int = 100,
    seed: int = 0,
    *,
    gait: str = "trot",
    proportions: Proportions | None = None,
    cycles_per_frame: float = 0.08,
    turn: float = math.radians(2),
    scanner: DepthScanner | None = None,
    dtype: torch.dtype = torch.float32,
) -> ScanSequence:
    """Return scans of a four-legged animal that moves on the spot while turning, in a `GAITS`; see `walking_figure`."""

    def walk(figure: Figure, phase: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        return animal_walk(figure, phase, gait, generator)

    return _walk(quadruped(proportions), walk, frames, seed, cycles_per_frame, turn, scanner, dtype)


def _walk(
    figure: Figure,
    gait: Gait,
    frames: int,
    seed: int,
    cycles_per_frame: float,
    turn: float,
    scanner: DepthScanner | None,
    dtype: torch.dtype,
) -> ScanSequence:
    """Return scans of a figure that begins at a random phase and angle to the camera and turns by ``turn`` a frame."""
    check_count(frames, "frames", 2)
    check_positive(cycles_per_frame, "cycles_per_frame")
    generator = torch.Generator().manual_seed(seed)
    start = torch.rand(1, generator=generator, dtype=torch.float64)
    times = torch.arange(frames, dtype=torch.float64)
    rotations, heights = gait(figure, start + cycles_per_frame * times, generator)
    # From the first number of the seed again, as the phase.
    angle = 2 * math.pi * start + turn * times
    base = facing_camera(figure, angle, torch.zeros_like(angle), heights)
    return ScanSequence(figure, figure.transforms(rotations, base), scanner or DepthScanner(), seed=seed, dtype=dtype)
