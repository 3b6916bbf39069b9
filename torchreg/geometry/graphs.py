"""Undirected graphs with lengths: shortest paths, connected components, spanning forests, links between components."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
import torch
from scipy.sparse import csgraph, csr_array
from torch import Tensor

from torchreg.geometry.neighbors import NeighborTree


@dataclass(frozen=True, eq=False, repr=False)
class Graph:
    """Nodes joined by edges with lengths, in compressed rows, for shortest paths; made by `from_edges`."""

    starts: Tensor  # (V + 1,) int32, the index in ``ends`` of the first neighbor of each node
    ends: Tensor  # (2 E,) int32 neighbors of all nodes
    lengths: Tensor  # (2 E,) float64 of the edges to them

    @classmethod
    def from_edges(cls, edges: Tensor, lengths: Tensor, count: int) -> Self:
        """Return the graph of edges (E, 2) and lengths (E,), not negative; the shorter of equal edges counts."""
        first, second = edges.cpu().numpy().T
        # Zero would be no edge.
        length = np.maximum(lengths.detach().cpu().double().numpy(), np.finfo(np.float64).tiny)
        rows, columns = np.concatenate((first, second)), np.concatenate((second, first))
        matrix = _adjacency(rows, columns, np.concatenate((length, length)), count)
        return cls(*(torch.from_numpy(array) for array in (matrix.indptr, matrix.indices, matrix.data)))

    def edges(self) -> tuple[Tensor, Tensor]:
        """Return the edges (E, 2) int64, the smaller node first, and their lengths (E,); repeated ones are repeated."""
        first = torch.arange(len(self)).repeat_interleave(self.starts.diff().long())
        once = first < self.ends
        return torch.stack((first[once], self.ends[once].long()), dim=1), self.lengths[once]

    def with_edges(self, edges: Tensor, lengths: Tensor) -> Self:
        """Return the graph with further edges (E, 2) of given lengths (E,)."""
        old, old_lengths = self.edges()
        return self.from_edges(torch.cat((old, edges)), torch.cat((old_lengths, lengths.double())), len(self))

    def __len__(self) -> int:
        return self.starts.shape[0] - 1

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self)} nodes, {len(self.ends) // 2} edges)"

    def distances(self, sources: Tensor | Sequence[int] | None = None, limit: float = math.inf) -> Tensor:
        """Return the distances (S, V) float64 from sources (S,), infinite beyond the limit (Dijkstra 1959)."""
        if sources is not None and len(sources) == 0:
            return self.lengths.new_zeros(0, len(self))
        indices = None if sources is None else _node_indices(sources)
        return torch.from_numpy(csgraph.dijkstra(self._matrix(), indices=indices, limit=limit))

    def nearest(self, sources: Tensor | Sequence[int]) -> tuple[Tensor, Tensor]:
        """Return the distance (V,) float64 to the nearest source, and its index (V,) in sources, -1 without a path."""
        indices = _node_indices(sources)
        distance, _, source = csgraph.dijkstra(self._matrix(), indices=indices, min_only=True, return_predecessors=True)
        number = np.full(len(self) + 1, -1)
        number[indices] = np.arange(len(indices))
        return torch.from_numpy(distance), torch.from_numpy(number[np.where(source >= 0, source, -1)])

    def shortest_paths(self, source: int) -> tuple[Tensor, Tensor]:
        """Return distances (V,) from a source, and predecessors (V,), -1 for the source and without a path."""
        distance, before = csgraph.dijkstra(self._matrix(), indices=source, return_predecessors=True)
        return torch.from_numpy(distance), torch.from_numpy(before.astype(np.int64)).clamp(min=-1)

    def components(self) -> Tensor:
        """Return the connected component (V,) of each node, numbered from 0."""
        return _components(self._matrix())

    def _matrix(self) -> csr_array:
        arrays = (self.lengths.numpy(), self.ends.numpy(), self.starts.numpy())
        return csr_array(arrays, shape=(len(self), len(self)))


def _node_indices(sources: Tensor | Sequence[int]) -> np.ndarray:
    indices: np.ndarray = torch.as_tensor(sources).cpu().numpy()
    return indices


def connected_components(edges: Tensor, count: int) -> Tensor:
    """Return the component (count,) int64 of each node under edges (E, 2), numbered from 0."""
    first, second = edges.cpu().numpy().T
    return _components(_adjacency(first, second, np.ones(len(first)), count)).to(edges.device)


class SpanningForest(NamedTuple):
    """One tree for each connected component of a graph; its root is its lowest node."""

    parents: Tensor  # (V,) int64 parent of each node; -1 for roots
    edges: Tensor  # (V,) int64 index of the edge to the parent; -1 for roots
    trees: Tensor  # (V,) int64 tree of each node, numbered from 0

    def chosen(self) -> Tensor:
        """Return the indices (F,) int64 of the edges of all trees, ascending."""
        return self.edges[self.edges >= 0].sort().values


def minimum_spanning_forest(edges: Tensor, lengths: Tensor, count: int) -> SpanningForest:
    """Return the trees of least total length that connect the components of a graph with edges (E, 2) (Kruskal 1956).

    Of equally long edges those at lower nodes come first, then those given first. Lengths may have any sign.
    """
    edges, lengths, device = edges.cpu(), lengths.detach().cpu(), edges.device
    if bool((lengths <= 0).any()):  # zero would be no edge
        lengths = lengths.unique(return_inverse=True)[1] + 1
    first, second = edges.unbind(1)
    tree = csgraph.minimum_spanning_tree(_adjacency(first.numpy(), second.numpy(), lengths.double().numpy(), count))
    trees = _components(tree)
    roots = torch.full((len(trees),), count).scatter_reduce(0, trees, torch.arange(count), "amin")
    parents = _breadth_first(tree, roots[roots < count].numpy())[1]
    # Of edges between a node and its parent the shortest, of these the first.
    upward = parents[first] == second
    used = (upward | (parents[second] == first)).nonzero()[:, 0]
    node, length = torch.where(upward, first, second)[used], lengths[used].double()
    least = torch.full((count,), torch.inf, dtype=torch.float64).scatter_reduce(0, node, length, "amin")
    best = length == least[node]
    index = torch.full((count,), len(edges)).scatter_reduce(0, node[best], used[best], "amin")
    return SpanningForest(parents.to(device), torch.where(parents < 0, -1, index).to(device), trees.to(device))


def rooted(edges: Tensor, roots: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return parents (count,) in a forest, -1 for roots and nodes in no root's tree, and the others, parents first."""
    first, second = edges.cpu().numpy().T
    order, parents = _breadth_first(_adjacency(first, second, np.ones(len(first)), count), roots.cpu().numpy())
    return parents.to(edges.device), order.to(edges.device)


