"""Handles of a surface, such as arms akimbo, cut open where they are thinnest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.graphs import Graph
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.surface_graph import one_piece, unique_edges
from torchreg.spines.skeleton.level_sets import LevelSets, MeshEdges, level_sets
from torchreg.spines.skeleton.protrusions import Protrusions


@dataclass(frozen=True)
class LoopCutting:
    """Which loops are cut, and which ends of the cuts are tips."""

    max_cuts: int = 16  # a surface with more handles is a sponge rather than a body
    min_tip_ratio: float = 0.5  # heights of the two ends of a cut at which the lower one is a tip, too


_CUTTING = LoopCutting()


@dataclass(frozen=True, eq=False)
class OpenedLoops:
    """A surface whose C long loops are cut and closed again: the two ends (C, 2, 3) of each, and half its rim (C,)."""

    mesh: TriangleMesh
    stumps: Tensor
    radii: Tensor

    @classmethod
    def from_uncut(cls, mesh: TriangleMesh) -> OpenedLoops:
        """Return a surface as it is, without cuts."""
        return cls(mesh, torch.zeros(0, 2, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.float64))

    def keep_tips(self, protrusions: Protrusions) -> list[int]:
        """Return the protrusions that are tips: not the lower end of a cut whose other end is a tip."""
        positions, keep = self.mesh.vertices[protrusions.tips], list(range(len(protrusions.tips)))
        for ends, radius in zip(self.stumps, self.radii, strict=True):
            near = torch.cdist(ends, positions) <= radius
            highest = (near * protrusions.heights).amax(1)
            low = protrusions.heights < _CUTTING.min_tip_ratio * highest.max()
            low &= near[int(highest.argmin())]
            keep = [tip for tip in keep if not low[tip]]
        return keep


def open_loops(mesh: TriangleMesh, min_length: float, num_levels: int) -> OpenedLoops:
    """Return a closed surface with every long loop cut at its thinnest ring, and the ends closed (Wood et al. 2004)."""
    opened = OpenedLoops.from_uncut(mesh)
    for _ in range(_CUTTING.max_cuts):
        mesh = opened.mesh
        if mesh.num_vertices - len(unique_edges(mesh.faces)[0]) + mesh.num_faces >= 2:  # Euler's formula
            break
        ring = _thinnest_ring(mesh, min_length, num_levels)
        if ring is None:
            break
        opened = _cut_ring(opened, *ring)
    return opened


def _cut_ring(opened: OpenedLoops, faces: Tensor, length: float) -> OpenedLoops:
    """Return the surface without the triangles ``faces`` of a ring of some length, and the two holes closed."""
    keep = torch.ones(opened.mesh.num_faces, dtype=torch.bool)
    keep[faces] = False
    closed = one_piece(TriangleMesh(opened.mesh.vertices, opened.mesh.faces[keep]))
    ends = closed.mesh.vertices[closed.vertex < 0]
    if len(ends) != 2:
        return OpenedLoops(closed.mesh, opened.stumps, opened.radii)
    radii = torch.cat((opened.radii, opened.radii.new_tensor([length / 2])))
    return OpenedLoops(closed.mesh, torch.cat((opened.stumps, ends[None])), radii)


def _thinnest_ring(mesh: TriangleMesh, min_length: float, num_levels: int) -> tuple[Tensor, float] | None:
    """Return the triangles that the shortest ring on the longest loop passes through, and its length."""
    graph = GeodesicGraph.from_mesh(mesh)
    far = int(graph.distances([0])[0].argmax())
    distance = graph.distances([far])[0]
    sets = level_sets(MeshEdges(mesh), distance, float(distance.max()) / num_levels)
    loop = _longest_loop(sets, int(sets.vertex_bands[far]))
    if len(loop) < min_length * num_levels:
        return None
    ring = loop[int(sets.lengths[loop].argmin())]
    return sets.faces[sets.face_rings == ring].unique(), float(sets.lengths[ring])


def _longest_loop(sets: LevelSets, root: int) -> list[int]:
    """Return the rings of the longest loop that a single ring closes with the tree of shortest paths from a band."""
    joined = torch.stack((sets.lower, sets.upper), dim=1)
    pairs = joined.unique(dim=0)
    graph = Graph.from_edges(pairs, torch.ones(len(pairs)), sets.num_bands)
    ends, steps, parent = (values.numpy() for values in (joined, *graph.shortest_paths(root)))
    child = np.where(parent[ends[:, 0]] == ends[:, 1], ends[:, 0], ends[:, 1])
    in_tree = parent[child] == ends.sum(1) - child
    # Of several rings between the same two bands only the longest is in the tree.
    order = np.lexsort((-sets.lengths.numpy(), child, ~in_tree))
    ring_above = np.full(sets.num_bands, -1)
    ring_above[child[order][::-1]] = np.where(in_tree[order], order, -1)[::-1]
    longest: list[int] = []
    for ring in np.setdiff1d(np.arange(len(ends)), ring_above):
        loop, (first, second) = [int(ring)], ends[ring]
        while first != second:
            if steps[first] < steps[second]:
                first, second = second, first
            loop.append(int(ring_above[first]))
            first = parent[first]
        longest = max(longest, loop, key=len)
    return longest
