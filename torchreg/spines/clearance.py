"""How far points are inside a closed surface, and the way to where that is farthest."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_finite, check_shape
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.neighbors import NeighborTree

# Of the grid across a ray, along each axis.
_MAX_SQUARES = 512
# Rays slightly off the axes, which a mesh made of voxels has edges along.
_RAYS = ((1.0, 0.0131, 0.0077), (0.0091, 1.0, 0.0127), (0.0119, 0.0083, 1.0))
_STEPS, _STEP, _SOFTNESS = 30, 0.15, 0.15
# Samples of the surface that are enough to find the middle of it.
_FEW = 3000


class Inside:
    """Tells which points lie inside a closed surface, whatever the winding of its triangles.

    A ray from a point that lies inside crosses the surface an odd number of times; two of three rays decide.

    Args:
        mesh: closed; where it is not, the rays that miss the hole may still outvote the one that meets it.

    Cost: O(triangles) to make; O(triangles in a line) per point.
    """

    def __init__(self, mesh: TriangleMesh) -> None:
        corners = mesh.vertices.detach().cpu().double()[mesh.faces.cpu()]
        self._views = [_View(corners, torch.tensor(ray, dtype=torch.float64)) for ray in _RAYS]

    def __call__(self, points: Tensor) -> Tensor:
        """Return which points (..., 3) lie inside, (...,) bool.

        Raises:
            InputError: if points are not finite.
        """
        points = as_float_tensor(points, "points").detach().cpu().double()
        check_shape(points, "points", (3,), batch=True)
        check_finite(points, "points")
        votes = torch.stack([view.odd(points.reshape(-1, 3)) for view in self._views]).sum(0)
        return (votes >= 2).reshape(points.shape[:-1])


class _View:
    """Triangles (F, 3, 3) seen along a ray, sorted into the squares of a grid across it."""

    def __init__(self, corners: Tensor, ray: Tensor) -> None:
        self.axis = int(ray.argmax())
        self.flat = [axis for axis in range(3) if axis != self.axis]
        # Sheared so that the ray runs along the axis.
        self.shear = (ray / ray[self.axis])[self.flat]
        self.plane, self.height = self._seen(corners)
        low, high = self.plane.amin(1), self.plane.amax(1)
        self.start = low.amin(0) if len(low) else low.new_zeros(2)
        self.size = float((high - low).mean()) if len(low) else 1.0
        self.size = max(self.size, float((high - self.start).amax(0).max()) / _MAX_SQUARES if len(low) else 0.0, 1e-300)
        first, last = self._square(low), self._square(high)
        self.number = last.amax(0) + 1 if len(low) else torch.ones(2, dtype=torch.int64)
        span = last - first + 1
        face, within = _numbered(span.prod(1))
        place = first[face] + torch.stack((within // span[face, 1], within % span[face, 1]), dim=1)
        square, order = (place[:, 0] * self.number[1] + place[:, 1]).sort(stable=True)
        self.faces = face[order]
        self.counts = torch.bincount(square, minlength=int(self.number.prod()))
        self.begins = self.counts.cumsum(0) - self.counts

    def _seen(self, places: Tensor) -> tuple[Tensor, Tensor]:
        return places[..., self.flat] - places[..., self.axis, None] * self.shear, places[..., self.axis]

    def _square(self, places: Tensor) -> Tensor:
        return ((places - self.start) / self.size).floor().long()

    def odd(self, points: Tensor) -> Tensor:
        """Return which points (N, 3) have an odd number of triangles in front of them."""
        at, start = self._seen(points)
        square = self._square(at)
        met = ((square >= 0) & (square < self.number)).all(1)
        square = torch.where(met, square[:, 0] * self.number[1] + square[:, 1], 0)
        which, within = _numbered(torch.where(met, self.counts[square], 0))
        face = self.faces[self.begins[square[which]] + within]
        a, b, c = (self.plane[face] - at[which, None]).unbind(1)
        areas = torch.stack([_cross(b, c), _cross(c, a), _cross(a, b)], dim=-1)
        hit = (areas > 0).all(-1) | (areas < 0).all(-1)
        place = (areas * self.height[face]).sum(-1) / torch.where(hit, areas.sum(-1), 1.0)
        return torch.bincount(which[hit & (place > start[which])], minlength=len(points)) % 2 == 1


def _numbered(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return the owner of each of ``counts[k]`` items of all k, and its number within."""
    owner = torch.arange(len(counts)).repeat_interleave(counts)
    return owner, torch.arange(len(owner)) - (counts.cumsum(0) - counts)[owner]


def _cross(first: Tensor, second: Tensor) -> Tensor:
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]


class Clearance:
    """Distances to a surface, by a tree over its vertices and the middles of its triangles."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self.mesh = mesh
        vertices = mesh.vertices.detach().cpu().double()
        self._samples = torch.cat((vertices, vertices[mesh.faces.cpu()].mean(1)))
        self._tree = NeighborTree(self._samples)
        self._few = self._samples[:: max(1, len(self._samples) // _FEW)]

    def __call__(self, points: Tensor) -> Tensor:
        """Return the distance (N,) of points (N, 3) to the surface."""
        return self._tree.nearest(points)[1]

    def beyond(self, points: Tensor, depth: float) -> Tensor:
        """Return points (N, 3) moved to and past the nearest place of the surface, by some depth."""
        nearest = self._samples[self._tree.nearest(points)[0]]
        towards = nearest - points
        return nearest + depth * torch.nn.functional.normalize(towards, dim=-1)

    def middles(self, points: Tensor, reach: float) -> Tensor:
        """Return points (N, 3) near others, whose distances to the surface are as large as can be.

        The way up follows the mean direction away from the surface, the nearest parts of which count most, as long as
        the clearance grows and the point stays within reach. From inside the surface it stays there.

        Args:
            points: (N, 3) inside the surface.
            reach: largest distance to go.
        """
        start, samples = points.double(), self._few
        place, step = start, torch.full((len(points), 1), _STEP, dtype=torch.float64)
        tiny = torch.finfo(torch.float64).tiny
        distance = torch.cdist(place, samples, compute_mode="donot_use_mm_for_euclid_dist").clamp(min=tiny)
        for _ in range(_STEPS):
            best = distance.amin(1, keepdim=True)
            weight = ((best - distance) / (_SOFTNESS * best)).exp() / distance
            away = (weight.sum(1, keepdim=True) * place - weight @ samples) / (weight * distance).sum(1, keepdim=True)
            there = place + step * best * away
            further = torch.cdist(there, samples, compute_mode="donot_use_mm_for_euclid_dist").clamp(min=tiny)
            grown = further.amin(1, keepdim=True) > best
            grown &= (there - start).norm(dim=1, keepdim=True) <= reach
            place, distance = torch.where(grown, there, place), torch.where(grown, further, distance)
            step = torch.where(grown, step, step / 2)
        return place
