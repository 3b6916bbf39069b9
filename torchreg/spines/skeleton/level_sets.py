"""Level sets of a function on a surface: the rings on which it takes a value, and the bands of surface between."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from torchreg.geometry.graphs import connected_components
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.surface_graph import unique_edges


@dataclass(frozen=True, eq=False)
class LevelSets:
    """The rings of all levels at once; every ring separates two bands."""

    centers: Tensor  # (R, 3) centroids of the rings as curves, whatever the density of vertices on them
    covariances: Tensor  # (R, 3, 3) mean over a ring's length of the outer product of offsets from its center
    lengths: Tensor  # (R,) of the rings
    levels: Tensor  # (R,) int64: on ring r the function is ``levels[r] * spacing``
    lower: Tensor  # (R,) band on the side of smaller values
    upper: Tensor  # (R,) band on the side of larger values
    vertex_bands: Tensor  # (V,) band that each vertex lies in
    num_bands: int  # B; a band is a connected part of the surface between two levels
    faces: Tensor  # (S,) triangles that rings pass through, once for each passage
    face_rings: Tensor  # (S,) the ring of each passage

    def __len__(self) -> int:
        return self.centers.shape[0]

    @cached_property
    def widths(self) -> Tensor:
        """Root mean square distances (R,) of the rings from their centers."""
        return self.covariances.diagonal(dim1=1, dim2=2).sum(-1).sqrt()


class MeshEdges:
    """A mesh with its edges found once, for several functions on it."""

    def __init__(self, mesh: TriangleMesh) -> None:
        edges, face_edges = unique_edges(mesh.faces.cpu())
        self.vertices = mesh.vertices.detach().cpu().double().numpy()
        self.faces, self.edges, self.face_edges = mesh.faces.cpu().numpy(), edges.numpy(), face_edges.numpy()


def level_sets(mesh: MeshEdges, values: Tensor, spacing: float) -> LevelSets:
    """Return the rings on which a function (V,) is a multiple of ``spacing`` (Verroust and Lazarus 2000)."""
    heights = values.numpy() / spacing
    bands = np.floor(heights).astype(np.int64)
    crossings = _Crossings(mesh, bands)
    points, ring = crossings.segments(heights)
    count = int(ring.max()) + 1 if len(ring) else 0
    # One segment of each ring gives its level and the bands on its two sides.
    segment = np.zeros(count, dtype=np.int64)
    segment[ring] = np.arange(len(ring))
    face, levels = crossings.face[segment], crossings.level[segment]
    band = crossings.connected_bands()
    centers, covariances, lengths = _moments(points, ring, count, float(np.ptp(mesh.vertices, axis=0).max()))
    return LevelSets(
        centers=torch.from_numpy(centers),
        covariances=torch.from_numpy(covariances),
        lengths=torch.from_numpy(lengths),
        levels=torch.from_numpy(levels),
        lower=torch.from_numpy(band[crossings.items(face, levels - 1)]),
        upper=torch.from_numpy(band[crossings.items(face, levels)]),
        vertex_bands=torch.from_numpy(band[: len(bands)]),
        num_bands=int(band.max()) + 1,
        faces=torch.from_numpy(crossings.face),
        face_rings=torch.from_numpy(ring),
    )


class _Crossings:
    """The crossings of triangles and edges with levels, all levels at once."""

    def __init__(self, mesh: MeshEdges, bands: np.ndarray) -> None:
        self.mesh, self.bands = mesh, bands
        self.low, self.high = np.sort(bands[mesh.edges], axis=1).T
        corners = bands[mesh.faces]
        self.face_low, self.face_high = corners.min(1), corners.max(1)
        between = np.maximum(self.high - self.low - 1, 0)
        self.first_of_edge = len(bands) + np.cumsum(between) - between
        inner = np.maximum(self.face_high - self.face_low - 1, 0)
        self.first_of_face = len(bands) + int(between.sum()) + np.cumsum(inner) - inner
        self.num_items = len(bands) + int(between.sum()) + int(inner.sum())
        self.num_inner = inner
        # Every crossing of a triangle with a level is a segment.
        self.face, self.level = _ranges(self.face_low + 1, self.face_high - self.face_low)

    def items(self, face: np.ndarray, band: np.ndarray) -> np.ndarray:
        """Return an item (n,) of triangles (n,) in bands (n,)."""
        item = self.first_of_face[face] + band - self.face_low[face] - 1
        for corner in range(3):
            vertex = self.mesh.faces[face, corner]
            item = np.where(self.bands[vertex] == band, vertex, item)
        return item

    def connected_bands(self) -> np.ndarray:
        """Return the number of the band that each item belongs to."""
        pairs = [self.mesh.edges[self.low == self.high]]
        face, band = _ranges(self.face_low + 1, self.num_inner)
        item = self.first_of_face[face] + band - self.face_low[face] - 1
        for corner in range(3):
            vertex, edge = self.mesh.faces[face, corner], self.mesh.face_edges[face, corner]
            at_vertex = self.bands[vertex] == band
            pairs.append(np.stack((item[at_vertex], vertex[at_vertex]), axis=1))
            on_edge = (self.low[edge] < band) & (band < self.high[edge])
            part = self.first_of_edge[edge] + band - self.low[edge] - 1
            pairs.append(np.stack((item[on_edge], part[on_edge]), axis=1))
        return connected_components(torch.from_numpy(np.concatenate(pairs)), self.num_items).numpy()

    def segments(self, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the ends (S, 2, 3) of the segments, and the ring (S,) that each belongs to."""
        count = self.high - self.low
        first = np.cumsum(count) - count
        points, crossing = np.zeros((len(self.face), 2, 3)), np.zeros((len(self.face), 2), dtype=np.int64)
        filled = np.zeros(len(self.face), dtype=np.int64)
        vertices = self.mesh.vertices
        for side in range(3):
            edge = self.mesh.face_edges[self.face, side]
            cut = np.flatnonzero((self.low[edge] < self.level) & (self.level <= self.high[edge]))
            edge, level = edge[cut], self.level[cut]
            start, end = self.mesh.edges[edge].T
            share = np.clip((level - heights[start]) / (heights[end] - heights[start]), 0, 1)
            points[cut, filled[cut]] = vertices[start] + share[:, None] * (vertices[end] - vertices[start])
            crossing[cut, filled[cut]] = first[edge] + level - self.low[edge] - 1
            filled[cut] += 1
        labels = connected_components(torch.from_numpy(crossing), int(count.sum())).numpy()[crossing[:, 0]]
        used = np.bincount(labels) > 0
        return points, (np.cumsum(used) - 1)[labels]


def _ranges(first: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers k and the values of ranges ``first[k] .. first[k] + count[k] - 1``, one after the other."""
    owner = np.repeat(np.arange(len(count)), count)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    return owner, first[owner] + within


def _moments(
    points: np.ndarray, ring: np.ndarray, count: int, extent: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centroids (R, 3), covariances (R, 3, 3) and lengths (R,) of rings of segments (S, 2, 3)."""
    along = points[:, 1] - points[:, 0]
    # A ring may be a point, where a level just touches a corner.
    weight = np.linalg.norm(along, axis=1) + 1e-12 * extent
    lengths = np.bincount(ring, weight, minlength=count)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(ring, weight * values, minlength=count) / lengths

    middle = points.mean(1)
    centers = np.stack([mean(middle[:, axis]) for axis in range(3)], axis=1)
    offset = middle - centers[ring]
    covariances = np.empty((count, 3, 3))
    for row in range(3):
        for column in range(row, 3):
            product = offset[:, row] * offset[:, column] + along[:, row] * along[:, column] / 12
            covariances[:, row, column] = covariances[:, column, row] = mean(product)
    return centers, covariances, lengths
