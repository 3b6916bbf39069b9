"""Made-up sequences of clouds of a moving hand or any shape, from a pair of cameras or from one, with exact truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_count, check_positive, check_shape
from torchreg.datasets.hand import HandCloud, hand_motion, make_hand_cloud, placed, surface_skin
from torchreg.datasets.stereo import StereoView, stereo_clouds, tube
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rotation import compose_rotation_vectors, so3_exp
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.skin import LinearBlendSkin


@dataclass(frozen=True)
class _RigMotion:
    """Periods of `rig_sequence`, seconds."""

    bend: float = 2.5
    turn: float = 3.0


@dataclass(frozen=True)
class _BarForm:
    """The obstacle in "occlusion"; lengths as shares of the distance of the hand."""

    distance: float = 0.7
    half_width: float = 0.05  # more or less by up to a tenth
    half_thickness: float = 0.01
    max_slant: float = math.radians(20)
    num_pieces: int = 20  # along its length of one: the rasterizer looks at the whole bounding box of a face


_RIG_MOTION, _BAR = _RigMotion(), _BarForm()


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


def hand_sequence(
    motion: str = "bending_palm",
    num_frames: int = 100,
    fps: float = 20.0,
    *,
    shape: ArticulatedShape | None = None,
    stereo: StereoView | None = None,
    skin: LinearBlendSkin | None = None,
    num_points: int = 600,
    outlier_ratio: float = 0.3,
    obstacle: TriangleMesh | None = None,
    bend: float = 0.6,
    distance: float = 0.6,
    seed: int = 0,
) -> list[HandCloud]:
    """Return the clouds of a moving hand, frame by frame, as a pair of cameras measures it, with the exact truth.

    Args:
        motion: a kind of `hand_motion`; "occlusion" puts a bar between the cameras and the path of the hand.
        num_frames: number of frames.
        fps: frames per second.
        shape: the true shape; an adult right hand by default. See `other_hand` for one that differs from a model.
        stereo: see `stereo_clouds`.
        skin: see `stereo_clouds`.
        num_points: see `stereo_clouds`; with 30 % outliers the default gives 500 to 1,000 points per frame.
        outlier_ratio: see `stereo_clouds`.
        obstacle: see `stereo_clouds`; None: none, or in "occlusion" a bar, its width and slant drawn from the seed.
        bend: see `hand_motion`.
        distance: see `hand_motion`.
        seed: of motion and measurements.

    Returns:
        Clouds, one per frame.

    Raises:
        InputError: if an argument is out of range or no frame shows the shape.

    References: Dewaele et al. 2006, section 5.

    Cost: about 5 s for 100 frames of a hand on one core.
    """
    shape = Hand() if shape is None else shape
    poses = hand_motion(shape, motion, num_frames, fps, bend=bend, distance=distance, seed=seed)
    if motion == "occlusion" and obstacle is None:
        obstacle = _bar(distance, torch.Generator().manual_seed(seed)).to(poses)
    return stereo_clouds(
        shape, poses, stereo=stereo, skin=skin, num_points=num_points, outlier_ratio=outlier_ratio, obstacle=obstacle,
        seed=seed,
    )  # fmt: skip


def range_clouds(
    shape: ArticulatedShape,
    poses: Tensor,
    *,
    num_points: int = 500,
    noise: float = 0.0015,
    outlier_ratio: float = 0.33,
    camera: Tensor | None = None,
    skin: LinearBlendSkin | None = None,
    seed: int = 0,
) -> list[HandCloud]:
    """Return the clouds of a shape in given poses, as a range camera or an all-round scanner sees it, with the truth.

    Args:
        shape: the true shape.
        poses: (T, num_dofs) true poses; those of `hand_motion` pass before a camera at ``torch.zeros(3)``.
        num_points: see `make_hand_cloud`.
        noise: see `make_hand_cloud`.
        outlier_ratio: see `make_hand_cloud`.
        camera: (3,) see `make_hand_cloud`; None measures on all sides.
        skin: see `make_hand_cloud`; made once for all poses.
        seed: of the measurements.

    Returns:
        Clouds, one per pose.

    Raises:
        InputError: if an argument is out of range.
    """
    check_shape(shape.check_pose(poses, "poses"), "poses", ("T", shape.num_dofs))
    skin, generator = surface_skin(shape) if skin is None else skin, torch.Generator().manual_seed(seed)
    return [
        make_hand_cloud(
            shape, pose, num_points=num_points, noise=noise, outlier_ratio=outlier_ratio, camera=camera, skin=skin,
            generator=generator,
        )
        for pose in poses
    ]  # fmt: skip


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


def _bar(distance: float, generator: torch.Generator) -> TriangleMesh:
    """Return a slanted, upright bar in the middle of the picture, before a hand that passes at ``distance``."""
    draws = 2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1
    along = torch.linspace(-0.5, 0.5, _BAR.num_pieces + 1, dtype=torch.float64).unsqueeze(-1)
    across = _BAR.half_width * (1 + 0.1 * draws[0]) * along.new_tensor([1.0, 1.0, -1.0, -1.0])
    deep = _BAR.half_thickness * along.new_tensor([-1.0, 1.0, 1.0, -1.0])
    corners = torch.stack(torch.broadcast_tensors(across, along, deep), dim=-1)
    turn = so3_exp(torch.cat([torch.zeros_like(draws), _BAR.max_slant * draws[1:]]))
    return tube(distance * (corners @ turn.mT + corners.new_tensor([0.0, 0.0, _BAR.distance])))
