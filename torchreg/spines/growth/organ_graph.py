"""The tree of all organs of a thing that grows, from trees of those that were there together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

import torch
from torch import Tensor

from torchreg.geometry.skeleton import Skeleton
from torchreg.spines.labeled_tree import LimbGraph, Tips, most_frequent_splits, skeleton_splits

# The organs that a frame shows, and the splits of its tree: of each limb the side without the least of them.
ShownTree = tuple[Tips, frozenset[Tips]]


@dataclass(frozen=True)
class _Tree:
    """A tree whose leaves are organs, 0, 1, ..., and whose other nodes are negative."""

    edges: tuple[tuple[int, int], ...]

    @classmethod
    def from_splits(cls, organs: Tips, splits: frozenset[Tips]) -> _Tree:
        """Return the tree of organs, two or more, with such splits."""
        order = sorted(organs)
        number = {organ: rank for rank, organ in enumerate(order)}
        graph = LimbGraph(len(order), frozenset(frozenset(number[organ] for organ in split) for split in splits))
        names = [*order, *(-1 - junction for junction in range(len(graph.edges) + 1 - len(order)))]
        return cls(tuple((names[start], names[end]) for start, end in graph.edges.tolist()))

    def with_organ(self, organ: int) -> Iterator[_Tree]:
        """Yield all trees with one more organ: on a junction, or on a limb, which it divides."""
        nodes = set(chain.from_iterable(self.edges))
        new = min(min(nodes), 0) - 1
        for node in sorted(node for node in nodes if node < 0):
            yield _Tree((*self.edges, (organ, node)))
        for start, end in self.edges:
            kept = tuple(edge for edge in self.edges if edge != (start, end))
            yield _Tree((*kept, (start, new), (new, end), (organ, new)))

    def sides(self) -> list[Tips]:
        """Return per edge the organs on one side of it."""
        neighbors: dict[int, list[int]] = {}
        for start, end in self.edges:
            neighbors.setdefault(start, []).append(end)
            neighbors.setdefault(end, []).append(start)
        root = next(iter(neighbors))
        parents, order = {root: root}, [root]
        for node in order:
            for neighbor in neighbors[node]:
                if neighbor not in parents:
                    parents[neighbor] = node
                    order.append(neighbor)
        behind = {node: {node} if node >= 0 else set() for node in order}
        for node in reversed(order[1:]):
            behind[parents[node]] |= behind[node]
        return [frozenset(behind[node]) for node in order[1:]]


def restricted(sides: Iterable[Tips], organs: Tips) -> frozenset[Tips]:
    """Return the splits of a tree between some of its organs, given one side (of each of its limbs)."""
    rows = (_proper_side(side & organs, organs) for side in sides)
    return frozenset(row for row in rows if 2 <= len(row) <= len(organs) - 2)


def _proper_side(side: Tips, organs: Tips) -> Tips:
    """Return the side of a limb without the least of the organs."""
    return organs - side if min(organs, default=-1) in side else side


def shown_tree(skeleton: Skeleton, labels: Sequence[int]) -> ShownTree:
    """Return the organs that a frame's skeleton shows, and the splits between them; see `skeleton_splits`."""
    organs = frozenset(organ for organ, tip in enumerate(labels) if tip >= 0)
    return organs, restricted(skeleton_splits(skeleton, labels), organs)


def common_graph(shown: Sequence[ShownTree], num_organs: int) -> LimbGraph:
    """Return the tree of all K organs, two or more, from the trees of T frames."""
    counts = Counter(shown)
    most = max(counts, key=lambda row: (len(row[0]), counts[row], sorted(row[0])))[0]
    tree = _Tree.from_splits(most, most_frequent_splits([splits for organs, splits in shown if organs == most]))
    present = set(most)
    while len(present) < num_organs:
        common = {organ: sum(len(organs & present) * count for (organs, _), count in counts.items() if organ in organs)
                  for organ in range(num_organs) if organ not in present}  # fmt: skip
        organ = max(common, key=lambda name: (common[name], -name))
        present.add(organ)
        tree = _best_tree(tree, organ, {row: count for row, count in counts.items() if organ in row[0]}, present)
    return LimbGraph(num_organs, restricted(tree.sides(), frozenset(range(num_organs))))


def _best_tree(tree: _Tree, organ: int, counts: dict[ShownTree, int], present: set[int]) -> _Tree:
    """Return the tree with one more organ where it differs least from trees that show it, each with a count."""
    wanted: Counter[ShownTree] = Counter()
    for (organs, splits), count in counts.items():
        known = frozenset(organs & present)
        wanted[known, restricted(splits, known)] += count

    def difference(candidate: _Tree) -> int:
        sides = candidate.sides()
        return sum(count * len(restricted(sides, organs) ^ splits) for (organs, splits), count in wanted.items())

    return min(tree.with_organ(organ), key=difference)


@dataclass(frozen=True)
class LimbChain:
    """A limb between shown organs as a chain of limbs of the tree of all; ``forward``: whether each runs along it."""

    limbs: tuple[int, ...]
    forward: tuple[bool, ...]


def shown_graph(graph: LimbGraph, organs: Tips) -> tuple[LimbGraph, list[LimbChain]]:
    """Return the graph of some organs, two or more, numbered in their order, and the chain of each of its limbs."""
    order, every = sorted(organs), frozenset(range(graph.num_tips))
    starts = _start_sides(graph)
    number = {organ: rank for rank, organ in enumerate(order)}
    splits = restricted(starts, organs)
    part = LimbGraph(len(order), frozenset(frozenset(number[organ] for organ in split) for split in splits))
    chains: dict[Tips, list[int]] = {}
    for limb, side in enumerate(starts):
        if side & organs and organs - side:
            chains.setdefault(_proper_side(side & organs, organs), []).append(limb)
    rows = []
    for side in _start_sides(part):
        here = frozenset(order[rank] for rank in side)
        first = min(here)
        # Limbs follow each other as the sides that hold the first organ grow.
        towards = {limb: starts[limb] if first in starts[limb] else every - starts[limb]
                   for limb in chains[_proper_side(here, organs)]}  # fmt: skip
        limbs = sorted(towards, key=lambda limb: len(towards[limb]))
        rows.append(LimbChain(tuple(limbs), tuple(first in starts[limb] for limb in limbs)))
    return part, rows


def _start_sides(graph: LimbGraph) -> list[Tips]:
    """Return per limb the tips on the side of its first node."""
    every = frozenset(range(graph.num_tips))
    if graph.num_tips == 2:
        return [frozenset({0})]
    return [*(frozenset({tip}) for tip in range(graph.num_tips)), *(every - split for split in graph.ordered_splits)]


def limbs_between(graph: LimbGraph, alive: Tensor) -> Tensor:
    """Return a mask (T, L) of the limbs that join existing organs (T, K)."""
    sides = torch.zeros(len(graph.edges), graph.num_tips, dtype=torch.bool)
    for limb, side in enumerate(_start_sides(graph)):
        sides[limb, list(side)] = True
    return (alive[:, None] & sides).any(-1) & (alive[:, None] & ~sides).any(-1)
