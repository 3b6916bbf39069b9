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
from torchreg.spines.level_sets import LevelSets, Surface, level_sets

# More handles than that are left as they are: the surface is a sponge rather than a body.
_MAX_CUTS = 16


@dataclass(frozen=True, eq=False)
class OpenedLoops:
    """A surface whose long loops are cut.

    Args:
        mesh: the surface, closed again at the cuts.
        stumps: (C, 2, 3) middle of the two ends of each cut.
        radii: (C,) half the length of the rim of each cut.
    """

    mesh: TriangleMesh
    stumps: Tensor
    radii: Tensor


def open_loops(mesh: TriangleMesh, min_length: float, num_levels: int = 100) -> OpenedLoops:
    """Return a closed surface with every loop that is long cut through at its thinnest ring, and the ends closed.

    A hand on the hip makes a loop of arm and trunk, which as a tree is cut best where the hand touches: a contact is
    thinner than what leads to it. Loops are those that the level sets of the distance from a far place make. A ring cut
    into two limbs has two tips.

    Args:
        mesh: closed, in one piece, float64 on the CPU.
        min_length: of a loop, as a share of the largest distance from the far place; shorter loops stay.
        num_levels: level sets in that distance.

    Cost: one source and one set of level sets, and again for each cut; nothing for a surface without handles.

    References: Wood, Hoppe, Desbrun and Schroeder 2004, loops from level sets and cuts at short ones.
    """
    stumps, radii = [], []
    for _ in range(_MAX_CUTS):
        if _euler_number(mesh) >= 2:
            break
        found = _thinnest_ring(mesh, min_length, num_levels)
        if found is None:
            break
        faces, length = found
        keep = torch.ones(mesh.num_faces, dtype=torch.bool)
        keep[faces] = False
        whole = one_piece(TriangleMesh(mesh.vertices, mesh.faces[keep]))
        ends = whole.mesh.vertices[whole.vertex < 0]
        mesh = whole.mesh
        if len(ends) == 2:
            stumps.append(ends)
            radii.append(length / 2)
    pairs = torch.stack(stumps) if stumps else torch.zeros(0, 2, 3, dtype=torch.float64)
    return OpenedLoops(mesh, pairs, torch.tensor(radii, dtype=torch.float64))


def _euler_number(mesh: TriangleMesh) -> int:
    return mesh.num_vertices - len(unique_edges(mesh.faces)[0]) + mesh.num_faces


def _thinnest_ring(mesh: TriangleMesh, min_length: float, num_levels: int) -> tuple[Tensor, float] | None:
    """Return the triangles that the shortest ring on the longest loop passes through, and its length."""
    graph = GeodesicGraph.from_mesh(mesh)
    far = int(graph.distances([0])[0].argmax())
    distance = graph.distances([far])[0]
    spacing = float(distance.max()) / num_levels
    sets = level_sets(Surface(mesh), distance, spacing)
    loop = _longest_loop(sets, int(sets.vertex_bands[far]))
    if len(loop) < min_length * num_levels:
        return None
    ring = loop[int(sets.lengths[loop].argmin())]
    return sets.faces[sets.face_rings == ring].unique(), float(sets.lengths[ring])


def _longest_loop(sets: LevelSets, root: int) -> list[int]:
    """Return the rings of the longest loop that one ring makes with the tree of shortest ways from a band."""
    joined = torch.stack((sets.lower, sets.upper), dim=1)
    pairs = joined.unique(dim=0)
    graph = Graph.from_edges(pairs, torch.ones(len(pairs)), sets.num_bands)
    ends, steps, before = (values.numpy() for values in (joined, *graph.shortest_paths(root)))
    child = np.where(before[ends[:, 0]] == ends[:, 1], ends[:, 0], ends[:, 1])
    in_tree = before[child] == ends.sum(1) - child
    # Of several rings between the same two bands one is in the tree, the longest.
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
            first = before[first]
        longest = max(longest, loop, key=len)
    return longest