def component_links(points: Tensor, component: Tensor, count: int = 3) -> tuple[Tensor, Tensor]:
    """Return the shortest links (L, 2) that join components one by one, ``count`` a pair, and their lengths (L,)."""
    joined = component == component.bincount().argmax()
    distance = torch.full((len(points),), torch.inf, dtype=torch.float64, device=points.device)
    nearest = torch.zeros_like(component)
    links, lengths, grown = [nearest.new_zeros(0, 2)], [distance[:0]], joined.nonzero()[:, 0]
    while not bool(joined.all()):
        outside = (~joined).nonzero()[:, 0]
        index, separation = NeighborTree(points[grown]).nearest(points[outside])
        nearer = separation < distance[outside]
        distance[outside[nearer]], nearest[outside[nearer]] = separation[nearer], grown[index[nearer]]
        grown = (component == component[outside[distance[outside].argmin()]]).nonzero()[:, 0]
        ends = grown[distance[grown].argsort(stable=True)[:count]]
        links.append(torch.stack((ends, nearest[ends]), dim=1).sort(dim=1).values)
        lengths.append(distance[ends])
        joined[grown] = True
    return torch.cat(links), torch.cat(lengths)


def sorting_order(values: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the stable order (N,) that sorts integers (N,) below count, and the start of each, (count + 1,)."""
    numbers = np.arange(len(values) + 1, dtype=np.int32)
    entries = csr_array((numbers[:-1], values.astype(np.int32), numbers), shape=(len(values), count)).tocsc()
    return entries.data, entries.indptr


def _adjacency(rows: np.ndarray, columns: np.ndarray, values: np.ndarray, count: int) -> csr_array:
    """Return the matrix of entries, each row's in their given order; repeated ones are not summed."""
    order, starts = sorting_order(rows, count)
    return csr_array((values[order], columns[order].astype(np.int32), starts), shape=(count, count))


def _components(matrix: csr_array) -> Tensor:
    return torch.from_numpy(csgraph.connected_components(matrix, directed=False)[1].astype(np.int64))


def _breadth_first(forest: csr_array, roots: np.ndarray) -> tuple[Tensor, Tensor]:
    """Return the nodes of the roots' trees, parents first, and the parents (V,) of all nodes, -1 for none."""
    count = forest.shape[0]
    # One more node above all roots: a single search reaches every tree.
    starts = np.append(forest.indptr, forest.nnz + len(roots))
    entries = np.append(forest.data, np.ones(len(roots))), np.append(forest.indices, roots.astype(np.int32)), starts
    tree = csr_array(entries, shape=(count + 1, count + 1))
    order, before = csgraph.breadth_first_order(tree, count, directed=False)
    parents = np.where((before < 0) | (before == count), -1, before)[:count]
    return torch.from_numpy(order[1:].astype(np.int64)), torch.from_numpy(parents.astype(np.int64))
