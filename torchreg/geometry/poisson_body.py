"""The body whose surface points show from all sides, without normals: its indicator function by Poisson's equation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.joined_pieces import join_pieces
from torchreg.geometry.marching_cubes import marching_cubes
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.neighbors import NeighborTree, k_nearest_others


@dataclass(frozen=True)
class PoissonFit:
    """How normals and the body are found; lengths in gaps, the median distance of a point to its last neighbor."""

    neighbors: int = 6  # around a point, for its share of the surface
    widths: tuple[float, ...] = (1.5, 1.0)  # of the blur under which normals agree; wider ones mix sides of thin limbs
    num_rounds: int = 8  # of new normals for each width
    turned_after: int = 2  # rounds, normals of inverted parts are turned over; in between parts turn by themselves
    blur: float = 0.75  # of the indicator function
    level_width: float = 1.5  # of the blur of its values at the points, of which the surface has the mean
    far: float = 0.01  # of the density at the points, below which points are far
    bar: float = 0.25  # of the fall of the indicator function, by which bars between pieces are inside
    max_resolution: int = 128  # gaps along the longest side; of more points, gaps count as so wide
    border: int = 6  # empty voxels around the points: the equation is solved on a torus
    num_rays: int = 500  # through the body, to test whether the far side is shown
    near: float = 3.0  # along a ray, within which points are those that it starts from
    least_shown: float = 0.5  # share of points with a far side: about one of a whole body, zero of what one view shows


FIT = PoissonFit()


@dataclass(frozen=True, eq=False)
class PoissonBody:
    """A body around points."""

    mesh: TriangleMesh  # its closed surface, facing outwards, float64, with the pieces joined by `join_pieces`
    joined: int  # number of pieces that were joined
    # share of its points whose far side is shown by points as well: near one for a body scanned from all sides, near
    # zero for one view
    shown: float

    @property
    def is_whole(self) -> bool:
        """Whether points show most of the body from both sides."""
        return self.shown > FIT.least_shown


def poisson_body(points: Tensor) -> PoissonBody:
    """Return the body whose surface points (N, 3) lie on, all different, float64 on the CPU.

    With outward normals ``n_i`` and areas ``a_i`` of points ``p_i``, the field ``V = sum a_i n_i delta(x - p_i)`` is
    that of a closed surface if it is the gradient of an indicator function. The iteration ``n_i <- (P V)(p_i) / |(P
    V)(p_i)|`` maximizes ``|P V|^2``, convex in the normals, with the part ``P V`` of the blurred field that is a
    gradient; normals of parts that are inside out, where the indicator is less than outside, are turned over on the way
    (Kazhdan, Bolitho and Hoppe 2006, Poisson's equation; Lin, Shi and Liu 2024, normals from the field; Journee,
    Nesterov, Richtarik and Sepulchre 2010, maxima of convex functions).
    """
    distance = k_nearest_others(points, FIT.neighbors)[1][:, -1]
    areas = math.pi * distance.square() / FIT.neighbors
    gap = max(float(distance.median()), float((points.amax(0) - points.amin(0)).max()) / FIT.max_resolution)
    grid = _Spectrum(points, gap)
    normals = _outward_normals(grid, areas, gap)
    indicator = grid.indicator(areas[:, None] * normals, FIT.blur * gap)
    level = _level(grid, areas, grid.at_points(indicator), FIT.level_width * gap)
    outside = level - indicator
    bars, joined = join_pieces(outside < 0)
    mesh = marching_cubes(torch.where(bars, outside.clamp_max(-FIT.bar), outside), grid.origin, grid.spacing)
    return PoissonBody(mesh=mesh, joined=joined, shown=_share_shown(points, normals, gap))


class _Spectrum:
    """Fields on a periodic grid around points (N, 3), of which each belongs to the eight samples around it."""

    def __init__(self, points: Tensor, spacing: float) -> None:
        low, high = points.amin(0), points.amax(0)
        self.spacing = spacing
        sizes = ((high - low) / self.spacing).ceil().long() + 2 * FIT.border
        self.sizes = [_smooth_number(size) for size in sizes.tolist()]
        self.origin = (low + high - self.spacing * (torch.tensor(self.sizes).to(points) - 1)) / 2
        places = (points - self.origin) / self.spacing
        corners = torch.cartesian_prod(*[torch.arange(2)] * 3)
        cells = places.floor().long()[:, None] + corners
        strides = torch.tensor([self.sizes[1] * self.sizes[2], self.sizes[2], 1])
        self._samples = (cells * strides).sum(-1)
        self._weights = (1 - (places[:, None] - cells).abs()).prod(-1)
        waves = [2 * math.pi * torch.fft.fftfreq(size, self.spacing, dtype=points.dtype) for size in self.sizes[:2]]
        waves.append(2 * math.pi * torch.fft.rfftfreq(self.sizes[2], self.spacing, dtype=points.dtype))
        self._waves = torch.meshgrid(*waves, indexing="ij")
        self._squares = torch.stack(self._waves).square().sum(0)

    def at_points(self, field: Tensor) -> Tensor:
        """Return the values (N,) of a field (X, Y, Z) at the points."""
        return (field.reshape(-1)[self._samples] * self._weights).sum(-1)

    def density(self, weights: Tensor, width: float) -> Tensor:
        """Return the blurred density (X, Y, Z) of the points, with weights (N,)."""
        return torch.fft.irfftn(self._transformed(weights) * self._blur(width), s=self.sizes)

    def density_gradients(self, weights: Tensor, width: float) -> Tensor:
        """Return the gradients (N, 3) at the points of their blurred density, with weights (N,)."""
        return self._gradients(self._transformed(weights), width)

    def improved_normals(self, vectors: Tensor, width: float) -> tuple[Tensor, Tensor]:
        """Return better normals (N, 3) from vectors (N, 3), and which points (N,) are inside out."""
        potential = self._potential(vectors)
        indicator = self._indicator(potential, width)
        return _normalized(self._gradients(potential, width)), self.at_points(indicator) < _outside(indicator)

    def indicator(self, vectors: Tensor, width: float) -> Tensor:
        """Return the function (X, Y, Z) that falls by one along each blurred vector (N, 3), times its area."""
        return self._indicator(self._potential(vectors), width)

    def _indicator(self, potential: Tensor, width: float) -> Tensor:
        return -torch.fft.irfftn(potential * self._blur(width), s=self.sizes)

    def _transformed(self, weights: Tensor) -> Tensor:
        field = weights.new_zeros(math.prod(self.sizes))
        field.index_add_(0, self._samples.reshape(-1), (weights[:, None] * self._weights).reshape(-1))
        return torch.fft.rfftn(field.reshape(self.sizes)) / self.spacing**3

    def _potential(self, vectors: Tensor) -> Tensor:
        """Return the spectrum of the function whose gradient is nearest to vectors (N, 3) at the points."""
        rows = zip(self._waves, vectors.unbind(1), strict=True)
        divergence = torch.stack([wave * self._transformed(values) for wave, values in rows]).sum(0)
        # Of complex numbers over infinity torch 2.5 makes NaN.
        return -1j * divergence * torch.where(self._squares > 0, 1 / self._squares, 0.0)

    def _blur(self, width: float) -> Tensor:
        return (-0.5 * width**2 * self._squares).exp()

    def _gradients(self, spectrum: Tensor, width: float) -> Tensor:
        blurred = 1j * spectrum * self._blur(width)
        return torch.stack([self.at_points(torch.fft.irfftn(wave * blurred, s=self.sizes)) for wave in self._waves], -1)


def _outside(field: Tensor) -> Tensor:
    """Return the mean () of a field (X, Y, Z) on the border of its grid."""
    sides = [field.select(axis, end).mean() for axis in range(field.dim()) for end in (0, -1)]
    return torch.stack(sides).mean()


def _level(grid: _Spectrum, areas: Tensor, values: Tensor, width: float) -> Tensor:
    """Return the mean (X, Y, Z) of values (N,) at the points around; far from them that of all."""
    density = grid.density(areas, width)
    everywhere = FIT.far * (areas * grid.at_points(density)).sum() / areas.sum()
    mean = (areas * values).sum() / areas.sum()
    return (grid.density(areas * values, width) + everywhere * mean) / (density.clamp_min(0) + everywhere)


def _smooth_number(size: int) -> int:
    """Return the least number from a size on without prime factors above five, as Fourier transforms like them."""
    rest = size
    for factor in (2, 3, 5):
        while rest % factor == 0:
            rest //= factor
    return size if rest == 1 else _smooth_number(size + 1)


def _outward_normals(grid: _Spectrum, areas: Tensor, gap: float) -> Tensor:
    """Return the normals (N, 3) of points with areas (N,), see `poisson_body`."""
    normals = -_normalized(grid.density_gradients(areas, FIT.widths[0] * gap))
    for width in FIT.widths:
        for number in range(FIT.num_rounds):
            following, inverted = grid.improved_normals(areas[:, None] * normals, width * gap)
            turned = inverted & (number % FIT.turned_after == FIT.turned_after - 1)
            normals = torch.where(turned[:, None], -following, following)
    inverted = grid.improved_normals(areas[:, None] * normals, FIT.blur * gap)[1]
    return torch.where(inverted[:, None], -normals, normals)


def _normalized(vectors: Tensor) -> Tensor:
    return torch.nn.functional.normalize(vectors, dim=-1, eps=1e-30)


def _share_shown(points: Tensor, normals: Tensor, gap: float) -> float:
    """Return the share of points whose inward ray meets other points that face the other way."""
    some = torch.linspace(0, len(points) - 1, min(len(points), FIT.num_rays)).round().long()
    extent = float((points.amax(0) - points.amin(0)).norm())
    steps = torch.arange(FIT.near * gap, extent, gap, dtype=points.dtype)
    places = points[some, None] - steps[:, None] * normals[some, None]
    index, distance = NeighborTree(points).nearest_within(places.flatten(0, 1), gap)
    opposite = (normals[index.reshape(len(some), -1)] * normals[some, None]).sum(-1) < 0
    return float((opposite & (distance.reshape(opposite.shape) < gap)).any(1).double().mean())
