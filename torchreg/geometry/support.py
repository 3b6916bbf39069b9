"""Segmentation of a scan into a thing and its support: a table, a turntable, a floor."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_points
from torchreg.errors import FileWarning
from torchreg.geometry.graphs import connected_components
from torchreg.geometry.loaded import as_points
from torchreg.geometry.mesh import TriangleMesh, even_samples
from torchreg.geometry.neighbors import weld

# What is done with a support: left out where one is found, or kept.
SUPPORTS = ("auto", "keep")


@dataclass(frozen=True)
class _Search:
    """How planes are searched among points."""

    num_points: int = 2000  # that stand for all
    num_planes: int = 256  # hypotheses: of a table that is a tenth of the points ten or more lie on it
    near: int = 128  # points around the first one of a hypothesis from which the others are drawn
    num_tried: int = 6  # planes, those of most points first, that are looked at closely
    num_fits: int = 8  # least-squares fits of each
    alike: float = 0.97  # cosine between two planes that are one
    outliers: float = 0.01  # share of the points that may lie anywhere
    band: float = 0.015  # distance of points from their plane in the first fits, in sizes of all
    noise: float = 6.0  # median deviations from a plane up to which points lie on it: four standard ones
    exact: float = 1e-3  # the same at least, in sizes of all: coordinates are rounded


@dataclass(frozen=True)
class _Rule:
    """What makes a plane a support; widths are means over all directions in the plane."""

    least: float = 0.01  # share of the points that stands on it: what lies on it altogether is flat itself
    small: float = 0.04  # share of the points up to which the thing must be small against its support
    floor: float = 2.0  # least width of the support of what is small, in those of the thing
    height: float = 0.05  # least height of the thing, in widths of its own
    lowest: float = 0.05  # share of the thing, next to the plane, that gives its position
    rim: float = 0.05  # of a plane, on which a thing does not stand, in widths of the plane
    inside: float = 0.6  # share of the lowest part that is inside of the rim
    filled: float = 0.75  # share of its convex hull that a plane fills: tables and floors are no stars, nor hands
    whole: float = 0.85  # the same of a support that is narrow or thick, unless it is a piece apart
    wider: float = 1.1  # least width of a support in those of the thing
    narrow: float = 0.75  # the same of one that is open, or a piece apart
    open: float = 0.4  # share of a narrow support above which nothing is
    thick: float = 0.25  # most depth of a slab that is no piece apart, in its widths
    legs: float = 0.6  # most depth of a piece apart, as of a table with its legs
    slab: float = 1.5  # least width, in those of the thing, of a slab that is no piece apart: it may be a part
    apart: float = 0.9  # share of the points on a plane that are of pieces without anything above
    num_directions: int = 24  # in which widths are measured
    num_cells: int = 24  # along the sides of the grid on which areas are measured
    near: float = 4.0  # points on a plane within the radius about a cell that decide whether it is full: all but 2 %


_SEARCH, _RULE = _Search(), _Rule()


@dataclass(frozen=True, eq=False)
class SupportSplit:
    """Points told apart into a support and what stands on it; see `split_support`.

    Args:
        mask: (N,) True for points on the support; nowhere if nothing stands on a plane.
        plane: (4,) float64 on the CPU, unit normal towards what stands on it and d, ``normal . x + d = 0``; None if
            nothing does.
        reach: height over the plane up to which points are on the support, in the unit of the points.
    """

    mask: Tensor
    plane: Tensor | None = None
    reach: float = 0.0

    def rest(self, mesh: TriangleMesh) -> TriangleMesh:
        """Return the mesh that was split without its support: the faces on the plane, or below, are cut."""
        if self.plane is None:
            return mesh
        below = _Plane(self.plane, self.reach).holds(mesh.vertices)
        faces = mesh.faces[~below[mesh.faces].all(1)]
        return TriangleMesh(mesh.vertices[~self.mask], ((~self.mask).cumsum(0) - 1)[faces])


@torch.no_grad()
def split_support(data: Any) -> SupportSplit:
    """Return which points lie on the table, turntable or floor that all the others stand on.

    A support is a plane, thin against the size of all, that everything else is on one side of, and that reaches beyond
    where this stands on it. It is wider than the thing, or nothing is above much of it; a thick one, as a slab, is
    wider by half or a piece of its own. A thing that is flat, the face of a thing, or a foot no wider than what it
    carries is none. Of a mesh those vertices are on the support that have no face above it.

    Args:
        data: a mesh, a scan, a cloud or points (N, 3), in any unit.

    Raises:
        InputError: if there is no point or one is not finite.

    Differentiable: no.

    Cost: 20 ms for 10,000 points; of more points a sample is searched.

    References: Fischler and Bolles 1981, random sample consensus.
    """
    points = as_float_tensor(as_points(data), "data")
    check_points(points, "data", batch=False)
    given = getattr(data, "faces", None)
    faces = torch.zeros(0, 3, dtype=torch.int64, device=points.device) if given is None else given
    samples, face = _samples(points, faces)
    for plane in _planes(samples):
        view = _View(samples, plane)
        if view.may_support and view.is_support(apart=_is_apart(points, faces, face[view.on], plane)):
            mask = plane.holds(points)
            mask[faces[~mask[faces].all(1)].reshape(-1)] = False
            return SupportSplit(mask=mask, plane=plane.coefficients, reach=plane.reach)
    return SupportSplit(mask=torch.zeros(len(points), dtype=torch.bool, device=points.device))


def warn_about_support(points: str, *, stacklevel: int) -> None:
    """Say which points, with their number, are left out as the support of the others."""
    warnings.warn(
        f"{points} lie on the plane that the others stand on, as of a table or a floor, and are left out; pass "
        f"support='keep' to keep them",
        FileWarning,
        stacklevel=stacklevel + 1,
    )


def _samples(points: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Return points spread by area and the face of each, or some of a cloud and none; float64 on the CPU."""
    points = points.detach().cpu().double()
    if len(faces):
        # Single precision is quicker, and enough for shares of the area.
        center = points.mean(0)
        scale = float((points - center).abs().amax()) or 1.0
        found, face = even_samples(TriangleMesh(((points - center) / scale).float(), faces.cpu()), _SEARCH.num_points)
        return found.double() * scale + center, face
    if len(points) > _SEARCH.num_points:
        chosen = torch.randint(len(points), (_SEARCH.num_points,), generator=torch.Generator().manual_seed(0))
        points = points[chosen]
    return points, torch.zeros(len(points), dtype=torch.int64)


