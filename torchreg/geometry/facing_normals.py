"""Normals of scans: towards a camera of unknown position, or outward where points are of all sides."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from torchreg.geometry.mesh import unit_sphere
from torchreg.geometry.neighbors import k_nearest
from torchreg.geometry.normals import fit_normals, orient_normals
from torchreg.geometry.rotation import rotation_between


@dataclass(frozen=True)
class _Facing:
    """Numbers by which the side of a scan is found."""

    # Of the neighborhoods of normals, as shares of the scan's size: less than a limb's radius, or more for noise.
    reaches: tuple[float, ...] = (0.02, 0.04)
    smooth_share: float = 0.6  # of neighbors on one smooth surface, below which a normal is noise
    min_neighbors: int = 12
    max_neighbors: int = 128
    subdivisions: int = 2  # of the sphere of directions to the camera, which are 18 degrees apart
    num_rounds: int = 3  # in which the best direction follows the normals
    alike: float = 0.8  # cosine of neighboring normals from which they lie on one smooth surface
    one_sided: float = 0.03  # share of smooth neighbors torn apart, up to which a scan counts as taken from one side
    spacing: int = 6  # neighbor to which points are as far as holes are wide
    cell: float = 0.5  # of a picture of points, in such distances: the largest of nine next to each other has no holes
    finest: float = 0.002  # such cell, as a share of the scan's size
    sure: float = 0.3  # of the sum of cosines to cameras that see a point, of which the rest may cancel


_FACING = _Facing()


def facing_normals(points: Tensor, viewpoint: Tensor | None = None) -> Tensor:
    """Return the unit normals (N, 3) of a scan, towards the camera where all points were taken from one side.

    Those of all sides point outward, as seen by cameras all around; a normal of an unknown side is zero.
    """
    points = points.detach().double()
    spread = float((points.quantile(0.95, dim=0) - points.quantile(0.05, dim=0)).norm())
    count = min(_FACING.max_neighbors + 1, len(points))
    index, distance = k_nearest(points, points, count)
    for reach in _FACING.reaches:
        within = int((distance < reach * spread).sum(-1).double().median())
        near = index[:, 1 : min(max(within, _FACING.min_neighbors + 1), count)]
        normals = fit_normals(points, near)
        cosine = (normals.unsqueeze(1) * normals[near]).sum(-1)
        smooth = cosine.abs() > _FACING.alike
        if float(smooth.double().mean()) > _FACING.smooth_share:
            spacing = float(distance[:, min(_FACING.spacing, count - 1)].median())
            return _oriented(points, normals, near, cosine, smooth, viewpoint, (spacing, spread))
    return torch.zeros_like(points)


def _oriented(
    points: Tensor, normals: Tensor, near: Tensor, cosine: Tensor, smooth: Tensor, viewpoint: Tensor | None,
    lengths: tuple[float, float],
) -> Tensor:  # fmt: skip
    """Return normals (N, 3) on one side, by cosines (N, K) to those of neighbors and which of these are smooth.

    Lengths are the spacing of points and the size of the scan.
    """
    if viewpoint is not None:
        return _facing(normals, viewpoint.to(points) - points)
    kept = slice(None, _FACING.min_neighbors)
    direction, torn = _least_torn(normals, near[:, kept], cosine[:, kept], smooth[:, kept])
    if torn > _FACING.one_sided:
        outward = _outward(points, normals, *lengths)
        # Of a surface with a border as much is seen from behind as from before.
        closed = float((outward != 0).any(-1).double().mean()) > _FACING.smooth_share
        return outward if closed else orient_normals(points, normals)
    normals = _facing(normals, direction)
    # On the whole a body is convex: its normals diverge.
    apart = torch.nn.functional.normalize(points.unsqueeze(1) - points[near], dim=-1)
    divergence = (apart * (normals.unsqueeze(1) - normals[near])).sum(-1)
    return normals * torch.where((divergence * smooth).sum() < 0, -1.0, 1.0)


def _outward(points: Tensor, normals: Tensor, spacing: float, spread: float) -> Tensor:
    """Return normals (N, 3) towards the cameras all around that see a point, zero where these disagree or see none."""
    side, total = torch.zeros_like(points[:, 0]), torch.zeros_like(points[:, 0])
    cell, middle = max(_FACING.cell * spacing, _FACING.finest * spread), points.median(0).values
    reach = int(spread / cell) + 1
    directions = unit_sphere(_FACING.subdivisions, dtype=points.dtype).vertices
    for frame in rotation_between(directions.new_tensor([0.0, 0.0, 1.0]).expand_as(directions), directions):
        seen = (points - middle) @ frame
        row, column = (reach + (seen[:, :2] / cell).floor().long().clamp(-reach, reach)).unbind(-1)
        front = torch.full((2 * reach + 1,) * 2, -torch.inf).to(seen)
        front.view(-1).scatter_reduce_(0, row * len(front) + column, seen[:, 2], "amax")
        nearest = max_pool2d(front[None], 3, stride=1, padding=1)[0, row, column]
        # A surface seen at a slant comes nearer by about a hole's width from one point to the next.
        cosine = (normals @ frame[:, 2]) * (nearest - seen[:, 2] < cell / _FACING.cell)
        side, total = side + cosine, total + cosine.abs()
    return normals * torch.where(side.abs() > _FACING.sure * total, side.sign(), 0.0).unsqueeze(-1)


def _facing(normals: Tensor, to_camera: Tensor) -> Tensor:
    return torch.where((normals * to_camera).sum(-1, keepdim=True) < 0, -normals, normals)


def _least_torn(normals: Tensor, near: Tensor, cosine: Tensor, smooth: Tensor) -> tuple[Tensor, float]:
    """Return the direction (3,) whose side of normals (N, 3) tears neighbors (N, K) least, and the share torn."""
    directions = unit_sphere(_FACING.subdivisions, dtype=normals.dtype).vertices
    for _ in range(_FACING.num_rounds):
        sides = normals @ directions.mT > 0
        torn = ((sides.unsqueeze(1) == sides[near]) != (cosine > 0).unsqueeze(-1)) & smooth.unsqueeze(-1)
        share = torn.sum((0, 1)) / smooth.sum().clamp_min(1)
        best = share.argmin()
        signs = torch.where(sides[:, best, None], 1.0, -1.0)
        directions = torch.nn.functional.normalize((signs * normals).sum(0, keepdim=True), dim=-1)
    return directions[0], float(share[best])
