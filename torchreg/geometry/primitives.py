"""Signed distances to the solids that make up an articulated shape, with analytic gradients.

Every function takes points in the solid's own frame (long axis z, center at the origin) and one row of sizes per solid,
and returns a signed distance that is negative inside and zero on the surface. It is Euclidean for capsules and cones,
Euclidean to first order at the surface for ellipsoids, and measured along rays from the center for superquadrics.
``*_gradient`` functions return the pair (distance, gradient) in closed form.
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
    return torch.cat([points[..., :2].expand(*nearest.shape, 2), (along - nearest).unsqueeze(-1)], dim=-1)


def cone_distance(points: Tensor, sizes: Tensor) -> Tensor:
    """Return the exact distance to truncated cones with flat ends on the z axis.

    Inside it is the larger of the signed distances to mantle and end; outside, the distance to the mantle, the end or
    the rim between them, whichever is nearest.

    Args:
        points: (..., 3), metres, in the cone's frame.
        sizes: (..., 3): half height, radius at -z, radius at +z; metres.

    Returns:
        (...), metres.

    Differentiable: in both; where the nearest face changes, one side's gradient is taken.
    """
    faces = _ConeFaces(points, sizes)
    return torch.where(faces.at_rim, faces.rim, torch.where(faces.at_mantle, faces.mantle, faces.end))


def cone_gradient(points: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor]:
    """Return (distance, gradient) of `cone_distance`."""
    faces = _ConeFaces(points, sizes)
    distance = torch.where(faces.at_rim, faces.rim, torch.where(faces.at_mantle, faces.mantle, faces.end))
    zero = torch.zeros_like(distance)
    radial = torch.where(faces.at_rim, faces.rim_radial / faces.rim, torch.where(faces.at_mantle, faces.cosine, zero))
    lift = torch.where(faces.at_mantle, -faces.slope * faces.cosine, points[..., 2].sign())
    lift = torch.where(faces.at_rim, faces.rim_axial / faces.rim, lift)
    return distance, torch.cat([faces.outward * radial.unsqueeze(-1), lift.unsqueeze(-1)], dim=-1)


class _ConeFaces:
    """Distances of points to the faces and the rims of cones, in the half plane (radius, z), and which is nearest."""

    def __init__(self, points: Tensor, sizes: Tensor) -> None:
        half, bottom, top = sizes.unbind(-1)
        squared = points[..., :2].square().sum(-1)
        on_axis = squared == 0
        safe = torch.where(on_axis, 1.0, squared).sqrt()
        radial = torch.where(on_axis, 0.0, safe)
        along = points[..., 2]
        self.outward = points[..., :2] / safe.unsqueeze(-1)
        self.slope = (top - bottom) / (2 * half)
        self.cosine = (1 + self.slope.square()).rsqrt()
        self.mantle = (radial - 0.5 * (top + bottom) - self.slope * along) * self.cosine
        self.end = along.abs() - half
        # Height of the foot of the perpendicular on the mantle's line.
        foot = along + self.slope * self.cosine * self.mantle
        over_mantle = (self.mantle > 0) & (foot.abs() <= half)
        over_end = (self.end > 0) & (radial <= torch.where(along < 0, bottom, top))
        inside = (self.mantle <= 0) & (self.end <= 0)
        self.at_mantle = over_mantle | (inside & (self.mantle >= self.end))
        low = foot < 0
        self.rim_radial = radial - torch.where(low, bottom, top)
        self.rim_axial = along + torch.where(low, half, -half)
        squared_rim = self.rim_radial.square() + self.rim_axial.square()
        self.at_rim = ~(inside | over_mantle | over_end) & (squared_rim > 0)
        self.rim = torch.where(self.at_rim, squared_rim, 1.0).sqrt()


def superquadric_distance(points: Tensor, sizes: Tensor) -> Tensor:
    """Return the radial distance to superquadrics, ``|x| (1 - 1 / k)``, k the inside-outside function of degree one.

    ``k = ((|x/a|^(2/e2) + |y/b|^(2/e2))^(e2/e1) + |z/c|^(2/e1))^(e1/2)``. It is measured along the ray from the center,
    so it exceeds the Euclidean distance on oblique faces.

    Args:
        points: (..., 3), metres, in the superquadric's frame.
        sizes: (..., 5): radii along x, y, z in metres; exponents e1, e2 in [0.1, 1.9] (1: ellipsoid, 0.1: near a box).

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
    scaled = (points / radii).abs()
    center = scaled.amax(-1) < 1e-6
    scaled = torch.where(center.unsqueeze(-1), 1.0, scaled)
    largest = scaled.amax(-1)
    # Degree one lets the largest coordinate be taken out, of the plane and of the whole, so that high powers of small
    # numbers are only ever added to one and neither overflow, nor vanish, nor divide by zero.
    u = (scaled / largest.unsqueeze(-1)).clamp_min(1e-12)
    widest = u[..., :2].amax(-1)
    v = u[..., :2] / widest.unsqueeze(-1)
    planar_sum = (v ** (2 / e2).unsqueeze(-1)).sum(-1)
    planar = widest * planar_sum ** (e2 / 2)
    inside = planar ** (2 / e1) + u[..., 2] ** (2 / e1)
    level = largest * inside ** (e1 / 2)
    power = inside ** (e1 / 2 - 1)
    in_plane = (power * planar ** (2 / e1 - 1) * planar_sum ** (e2 / 2 - 1)).unsqueeze(-1)
    in_plane = in_plane * v ** (2 / e2 - 1).unsqueeze(-1)
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
