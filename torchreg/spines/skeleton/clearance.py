"""The inside of a closed surface: which points lie in it, their distance to the surface, and the medial axis nearby."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.graphs import sorting_order
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.neighbors import NeighborTree

# Rays slightly off the axes, along which a mesh made of voxels has its edges.
_RAYS = ((1.0, 0.0131, 0.0077), (0.0091, 1.0, 0.0127), (0.0119, 0.0083, 1.0))
# Cells of the grid across a ray, along each axis, at most; bounds its memory.
_MAX_CELLS = 512


@dataclass(frozen=True)
class ClearanceAscent:
    """How points climb to where their clearance, the distance to the surface, is largest."""

    num_steps: int = 30  # at most
    step: float = 0.15  # length of the first step, in clearances; halved where a step does not climb
    softness: float = 0.15  # excess distance, in clearances, at which surface counts 1 / e of the nearest
    num_samples: int = 3000  # of the surface: enough to find its middle


_ASCENT = ClearanceAscent()


class Inside:
    """The test for points inside a closed surface of any winding: parity of crossings, two of three rays decide."""

    def __init__(self, mesh: TriangleMesh) -> None:
        corners = mesh.vertices.detach().cpu().double()[mesh.faces.cpu()]
        self._grids = [_RayGrid(corners, torch.tensor(ray, dtype=torch.float64)) for ray in _RAYS]

    def __call__(self, points: Tensor) -> Tensor:
        """Return a mask (...,) of the points (..., 3) inside."""
        flat = points.detach().cpu().double().reshape(-1, 3)
        votes = torch.stack([grid.crosses_odd(flat) for grid in self._grids]).sum(0)
        return (votes >= 2).reshape(points.shape[:-1])


class _RayGrid:
    """Triangles (F, 3, 3) projected along a ray, sorted into the cells of a grid across it."""

    def __init__(self, corners: Tensor, ray: Tensor) -> None:
        self.axis = int(ray.argmax())
        self.across = [axis for axis in range(3) if axis != self.axis]
        # Sheared so that the ray runs along the axis.
        self.shear = (ray / ray[self.axis])[self.across]
        self.plane, self.height = self._project(corners)
        low, high = self.plane.amin(1), self.plane.amax(1)
        self.start = low.amin(0) if len(low) else low.new_zeros(2)
        self.size = float((high - low).mean()) if len(low) else 1.0
        self.size = max(self.size, float((high - self.start).amax(0).max()) / _MAX_CELLS if len(low) else 0.0, 1e-300)
        first, last = self._cell(low), self._cell(high)
        self.shape = last.amax(0) + 1 if len(low) else torch.ones(2, dtype=torch.int64)
        span = last - first + 1
        face, item = _expand_counts(span.prod(1))
        position = first[face] + torch.stack((item // span[face, 1], item % span[face, 1]), dim=1)
        cell = position[:, 0] * self.shape[1] + position[:, 1]
        order, begins = (torch.from_numpy(part) for part in sorting_order(cell.numpy(), int(self.shape.prod())))
        self.faces, self.begins, self.counts = face[order], begins[:-1].long(), begins.diff().long()

    def _project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return the coordinates (..., 2) of points (..., 3) across the ray, and those (...,) along it."""
        return points[..., self.across] - points[..., self.axis, None] * self.shear, points[..., self.axis]

    def _cell(self, plane: Tensor) -> Tensor:
        return ((plane - self.start) / self.size).floor().long()

    def crosses_odd(self, points: Tensor) -> Tensor:
        """Return for which points (N, 3) the ray crosses an odd number of triangles."""
        plane, height = self._project(points)
        cell = self._cell(plane)
        covered = ((cell >= 0) & (cell < self.shape)).all(1)
        cell = torch.where(covered, cell[:, 0] * self.shape[1] + cell[:, 1], 0)
        point, item = _expand_counts(torch.where(covered, self.counts[cell], 0))
        face = self.faces[self.begins[cell[point]] + item]
        a, b, c = (self.plane[face] - plane[point, None]).unbind(1)
        areas = torch.stack([_signed_area(b, c), _signed_area(c, a), _signed_area(a, b)], dim=-1)
        hit = (areas > 0).all(-1) | (areas < 0).all(-1)
        crossing = (areas * self.height[face]).sum(-1) / torch.where(hit, areas.sum(-1), 1.0)
        return torch.bincount(point[hit & (crossing > height[point])], minlength=len(points)) % 2 == 1


def _expand_counts(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return for each of ``counts[k]`` items of all k, one after the other, its k and its number within k."""
    owner = torch.arange(len(counts)).repeat_interleave(counts)
    return owner, torch.arange(len(owner)) - (counts.cumsum(0) - counts)[owner]


def _signed_area(first: Tensor, second: Tensor) -> Tensor:
    """Return twice the signed areas (N,) of the triangles that vectors (N, 2) span."""
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]


class Clearance:
    """The distance to a surface, sampled at its vertices and the centers of its triangles."""

    def __init__(self, mesh: TriangleMesh) -> None:
        vertices = mesh.vertices.detach().cpu().double()
        self._samples = torch.cat((vertices, vertices[mesh.faces.cpu()].mean(1)))
        self._tree = NeighborTree(self._samples)
        self._coarse = self._samples[:: max(1, len(self._samples) // _ASCENT.num_samples)]

    def __call__(self, points: Tensor) -> Tensor:
        """Return the distances (N,) of points (N, 3) to the surface."""
        return self._tree.nearest(points)[1]

    def behind_surface(self, points: Tensor, depth: float) -> Tensor:
        """Return points (N, 3) moved to the nearest sample of the surface and ``depth`` beyond it."""
        nearest = self._samples[self._tree.nearest(points)[0]]
        return nearest + depth * torch.nn.functional.normalize(nearest - points, dim=-1)

    def ascend(self, points: Tensor, reach: float) -> Tensor:
        """Return the local maxima (N, 3) of the clearance, on the medial axis, within reach of points inside."""
        start, samples = points.double(), self._coarse
        position, step = start, torch.full((len(points), 1), _ASCENT.step, dtype=torch.float64)
        distance = _distance_table(position, samples)
        for _ in range(_ASCENT.num_steps):
            clearance = distance.amin(1, keepdim=True)
            weight = ((clearance - distance) / (_ASCENT.softness * clearance)).exp() / distance
            away = (weight.sum(1, keepdim=True) * position - weight @ samples) / (weight * distance).sum(
                1, keepdim=True
            )
            trial = position + step * clearance * away
            trial_distance = _distance_table(trial, samples)
            climbs = trial_distance.amin(1, keepdim=True) > clearance
            climbs &= (trial - start).norm(dim=1, keepdim=True) <= reach
            position, distance = torch.where(climbs, trial, position), torch.where(climbs, trial_distance, distance)
            step = torch.where(climbs, step, step / 2)
        return position


def _distance_table(points: Tensor, samples: Tensor) -> Tensor:
    """Return the distances (N, M) of points (N, 3) to samples (M, 3), exact near zero and never zero."""
    distance = torch.cdist(points, samples, compute_mode="donot_use_mm_for_euclid_dist")
    return distance.clamp(min=torch.finfo(torch.float64).tiny)
