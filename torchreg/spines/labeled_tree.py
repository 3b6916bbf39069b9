"""Trees with named tips: the splits that describe them, the graph of their limbs, and where its junctions lie."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchreg._checks import check_count
from torchreg.errors import InputError
from torchreg.geometry.graphs import Graph, rooted
from torchreg.geometry.skeleton import Skeleton

# A split names the tips on one side of a limb between junctions: the side without tip 0.
Split = frozenset[int]


@dataclass(frozen=True)
class LimbGraph:
    """A tree of limbs with named tips, without places: the G of a spine.

    Args:
        num_tips: K, at least 2; the tips are the nodes 0 to K - 1, the junctions follow.
        splits: one per limb between two junctions: the tips on its side away from tip 0. They must fit into one tree.

    Raises:
        InputError: if a split is not of that kind or contradicts another.

    References: Buneman 1971.
    """

    num_tips: int
    splits: frozenset[Split]

    def __post_init__(self) -> None:
        check_count(self.num_tips, "num_tips", 2)
        inner = range(1, self.num_tips)
        for split in self.splits:
            if not 2 <= len(split) <= self.num_tips - 2 or not all(tip in inner for tip in split):
                most = self.num_tips - 2
                raise InputError(f"splits must hold 2 to {most} of the tips 1 to {most + 1}, got {sorted(split)}")
        for split in self.splits:
            for other in self.splits:
                if not fit_together(split, other):
                    raise InputError(f"splits must fit into one tree, but {sorted(split)} and {sorted(other)} do not")

    @cached_property
    def branches(self) -> tuple[tuple[frozenset[int], ...], ...]:
        """Per junction the tips behind each of its limbs; the limb towards tip 0 comes first."""
        every = frozenset(range(self.num_tips))
        if self.num_tips == 2:
            return ()
        result = []
        for below in [every - {0}, *self.ordered_splits]:
            inside = [split for split in self.ordered_splits if split < below]
            children = [split for split in inside if not any(split < other for other in inside)]
            loose = below.difference(*children)
            parts = sorted([*children, *(frozenset({tip}) for tip in loose)], key=min)
            result.append((every - below, *parts))
        return tuple(result)

    @cached_property
    def edges(self) -> Tensor:
        """Node indices (L, 2) of the limbs: K that start at the tips, in order, then those between junctions."""
        if self.num_tips == 2:
            return torch.tensor([[0, 1]])
        owner = {}
        for number, (_, *parts) in enumerate(self.branches):
            for part in parts:
                owner[part] = self.num_tips + number
        rows = [(0, self.num_tips)]
        rows += [(tip, owner[frozenset({tip})]) for tip in range(1, self.num_tips)]
        rows += [(owner[split], self.num_tips + 1 + number) for number, split in enumerate(self.ordered_splits)]
        return torch.tensor(rows)

    @cached_property
    def topology(self) -> str:
        """Canonical form without names, as in `Skeleton.topology`."""
        count = len(self.edges) + 1
        return Skeleton(torch.eye(3)[torch.zeros(count).long()], self.edges, torch.zeros(count)).topology

    @property
    def ordered_splits(self) -> list[Split]:
        """The splits, one per limb between junctions, in the order of `edges`: large ones first, then by their tips."""
        return sorted(self.splits, key=lambda split: (-len(split), sorted(split)))


def number_nodes(graph: Tensor, num_samples: int) -> Tensor:
    """Return which node each sample of each limb is, (L, num_samples), for limbs (L, 2) that share their end nodes.

    The nodes of the graph keep their numbers; the samples inside the limbs follow.
    """
    inner = len(graph) + 1 + torch.arange(len(graph) * (num_samples - 2), device=graph.device)
    return torch.cat((graph[:, :1], inner.reshape(len(graph), num_samples - 2), graph[:, 1:]), dim=1)


def gather_nodes(values: Tensor, limb_nodes: Tensor) -> Tensor:
    """Return values (T, L, S, ...) along limbs per node (T, N, ...), each from the first limb that has it."""
    flat = limb_nodes.reshape(-1)
    place = torch.arange(len(flat), device=flat.device)
    first = torch.full_like(place[: int(flat.max()) + 1], len(flat)).scatter_reduce(0, flat, place, "amin")
    return values.flatten(1, 2)[:, first]


def fit_together(split: Split, other: Split) -> bool:
    """Return whether two splits can be limbs of one tree: one holds the other, or they share no tip."""
    return split <= other or other <= split or not split & other


def path_lengths(skeleton: Skeleton, starts: Tensor) -> Tensor:
    """Return the lengths (K, N) along the tree from the nodes ``starts`` (K,) to all nodes, float64."""
    first, second = skeleton.nodes.detach().cpu().double()[skeleton.edges.cpu()].unbind(1)
    return Graph.from_edges(skeleton.edges, (first - second).norm(dim=-1), len(skeleton)).distances(starts)


def skeleton_splits(skeleton: Skeleton, named: Sequence[int]) -> frozenset[Split]:
    """Return the splits of the tree that joins named tips; limbs to other tips are left out.

    Args:
        skeleton: the tree.
        named: K indices into `Skeleton.tips`, one per name, or -1 for names without a tip.

    Raises:
        InputError: if an index occurs twice or is out of range.
    """
    nodes = _named_nodes(skeleton, named)
    first = next((name for name, node in enumerate(nodes) if node >= 0), 0)
    root = torch.tensor([max(nodes[first], 0)])
    parents, order = (found.tolist() for found in rooted(skeleton.edges, root, len(skeleton)))
    behind: dict[int, set[int]] = {node: set() for node in order}
    for name, node in enumerate(nodes):
        if node >= 0:
            behind[node].add(name)
    present = {name for name, node in enumerate(nodes) if node >= 0}
    found = set()
    for node in reversed(order[1:]):
        side = frozenset(behind[node])
        side = side if 0 not in side else frozenset(present - side)
        if 2 <= len(side) <= len(present) - 2:
            found.add(side)
        behind[parents[node]] |= behind[node]
    return frozenset(found)


def consensus(rows: Sequence[frozenset[Split]]) -> frozenset[Split]:
    """Return the most frequent set of splits; where several are, the one whose splits are most frequent.

    Raises:
        InputError: if there is none.
    """
    if not rows:
        raise InputError("rows must hold at least one set of splits, got none")
    count, single = Counter(rows), Counter(split for row in rows for split in row)
    return max(count, key=lambda row: (count[row], sum(single[split] for split in row), sorted(sorted(s) for s in row)))


def place_junctions(skeleton: Skeleton, named: Sequence[int], graph: LimbGraph) -> list[int]:
    """Return the node of the skeleton on which each junction of a graph lies.

    A junction lies where the mean lengths to the tips behind each of its limbs have the least sum: on a tree that is
    where no limb holds more than half of all. The answer exists for any tree, also for one with other junctions. Of
    several equally good nodes it is the middle one.

    Args:
        skeleton: the tree.
        named: K indices into `Skeleton.tips`, or -1 for a tip that was not found; at least one must be.
        graph: with K tips.

    Raises:
        InputError: if the sizes do not fit.
    """
    if len(named) != graph.num_tips:
        raise InputError(f"named must have one entry per tip of graph ({graph.num_tips}), got {len(named)}")
    nodes = _named_nodes(skeleton, named)
    found = [name for name, node in enumerate(nodes) if node >= 0]
    if not found:
        raise InputError("named must give one tip at least, got none")
    lengths = path_lengths(skeleton, torch.tensor([nodes[name] for name in found]))
    places = []
    for parts in graph.branches:
        sums = lengths.new_zeros(len(skeleton))
        for part in parts:
            rows = [row for row, name in enumerate(found) if name in part]
            if rows:
                sums = sums + lengths[rows].mean(0)
        best = (sums <= sums.min() + 1e-6 * lengths.max()).nonzero()[:, 0]
        middle = path_lengths(skeleton, best)[:, best].amax(-1).argmin()
        places.append(int(best[middle]))
    return places


def _named_nodes(skeleton: Skeleton, named: Sequence[int]) -> list[int]:
    tips = skeleton.tips.tolist()
    given = [index for index in named if index >= 0]
    if len(set(given)) < len(given) or any(not -1 <= index < len(tips) for index in named):
        raise InputError(f"named must hold different tips from 0 to {len(tips) - 1}, or -1, got {list(named)}")
    return [tips[index] if index >= 0 else -1 for index in named]
