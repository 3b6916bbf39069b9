"""What branches where, seen from a tip: level sets of the distance from it, walked from every other tip."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
import torch
from torch import Tensor

from torchreg.geometry.graphs import Graph
from torchreg.spines.level_sets import LevelSets

Tips = frozenset[int]
_MAX_TRIPLES = 400


@dataclass(frozen=True, eq=False)
class Branch:
    """A stretch of a tree between two places where ways part.

    Args:
        tips: those that lie beyond it, seen from the root.
        rings: (n,) away from the root. The first is the ring in which the branch parts from others (not so for the
            branch that starts at the root), the last the one in which its own tips part.
    """

    tips: Tips
    rings: Tensor


@dataclass(frozen=True, eq=False)
class TipTree:
    """The tree of rings around one tip.

    Args:
        root: number of the tip.
        sets: the level sets of the distance from it.
        branches: one per set of tips that ways lead to together; the one from the root, to all others, first.
    """

    root: int
    sets: LevelSets
    branches: tuple[Branch, ...]

    def towards(self, tips: Sequence[int]) -> Branch:
        """Return the last branch that leads to all of some tips."""
        return min((branch for branch in self.branches if branch.tips.issuperset(tips)), key=lambda one: len(one.tips))

    def parting(self, triple: Sequence[int]) -> int:
        """Return the ring in which the ways between three tips meet."""
        if self.root in triple:
            branch = self.towards([tip for tip in triple if tip != self.root])
        else:
            branch = min((self.towards(pair) for pair in combinations(triple, 2)), key=lambda one: len(one.tips))
        return int(branch.rings[-1])


def grow_tip_tree(sets: LevelSets, bands: Tensor, root: int, bridges: Tensor | None = None) -> TipTree:
    """Return the tree that the ways from all tips to one of them make together.

    A way leads from band to band through the rings between, by the least number of rings; of two between the same bands
    by the longer one. Only what lies on a way is in the tree: bumps that are no tips leave no branch. A surface with
    handles has several ways around them; the shortest is taken, so that what comes out is a tree all the same.

    Args:
        sets: level sets of the distance from the root.
        bands: (K,) band that each tip lies in.
        root: number of the tip from which distances are measured, 0 to K - 1.
        bridges: (B, 2) bands to be thought of as touching, or None.

    References: Brostow et al. 2004, section 4.1, "walking along edges of the surface graph".
    """
    lower, upper = sets.lower.numpy(), sets.upper.numpy()
    ring = np.arange(len(sets))
    if bridges is not None and len(bridges):
        lower, upper = (
            np.concatenate((ends, column.numpy())) for ends, column in zip((lower, upper), bridges.T, strict=True)
        )
        ring = np.concatenate((ring, np.full(len(bridges), -1)))
    length = np.concatenate((sets.lengths.numpy(), np.zeros(len(ring) - len(sets))))
    key = np.minimum(lower, upper) * sets.num_bands + np.maximum(lower, upper)
    order = np.lexsort((-length, key))
    key, first = np.unique(key[order], return_index=True)
    ring = ring[order][first]
    edges = torch.from_numpy(np.stack((key // sets.num_bands, key % sets.num_bands), axis=1))
    _, before = Graph.from_edges(edges, torch.ones(len(edges)), sets.num_bands).shortest_paths(int(bands[root]))
    ways = {}
    for tip, band in enumerate(bands.tolist()):
        way = []
        while tip != root and before[band] >= 0:
            previous = int(before[band])
            way.append(int(ring[np.searchsorted(key, min(band, previous) * sets.num_bands + max(band, previous))]))
            band = previous
        if tip != root:
            ways[tip] = [one for one in reversed(way) if one >= 0]
    return TipTree(root, sets, tuple(_branches(ways)))


def _branches(ways: dict[int, list[int]]) -> list[Branch]:
    """Return the branches of ways, which are lists of rings away from the root."""
    branches = []
    todo = [(tuple(ways), 0, 0)]
    while todo:
        tips, start, place = todo.pop()
        groups = _groups(ways, tips, place)
        while len(groups) == 1 and place < len(ways[tips[0]]):
            place += 1
            groups = _groups(ways, tips, place)
        branches.append(Branch(frozenset(tips), torch.tensor(ways[tips[0]][start:place], dtype=torch.int64)))
        if len(groups) > 1:
            todo += [(group, max(place - 1, 0), place) for group in groups]
    return branches


def _groups(ways: dict[int, list[int]], tips: tuple[int, ...], place: int) -> list[tuple[int, ...]]:
    """Return the tips by the ring at some place of their ways; a way that ends before is a group of its own."""
    groups: dict[tuple[int, int], list[int]] = {}
    for tip in tips:
        name = (ways[tip][place], -1) if place < len(ways[tip]) else (-1, tip)
        groups.setdefault(name, []).append(tip)
    return [tuple(group) for group in groups.values()]


def majority_splits(trees: Sequence[TipTree]) -> list[Tips]:
    """Return the ways of parting the tips in two that more than half of the trees show; the side without tip 0.

    Any two of them fit into one tree, however much the trees contradict each other: more than half and more than half
    share a tree. Where trees disagree there is no split, and so a junction of higher degree: two trees that show pairs
    of three-way junctions, differently, have one four-way junction in common.

    References: Margush and McMorris 1981, majority-rule consensus; Brostow et al. 2004, figure 3B.
    """
    everything = frozenset(range(len(trees)))
    votes = Counter(
        frozenset(branch.tips if 0 not in branch.tips else everything - branch.tips)
        for tree in trees
        for branch in tree.branches
        if 1 < len(branch.tips) < len(trees) - 1 and len(branch.rings) > 1
    )
    return [split for split, number in votes.items() if 2 * number > len(trees)]


def joints_of(splits: Sequence[Tips], num_tips: int) -> list[tuple[Tips, ...]]:
    """Return the inner nodes of the tree that splits make, each as the sets of tips that its limbs lead to.

    Args:
        splits: compatible, each the side without tip 0.
        num_tips: K, three or more.

    Returns:
        one tuple per node; in each, the set that holds tip 0 comes first. The node next to tip 0 comes first.
    """
    everything = frozenset(range(num_tips))
    inner = sorted({everything - {0}, *splits}, key=len, reverse=True)
    parts: dict[Tips, list[Tips]] = {node: [everything - node] for node in inner}
    for child in (*inner[1:], *(frozenset({tip}) for tip in range(1, num_tips))):
        parts[min((node for node in inner if child < node), key=len)].append(child)
    return [tuple(parts[node]) for node in inner]


def locate(joint: tuple[Tips, ...], trees: Sequence[TipTree]) -> tuple[Tensor, Tensor]:
    """Return where a junction is (3,), and how wide () the rings are there: root mean square distance to their centers.

    The mean over the rings of `partings`; trees count by how compact these are.
    """
    places, widths = [], []
    for tree in trees:
        rings = partings(joint, tree)
        places.append(tree.sets.centers[rings].mean(0))
        widths.append(ring_widths(tree.sets)[rings].mean())
    weights = torch.stack(widths) ** -2
    return (weights / weights.sum()) @ torch.stack(places), torch.stack(widths).mean()


def partings(joint: tuple[Tips, ...], tree: TipTree) -> Tensor:
    """Return the rings (n,) of a tree where ways between tips beyond three different limbs of a junction meet."""
    triples = [triple for limbs in combinations(joint, 3) for triple in product(*limbs)]
    # Many tips make very many triples; evenly spaced ones will do.
    return torch.tensor([tree.parting(triple) for triple in triples[:: 1 + len(triples) // _MAX_TRIPLES]])


def ring_widths(sets: LevelSets) -> Tensor:
    """Return the root mean square distance (R,) of the rings from their centers."""
    return sets.covariances.diagonal(dim1=1, dim2=2).sum(-1).sqrt()


def consensus(trees: Sequence[TipTree], overlap: float) -> list[tuple[Tips, ...]]:
    """Return the junctions of the one tree that stands for all, see `joints_of`.

    Splits of a majority count, unless the two junctions they part overlap: are closer than ``overlap`` times the sum of
    their widths. Overlapping ones are merged, closest first, and located anew.
    """
    splits = majority_splits(trees)
    while splits:
        joints = joints_of(splits, len(trees))
        places = [locate(joint, trees) for joint in joints]
        gaps = {}
        for (first, a), (second, b) in combinations(enumerate(joints), 2):
            between = _between(a, b)
            if between is not None:
                distance = (places[first][0] - places[second][0]).norm()
                gaps[between] = float(distance / (places[first][1] + places[second][1]))
        closest = min(gaps, key=lambda split: gaps[split])
        if gaps[closest] >= overlap:
            break
        splits.remove(closest)
    return joints_of(splits, len(trees))


def _between(first: tuple[Tips, ...], second: tuple[Tips, ...]) -> Tips | None:
    """Return the split that two junctions share as a limb, the side without tip 0; None if they are no neighbors."""
    everything = frozenset().union(*first)
    shared = [limb for limb in first if everything - limb in second]
    return next((limb if 0 not in limb else everything - limb for limb in shared), None)
