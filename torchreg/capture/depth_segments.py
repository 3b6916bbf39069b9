"""The surfaces of a depth picture: which pixels belong together, and where something of a given size may be."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.capture.depth_frame import DepthFrame, grown
from torchreg.geometry.graphs import Graph, connected_components
from torchreg.geometry.planes import distance_to_plane


@dataclass(frozen=True)
class Segmentation:
    """How a picture is cut. Lengths are shares of the size that is looked for."""

    spacing: float = 0.02  # of the pixels that are looked at
    step: float = 0.05  # in depth, between neighboring pixels of one surface
    least: float = 0.3  # extent of a surface that may show the shape
    reach: float = 1.0  # along the surface from an end of it: what is farther is cut off
    apart: float = 0.8  # ends nearer to one another show the same
    beyond: float = 0.2  # from an end: nothing so near is farther from the other ends
    max_ends: int = 4  # of a surface
    max_surfaces: int = 3  # of a picture
    gap: float = 0.25  # between surfaces of one shape, a part of which hides what lies between them
    max_pieces: int = 24  # surfaces that are joined, the largest
    piece_points: int = 100  # of each, between which gaps are measured
    plane_band: float = 0.02  # within which points lie on one plane
    plane_width: float = 0.7  # from which on no part of the shape is so wide: a floor, a table, a wall
    max_planes: int = 4  # of a picture that are looked for
    noisy: float = 4.0  # standard deviations of depths by which those of one surface may differ


SEGMENTATION = Segmentation()


@dataclass(frozen=True, eq=False)
class SurfaceGrid:
    """Every ``stride``-th pixel of a picture, and the graph of those on one surface."""

    frame: DepthFrame
    stride: int
    pixels: Tensor
    points: Tensor
    graph: Graph
    noise: float = 0.0

    @classmethod
    def of(cls, frame: DepthFrame, size: float, noise: float = 0.0, most: int | None = None) -> SurfaceGrid:
        """Return the grid, of ``most`` pixels if given, for a shape of some size and a deviation of depths, metres."""
        reach = max(SEGMENTATION.step * size, SEGMENTATION.noisy * noise)
        depth = frame.depth * frame.measured
        middle = float(depth[depth > 0].median())
        focal = float(frame.camera.intrinsics[:2].mean())
        stride = max(1, round(SEGMENTATION.spacing * size * focal / middle))
        if most is not None:
            stride = max(stride, math.ceil(math.sqrt(depth.numel() / most)))
        coarse = depth[::stride, ::stride]
        pixels = coarse.nonzero()
        number = torch.full(coarse.shape, -1, dtype=torch.int64, device=depth.device)
        number[tuple(pixels.T)] = torch.arange(len(pixels), device=depth.device)
        edges = [
            torch.stack((first[joined], second[joined]), dim=-1)
            for first, second, step in (
                (number[:, :-1], number[:, 1:], coarse[:, 1:] - coarse[:, :-1]),
                (number[:-1], number[1:], coarse[1:] - coarse[:-1]),
            )
            if (joined := (first >= 0) & (second >= 0) & (step.abs() <= reach)) is not None
        ]
        seen = stride * pixels.flip(-1)
        points = frame.camera.unproject(seen.double(), depth[seen[:, 1], seen[:, 0]].double())
        pairs = torch.cat(edges)
        lengths = (points[pairs[:, 0]] - points[pairs[:, 1]]).norm(dim=-1)
        return cls(frame, stride, pixels, points, Graph.from_edges(pairs, lengths, len(pixels)), noise)

    def without_planes(self, size: float, wanted: Callable[[Tensor], bool] | None = None) -> SurfaceGrid:
        """Return the grid without planes that are larger than a shape of some size: floors, tables, walls.

        Planes whose nodes (K,) are ``wanted`` stay.
        """
        kept, generator = torch.ones(len(self.points), dtype=torch.bool), torch.Generator().manual_seed(0)
        edges, lengths = self.graph.edges()
        free, band = kept.clone(), max(SEGMENTATION.plane_band * size, SEGMENTATION.noisy * self.noise)
        for _ in range(SEGMENTATION.max_planes):
            away = distance_to_plane(self.points[None], free[None], band, generator)[0]
            patch = _largest_patch(free & (away < band), edges)
            if not len(patch) or _width(self.points[patch]) < SEGMENTATION.plane_width * size:
                break
            free[patch] = False
            if wanted is None or not wanted(patch):
                kept[patch] = False
        number = kept.cumsum(0) - 1
        both = kept[edges].all(-1)
        graph = Graph.from_edges(number[edges[both]], lengths[both], int(kept.sum()))
        return replace(self, pixels=self.pixels[kept], points=self.points[kept], graph=graph)

    def at(self, picture: Tensor) -> Tensor:
        """Return the values (V, ...) of a picture (H, W, ...) at the nodes."""
        row, column = (self.stride * self.pixels).unbind(-1)
        return picture[row, column]

    def mask(self, kept: Tensor) -> Tensor:
        """Return the mask (H, W) of what some nodes (V,) stand for."""
        coarse = torch.zeros(self.frame.depth[:: self.stride, :: self.stride].shape, dtype=torch.bool)
        coarse[tuple(self.pixels[kept.cpu()].T.cpu())] = True
        height, width = self.frame.depth.shape
        full = coarse.repeat_interleave(self.stride, 0).repeat_interleave(self.stride, 1)[:height, :width]
        return full.to(self.frame.depth.device) & self.frame.measured


def candidate_crops(grid: SurfaceGrid, size: float) -> Iterator[Tensor]:
    """Yield the nodes (V,) of a grid that may show a shape of some size, metres: nearer first, joined before all.

    Surfaces next to each other that are no larger together are one crop: a shape hides parts of itself. Then a surface
    of about that size is one crop. Of a larger one, as an arm or a body, its ends are: what lies within reach of an
    end, along the surface. Planes that are larger than the shape show something else, see `without_planes`.
    """
    component = grid.graph.components().to(grid.points.device)
    group = _joined(grid.points, component, size)
    is_joined = group != component
    is_joined |= torch.isin(component, group[is_joined])
    for number, index in _nearest_first(grid, group, size):
        if bool(is_joined[index].any()):
            yield group == number
    for _, index in _nearest_first(grid, component, size):
        yield from _parts(grid, index, size)


def _nearest_first(grid: SurfaceGrid, number: Tensor, size: float) -> Iterator[tuple[int, Tensor]]:
    """Yield the numbers (V,) of a few surfaces that are large enough, and their nodes (K,), by their mean depth."""
    depth = grid.frame.camera.project(grid.points)[1]
    nearness = torch.full_like(depth, torch.inf).scatter_reduce(0, number, depth, "mean", include_self=False)
    num_surfaces = 0
    for chosen in nearness.argsort()[: len(number.unique())].tolist():
        index = (number == chosen).nonzero()[:, 0]
        if float(_extent(grid.points[index])) >= SEGMENTATION.least * size:
            yield chosen, index
            num_surfaces += 1
        if num_surfaces == SEGMENTATION.max_surfaces:
            return


def _joined(points: Tensor, component: Tensor, size: float) -> Tensor:
    """Return the numbers (V,) of surfaces, those joined that are near each other and together no larger than a shape.

    The nearest are joined first, as in single-linkage clustering.
    """
    found, counts = component.clone(), torch.bincount(component)
    pieces = counts.argsort(descending=True)[: SEGMENTATION.max_pieces].tolist()
    samples = []
    for piece in pieces:
        index = (component == piece).nonzero()[:, 0]
        samples.append(points[index[:: -(-len(index) // SEGMENTATION.piece_points)]])
    gaps = [
        (float(torch.cdist(samples[one], samples[two]).min()), pieces[one], pieces[two])
        for one in range(len(pieces))
        for two in range(one)
    ]
    largest = (SEGMENTATION.reach + SEGMENTATION.least) * size
    for gap, one, two in sorted(gaps):
        if gap > SEGMENTATION.gap * size:
            break
        first, second = (int(found[component == piece][0]) for piece in (one, two))
        both = (found == first) | (found == second)
        if first != second and float(_extent(points[both])) <= largest:
            found[both] = first
    return found


def _largest_patch(on_plane: Tensor, edges: Tensor) -> Tensor:
    """Return the nodes (K,) of the largest piece of those on a plane (V,)."""
    index = on_plane.nonzero()[:, 0]
    part = connected_components(edges[on_plane[edges].all(-1)], len(on_plane))[index]
    return index[part == part.mode().values] if len(index) else index


def _extent(points: Tensor) -> Tensor:
    """Return the diagonal () of the box around points (N, 3)."""
    return (points.amax(0) - points.amin(0)).norm()


def _width(points: Tensor) -> float:
    """Return the shorter side of a rectangle that spreads as points (N, 3) do, which lie on a plane."""
    local = points - points.mean(0)
    return math.sqrt(12 * max(0.0, float(torch.linalg.eigvalsh(local.mT @ local / len(points))[1])))


def _parts(grid: SurfaceGrid, index: Tensor, size: float) -> Iterator[Tensor]:
    """Yield the nodes (V,) of a surface, or those around its ends, farthest from the picture's rim first."""
    every = torch.zeros(len(grid.points), dtype=torch.bool)
    every[index] = True
    inside = _distance(grid, int(index[0]), every)
    first = int(inside.argmax())
    ends, around = [first], [_distance(grid, first, every)]
    if float(around[0].max()) <= (SEGMENTATION.reach + SEGMENTATION.least) * size:
        yield every
        return
    while len(around) < 2 * SEGMENTATION.max_ends and len(ends) < SEGMENTATION.max_ends:
        nearest = torch.stack(around).amin(0)
        farthest = int(nearest.argmax())
        if float(nearest[farthest]) < SEGMENTATION.apart * size:
            break
        around.append(_distance(grid, farthest, every))
        # The middle of a long surface is far from its ends, too, but more of it lies beyond.
        beside = every & (around[-1] <= SEGMENTATION.beyond * size)
        if float(around[0][beside].max()) <= float(around[0][farthest]) + SEGMENTATION.step * size:
            ends.append(farthest)
    reached = [_distance(grid, end, every) for end in ends]
    for number in _rim_distance(grid, ends).argsort(descending=True).tolist():
        yield every & (reached[number] <= SEGMENTATION.reach * size)


