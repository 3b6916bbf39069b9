"""Signed distances to the solids that make up an articulated shape, with analytic gradients.

Every function takes points in the solid's own frame (long axis z, center at the origin) and one row of sizes per solid,
and returns a signed distance that is negative inside, exact to first order at the surface. ``*_gradient`` functions return
the pair (distance, gradient) without building an autograd graph of the distance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class PrimitiveKind:
    """What a kind of solid is called, measured by, and how its distance is evaluated.

    Args:
        name: the kind's name.
        sizes: names of the sizes, in the order of the size row.
        distance: (points (..., 3), sizes (..., S)) -> (...).
        gradient: (points (..., 3), sizes (..., S)) -> ((...), (..., 3)).
        long_sizes: which sizes lie along the long axis z.
        scalable: which sizes are lengths (the others are exponents).
    """

    name: str
    sizes: tuple[str, ...]
    distance: Callable[[Tensor, Tensor], Tensor]
    gradient: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
    long_sizes: tuple[bool, ...]
    scalable: tuple[bool, ...]


def ellipsoid_distance(points: Tensor, sizes: Tensor) -> Tensor:
    """Return the pseudo-Euclidean distance to ellipsoids, ``k0 (k0 - 1) / k1``, ``k0 = |x / r|``, ``k1 = |x / r^2|``.

    It agrees with the Euclidean distance to first order at the surface and is too deep inside; at the center, where
    the ratio is 0/0, it returns minus the smallest radius.

    Args:
        points: (..., 3), metres, in the ellipsoid's frame.
        sizes: (..., 3) radii along x, y, z, metres.

    Returns:
        (...), metres.

    Differentiable: in both; the gradient at the center is zero.

    References: Dewaele et al. 2006, section 2.
    """
    k0, k1, center = _ellipsoid_norms(points, sizes)
    return torch.where(center, -sizes.amin(-1).expand_as(k0), k0 * (k0 - 1) / k1)


def ellipsoid_gradient(points: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor]:
    """Return (distance, gradient) of `ellipsoid_distance`."""
    k0, k1, center = _ellipsoid_norms(points, sizes)
    inverse_square = sizes.square().reciprocal()
    first = points * inverse_square
    ratio = (k0 - 1) / k1
    distance = torch.where(center, -sizes.amin(-1).expand_as(k0), k0 * ratio)
    # With grad k0 = x / (r^2 k0) and grad k1 = x / (r^4 k1).
    along_k0 = (2 * k0 - 1) / (k0 * k1)
    along_k1 = k0 * ratio / k1.square()
    gradient = first * (along_k0.unsqueeze(-1) - along_k1.unsqueeze(-1) * inverse_square)
    return distance, torch.where(center.unsqueeze(-1), 0.0, gradient)


def _ellipsoid_norms(points: Tensor, radii: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    scaled = points / radii
    squared = scaled.square().sum(-1)
    center = squared < 1e-12
    squared_second = (scaled / radii).square().sum(-1)
    return torch.where(center, 1.0, squared).sqrt(), torch.where(center, 1.0, squared_second).sqrt(), center


def capsule_distance(points: Tensor, sizes: Tensor) -> Tensor:
    """Return the exact distance to capsules, segments of the z axis grown by a radius.

    Args:
        points: (..., 3), metres, in the capsule's frame.
        sizes: (..., 2): half length of the segment, radius; metres.

    Returns:
        (...), metres.

    Differentiable: in both; the gradient on the segment is zero.
    """
    offset = _capsule_offset(points, sizes)
    squared = offset.square().sum(-1)
    on_axis = squared == 0
    return torch.where(on_axis, 0.0, torch.where(on_axis, 1.0, squared).sqrt()) - sizes[..., 1]


def capsule_gradient(points: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor]:
    """Return (distance, gradient) of `capsule_distance`."""
    offset = _capsule_offset(points, sizes)
    norm = torch.linalg.vector_norm(offset, dim=-1)
    safe = torch.where(norm == 0, 1.0, norm)
    return norm - sizes[..., 1], offset / safe.unsqueeze(-1)


def _capsule_offset(points: Tensor, sizes: Tensor) -> Tensor:
    half = sizes[..., 0]
    along = points[..., 2]
    nearest = torch.minimum(torch.maximum(along, -half), half)
    return torch.cat([points[..., :2], (along - nearest).unsqueeze(-1)], dim=-1)


def cone_distance(points: Tensor, sizes: Tensor) -> Tensor:
    """Return the distance to truncated cones with flat ends on the z axis.

    The larger of the distances to mantle and ends; beyond both, the root of their squares. This is exact for a
    cylinder, and for a cone everywhere but beyond the rims, where it is a close bound with the same zero set.

    Args:
        points: (..., 3), metres, in the cone's frame.
        sizes: (..., 3): half height, radius at -z, radius at +z; metres.

    Returns:
        (...), metres.

    Differentiable: in both, away from the axis and the edges of the nearest face, where one side's gradient is taken.
    """
    mantle, end = _cone_faces(points, sizes)[:2]
    return _outside_both(mantle, end)[0]


def cone_gradient(points: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor]:
    """Return (distance, gradient) of `cone_distance`."""
    mantle, end, mantle_normal, end_normal = _cone_faces(points, sizes)
    distance, mantle_share, end_share = _outside_both(mantle, end)
    return distance, mantle_share.unsqueeze(-1) * mantle_normal + end_share.unsqueeze(-1) * end_normal


def _cone_faces(points: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    half, bottom, top = sizes.unbind(-1)
    squared = points[..., :2].square().sum(-1)
    on_axis = squared == 0
    radial = torch.where(on_axis, 0.0, torch.where(on_axis, 1.0, squared).sqrt())
    along = points[..., 2]
    slope = (top - bottom) / (2 * half)
    cosine = (1 + slope.square()).rsqrt()
    mantle = (radial - 0.5 * (top + bottom) - slope * along) * cosine
    end = along.abs() - half
    outward = points[..., :2] / torch.where(on_axis, 1.0, radial).unsqueeze(-1)
    lift = (-slope * cosine).expand_as(radial)
    mantle_normal = torch.cat([outward * cosine.unsqueeze(-1), lift.unsqueeze(-1)], dim=-1)
    zero = torch.zeros_like(along)
    end_normal = torch.stack([zero, zero, along.sign()], dim=-1)
    return mantle, end, mantle_normal, end_normal


def _outside_both(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    corner = (first > 0) & (second > 0)
    squared = torch.where(corner, first.square() + second.square(), 1.0)
    root = squared.sqrt()
    nearer = first >= second
    distance = torch.where(corner, root, torch.maximum(first, second))
    share_first = torch.where(corner, first / root, nearer.to(first.dtype))
    share_second = torch.where(corner, second / root, (~nearer).to(first.dtype))
    return distance, share_first, share_second


def superquadric_distance(points: Tensor, sizes: Tensor) -> Tensor:
    """Return the radial distance to superquadrics, ``|x| (1 - 1 / k)``, with the inside-outside function k of degree one.

    ``k = ((|x/a|^(2/e2) + |y/b|^(2/e2))^(e2/e1) + |z/c|^(2/e1))^(e1/2)``. It is measured along the ray from the center,
    so it exceeds the Euclidean distance on oblique faces.

    Args:
        points: (..., 3), metres, in the superquadric's frame.
        sizes: (..., 5): radii along x, y, z in metres; exponents e1, e2 in [0.1, 1.9] (1: ellipsoid, 0.1: nearly a box).

    Returns:
        (...), metres; minus the smallest radius at the center.

    Differentiable: in both, away from the coordinate planes for exponents above 1; the gradient at the center is zero.

    References: Gross and Boult 1988.
    """
    norm, level, _, center = _superquadric_level(points, sizes)
    return torch.where(center, -sizes[..., :3].amin(-1).expand_as(norm), norm * (1 - 1 / level))


def superquadric_gradient(points: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor]:
    """Return (distance, gradient) of `superquadric_distance`."""
    norm, level, level_gradient, center = _superquadric_level(points, sizes)
    distance = torch.where(center, -sizes[..., :3].amin(-1).expand_as(norm), norm * (1 - 1 / level))
    gradient = points * ((1 - 1 / level) / norm).unsqueeze(-1) + level_gradient * (norm / level.square()).unsqueeze(-1)
    return distance, torch.where(center.unsqueeze(-1), 0.0, gradient)


def _superquadric_level(points: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    radii, e1, e2 = sizes[..., :3], sizes[..., 3], sizes[..., 4]
    scaled = points / radii
    largest = scaled.abs().amax(-1)
    center = largest < 1e-6
    # Degree one lets the largest coordinate be taken out, so that high powers neither overflow nor vanish.
    largest = torch.where(center, 1.0, largest)
    u = (scaled / largest.unsqueeze(-1)).abs().clamp_min(1e-12)
    planar = u[..., 0] ** (2 / e2) + u[..., 1] ** (2 / e2)
    inside = planar ** (e2 / e1) + u[..., 2] ** (2 / e1)
    level = largest * inside ** (e1 / 2)
    power = inside ** (e1 / 2 - 1)
    in_plane = (power * planar ** (e2 / e1 - 1)).unsqueeze(-1) * u[..., :2] ** (2 / e2 - 1).unsqueeze(-1)
    in_height = power * u[..., 2] ** (2 / e1 - 1)
    level_gradient = torch.cat([in_plane, in_height.unsqueeze(-1)], dim=-1) * points.sign() / radii
    squared = points.square().sum(-1)
    norm = torch.where(center, 1.0, squared).sqrt()
    return norm, torch.where(center, 1.0, level), level_gradient, center


ELLIPSOID = PrimitiveKind(
    "ellipsoid", ("radius_x", "radius_y", "radius_z"), ellipsoid_distance, ellipsoid_gradient,
    long_sizes=(False, False, True), scalable=(True, True, True),
)  # fmt: skip
CAPSULE = PrimitiveKind(
    "capsule", ("half_length", "radius"), capsule_distance, capsule_gradient,
    long_sizes=(True, False), scalable=(True, True),
)  # fmt: skip
CONE = PrimitiveKind(
    "cone", ("half_length", "radius_bottom", "radius_top"), cone_distance, cone_gradient,
    long_sizes=(True, False, False), scalable=(True, True, True),
)  # fmt: skip
SUPERQUADRIC = PrimitiveKind(
    "superquadric", ("radius_x", "radius_y", "radius_z", "exponent_1", "exponent_2"),
    superquadric_distance, superquadric_gradient,
    long_sizes=(False, False, True, False, False), scalable=(True, True, True, False, False),
)  # fmt: skip
PRIMITIVE_KINDS = {kind.name: kind for kind in (ELLIPSOID, CAPSULE, CONE, SUPERQUADRIC)}
