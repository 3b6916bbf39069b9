"""Made-up creatures of many arms that bend and sway: voxels meshed anew in each frame, with the exact truth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_choice, check_count, check_positive
from torchreg.datasets.ball_surface import ball_surface, bent_axes
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rotation import so3_exp

TOUCHING = ("none", "flanks", "tips")


@dataclass(frozen=True)
class _ArmMotion:
    """Form and motion of arms; lengths in shares of an arm's."""

    num_samples: int = 48  # along the axis of an arm; the balls around them are the arm
    length_spread: float = 0.08  # of arms
    direction_spread: float = 0.06  # of arms, radians
    frames_per_half_cycle: int = 12  # of swaying
    touch_from: float = 0.35  # of the sequence: arms 0 and 1 touch from that share on
    touch_until: float = 0.65
    touch_distance: float = 1.5  # between the axes of arms that touch, in their radii


_MOTION = _ArmMotion()


@dataclass(frozen=True)
class CreatureForm:
    """The form of a creature and the amplitudes of its motion; lengths in shares of an arm's."""

    num_arms: int
    body: float
    root: float  # radius of an arm at the body
    end: float  # radius of an arm at its tip
    sway: float  # largest turn of an arm's end in the plane of the body, radians; all arms sway together by half of it
    curl: float  # largest turn of an arm's end out of that plane, radians

    def __post_init__(self) -> None:
        check_count(self.num_arms, "num_arms", 3)
        for name in ("body", "root", "end"):
            check_positive(getattr(self, name), name)
        for name in ("sway", "curl"):
            check_positive(getattr(self, name), name, allow_zero=True)


STARFISH = CreatureForm(num_arms=5, body=0.26, root=0.17, end=0.08, sway=0.6, curl=0.6)
OCTOPUS = CreatureForm(num_arms=8, body=0.3, root=0.1, end=0.05, sway=0.4, curl=0.9)


@dataclass(frozen=True, eq=False)
class CreatureSequence:
    """A creature in T frames whose meshes are unrelated, and the truth; the length of an arm is about 1."""

    meshes: tuple[TriangleMesh, ...]
    tips: Tensor  # (T, K, 3) ends of the arms, on the surface
    curves: Tensor  # (T, K, S, 3) axes of the arms, from the middle of the body to the middle of the last ball
    radii: Tensor  # (K, S) of the arms around their axes
    touching: Tensor  # (T,) bool, True where arms 0 and 1 are merged
    topology: str  # of the tree of arms in the form of `Skeleton.topology`


def creature_sequence(
    form: CreatureForm = STARFISH,
    num_frames: int = 24,
    *,
    touching: str = "none",
    noise: float = 0.0,
    resolution: int = 96,
    dtype: torch.dtype = torch.float32,
    seed: int = 0,
) -> CreatureSequence:
    """Return a creature that bends and sways its arms while it turns and drifts, meshed anew in every frame.

    In the middle third of the sequence arms 0 and 1 touch: "none", "flanks" (side by side, the tips apart) or "tips"
    (end to end). The noise is the standard deviation of the field at each voxel, in voxels; the resolution counts
    voxels along the longest side of the box.
    """
    check_count(num_frames, "num_frames", 1)
    check_choice(touching, "touching", TOUCHING)
    check_positive(noise, "noise", allow_zero=True)
    check_count(resolution, "resolution", 16)
    generator = torch.Generator().manual_seed(seed)
    curves, headings, merged = _moving_axes(form, num_frames, touching, generator)
    share = torch.linspace(0, 1, _MOTION.num_samples, dtype=torch.float64)
    radii = (form.root + share * (form.end - form.root)).expand(form.num_arms, -1)
    sizes = torch.cat((radii.flatten(), radii.new_tensor([form.body])))
    bodies = [torch.cat((axes.flatten(0, 1), axes[:1, 0])) for axes in curves]
    meshes = [ball_surface(balls, sizes, resolution, noise, generator, dtype) for balls in bodies]
    return CreatureSequence(
        meshes=tuple(meshes),
        tips=(curves[:, :, -1] + form.end * headings).to(dtype),
        curves=curves.to(dtype),
        radii=radii.to(dtype),
        touching=merged,
        topology="(" + "()" * form.num_arms + ")",
    )