@dataclass(frozen=True, eq=False)
class _Plane:
    """A plane ``normal . x + d = 0``, (4,) float64 on the CPU, and the distance up to which points lie on it."""

    coefficients: Tensor
    reach: float

    def heights(self, points: Tensor) -> Tensor:
        """Return the signed distances (N,) of points (N, 3)."""
        plane = self.coefficients.to(points.device)
        return points.detach().double() @ plane[:3] + plane[3]

    def holds(self, points: Tensor) -> Tensor:
        """Return a mask (N,) of the points that are not above."""
        return self.heights(points) <= self.reach

    def along(self, points: Tensor) -> Tensor:
        """Return coordinates (N, 2) within the plane."""
        normal = self.coefficients[:3]
        first = torch.linalg.cross(normal, torch.eye(3, dtype=normal.dtype)[normal.abs().argmin()])
        first = first / first.norm()
        return points @ torch.stack((first, torch.linalg.cross(normal, first)), dim=1)


def _planes(samples: Tensor) -> Iterator[_Plane]:
    """Yield planes below which nothing is but perhaps a slab, those on which most samples lie first."""
    center = samples.mean(0)
    samples = samples - center
    size = 2 * float(samples.norm(dim=1).quantile(1 - _SEARCH.outliers))
    if len(samples) < _SEARCH.near or not size > 0:
        return
    planes = _hypotheses(samples)
    heights = samples @ planes[:, :3].mT + planes[:, 3]
    count = (heights.abs() < _SEARCH.band * size).sum(0).double()
    below, above = ((sign * heights > _RULE.legs * size).double().mean(0) for sign in (-1, 1))
    planes = torch.cat((planes, -planes))
    count = torch.cat((count * (below <= _SEARCH.outliers), count * (above <= _SEARCH.outliers)))
    for _ in range(_SEARCH.num_tried):
        if not bool((count > 0).any()):
            return
        best = planes[count.argmax()]
        alike = (planes[:, :3] @ best[:3] > _SEARCH.alike) & ((planes[:, 3] - best[3]).abs() < _SEARCH.band * size)
        count = count.masked_fill(alike, 0)
        plane = _fitted(samples, best, size, center)
        if plane is not None:
            yield plane


