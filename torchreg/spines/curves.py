"""Polylines: lengths, bending angles, tangents, smoothing, and frames that follow them without twist."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.geometry.rotation import rotation_between

# Relative size below which a step has no direction.
_DEGENERATE = 1e-6


def curve_lengths(curves: Tensor) -> Tensor:
    """Return the lengths (...,) of curves (..., S, 3), in their unit; zero gradient at steps without length."""
    return _safe_norm(curves[..., 1:, :] - curves[..., :-1, :]).sum(-1)


def arc_lengths(curve: Tensor) -> Tensor:
    """Return the arc length (n,) from the first point of a curve (n, 3) to each of its points."""
    steps = (curve[1:] - curve[:-1]).norm(dim=-1)
    return torch.cat((steps.new_zeros(1), steps.cumsum(0)))


def points_along(curve: Tensor, lengths: Tensor) -> Tensor:
    """Return the points (..., 3) of a curve (n, 3) at arc lengths (...,); its last point beyond the end."""
    along = torch.cat((curve.new_zeros(1), _safe_norm(curve[1:] - curve[:-1]).cumsum(0))).detach()
    lengths = lengths.clamp(0, float(along[-1]))
    after = torch.searchsorted(along, lengths).clamp(min(1, len(curve) - 1), len(curve) - 1)
    before = (after - 1).clamp_min(0)
    step = along[after] - along[before]
    share = torch.where(step > 0, (lengths - along[before]) / torch.where(step > 0, step, 1.0), 0.0)
    return curve[before] + share.unsqueeze(-1) * (curve[after] - curve[before])


def moving_average(curve: Tensor, window: float, count: int) -> Tensor:
    """Return a curve as ``count`` points at equal intervals, averaged over a share of its length; its ends stay."""
    length = float(curve_lengths(curve.detach()))
    even = points_along(curve, torch.linspace(0, length, count, dtype=curve.dtype, device=curve.device))
    half = min(round(0.5 * window * (count - 1)), count - 1)
    # Continued by point reflection at its ends: a straight curve stays what it is.
    before = 2 * even[:1] - even[1 : half + 1].flip(0)
    after = 2 * even[-1:] - even[count - 1 - half : count - 1].flip(0)
    return torch.cat((before, even, after)).unfold(0, 2 * half + 1, 1).mean(-1)


def binomial_smoothing(values: Tensor, passes: int) -> Tensor:
    """Return rows (n, 3) averaged with their two neighbors, weights 1-2-1, so many times; the end rows stay."""
    for _ in range(passes):
        inner = 0.25 * (values[:-2] + 2 * values[1:-1] + values[2:])
        values = torch.cat((values[:1], inner, values[-1:]))
    return values


def bend_angles(curves: Tensor) -> Tensor:
    """Return the turning angles (..., S - 2), 0 to pi, of curves (..., S, 3) at their inner points."""
    steps = curves[..., 1:, :] - curves[..., :-1, :]
    before, after = steps[..., :-1, :], steps[..., 1:, :]
    cross = torch.linalg.cross(before, after, dim=-1)
    dot = (before * after).sum(-1)
    # atan2 has no gradient where both are zero.
    empty = (before.square().sum(-1) == 0) | (after.square().sum(-1) == 0)
    return torch.where(empty, 0.0, torch.atan2(_safe_norm(cross), torch.where(empty, 1.0, dot)))


def tangents(curves: Tensor) -> Tensor:
    """Return the unit tangents (..., S, 3) of curves (..., S, 3): central differences, one-sided at the ends."""
    steps = curves[..., 1:, :] - curves[..., :-1, :]
    padded = torch.cat((steps[..., :1, :], steps, steps[..., -1:, :]), dim=-2)
    central = padded[..., 1:, :] + padded[..., :-1, :]
    length = _safe_norm(central)
    chord = curves[..., -1:, :] - curves[..., :1, :]
    degenerate = (length <= _DEGENERATE * length.detach().amax(-1, keepdim=True)).unsqueeze(-1)
    extent = _safe_norm(chord).unsqueeze(-1)
    x_axis = torch.zeros_like(chord)
    x_axis[..., 0] = 1.0
    fallback = torch.where(extent > 0, chord / torch.where(extent > 0, extent, 1.0), x_axis)
    return torch.where(degenerate, fallback, central / torch.where(degenerate, 1.0, length.unsqueeze(-1)))


def align_frames(frames: Tensor, directions: Tensor) -> Tensor:
    """Return frames (..., 3, 3) turned by the smallest angle that makes ``directions`` their third columns."""
    return rotation_between(frames[..., 2], directions) @ frames


def curve_frames(curves: Tensor) -> Tensor:
    """Return rotation-minimizing frames ``R_world_curve`` (..., S, 3, 3) along curves (..., S, 3) (Bishop 1975).

    The third column is the tangent. The first frame is the smallest rotation of the world's axes.
    """
    directions = tangents(curves)
    eye = torch.eye(3, dtype=curves.dtype, device=curves.device).expand(*curves.shape[:-2], 3, 3)
    frames = [align_frames(eye, directions[..., 0, :])]
    for turn in rotation_between(directions[..., :-1, :], directions[..., 1:, :]).unbind(-3):
        frames.append(turn @ frames[-1])
    return torch.stack(frames, dim=-3)


def _safe_norm(vectors: Tensor) -> Tensor:
    """Return the lengths (...,) of vectors (..., 3), with gradient zero at zero."""
    square = vectors.square().sum(-1)
    return torch.where(square > 0, torch.where(square > 0, square, 1.0).sqrt(), 0.0)
