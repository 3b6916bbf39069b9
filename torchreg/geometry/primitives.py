"""Signed distances to the solids that make up an articulated shape, with analytic gradients.

Every function takes points in the solid's own frame (long axis z, center at the origin) and one row of sizes per solid,
and returns a signed distance that is negative inside and zero on the surface. It is Euclidean for capsules and cones,
Euclidean to first order at the surface for ellipsoids, and measured along rays from the center for superquadrics.

The formulas work on planes, all x, all y and all z, each contiguous: many times as fast as on interleaved points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

Planes = tuple[Tensor, Tensor, Tensor]

# Squared distance from an ellipsoid's center, in radii, below which the ratio of its norms means nothing.
_CENTER = 1e-12


@dataclass(frozen=True)
class PrimitiveKind:
    """What a kind of solid is called, measured by, and how its distance is evaluated.

    Args:
        name: the kind's name.
        sizes: names of the sizes, in the order of the size row.
        plane_distance: (planes of points, sizes (..., S)) -> distances of the planes' shape.
        plane_gradient: (planes of points, sizes (..., S)) -> (distances, planes of the gradient).
        long_sizes: which sizes lie along the long axis z.
        scalable: which sizes are lengths (the others are exponents).
    """

    name: str
    sizes: tuple[str, ...]
    plane_distance: Callable[[Planes, Tensor], Tensor]
    plane_gradient: Callable[[Planes, Tensor], tuple[Tensor, Planes]]
    long_sizes: tuple[bool, ...]
    scalable: tuple[bool, ...]

    def distance(self, points: Tensor, sizes: Tensor) -> Tensor:
        """Return the distances (...) of points (..., 3) to solids of sizes (..., S)."""
        return self.plane_distance(_planes(points), sizes)

    def gradient(self, points: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distances (...) and their gradients (..., 3), in closed form."""
        distance, gradient = self.plane_gradient(_planes(points), sizes)
        return distance, torch.stack(torch.broadcast_tensors(*gradient), dim=-1)


def _planes(points: Tensor) -> Planes:
    x, y, z = points.unbind(-1)
    return x, y, z


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
    return _ellipsoid_distance(_planes(points), sizes)


def _ellipsoid_distance(points: Planes, sizes: Tensor) -> Tensor:
    return _EllipsoidNorms(points, sizes).distance()


def _ellipsoid_gradient(points: Planes, sizes: Tensor) -> tuple[Tensor, Planes]:
    norms = _EllipsoidNorms(points, sizes)
    distance = norms.distance()
    # With grad k0 = x / (r^2 k0) and grad k1 = x / (r^4 k1).
    along_k0 = (2 - norms.inverse_k0) * norms.inverse_k1
    along_k1 = -distance * norms.inverse_k1 * norms.inverse_k1
    x, y, z = (
        plane * torch.addcmul(along_k0, along_k1, inverse * inverse)
        for plane, inverse in zip(norms.second, norms.inverse, strict=True)
    )
    return distance, (x, y, z)


class _EllipsoidNorms:
    """The norms ``k0 = |x / r|`` and ``k1 = |x / r^2|``, kept from zero, and ``x / r^2``."""

    def __init__(self, points: Planes, radii: Tensor) -> None:
        self.smallest = radii.amin(-1)
        self.inverse = _planes(radii.reciprocal())
        first = [plane * inverse for plane, inverse in zip(points, self.inverse, strict=True)]
        x, y, z = (plane * inverse for plane, inverse in zip(first, self.inverse, strict=True))
        self.second = x, y, z
        self.squared = _squared_norm(*first)
        safe = self.squared.clamp_min(_CENTER)
        safe_second = torch.maximum(_squared_norm(x, y, z), _CENTER / radii.amax(-1).square())
        self.inverse_k0, self.inverse_k1 = safe.rsqrt(), safe_second.rsqrt()
        self.k0 = safe * self.inverse_k0

    def distance(self) -> Tensor:
        distance = (self.k0 - 1) * self.inverse_k1 * self.k0
        # One at the center, zero outside of its surroundings: a choice by comparison takes ten times as long.
        at_center = torch.rsub(self.squared, 1, alpha=1 / _CENTER).clamp_min(0)
        return torch.lerp(distance, -self.smallest.expand_as(distance), at_center)


