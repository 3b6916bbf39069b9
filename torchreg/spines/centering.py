"""Curves moved to the middle of the surface around them, across their own direction."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.neighbors import NeighborTree
from torchreg.spines.curves import tangents

# Slices per point, each way, that a part of the surface may be in besides that of the nearest point.
_NEIGHBORS = 3
_PASSES, _SMOOTH_PASSES = 2, 2
# Least number of triangles in a slice; largest offset of a round slice and spread of its radius, in mean radii.
_LEAST_COUNT, _LARGEST_OFFSET, _LARGEST_SPREAD = 8, 0.3, 0.3
# Points next to one without a round slice that stay.
_MARGIN = 2
# Points at a free end that may lack a slice.
_END = 8
# Of a slice, in square roots of the mean area of the triangles.
_LEAST_THICKNESS = 2.0


def centered_curves(
    curves: Sequence[Tensor], mesh: TriangleMesh, thickness: float, free: Sequence[tuple[bool, bool]] | None = None
) -> list[Tensor]:
    """Return curves with their inner points moved across the curves to the middles of slices of the surface.

    Level sets of distances along a surface lean over in bends, where the way inside is shorter, and so their centers
    are off the axis by up to a tenth of the radius. Slices here are perpendicular to the curves. A part of the surface
    belongs to the curve, and to the stretch of it, that is nearest. Where slices are not round, the
    curves stay.

    Args:
        curves: (n, 3) each.
        mesh: the surface, any winding.
        thickness: of a slice; about the distance between points.
        free: whether the first and the last point of each curve go along with those next to them; all stay by default.

    References: Tagliasacchi, Zhang and Cohen-Or 2009, recentering across the axis.
    """
    corners = mesh.vertices[mesh.faces]
    samples, areas = corners.mean(1), mesh.face_areas()
    # Thinner slices than triangles would have gaps.
    thickness = max(thickness, _LEAST_THICKNESS * float(areas.mean().sqrt()))
    curves = list(curves)
    free = [(False, False)] * len(curves) if free is None else free
    for _ in range(_PASSES):
        nearest, _ = NeighborTree(torch.cat(curves)).nearest(samples)
        begin = 0
        for number, curve in enumerate(curves):
            own = ((nearest >= begin) & (nearest < begin + len(curve))).nonzero()[:, 0]
            shift = _shift(curve, samples[own], areas[own], nearest[own] - begin, thickness)
            curves[number] = curve + _smooth(shift, *free[number])
            begin += len(curve)
    return curves


def _smooth(shift: Tensor, start: bool, end: bool) -> Tensor:
    """Return shifts (n, 3) averaged with their neighbors; free ends get that of the nearest point that moves."""
    moved = shift.abs().amax(1).nonzero()[:, 0]
    shift = shift.clone()
    if len(moved) and start and moved[0] <= _END:
        shift[: moved[0]] = shift[moved[0]]
    if len(moved) and end and moved[-1] >= len(shift) - 1 - _END:
        shift[moved[-1] :] = shift[moved[-1]].clone()
    for _ in range(_SMOOTH_PASSES):
        shift = torch.cat((shift[:1], 0.25 * (shift[:-2] + 2 * shift[1:-1] + shift[2:]), shift[-1:]))
    return shift


def _shift(curve: Tensor, samples: Tensor, areas: Tensor, nearest: Tensor, thickness: float) -> Tensor:
    """Return the way (n, 3) from each point of a curve to the middle of its slice, given the point nearest to samples.

    It is zero where the slice is not round.
    """
    directions = tangents(curve)
    steps = torch.arange(-_NEIGHBORS, _NEIGHBORS + 1)
    place = nearest[:, None] + steps
    offset = samples[:, None] - curve[place.clamp(0, len(curve) - 1)]
    along = (offset * directions[place.clamp(0, len(curve) - 1)]).sum(-1)
    taken = (place > 0) & (place < len(curve) - 1) & (along.abs() <= thickness / 2)
    sample, step = taken.nonzero().T
    place, weight, offset = place[sample, step], areas[sample], offset[sample, step]
    across = offset - along[sample, step, None] * directions[place]
    total = torch.zeros(len(curve), dtype=curve.dtype).index_add(0, place, weight)
    divisor = torch.where(total > 0, total, 1.0)
    mean = torch.zeros_like(curve).index_add(0, place, weight[:, None] * across) / divisor[:, None]
    out = (across - mean[place]).norm(dim=-1)
    radius = torch.zeros_like(total).index_add(0, place, weight * out) / divisor
    spread = torch.zeros_like(total).index_add(0, place, weight * (out - radius[place]) ** 2) / divisor
    round_ = torch.bincount(place, minlength=len(curve)) >= _LEAST_COUNT
    round_ &= (mean.norm(dim=-1) <= _LARGEST_OFFSET * radius) & (spread.sqrt() <= _LARGEST_SPREAD * radius)
    # What is not round, as at junctions, has neighbors left alone, too.
    padded = torch.nn.functional.pad(round_[None].double(), (_MARGIN, _MARGIN))
    round_ = -torch.nn.functional.max_pool1d(-padded, 2 * _MARGIN + 1, 1)[0] > 0.5
    return torch.where(round_[:, None], mean, 0.0)