def _hypotheses(samples: Tensor) -> Tensor:
    """Return planes (H, 4) through three samples that are near each other."""
    generator = torch.Generator().manual_seed(0)
    first = torch.randint(len(samples), (_SEARCH.num_planes,), generator=generator)
    near = torch.cdist(samples[first], samples).topk(_SEARCH.near, largest=False).indices
    drawn = torch.randint(1, _SEARCH.near, (_SEARCH.num_planes, 2), generator=generator)
    second, third = (samples[index] - samples[first] for index in near.gather(1, drawn).unbind(1))
    normals = torch.linalg.cross(second, third)
    lengths = normals.norm(dim=1)
    normals, corners = normals[lengths > 0] / lengths[lengths > 0, None], samples[first][lengths > 0]
    return torch.cat((normals, -(normals * corners).sum(1, keepdim=True)), dim=1)


def _fitted(samples: Tensor, plane: Tensor, size: float, center: Tensor) -> _Plane | None:
    """Return the least-squares plane of the centered samples on it, moved back to the center; None if not flat."""
    band = reach = _SEARCH.band * size
    for fit in range(_SEARCH.num_fits):
        on = samples[(samples @ plane[:3] + plane[3]).abs() <= band]
        middle = on.mean(0)
        normal = torch.linalg.eigh((on - middle).mT @ (on - middle))[1][:, 0]
        normal = normal * torch.where(normal @ plane[:3] < 0, -1.0, 1.0)
        plane = torch.cat((normal, -(normal @ middle)[None]))
        reach = _SEARCH.noise * float(((on - middle) @ normal).abs().median())
        if reach > 2 * _SEARCH.band * size:
            return None  # what fills the band evenly is not flat
        reach = max(reach, _SEARCH.exact * size)
        if 2 * fit >= _SEARCH.num_fits:
            band = reach
    return _Plane(torch.cat((plane[:3], (plane[3] - plane[:3] @ center)[None])), reach)


