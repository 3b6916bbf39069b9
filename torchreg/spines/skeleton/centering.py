"""Curves moved onto the axis of the surface around them, perpendicular to their own direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.neighbors import NeighborTree
from torchreg.spines.curves import binomial_smoothing, tangents


@dataclass(frozen=True)
class Recentering:
    """How slices of the surface are made, which of them are round, and how offsets spread along a curve."""

    num_passes: int = 2  # of slicing and moving: the second slices are perpendicular to the improved curve
    smoothing_passes: int = 2  # of 1-2-1 averages over the offsets of neighboring points
    neighbor_slices: int = 3  # to each side of the nearest point's that may hold a triangle instead, as in bends
    min_thickness: float = 2.0  # of a slice, in square roots of the mean triangle area: thinner ones would have gaps
    min_triangles: int = 8  # in a round slice: fewer do not show a ring
    max_offset: float = 0.3  # of the center of a round slice from the curve, in mean radii
    max_spread: float = 0.3  # standard deviation of the radius over a round slice, in mean radii
    margin: int = 2  # points next to one without a round slice that stay, too: a junction reaches that far
    free_end: int = 8  # points at a free end that may lack a round slice and still move with the next one


_RECENTERING = Recentering()


def centered_curves(
    curves: Sequence[Tensor], mesh: TriangleMesh, thickness: float, free: Sequence[tuple[bool, bool]]
) -> list[Tensor]:
    """Return curves (n, 3) with inner points at the centers of perpendicular slices (Tagliasacchi et al. 2009)."""
    samples, areas = mesh.vertices[mesh.faces].mean(1), mesh.face_areas()
    thickness = max(thickness, _RECENTERING.min_thickness * float(areas.mean().sqrt()))
    curves = list(curves)
    for _ in range(_RECENTERING.num_passes):
        nearest, _ = NeighborTree(torch.cat(curves)).nearest(samples)
        begin = 0
        for number, curve in enumerate(curves):
            around = ((nearest >= begin) & (nearest < begin + len(curve))).nonzero()[:, 0]
            offsets = _axis_offsets(curve, samples[around], areas[around], nearest[around] - begin, thickness)
            curves[number] = curve + _smooth(offsets, *free[number])
            begin += len(curve)
    return curves


def _smooth(offsets: Tensor, free_start: bool, free_end: bool) -> Tensor:
    """Return offsets (n, 3) averaged with their neighbors; free ends get that of the nearest point that moves."""
    moving = offsets.abs().amax(1).nonzero()[:, 0]
    offsets = offsets.clone()
    if len(moving) and free_start and moving[0] <= _RECENTERING.free_end:
        offsets[: moving[0]] = offsets[moving[0]]
    if len(moving) and free_end and moving[-1] >= len(offsets) - 1 - _RECENTERING.free_end:
        offsets[moving[-1] :] = offsets[moving[-1]].clone()
    return binomial_smoothing(offsets, _RECENTERING.smoothing_passes)


def _axis_offsets(curve: Tensor, samples: Tensor, areas: Tensor, nearest: Tensor, thickness: float) -> Tensor:
    """Return the offsets (n, 3) from a curve's points to the centers of their slices; zero for slices not round."""
    count, reach = len(curve), _RECENTERING.neighbor_slices
    directions = tangents(curve)
    point = nearest[:, None] + torch.arange(-reach, reach + 1)
    clamped = point.clamp(0, count - 1)
    offset = samples[:, None] - curve[clamped]
    along = (offset * directions[clamped]).sum(-1)
    in_slice = (point > 0) & (point < count - 1) & (along.abs() <= thickness / 2)
    sample, step = in_slice.nonzero().T
    point, weight, offset = point[sample, step], areas[sample], offset[sample, step]
    across = offset - along[sample, step, None] * directions[point]

    total = torch.zeros(count, dtype=curve.dtype).index_add(0, point, weight)
    divisor = torch.where(total > 0, total, 1.0)
    center = torch.zeros_like(curve).index_add(0, point, weight[:, None] * across) / divisor[:, None]
    distance = (across - center[point]).norm(dim=-1)
    radius = torch.zeros_like(total).index_add(0, point, weight * distance) / divisor
    variance = torch.zeros_like(total).index_add(0, point, weight * (distance - radius[point]) ** 2) / divisor
    is_round = torch.bincount(point, minlength=count) >= _RECENTERING.min_triangles
    is_round &= center.norm(dim=-1) <= _RECENTERING.max_offset * radius
    is_round &= variance.sqrt() <= _RECENTERING.max_spread * radius
    return torch.where(_eroded(is_round, _RECENTERING.margin)[:, None], center, 0.0)


def _eroded(flags: Tensor, margin: int) -> Tensor:
    """Return flags (n,) that are True where they and their neighbors up to ``margin`` away are; beyond is False."""
    padded = torch.nn.functional.pad(flags[None].double(), (margin, margin))
    return -torch.nn.functional.max_pool1d(-padded, 2 * margin + 1, 1)[0] > 0.5
