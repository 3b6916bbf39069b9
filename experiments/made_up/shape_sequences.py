"""A hand that differs from the model of a hand, and clouds of any shape that bends and turns before one camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_count, check_positive, check_shape
from torchreg.datasets.hand import HandCloud, placed
from torchreg.datasets.sequences import range_clouds
from torchreg.errors import InputError
from torchreg.geometry.rotation import compose_rotation_vectors
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.skin import LinearBlendSkin


@dataclass(frozen=True)
class _RigMotion:
    """Periods of `rig_sequence`, seconds."""

    bend: float = 2.5
    turn: float = 3.0


_RIG_MOTION = _RigMotion()


def other_hand(
    generator: torch.Generator | None = None, scale: float = 0.05, *, side: str = "right", nu: float = 0.002
) -> Hand:
    """Return a hand that differs from ``Hand()``: every bone length and radius longer or shorter, and another fusion.

    For a skin that differs too, give it another sharpness: ``surface_skin(hand, sharpness=10.0)``.

    Args:
        generator: of longer or shorter, part by part; None draws from a fresh generator with seed 0.
        scale: relative difference: the ratio to the plain hand is ``1 + scale`` or ``1 / (1 + scale)``.
        side: "right" or "left".
        nu: fusion length, metres; the plain hand has 0.003.

    Raises:
        InputError: if an argument is out of range.
    """
    check_positive(scale, "scale", allow_zero=True)
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    hand = Hand(side, nu=nu)
    with torch.no_grad():
        for scales in (hand.log_length_scales, hand.log_radius_scales):
            longer = torch.randint(2, (hand.num_parts,), generator=generator, device=generator.device)
            scales.copy_(math.log1p(scale) * (2.0 * longer - 1.0))
    return hand


def rig_sequence(
    shape: ArticulatedShape,
    full_bend: Tensor,
    num_frames: int = 60,
    fps: float = 20.0,
    *,
    facing: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
    turn: float = math.radians(40),
    distance: float = 0.5,
    num_points: int = 1000,
    noise: float = 0.001,
    outlier_ratio: float = 0.2,
    skin: LinearBlendSkin | None = None,
    seed: int = 0,
) -> list[HandCloud]:
    """Return clouds of any shape that bends and turns to and fro before one camera at the origin that looks along +z.

    It bends from rest to ``full_bend`` and back every 2.5 s, as a sine, and turns about the vertical every 3 s.

    Args:
        shape: the true shape.
        full_bend: (num_dofs,) added to the rest pose at the deepest bend, radians; zero for the base.
        num_frames: number of frames.
        fps: frames per second.
        facing: (3,) rotation vector of the base before it turns; -y is up in the picture.
        turn: angle to each side, radians.
        distance: from the camera to the middle of the shape, metres.
        num_points: see `make_hand_cloud`.
        noise: see `make_hand_cloud`.
        outlier_ratio: see `make_hand_cloud`.
        skin: see `make_hand_cloud`; made once for all frames. A shape read from a file with a mesh has the file's.
        seed: of the measurements.

    Returns:
        Clouds, one per frame; their ``vertices`` are the true positions of the skin's points.

    Raises:
        InputError: if an argument is out of range.
    """
    full_bend = shape.check_pose(full_bend, "full_bend").detach()
    check_shape(full_bend, "full_bend", (shape.num_dofs,))
    if bool(full_bend[:6].any()):
        raise InputError("full_bend must be zero for the six degrees of freedom of the base; use facing and turn")
    check_count(num_frames, "num_frames", 1)
    check_positive(fps, "fps")
    check_positive(turn, "turn", allow_zero=True)
    check_positive(distance, "distance")
    front = as_float_tensor(facing, "facing", like=full_bend)
    check_shape(front, "facing", (3,))
    seconds = (torch.arange(num_frames, dtype=torch.float64) / fps).to(full_bend).unsqueeze(-1)
    share = 0.5 - 0.5 * torch.cos(2 * math.pi * seconds / _RIG_MOTION.bend)
    angle = turn * torch.sin(2 * math.pi * seconds / _RIG_MOTION.turn)
    poses = shape.rest_pose() + share * full_bend
    poses[:, 3:6] = compose_rotation_vectors(angle * angle.new_tensor([0.0, 1.0, 0.0]), front.expand(num_frames, 3))
    poses = placed(shape, poses, poses.new_tensor([0.0, 0.0, distance]))
    return range_clouds(
        shape, poses, num_points=num_points, noise=noise, outlier_ratio=outlier_ratio, camera=torch.zeros(3),
        skin=skin, seed=seed,
    )  # fmt: skip
