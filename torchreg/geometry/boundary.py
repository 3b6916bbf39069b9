"""The boundary of scans, with and without triangles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class BoundarySettings:
    """Rule by which points without triangles are boundary."""

    # Neighbors around a point.
    num_neighbors: int = 24
    # Widest angle between neighbors off the boundary: of 24 random directions 1 in 500 leave a wider one.
    widest_angle: float = math.pi * 2 / 3


BOUNDARY = BoundarySettings()


def boundary_of_faces(faces: Tensor, count: int) -> Tensor:
    """Return a mask (N,) of the points on an edge of one face alone, or on no face."""
    sides = torch.stack((faces, faces.roll(-1, dims=1)), dim=-1).sort(dim=-1).values.reshape(-1, 2)
    key, uses = (sides[:, 0] * count + sides[:, 1]).unique(return_counts=True)
    rim = key[uses == 1]
    boundary = torch.ones(count, dtype=torch.bool).index_fill(0, faces.reshape(-1), False)
    return boundary.index_fill(0, torch.cat((rim // count, rim % count)), True)


def boundary_of_points(points: Tensor, normals: Tensor, near: Tensor) -> Tensor:
    """Return a mask (N,) of the points whose neighbors (N, K) leave a wide angle empty in the tangent plane."""
    axis = torch.zeros_like(normals).scatter(1, normals.abs().argmin(dim=1, keepdim=True), 1.0)
    first = torch.nn.functional.normalize(torch.linalg.cross(normals, axis), dim=-1)
    second = torch.linalg.cross(normals, first)
    offset = points[near] - points[:, None]
    frame = torch.stack((first, second, normals), dim=-1)
    right, up, height = (offset @ frame).unbind(-1)
    # Neighbors steeply above or below belong to another surface in front or behind.
    level = height.abs() <= torch.hypot(right, up)
    angle = torch.where(level, torch.atan2(up, right), torch.inf).sort(dim=-1).values
    number = level.sum(dim=-1)
    last = angle.gather(1, (number - 1).clamp(min=0)[:, None])[:, 0]
    around = 2 * torch.pi + angle[:, 0] - last
    between = torch.where(angle[:, 1:].isfinite(), angle[:, 1:] - angle[:, :-1], 0.0)
    widest = torch.maximum(around, between.amax(dim=-1)) if angle.shape[1] > 1 else around
    return (widest > BOUNDARY.widest_angle) | (number == 0)
