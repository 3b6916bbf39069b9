"""Normals of scans from one side, towards a camera of unknown position."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.mesh import unit_sphere
from torchreg.geometry.neighbors import k_nearest
from torchreg.geometry.normals import fit_normals, orient_normals


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


_FACING = _Facing()


def facing_normals(points: Tensor, viewpoint: Tensor | None = None) -> Tensor:
    """Return the unit normals (N, 3) of a scan, towards the camera where all points were taken from one side."""
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
            return _oriented(points, normals, near, cosine, smooth, viewpoint)
    return torch.zeros_like(points)


def _oriented(
    points: Tensor, normals: Tensor, near: Tensor, cosine: Tensor, smooth: Tensor, viewpoint: Tensor | None
) -> Tensor:
    """Return normals (N, 3) on one side, by cosines (N, K) to those of neighbors and which of these are smooth."""
    if viewpoint is not None:
        return _facing(normals, viewpoint.to(points) - points)
    kept = slice(None, _FACING.min_neighbors)
    direction, torn = _least_torn(normals, near[:, kept], cosine[:, kept], smooth[:, kept])
    if torn > _FACING.one_sided:
        return orient_normals(points, normals)
    normals = _facing(normals, direction)
    # On the whole a body is convex: its normals diverge.
    apart = torch.nn.functional.normalize(points.unsqueeze(1) - points[near], dim=-1)
    divergence = (apart * (normals.unsqueeze(1) - normals[near])).sum(-1)
    return normals * torch.where((divergence * smooth).sum() < 0, -1.0, 1.0)


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