def _squared_norm(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    return torch.addcmul(torch.addcmul(x * x, y, y), z, z)


def capsule_distance(points: Tensor, sizes: Tensor) -> Tensor:
    """Return the exact distance to capsules, segments of the z axis grown by a radius.

    Args:
        points: (..., 3), metres, in the capsule's frame.
        sizes: (..., 2): half length of the segment, radius; metres.

    Returns:
        (...), metres.

    Differentiable: in both; the gradient on the segment is zero.
    """
    return _capsule_distance(_planes(points), sizes)


def _capsule_distance(points: Planes, sizes: Tensor) -> Tensor:
    squared = _squared_norm(*_capsule_offset(points, sizes))
    on_axis = squared == 0
    return squared.masked_fill(on_axis, 1.0).sqrt().masked_fill(on_axis, 0.0) - sizes[..., 1]


def _capsule_gradient(points: Planes, sizes: Tensor) -> tuple[Tensor, Planes]:
    x, y, z = _capsule_offset(points, sizes)
    squared = _squared_norm(x, y, z)
    on_axis = squared == 0
    norm = squared.masked_fill(on_axis, 1.0).sqrt()
    inverse = norm.reciprocal()
    return norm.masked_fill(on_axis, 0.0) - sizes[..., 1], (x * inverse, y * inverse, z * inverse)


def _capsule_offset(points: Planes, sizes: Tensor) -> Planes:
    half = sizes[..., 0]
    x, y, z = points
    return x, y, z - torch.minimum(torch.maximum(z, -half), half)


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
    return _cone_distance(_planes(points), sizes)


def _cone_distance(points: Planes, sizes: Tensor) -> Tensor:
    return _ConeFaces(points, sizes).distance()


def _cone_gradient(points: Planes, sizes: Tensor) -> tuple[Tensor, Planes]:
    faces = _ConeFaces(points, sizes)
    cosine = (faces.cosine * faces.at_mantle) * faces.inverse_radial
    radial = torch.where(faces.at_rim, faces.rim_radial / faces.rim * faces.inverse_radial, cosine)
    lift = torch.where(faces.at_mantle, -faces.slope * faces.cosine, points[2].sign())
    lift = torch.where(faces.at_rim, faces.rim_axial / faces.rim, lift)
    return faces.distance(), (points[0] * radial, points[1] * radial, lift)


class _ConeFaces:
    """Distances of points to the faces and the rims of cones, in the half plane (radius, z), and which is nearest."""

    def __init__(self, points: Planes, sizes: Tensor) -> None:
        half, bottom, top = sizes.unbind(-1)
        x, y, along = points
        squared = torch.addcmul(x * x, y, y)
        on_axis = squared == 0
        safe = squared.masked_fill(on_axis, 1.0).sqrt()
        radial = safe.masked_fill(on_axis, 0.0)
        self.inverse_radial = safe.reciprocal()
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
        self.rim = squared_rim.masked_fill(~self.at_rim, 1.0).sqrt()

    def distance(self) -> Tensor:
        return torch.where(self.at_rim, self.rim, torch.where(self.at_mantle, self.mantle, self.end))


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
    return _superquadric_distance(_planes(points), sizes)


def _superquadric_distance(points: Planes, sizes: Tensor) -> Tensor:
    norm, level, _, center = _superquadric_level(points, sizes)
    return torch.where(center, -sizes[..., :3].amin(-1).expand_as(norm), norm * (1 - 1 / level))


def _superquadric_gradient(points: Planes, sizes: Tensor) -> tuple[Tensor, Planes]:
    norm, level, level_gradient, center = _superquadric_level(points, sizes)
    distance = torch.where(center, -sizes[..., :3].amin(-1).expand_as(norm), norm * (1 - 1 / level))
    outward = ((1 - 1 / level) / norm).masked_fill(center, 0.0)
    steep = (norm / level.square()).masked_fill(center, 0.0)
    x, y, z = (
        torch.addcmul(plane * outward, slope, steep) for plane, slope in zip(points, level_gradient, strict=True)
    )
    return distance, (x, y, z)


def _superquadric_level(points: Planes, sizes: Tensor) -> tuple[Tensor, Tensor, Planes, Tensor]:
    e1, e2 = sizes[..., 3], sizes[..., 4]
    inverse = _planes(sizes[..., :3].reciprocal())
    scaled = [(plane * radius).abs() for plane, radius in zip(points, inverse, strict=True)]
    largest = torch.maximum(torch.maximum(scaled[0], scaled[1]), scaled[2])
    center = largest < 1e-6
    largest = largest.masked_fill(center, 1.0)
    # Degree one lets the largest coordinate be taken out, of the plane and of the whole, so that high powers of small
    # numbers are only ever added to one and neither overflow, nor vanish, nor divide by zero.
    u = [(plane.masked_fill(center, 1.0) / largest).clamp_min(1e-12) for plane in scaled]
    widest = torch.maximum(u[0], u[1])
    v = [u[0] / widest, u[1] / widest]
    planar_sum = v[0] ** (2 / e2) + v[1] ** (2 / e2)
    planar = widest * planar_sum ** (e2 / 2)
    inside = planar ** (2 / e1) + u[2] ** (2 / e1)
    level = largest * inside ** (e1 / 2)
    power = inside ** (e1 / 2 - 1)
    in_plane = power * planar ** (2 / e1 - 1) * planar_sum ** (e2 / 2 - 1)
    slopes = in_plane * v[0] ** (2 / e2 - 1), in_plane * v[1] ** (2 / e2 - 1), power * u[2] ** (2 / e1 - 1)
    x, y, z = (slope * plane.sign() * radius for slope, plane, radius in zip(slopes, points, inverse, strict=True))
    norm = _squared_norm(*points).masked_fill(center, 1.0).sqrt()
    return norm, level.masked_fill(center, 1.0), (x, y, z), center


ELLIPSOID = PrimitiveKind(
    "ellipsoid", ("radius_x", "radius_y", "radius_z"), _ellipsoid_distance, _ellipsoid_gradient,
    long_sizes=(False, False, True), scalable=(True, True, True),
)  # fmt: skip
CAPSULE = PrimitiveKind(
    "capsule", ("half_length", "radius"), _capsule_distance, _capsule_gradient,
    long_sizes=(True, False), scalable=(True, True),
)  # fmt: skip
CONE = PrimitiveKind(
    "cone", ("half_length", "radius_bottom", "radius_top"), _cone_distance, _cone_gradient,
    long_sizes=(True, False, False), scalable=(True, True, True),
)  # fmt: skip
SUPERQUADRIC = PrimitiveKind(
    "superquadric", ("radius_x", "radius_y", "radius_z", "exponent_1", "exponent_2"),
    _superquadric_distance, _superquadric_gradient,
    long_sizes=(False, False, True, False, False), scalable=(True, True, True, False, False),
)  # fmt: skip
PRIMITIVE_KINDS = {kind.name: kind for kind in (ELLIPSOID, CAPSULE, CONE, SUPERQUADRIC)}
