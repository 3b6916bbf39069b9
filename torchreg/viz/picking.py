"""Picking by rays: the first triangle that a ray meets, or the nearest point along it."""

from __future__ import annotations

import torch
from torch import Tensor

# Rays this near to parallel to a triangle do not meet it.
_GRAZING = 1e-12


@torch.no_grad()
def meet_triangles(vertices: Tensor, faces: Tensor, origin: Tensor, direction: Tensor) -> tuple[int, Tensor] | None:
    """Return the first triangle that a ray meets from either side, with barycentric coordinates (3,); None if none.

    References: Moeller and Trumbore 1997.
    """
    origin, direction = origin.to(vertices.device, torch.float64), direction.to(vertices.device, torch.float64)
    corner, first, second = vertices.double()[faces].unbind(1)
    first, second = first - corner, second - corner
    across = torch.linalg.cross(direction.expand_as(second), second)
    determinant = (first * across).sum(-1)
    size = first.norm(dim=-1) * second.norm(dim=-1)
    inverse = 1 / torch.where(determinant.abs() > _GRAZING * size, determinant, torch.nan)
    offset = origin - corner
    u = (offset * across).sum(-1) * inverse
    normal = torch.linalg.cross(offset, first)
    v = (direction * normal).sum(-1) * inverse
    distance = (second * normal).sum(-1) * inverse
    met = (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    if not bool(met.any()):
        return None
    nearest = int(torch.where(met, distance, torch.inf).argmin())
    share = torch.stack([1 - u[nearest] - v[nearest], u[nearest], v[nearest]])
    return nearest, share.to(vertices.dtype)


@torch.no_grad()
def pick_vertex(
    vertices: Tensor, faces: Tensor | None, origin: Tensor, direction: Tensor, *, reach: float = 0.02
) -> int | None:
    """Return the vertex that a ray points at; None if there is none.

    On a surface, the nearest corner of the triangle that the ray meets. Of points, the first along the ray among those
    whose distance from it is at most ``reach`` times their distance from the origin.
    """
    if faces is not None and len(faces):
        found = meet_triangles(vertices, faces, origin, direction)
        return None if found is None else int(faces[found[0], found[1].argmax()])
    origin, direction = origin.to(vertices.device, torch.float64), direction.to(vertices.device, torch.float64)
    offset = vertices.double() - origin
    depth = offset @ (direction / direction.norm())
    aside = (offset.square().sum(-1) - depth.square()).clamp(min=0).sqrt()
    met = (depth > 0) & (aside <= reach * depth)
    return int(torch.where(met, depth, torch.inf).argmin()) if bool(met.any()) else None