def _moving_axes(
    form: CreatureForm, num_frames: int, touching: str, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Return axes (T, K, S, 3), their directions at the tips (T, K, 3), and whether arms 0 and 1 touch (T,)."""
    arms, draw = form.num_arms, lambda *size: torch.rand(*size, generator=generator, dtype=torch.float64)
    time = torch.arange(num_frames, dtype=torch.float64)
    lengths = 1 + _MOTION.length_spread * (2 * draw(arms) - 1)
    even = 2 * math.pi * torch.arange(arms, dtype=torch.float64) / arms
    facing = even + _MOTION.direction_spread * (2 * draw(arms) - 1)
    phase = 2 * math.pi * draw(arms)
    cycle = math.pi * time / _MOTION.frames_per_half_cycle
    # All arms sway alike, and each a little by itself: neighbors stay apart.
    sway = 0.5 * form.sway * cycle.sin().unsqueeze(-1) + 0.5 * form.sway * (cycle.unsqueeze(-1) + phase).sin()
    curl = form.curl * (1.3 * cycle.unsqueeze(-1) + 2 * phase).sin()
    merged = (time >= _MOTION.touch_from * num_frames) & (time <= _MOTION.touch_until * num_frames)
    merged &= touching != "none"
    share = torch.linspace(0, 1, _MOTION.num_samples, dtype=torch.float64)
    turned = facing.unsqueeze(-1) + sway.unsqueeze(-1) * share
    raised = curl.unsqueeze(-1) * share
    if touching != "none":
        _bring_together(form, turned, raised, lengths, merged, touching)
    axes, headings = _axes(turned, raised, lengths)
    spin = 0.04 * time.unsqueeze(-1) * torch.tensor([0.3, 0.2, 1.0], dtype=torch.float64)
    pose = so3_exp(spin + (2 * draw(3) - 1))
    drift = 0.02 * time[:, None] * (2 * draw(3) - 1)
    moved = torch.einsum("tij,tksj->tksi", pose, axes) + drift[:, None, None]
    return moved, torch.einsum("tij,tkj->tki", pose, headings), merged


def _axes(turned: Tensor, raised: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Return axes (T, K, S, 3) from the origin along headings and elevations (T, K, S), and their last directions."""
    axes, directions = bent_axes(turned.cos(), turned.sin(), raised, lengths)
    return axes, directions[..., -1, :]


def _bring_together(
    form: CreatureForm, turned: Tensor, raised: Tensor, lengths: Tensor, merged: Tensor, touching: str
) -> None:
    """Bend arms 0 and 1 towards each other, in place: in merged frames until they touch, in the frames around less."""
    share = torch.linspace(0, 1, _MOTION.num_samples, dtype=turned.dtype)
    # Flanks: bent at the root, then parallel, then apart. Tips: bent evenly.
    bend = 2 * share if touching == "tips" else (share / 0.35).clamp_max(1.0) - 2.2 * (share - 0.6).clamp_min(0.0)
    raised[:, 1] = raised[:, 0]
    distance = _MOTION.touch_distance * (form.end if touching == "tips" else 0.5 * (form.root + form.end))
    start = turned.clone()
    signs = torch.tensor([1.0, -1.0], dtype=turned.dtype)[:, None]
    low, high = (torch.full((len(turned), 1, 1), value, dtype=turned.dtype) for value in (-0.5, 1.6))
    for _ in range(40):  # bisection for the turn that brings the axes to that distance
        middle = 0.5 * (low + high)
        turned[:, :2] = start[:, :2] + middle * signs * bend
        axes, _ = _axes(turned[:, :2], raised[:, :2], lengths[:2])
        outer = axes[:, :, _MOTION.num_samples // 3 :]
        near = torch.cdist(outer[:, 0], outer[:, 1]).amin((1, 2))[:, None, None] < distance
        high, low = torch.where(near, middle, high), torch.where(near, low, middle)
    # The frames around approach it smoothly.
    frames = torch.arange(len(turned), dtype=turned.dtype)
    inside = frames[merged]
    off = (torch.cdist(frames[:, None], inside[:, None]).amin(1) / 4).clamp_max(1.0) if len(inside) else frames * 0 + 1
    amount = 0.5 + 0.5 * (math.pi * off).cos()
    amount = torch.where(merged, amount, 0.85 * amount)[:, None, None]
    turned[:, :2] = start[:, :2] + amount * high * signs * bend
