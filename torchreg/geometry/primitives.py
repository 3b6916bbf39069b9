"""Kinds of solids that make up an articulated shape: signed distances, analytic gradients and fits to points.

Distances take points in the solid's own frame (long axis z, center at the origin) and one row of sizes per solid; they
are negative inside. The formulas work on planes, all x, all y and all z, each contiguous: many times as fast as on
interleaved points. A further kind is one subclass of `PrimitiveKind` and one entry of `PRIMITIVE_KINDS`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.rigid import rigid_matrix

Planes = tuple[Tensor, Tensor, Tensor]
# Sizes of a solid, metres and exponents, and its frame (4, 4) in the coordinates of the points it is fitted to.
Candidate = tuple[list[float], Tensor]

# Squared distance from an ellipsoid's center, in radii, below which the ratio of its norms means nothing.
_CENTER = 1e-12


@dataclass(frozen=True)
class FitSettings:
    """Numbers by which solids are fitted to points."""

    # Least half extent of flat and thin clouds: as a share of the largest, and metres.
    least_share: float = 1e-2
    least_extent: float = 1e-6
    # Largest radius of an ellipsoid in half extents: a tube open at both ends says little about its length.
    overshoot: float = 1.4
    # Points from which the least-squares ellipsoid, of six unknowns, is fitted.
    ellipsoid_points: int = 10
    # Quantile of the distances from the axis that is a capsule's radius: points on the round ends lie nearer.
    radius_quantile: float = 0.7
    # Share of a cone's half height within which points belong to the mantle.
    mantle_share: float = 0.95
    # Exponents tried for superquadrics, from near boxes to ellipsoids.
    exponents: tuple[float, ...] = (0.2, 0.5, 1.0)


FIT = FitSettings()


@dataclass(frozen=True)
class Size:
    """One size of a kind of solid: whether it lies along the long axis z, and whether it is a length or an exponent."""

    name: str
    is_long: bool = False
    is_length: bool = True


class PrimitiveKind(ABC):
    """A kind of solid; ``sizes`` are in the order of size rows."""

    name: str
    sizes: tuple[Size, ...]

    @abstractmethod
    def plane_distance(self, points: Planes, sizes: Tensor) -> Tensor:
        """Return the distances of planes of points to solids of sizes (..., S), in the planes' shape."""

    @abstractmethod
    def plane_gradient(self, points: Planes, sizes: Tensor) -> tuple[Tensor, Planes]:
        """Return the distances of planes of points to solids of sizes (..., S), and the planes of their gradients."""

    @abstractmethod
    def candidates(self, points: Tensor, frame: Tensor) -> list[Candidate]:
        """Return solids that fit surface points (N, 3) float64, with the axes of a frame (4, 4) at their center."""

    def distance(self, points: Tensor, sizes: Tensor) -> Tensor:
        """Return the distances (...) of points (..., 3) to solids of sizes (..., S); zero gradient on the axis."""
        return self.plane_distance(_planes(points), sizes)

    def gradient(self, points: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distances (...) and their gradients (..., 3), in closed form."""
        distance, gradient = self.plane_gradient(_planes(points), sizes)
        return distance, torch.stack(torch.broadcast_tensors(*gradient), dim=-1)


def _planes(points: Tensor) -> Planes:
    x, y, z = points.unbind(-1)
    return x, y, z


def _squared_norm(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    return torch.addcmul(torch.addcmul(x * x, y, y), z, z)


def _half_extents(points: Tensor, frame: Tensor) -> tuple[Tensor, Tensor]:
    """Return the points in a frame, and the half extents (3,) of their bounding box, none of them zero."""
    local = (points - frame[:3, 3]) @ frame[:3, :3]
    half = (local.amax(0) - local.amin(0)) / 2
    return local, half.clamp_min(float(half.max()) * FIT.least_share).clamp_min(FIT.least_extent)


class Ellipsoid(PrimitiveKind):
    """Ellipsoids with radii along x, y, z and the distance ``k0 (k0 - 1) / k1``, ``k0 = |x / r|``, ``k1 = |x / r^2|``.

    Euclidean to first order at the surface, too deep inside, at the center minus the smallest radius. Dewaele et al.
    2006, section 2.
    """

    name = "ellipsoid"
    sizes = (Size("radius_x"), Size("radius_y"), Size("radius_z", is_long=True))

    def plane_distance(self, points: Planes, sizes: Tensor) -> Tensor:
        """Return the distances of planes of points; see `PrimitiveKind`."""
        return _EllipsoidNorms(points, sizes).distance()

    def plane_gradient(self, points: Planes, sizes: Tensor) -> tuple[Tensor, Planes]:
        """Return the distances of planes of points and the planes of their gradients; see `PrimitiveKind`."""
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

    def candidates(self, points: Tensor, frame: Tensor) -> list[Candidate]:
        """Return the ellipsoid of the bounding box and the algebraic least-squares one."""
        local, half = _half_extents(points, frame)
        found = [(half.tolist(), frame)]
        if len(points) < FIT.ellipsoid_points:
            return found
        scaled = local / half
        design, ones = torch.cat([scaled.square(), scaled], dim=-1), torch.ones(len(points), 1, dtype=points.dtype)
        solution = torch.linalg.lstsq(design, ones, driver="gelsd").solution[:, 0]
        curvature = solution[:3].clamp_min(FIT.overshoot**-2)
        center = (-0.5 * solution[3:] / curvature).clamp(-0.5, 0.5)
        level = 1 + (curvature * center.square()).sum()
        radii = (level / curvature).sqrt().clamp(0.5, FIT.overshoot)
        moved = rigid_matrix(frame[:3, :3], frame[:3, 3] + frame[:3, :3] @ (center * half))
        return [*found, ((radii * half).tolist(), moved)]


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


class Capsule(PrimitiveKind):
    """Capsules, segments of the z axis grown by a radius, with the exact distance; sizes in metres."""

    name = "capsule"
    sizes = (Size("half_length", is_long=True), Size("radius"))

    def plane_distance(self, points: Planes, sizes: Tensor) -> Tensor:
        """Return the distances of planes of points; see `PrimitiveKind`."""
        squared = _squared_norm(*_capsule_offset(points, sizes))
        on_axis = squared == 0
        return squared.masked_fill(on_axis, 1.0).sqrt().masked_fill(on_axis, 0.0) - sizes[..., 1]

    def plane_gradient(self, points: Planes, sizes: Tensor) -> tuple[Tensor, Planes]:
        """Return the distances of planes of points and the planes of their gradients; see `PrimitiveKind`."""
        x, y, z = _capsule_offset(points, sizes)
        squared = _squared_norm(x, y, z)
        on_axis = squared == 0
        norm = squared.masked_fill(on_axis, 1.0).sqrt()
        inverse = norm.reciprocal()
        return norm.masked_fill(on_axis, 0.0) - sizes[..., 1], (x * inverse, y * inverse, z * inverse)

    def candidates(self, points: Tensor, frame: Tensor) -> list[Candidate]:
        """Return the capsule whose radius is a quantile of the distances from the axis."""
        local, half = _half_extents(points, frame)
        radius = float(local[:, :2].norm(dim=-1).quantile(FIT.radius_quantile).clamp_min(FIT.least_extent))
        return [([max(float(half[2]) - radius, 1e-3 * radius), radius], frame)]


def _capsule_offset(points: Planes, sizes: Tensor) -> Planes:
    half = sizes[..., 0]
    x, y, z = points
    return x, y, z - torch.minimum(torch.maximum(z, -half), half)


class Cone(PrimitiveKind):
    """Truncated cones with flat ends on the z axis, with the exact distance; sizes in metres."""

    name = "cone"
    sizes = (Size("half_length", is_long=True), Size("radius_bottom"), Size("radius_top"))

    def plane_distance(self, points: Planes, sizes: Tensor) -> Tensor:
        """Return the distances of planes of points; see `PrimitiveKind`."""
        return _ConeFaces(points, sizes).distance()

    def plane_gradient(self, points: Planes, sizes: Tensor) -> tuple[Tensor, Planes]:
        """Return the distances of planes of points and the planes of their gradients; see `PrimitiveKind`."""
        faces = _ConeFaces(points, sizes)
        cosine = (faces.cosine * faces.at_mantle) * faces.inverse_radial
        radial = torch.where(faces.at_rim, faces.rim_radial / faces.rim * faces.inverse_radial, cosine)
        lift = torch.where(faces.at_mantle, -faces.slope * faces.cosine, points[2].sign())
        lift = torch.where(faces.at_rim, faces.rim_axial / faces.rim, lift)
        return faces.distance(), (points[0] * radial, points[1] * radial, lift)

    def candidates(self, points: Tensor, frame: Tensor) -> list[Candidate]:
        """Return the cone whose mantle is the regression of the radius on the height, over the points off the ends."""
        local, half = _half_extents(points, frame)
        side = local[:, 2].abs() < FIT.mantle_share * half[2]
        side = side if int(side.sum()) >= 4 else torch.ones_like(side)
        height, radial = local[side, 2], local[side, :2].norm(dim=-1)
        spread = (height - height.mean()).square().mean()
        slope = ((height - height.mean()) * radial).mean() / spread.clamp_min(1e-12)
        middle = radial.mean() - slope * height.mean()
        least = FIT.least_share * float(half[:2].max())
        ends = torch.stack([middle - slope * half[2], middle + slope * half[2]]).clamp_min(least)
        return [([float(half[2]), *ends.tolist()], frame)]


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


class Superquadric(PrimitiveKind):
    """Superquadrics with the radial distance ``|x| (1 - 1 / k)``, k the inside-outside function of degree one.

    ``k = ((|x/a|^(2/e2) + |y/b|^(2/e2))^(e2/e1) + |z/c|^(2/e1))^(e1/2)``. It is measured along the ray from the center
    and exceeds the Euclidean distance on oblique faces. Sizes are the radii, metres, and the exponents e1 and e2 in
    [0.1, 1.9], above 1 of which there is no derivative on the coordinate planes. Gross and Boult 1988.
    """

    name = "superquadric"
    sizes = (*Ellipsoid.sizes, Size("exponent_1", is_length=False), Size("exponent_2", is_length=False))

    def plane_distance(self, points: Planes, sizes: Tensor) -> Tensor:
        """Return the distances of planes of points; see `PrimitiveKind`."""
        norm, level, _, center = _superquadric_level(points, sizes)
        return torch.where(center, -sizes[..., :3].amin(-1).expand_as(norm), norm * (1 - 1 / level))

    def plane_gradient(self, points: Planes, sizes: Tensor) -> tuple[Tensor, Planes]:
        """Return the distances of planes of points and the planes of their gradients; see `PrimitiveKind`."""
        norm, level, level_gradient, center = _superquadric_level(points, sizes)
        distance = torch.where(center, -sizes[..., :3].amin(-1).expand_as(norm), norm * (1 - 1 / level))
        outward = ((1 - 1 / level) / norm).masked_fill(center, 0.0)
        steep = (norm / level.square()).masked_fill(center, 0.0)
        x, y, z = (
            torch.addcmul(plane * outward, slope, steep) for plane, slope in zip(points, level_gradient, strict=True)
        )
        return distance, (x, y, z)

    def candidates(self, points: Tensor, frame: Tensor) -> list[Candidate]:
        """Return the superquadrics of the bounding box with all pairs of a few exponents."""
        _, half = _half_extents(points, frame)
        return [([*half.tolist(), e1, e2], frame) for e1 in FIT.exponents for e2 in FIT.exponents]


def _superquadric_level(points: Planes, sizes: Tensor) -> tuple[Tensor, Tensor, Planes, Tensor]:
    """Return the norms of points, their level k, the planes of its gradient, and the mask of points at the center."""
    e1, e2 = sizes[..., 3], sizes[..., 4]
    inverse = _planes(sizes[..., :3].reciprocal())
    scaled = [(plane * radius).abs() for plane, radius in zip(points, inverse, strict=True)]
    largest = torch.maximum(torch.maximum(scaled[0], scaled[1]), scaled[2])
    center = largest < 1e-6
    largest = largest.masked_fill(center, 1.0)
    # The largest coordinate is factored out, of the plane and of all three, so that high powers of small numbers are
    # only ever added to one and neither overflow, nor vanish, nor divide by zero.
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


PRIMITIVE_KINDS: dict[str, PrimitiveKind] = {
    kind.name: kind for kind in (Ellipsoid(), Capsule(), Cone(), Superquadric())
}
