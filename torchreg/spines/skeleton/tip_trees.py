"""Trees of rings around the tips, and the junctions on which most of these trees agree."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
import torch
from torch import Tensor

from torchreg.geometry.graphs import Graph
from torchreg.spines.labeled_tree import Tips, junctions_from_splits, without_tip_zero
from torchreg.spines.skeleton.level_sets import LevelSets

# Triples of tips that say where a junction lies, at most; many tips make very many, and evenly spaced ones will do.
_MAX_TRIPLES = 400


@dataclass(frozen=True, eq=False)
class Branch:
    """A stretch of a tree between points at which paths diverge: the tips beyond it, its rings (n,) from the root."""

    tips: Tips
    rings: Tensor


@dataclass(frozen=True, eq=False)
class TipTree:
    """The tree of rings around one tip, the root; the branch from the root, to all other tips, comes first."""

    root: int
    sets: LevelSets
    branches: tuple[Branch, ...]

    def last_common(self, tips: Sequence[int]) -> Branch:
        """Return the last branch that leads to all of the given tips."""
        return min((row for row in self.branches if row.tips.issuperset(tips)), key=lambda row: len(row.tips))

    def meeting_ring(self, triple: Sequence[int]) -> int:
        """Return the ring in which the paths between three tips meet."""
        if self.root in triple:
            branch = self.last_common([tip for tip in triple if tip != self.root])
        else:
            branch = min((self.last_common(pair) for pair in combinations(triple, 2)), key=lambda row: len(row.tips))
        if not len(branch.rings):
            # Paths that diverge within the root's own band meet before their first ring.
            return int(next(row.rings[0] for row in self.branches if len(row.rings)))
        return int(branch.rings[-1])

    def junction_rings(self, junction: tuple[Tips, ...]) -> Tensor:
        """Return the rings (n,) in which the paths between tips beyond three limbs of a junction meet."""
        triples = [triple for limbs in combinations(junction, 3) for triple in product(*limbs)]
        return torch.tensor([self.meeting_ring(triple) for triple in triples[:: 1 + len(triples) // _MAX_TRIPLES]])


def grow_tip_tree(sets: LevelSets, bands: Tensor, root: int, bridges: Tensor | None = None) -> TipTree:
    """Return the tree that the paths from one tip to all others make together.

    A path leads from band (K,) to band through the least number of rings; of two between the same bands through the
    longer one. Bumps that are no tips leave no branch; around handles the shortest path is taken. ``bridges`` (B, 2)
    are bands joined between pieces (Brostow et al. 2004, section 4.1, "walking along edges of the surface graph").
    """
    lower, upper, length = sets.lower.numpy(), sets.upper.numpy(), sets.lengths.numpy()
    ring = np.arange(len(sets))
    if bridges is not None:
        lower, upper = (
            np.concatenate((ends, row.numpy())) for ends, row in zip((lower, upper), bridges.T, strict=True)
        )
        ring = np.concatenate((ring, np.full(len(bridges), -1)))
        length = np.concatenate((length, np.zeros(len(bridges))))
    key = np.minimum(lower, upper) * sets.num_bands + np.maximum(lower, upper)
    order = np.lexsort((-length, key))
    key, first = np.unique(key[order], return_index=True)
    ring = ring[order][first]
    edges = torch.from_numpy(np.stack((key // sets.num_bands, key % sets.num_bands), axis=1))
    _, before = Graph.from_edges(edges, torch.ones(len(edges)), sets.num_bands).shortest_paths(int(bands[root]))
    paths = {}
    for tip, band in enumerate(bands.tolist()):
        path = []
        while tip != root and before[band] >= 0:
            previous = int(before[band])
            path.append(int(ring[np.searchsorted(key, min(band, previous) * sets.num_bands + max(band, previous))]))
            band = previous
        if tip != root:
            paths[tip] = [row for row in reversed(path) if row >= 0]
    return TipTree(root, sets, tuple(_branches(paths)))


def _branches(paths: dict[int, list[int]]) -> list[Branch]:
    """Return the branches of the tree of paths, which are lists of rings away from the root."""
    branches = []
    todo = [(tuple(paths), 0, 0)]
    while todo:
        tips, start, position = todo.pop()
        groups = _groups(paths, tips, position)
        while len(groups) == 1 and position < len(paths[tips[0]]):
            position += 1
            groups = _groups(paths, tips, position)
        branches.append(Branch(frozenset(tips), torch.tensor(paths[tips[0]][start:position], dtype=torch.int64)))
        if len(groups) > 1:
            todo += [(group, max(position - 1, 0), position) for group in groups]
    return branches


def _groups(paths: dict[int, list[int]], tips: tuple[int, ...], position: int) -> list[tuple[int, ...]]:
    """Return the tips grouped by the ring at a position of their paths; a path that ended is a group of its own."""
    groups: dict[tuple[int, int], list[int]] = {}
    for tip in tips:
        key = (paths[tip][position], -1) if position < len(paths[tip]) else (-1, tip)
        groups.setdefault(key, []).append(tip)
    return [tuple(group) for group in groups.values()]


def majority_splits(trees: Sequence[TipTree]) -> list[Tips]:
    """Return the splits that more than half of the trees show, all compatible (Margush and McMorris 1981)."""
    every = frozenset(range(len(trees)))
    votes = Counter(
        without_tip_zero(branch.tips, every)
        for tree in trees
        for branch in tree.branches
        if 1 < len(branch.tips) < len(trees) - 1 and len(branch.rings) > 1
    )
    return [split for split, number in votes.items() if 2 * number > len(trees)]


def estimate_junction(junction: tuple[Tips, ...], trees: Sequence[TipTree]) -> tuple[Tensor, Tensor]:
    """Return the position (3,) of a junction, and the mean width () of its rings in the trees."""
    positions, widths = [], []
    for tree in trees:
        rings = tree.junction_rings(junction)
        positions.append(tree.sets.centers[rings].mean(0))
        widths.append(tree.sets.widths[rings].mean())
    weights = torch.stack(widths) ** -2
    return (weights / weights.sum()) @ torch.stack(positions), torch.stack(widths).mean()


def consensus_junctions(trees: Sequence[TipTree], overlap: float) -> list[tuple[Tips, ...]]:
    """Return the junctions of the tree on which most trees agree, see `junctions_from_splits`."""
    if len(trees) == 2:
        return []
    splits = majority_splits(trees)
    while splits:
        junctions = junctions_from_splits(splits, len(trees))
        estimates = [estimate_junction(junction, trees) for junction in junctions]
        relative = {}
        for first, second in combinations(range(len(junctions)), 2):
            split = _shared_limb(junctions[first], junctions[second])
            if split is not None:
                distance = (estimates[first][0] - estimates[second][0]).norm()
                relative[split] = float(distance / (estimates[first][1] + estimates[second][1]))
        closest = min(relative, key=lambda split: relative[split])
        if relative[closest] >= overlap:
            break
        splits.remove(closest)
    return junctions_from_splits(splits, len(trees))


def _shared_limb(first: tuple[Tips, ...], second: tuple[Tips, ...]) -> Tips | None:
    """Return the split of the limb that two junctions share; None if they are no neighbors."""
    every: Tips = frozenset().union(*first)
    return next((without_tip_zero(limb, every) for limb in first if every - limb in second), None)