def _distance(grid: SurfaceGrid, source: int, every: Tensor) -> Tensor:
    """Return the distances (V,) of nodes from a source along the surface, -1 off it."""
    return torch.where(every, grid.graph.distances([source])[0], -1.0)


def _rim_distance(grid: SurfaceGrid, nodes: list[int]) -> Tensor:
    """Return the distances of nodes from the rim of the picture, pixels of the grid."""
    height, width = grid.frame.depth[:: grid.stride, :: grid.stride].shape
    row, column = grid.pixels[nodes].unbind(-1)
    return torch.stack((row, height - 1 - row, column, width - 1 - column)).amin(0)


def beyond_cut(frame: DepthFrame, off: Tensor) -> Tensor:
    """Return which points (M,) off a shape belong to what the mask, or the rim of the picture, cuts off."""
    edges = frame.links
    edges = edges[off[edges].all(-1)]
    part = connected_components(edges, len(off))
    is_cut = torch.zeros(int(part.max()) + 1, dtype=torch.bool, device=off.device)
    is_cut[part[frame.cut & off]] = True
    return off & is_cut[part]


def open_rim(frame: DepthFrame, lies_on: Callable[[Tensor], Tensor]) -> float:
    """Return the share of the rim of what ``lies_on`` says of points (M, 3) along which the surface goes on, 0 to 1."""
    stride, surface = frame.stride, frame.without_mask.measured
    depth = (frame.depth * surface)[::stride, ::stride]
    pixels = depth.nonzero()
    points = frame.camera.unproject(stride * pixels.flip(-1).double(), depth[tuple(pixels.T)].double())
    on = torch.zeros_like(depth, dtype=torch.bool)
    on[tuple(pixels.T)] = lies_on(points)
    off = (depth > 0) & ~on
    filled = ~grown(~grown(on, 1), 1) & ~off  # pixels that measured nothing are no rim
    rim = goes_on = 0
    for axis in (0, 1):
        size = on.shape[axis] - 1
        first, second = filled.narrow(axis, 0, size), filled.narrow(axis, 1, size)
        onto = (first & off.narrow(axis, 1, size)) | (off.narrow(axis, 0, size) & second)
        rim += int((first ^ second).sum())
        goes_on += int((onto & frame.is_continuous(depth, axis)).sum())
    return goes_on / rim if rim else 0.0
