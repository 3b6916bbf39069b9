"""Made-up hands, their poses and motions, and single clouds of them, or of any articulated shape, with exact truth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_choice, check_count, check_positive
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh, interpolate, sample_surface
from torchreg.geometry.rotation import compose_rotation_vectors, so3_exp
from torchreg.geometry.visibility import sample_visible
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.skin import BendingSkin, LinearBlendSkin

MOTIONS = ("bend", "rotate", "rotation", "bending_palm", "bending_back", "flip", "fast", "occlusion")
# Points that a part must have at least to count as measured.
MIN_SEEN_POINTS = 8
# Rotation vector of a hand with fingers up, palm to a camera that looks along +z with -y up.
_FACING = (math.pi / 2, 0.0, 0.0)


@dataclass(frozen=True)
class _Stage:
    """Positions and motions of shapes, metres, for a shape at ``distance`` from the camera."""

    distance: float = 0.5
    drift: float = 0.03  # of the middle of the shape, to each side
    passage: float = 0.14  # to each side of an obstacle
    clutter_margin: float = 0.05  # by which the box of outliers is larger than the surface, on each side
    open_limit: float = math.pi / 2  # of joints without limits, radians (metres for sliding joints)


@dataclass(frozen=True)
class _Periods:
    """Durations of motions, seconds."""

    bend: float = 2.5  # fingers close and open
    sway: float = 5.0  # and one turn about the own axis
    rotation: float = 4.5  # to and fro
    flip: float = 1.0
    passage: float = 1.5
    undone: float = 4.0  # from a flip or passage to its reverse
    again: float = 8.0  # to the next flip or passage


_STAGE, _PERIODS = _Stage(), _Periods()


@dataclass(frozen=True, eq=False)
class HandCloud:
    """A measured cloud (M, 3) in random order and the truth behind it; parts are -1 for outliers.

    ``vertices`` (V, 3) are the true positions of those of the skin, ``part_counts`` (P,) the points on each part.
    """

    points: Tensor
    inliers: Tensor
    part_labels: Tensor
    pose: Tensor
    keypoints: Tensor
    vertices: Tensor
    part_counts: Tensor

    @property
    def seen_parts(self) -> Tensor:
        """Mask (P,) of parts with at least 8 points; of a hand, ``seen_parts[list(hand.fingertip_parts)]`` are tips."""
        return self.part_counts >= MIN_SEEN_POINTS


def surface_skin(
    shape: ArticulatedShape, *, spacing: float | None = None, sharpness: float | None = None
) -> LinearBlendSkin:
    """Return the shape's whole surface as a skin with faces: the mesh of its file, else its fused surface at rest.

    Meshing takes about a second; ``spacing`` (metres) is that of `ArticulatedShape.surface_mesh`.
    """
    if shape.surface is not None:
        return shape.file_skin()
    mesh = shape.surface_mesh(spacing=spacing)
    return BendingSkin(shape, mesh.vertices, shape.rest_pose(), sharpness, faces=mesh.faces)


def faces_of(skin: LinearBlendSkin) -> Tensor:
    """Return the faces (F, 3) of a skin; InputError if it has none."""
    if skin.faces is None:
        raise InputError("skin must have faces; make it with surface_skin(shape)")
    return skin.faces


def make_hand_cloud(
    shape: ArticulatedShape,
    pose: Tensor,
    *,
    num_points: int = 500,
    noise: float = 0.0015,
    outlier_ratio: float = 0.33,
    camera: Tensor | None = None,
    skin: LinearBlendSkin | None = None,
    generator: torch.Generator | None = None,
) -> HandCloud:
    """Return a noisy cloud of a shape in a pose (num_dofs,), with outliers, as a range camera would deliver it.

    A camera at (3,) sees the side towards it, uniformly over its picture; None: all sides, uniformly by area.
    ``outlier_ratio`` is the share of all points that lie uniformly in the posed surface's box, grown by 5 cm; ``noise``
    is the standard deviation of each coordinate, metres. Without a generator it is the same cloud at every call.
    """
    check_count(num_points, "num_points", 1)
    check_positive(noise, "noise", allow_zero=True)
    if not 0 <= outlier_ratio < 1:
        raise InputError(f"outlier_ratio must be at least 0 and below 1, got {outlier_ratio}")
    pose = shape.check_pose(pose).detach()
    if pose.ndim != 1:
        raise InputError(f"pose must have shape ({shape.num_dofs},), got {tuple(pose.shape)}; make one cloud per pose")
    skin = surface_skin(shape) if skin is None else skin
    faces = faces_of(skin)
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    with torch.no_grad():
        mesh = TriangleMesh(skin(pose), faces)
        if camera is None:
            surface, face, barycentric = sample_surface(mesh, num_points, generator)
        else:
            surface, face, barycentric = sample_visible(mesh, camera, num_points, generator, density="pixel")
        labels = interpolate(skin.weights, mesh.faces, face, barycentric).argmax(-1)
        surface = surface + noise * _normal((num_points, 3), generator, surface)
        num_outliers = round(num_points * outlier_ratio / (1 - outlier_ratio))
        lower, upper = mesh.bounds()
        share, margin = _uniform((num_outliers, 3), generator, surface), _STAGE.clutter_margin
        clutter = lower - margin + share * (upper - lower + 2 * margin)
        return shuffled_cloud(shape, pose, mesh.vertices, surface, labels, clutter, generator)


def shuffled_cloud(
    shape: ArticulatedShape,
    pose: Tensor,
    vertices: Tensor,
    surface: Tensor,
    labels: Tensor,
    outliers: Tensor,
    generator: torch.Generator,
) -> HandCloud:
    """Return N points of a shape, with their parts, and O outliers as one cloud in random order, with the truth."""
    order = torch.randperm(len(surface) + len(outliers), generator=generator, device=generator.device)
    order = order.to(surface.device)
    with torch.no_grad():
        keypoints = shape.keypoints(pose)
    return HandCloud(
        points=torch.cat([surface, outliers])[order],
        inliers=order < len(surface),
        part_labels=torch.cat([labels, labels.new_full((len(outliers),), -1)])[order],
        pose=pose,
        keypoints=keypoints,
        vertices=vertices,
        part_counts=torch.bincount(labels, minlength=shape.num_parts),
    )


def random_hand_pose(
    hand: ArticulatedShape,
    generator: torch.Generator | None = None,
    *,
    bend: float = 0.6,
    distance: float = _STAGE.distance,
) -> Tensor:
    """Return a random pose within the joint limits, turned at random, before a camera at the origin looking along +z.

    All joints of a finger curl together, and fingers spread apart, so that they do not run through each other; joints
    of other shapes move independently around the rest pose, by up to a share ``bend`` of the way to their limits.
    ``distance`` is from the origin to the middle of the shape, metres, up to 3 cm to each side; for a unit of your own,
    choose a few times the size of the shape. Without a generator it is the same pose at every call.
    """
    _check_share(bend, "bend")
    check_positive(distance, "distance")
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    draws = _uniform((3, hand.num_dofs - 6), generator, hand.rest)
    quaternion = _normal((4,), generator, hand.rest)
    offset = _uniform((3,), generator, hand.rest)
    pose = hand.rest_pose()
    if isinstance(hand, Hand):
        pose[6:] = curled_joints(hand, draws[0], draws[1], 2 * draws[2] - 1, bend)
    else:
        lower, upper = joint_ranges(hand)
        pose[6:] = pose[6:] + bend * torch.where(draws[1] < 0.5, lower, upper) * draws[0]
    axis_length = quaternion[1:].norm()
    pose[3:6] = 2 * torch.atan2(axis_length, quaternion[0].abs()) * quaternion[1:] / axis_length * quaternion[0].sign()
    shift = distance / _STAGE.distance * _STAGE.drift * (2 * offset - 1)
    target = hand.rest.new_tensor([0.0, 0.0, distance]) + shift
    return placed(hand, pose, target)


def placed(shape: ArticulatedShape, pose: Tensor, target: Tensor) -> Tensor:
    """Return poses within limits, their base moved (if it can) so that the middle of the parts lies at the target."""
    pose = torch.maximum(torch.minimum(pose, shape.upper), shape.lower)
    still = torch.cat([torch.zeros_like(pose[..., :6]), pose[..., 6:]], dim=-1)
    with torch.no_grad():
        middle = shape.part_transforms(still)[..., :3, 3].mean(-2)
    turned = (so3_exp(pose[..., 3:6]) @ middle.unsqueeze(-1)).squeeze(-1)
    moved = torch.cat([target - turned, pose[..., 3:]], dim=-1)
    return torch.maximum(torch.minimum(moved, shape.upper), shape.lower)


def hand_motion(
    shape: ArticulatedShape,
    kind: str = "bend",
    num_frames: int = 100,
    fps: float = 20.0,
    *,
    bend: float = 0.6,
    distance: float = _STAGE.distance,
    seed: int = 0,
) -> Tensor:
    """Return the poses (num_frames, num_dofs) of a smooth motion before a camera at the origin along +z with -y up.

    In all of them the hand sways a little, upright with the palm to the camera unless said otherwise:

    - "bend": the fingers close and open one after the other, every 2.5 s;
    - "rotate": the fingers half bent, it turns around its own axis once in 5 s;
    - "rotation": the fingers slightly bent, it turns to and fro by 60 to 70 degrees about an axis that is parallel to
      the picture and at most 25 degrees from upright;
    - "bending_palm", "bending_back": the fingers close and open one after the other and, by and by, all together,
      with the palm or the back to the camera;
    - "flip": within a second, about 2 s after the start, it turns by 180 degrees; 4 s later it turns back;
    - "fast": as "bending_palm", swaying more, 3 to 4 times as fast;
    - "occlusion": in 1.5 s, about 2 s after the start, it passes through the middle of the picture from one side to
      the other, in `hand_sequence` behind a bar; 4 s later it returns.

    ``bend`` is the share of the way to their limits that joints move at most, ``distance`` that of the middle of the
    shape, metres. Dewaele et al. 2006, section 5.
    """
    check_choice(kind, "kind", MOTIONS)
    check_count(num_frames, "num_frames", 1)
    check_positive(fps, "fps")
    check_positive(distance, "distance")
    _check_share(bend, "bend")
    generator = torch.Generator().manual_seed(seed)
    draws = _uniform((3, shape.num_dofs - 6), generator, shape.rest)
    sway = _uniform((6,), generator, shape.rest)
    chance = _uniform((4,), generator, shape.rest)
    seconds = (torch.arange(num_frames, dtype=torch.float64) / fps).to(shape.rest)
    seconds = seconds * (3 + chance[0]) if kind == "fast" else seconds
    share = bend * (0.8 + 0.2 * draws[0]) * _closing(kind, seconds, _curl_groups(shape))
    pose = shape.rest_pose().expand(num_frames, -1).clone()
    if isinstance(shape, Hand):
        pose[:, 6:] = _hand_joints(shape, share, 2 * draws[1] - 1, bend)
    else:
        lower, upper = joint_ranges(shape)
        pose[:, 6:] = pose[:, 6:] + share * torch.where(draws[2] < 0.5, lower, upper)
    tilts, shifts = torch.sin(2 * math.pi * (seconds[:, None] / _PERIODS.sway + sway.view(2, 1, 3)))
    pose[:, 3:6] = _base_rotations(kind, seconds, tilts, chance)
    drift = _STAGE.drift * (1.6 if kind == "fast" else 1.0) * shifts
    if kind == "occlusion":
        passed = 2 * _step_and_return(seconds, 1.6 + 0.3 * chance[3], _PERIODS.passage) - 1
        drift[:, 0] = 0.5 * drift[:, 0] + torch.where(chance[2] < 0.5, _STAGE.passage, -_STAGE.passage) * passed
    target = shape.rest.new_tensor([0.0, 0.0, distance]) + distance / _STAGE.distance * drift
    return placed(shape, pose, target)


def _closing(kind: str, seconds: Tensor, fingers: Tensor) -> Tensor:
    """Return the closure (T, D) of each joint at each time, 0 open to 1 closed."""
    lag: float | Tensor = 0.1
    if kind in ("bending_palm", "bending_back", "fast"):
        lag = 0.075 * (1 + torch.cos(2 * math.pi * seconds[:, None] / _PERIODS.sway))
    wave = 0.5 - 0.5 * torch.cos(2 * math.pi * (seconds[:, None] / _PERIODS.bend - lag * fingers))
    if kind == "rotate":
        return 0.4 + 0.2 * wave
    return 0.15 + 0.2 * wave if kind in ("rotation", "flip", "occlusion") else wave


def _base_rotations(kind: str, seconds: Tensor, tilts: Tensor, chance: Tensor) -> Tensor:
    """Return rotation vectors (T, 3) of the base, from swaying (T, 3) and four draws from 0 to 1."""
    sway = {"fast": 0.3, "rotation": 0.05}.get(kind, 0.2) * tilts
    turn = compose_rotation_vectors(sway, sway.new_tensor(_FACING).expand_as(sway))
    if kind == "rotate":
        about = 2 * math.pi * seconds / _PERIODS.sway
        return compose_rotation_vectors(turn, about[:, None] * turn.new_tensor([0.0, 0.0, 1.0]))
    tilt = torch.zeros_like(chance[2])
    if kind == "rotation":
        tilt = math.radians(25) * (2 * chance[2] - 1)
        angle = torch.deg2rad(60 + 10 * chance[1]) * torch.sin(2 * math.pi * seconds / _PERIODS.rotation)
    elif kind == "bending_back":
        angle = torch.full_like(seconds, math.pi)
    elif kind == "flip":
        tilt = math.radians(10) * (2 * chance[2] - 1)
        angle = math.pi * _step_and_return(seconds, 1.8 + 0.4 * chance[3], _PERIODS.flip)
    else:
        return turn
    angle = torch.where(chance[0] < 0.5, angle, -angle)
    axis = torch.stack([tilt.sin(), tilt.cos(), torch.zeros_like(tilt)])
    return compose_rotation_vectors(angle[:, None] * axis, turn)


def _step_and_return(seconds: Tensor, start: Tensor, duration: float) -> Tensor:
    """Return a smooth step (T,) from 0 to 1 that is undone later, again and again."""
    since = torch.remainder(seconds, _PERIODS.again) - start
    share = torch.stack([since, since - _PERIODS.undone]).div(duration).clamp(0, 1)
    forth, back = share**3 * (10 - 15 * share + 6 * share**2)
    return forth - back


def _uniform(size: tuple[int, ...], generator: torch.Generator, like: Tensor) -> Tensor:
    """Return numbers in [0, 1) of the kind of ``like``, drawn in float64 on the generator's device."""
    return torch.rand(size, generator=generator, device=generator.device, dtype=torch.float64).to(like)