class _View:
    """Samples as seen along the normal of a plane: on it, above it (the thing), below it (a slab, if not outliers)."""

    def __init__(self, samples: Tensor, plane: _Plane) -> None:
        heights, self._flat = plane.heights(samples), plane.along(samples)
        self.on, self._thing = heights.abs() <= plane.reach, heights > plane.reach
        self._heights = heights
        self._is_slab = float((heights < -2 * plane.reach).double().mean()) > _SEARCH.outliers
        angles = torch.arange(_RULE.num_directions, dtype=heights.dtype) * (math.pi / _RULE.num_directions)
        self._directions = torch.stack((angles.cos(), angles.sin()))

    @cached_property
    def _bounds(self) -> tuple[Tensor, Tensor]:
        """Of the plane in all directions, (D,) each."""
        return _bounds(self._flat[self.on] @ self._directions)

    @cached_property
    def _width(self) -> float:
        return float((self._bounds[1] - self._bounds[0]).mean())

    @cached_property
    def _thing_width(self) -> float:
        low, high = _bounds(self._flat[self._thing] @ self._directions)
        return max(float((high - low).mean()), 1e-9 * self._width)

    @cached_property
    def _depth(self) -> float:
        """What is below the plane, in widths of the plane."""
        return -float(self._heights.quantile(_SEARCH.outliers)) / max(self._width, 1e-300)

    @property
    def may_support(self) -> bool:
        """Whether the thing stands inside the rim of the plane, so that this is a support if it is a piece apart."""
        share = float(self._thing.double().mean())
        if int(self.on.sum()) < _RULE.near or share < _RULE.least:
            return False
        wider = self._width / self._thing_width
        tall = float(self._heights[self._thing].quantile(1 - _SEARCH.outliers)) > _RULE.height * self._thing_width
        wide = wider >= (_RULE.narrow if share >= _RULE.small else _RULE.floor)
        return tall and wide and self._depth <= _RULE.legs and self._inside()

    def is_support(self, *, apart: bool) -> bool:
        """Whether what may be a support, a piece apart or not, is one."""
        wider, (filled, covered) = self._width / self._thing_width, self._covered()
        if apart or (wider >= _RULE.wider and not self._is_slab):
            return filled >= _RULE.filled
        if self._depth > _RULE.thick:
            return False
        return filled >= _RULE.whole and (wider >= _RULE.slab if self._is_slab else covered <= 1 - _RULE.open)

    def _inside(self) -> bool:
        """Return whether most of what is lowest of the thing is inside the rim of the plane."""
        lowest = self._heights[self._thing].quantile(_RULE.lowest)
        spans = self._flat[self._thing & (self._heights <= lowest)] @ self._directions
        rim, (low, high) = _RULE.rim * self._width, self._bounds
        inside = ((spans > low + rim) & (spans < high - rim)).all(1)
        return float(inside.double().mean()) >= _RULE.inside

    def _covered(self) -> tuple[float, float]:
        """Return the share of its convex hull that the plane fills, and the share of this that the thing covers."""
        on, thing, (low, high) = self._flat[self.on], self._flat[self._thing], self._bounds
        corner, sides = on.amin(0), on.amax(0) - on.amin(0)
        steps = (torch.arange(_RULE.num_cells, dtype=on.dtype) + 0.5) / _RULE.num_cells
        grid = corner + torch.cartesian_prod(steps, steps) * sides
        spans = grid @ self._directions
        hull = grid[((spans >= low) & (spans <= high)).all(1)]
        area = float(sides.prod()) * len(hull) / len(grid)
        radius = math.sqrt(_RULE.near * area / (math.pi * len(on)))
        full = hull[torch.cdist(hull, on).amin(1) <= radius]
        if not len(full):
            return 0.0, 1.0
        covered = torch.cdist(full, thing).amin(1) <= radius
        return len(full) / len(hull), float(covered.double().mean())


def _bounds(spans: Tensor) -> tuple[Tensor, Tensor]:
    """Return the least and the largest of coordinates (N, D) but for outliers, (D,) each."""
    low, high = spans.quantile(torch.tensor((_SEARCH.outliers, 1 - _SEARCH.outliers), dtype=spans.dtype), dim=0)
    return low, high


def _is_apart(points: Tensor, faces: Tensor, face: Tensor, plane: _Plane) -> bool:
    """Return whether nearly all faces (N,) on a plane are of pieces that have nothing above it; False without faces."""
    if not len(faces):
        return False
    position = weld(points.detach().cpu().double())
    joined = position[faces.cpu()]
    piece = connected_components(torch.cat((joined[:, :2], joined[:, 1:])), int(position.max()) + 1)
    above = torch.zeros(int(piece.max()) + 1, dtype=torch.bool)
    above[piece[position[~plane.holds(points).cpu()]]] = True
    return float(above[piece[joined[face, 0]]].double().mean()) <= 1 - _RULE.apart