def _normal(size: tuple[int, ...], generator: torch.Generator, like: Tensor) -> Tensor:
    """Return standard normal numbers of the kind of ``like``, drawn in float64 on the generator's device."""
    return torch.randn(size, generator=generator, device=generator.device, dtype=torch.float64).to(like)


def _check_share(value: float, name: str) -> None:
    check_positive(value, name, allow_zero=True)
    if value > 1:
        raise InputError(f"{name} must be between 0 and 1, got {value}")


def joint_ranges(shape: ArticulatedShape) -> tuple[Tensor, Tensor]:
    """Return the ranges (D,) of each joint below and above its rest angle."""
    rest = shape.rest[6:]
    lower = shape.lower[6:].clamp(min=-_STAGE.open_limit) - rest
    upper = shape.upper[6:].clamp(max=_STAGE.open_limit) - rest
    return lower.clamp(max=0), upper.clamp(min=0)


def _curl_groups(shape: ArticulatedShape) -> Tensor:
    """Return the number (D,) of each joint's finger; of shapes other than hands, the number of the joint."""
    if not isinstance(shape, Hand):
        return torch.arange(shape.num_dofs - 6, device=shape.rest.device)
    fingers = [name.split("_")[0] for name in shape.dof_names[6:]]
    known = list(dict.fromkeys(fingers))
    return torch.tensor([known.index(finger) for finger in fingers], device=shape.rest.device)


def curled_joints(hand: Hand, own: Tensor, finger: Tensor, spread: Tensor, bend: float | Tensor) -> Tensor:
    """Return joint angles (..., 21) of a hand whose fingers curl, and spread so that they do not meet.

    Draws are (..., 21): of joints and fingers from 0 to 1, of abductions from -1 to 1; ``bend`` is a share.
    """
    # One draw per finger, and a little of one per joint.
    return _hand_joints(hand, bend * (0.8 * finger[..., _curl_groups(hand)] + 0.2 * own), spread, bend)


def _hand_joints(hand: Hand, share: Tensor, spread: Tensor, bend: float | Tensor) -> Tensor:
    """Return joint angles (..., 21) of a hand: flexions at a share of their limits, abductions by a spread -1 to 1."""
    names = hand.dof_names[6:]
    # Away from the middle finger: thumb and index towards the thumb side, ring and little finger away from it.
    outward = {"index": 1.0, "ring": -1.0, "little": -1.0}
    away = spread.new_tensor([outward.get(name.split("_")[0], 0.0) for name in names])
    flexion = torch.tensor([name.endswith("flexion") for name in names], device=spread.device)
    sideways = torch.where(away != 0, away * spread.abs(), 0.3 * spread)
    # Fingers that close come together again.
    straight = 1 - share
    abduction = 0.4 * bend * straight * sideways * hand.upper[6:]
    return torch.where(flexion, share * hand.upper[6:], abduction)
