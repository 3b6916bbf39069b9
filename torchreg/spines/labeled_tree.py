"""Trees with labeled tips: the splits that describe them, the graph of their limbs, and its junctions on a skeleton."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchreg.geometry.graphs import Graph, rooted
from torchreg.geometry.skeleton import Skeleton

# The labels of the tips on one side of a limb; a split is the side without tip 0, and stands for the limb.
Tips = frozenset[int]


@dataclass(frozen=True)
class LimbGraph:
    """A tree of limbs with labeled tips, without positions: the G of a spine (Buneman 1971)."""

    num_tips: int  # K, at least 2; the tips are the nodes 0 to K - 1, the junctions follow
    # one per limb between two junctions; of any two, one contains the other or they share no tip
    splits: frozenset[Tips]

    @cached_property
    def branches(self) -> tuple[tuple[Tips, ...], ...]:
        """Per junction the tips behind each of its limbs; the limb towards tip 0 comes first."""
        if self.num_tips == 2:
            return ()
        rows = [(first, *sorted(rest, key=min)) for first, *rest in junctions_from_splits(self.splits, self.num_tips)]
        every = frozenset(range(self.num_tips))
        return tuple(sorted(rows, key=lambda row: _split_order(every - row[0])))

    @cached_property
    def edges(self) -> Tensor:
        """Node indices (L, 2) of the limbs: K that start at the tips, in order, then those between junctions."""
        if self.num_tips == 2:
            return torch.tensor([[0, 1]])
        inner_end = {part: self.num_tips + k for k, (_, *parts) in enumerate(self.branches) for part in parts}
        rows = [(0, self.num_tips)]
        rows += [(tip, inner_end[frozenset({tip})]) for tip in range(1, self.num_tips)]
        rows += [(inner_end[split], self.num_tips + 1 + k) for k, split in enumerate(self.ordered_splits)]
        return torch.tensor(rows)

    @cached_property
    def topology(self) -> str:
        """Canonical form without labels, as in `Skeleton.topology`."""
        count = len(self.edges) + 1
        return Skeleton(torch.zeros(count, 3), self.edges, torch.zeros(count)).topology

    @property
    def ordered_splits(self) -> list[Tips]:
        """The splits in the order of `edges`: large ones first, then by their tips."""
        return sorted(self.splits, key=_split_order)


def _split_order(split: Tips) -> tuple[int, list[int]]:
    return -len(split), sorted(split)


def junctions_from_splits(splits: Collection[Tips], num_tips: int) -> list[tuple[Tips, ...]]:
    """Return the junctions of compatible splits as the sets of tips behind their limbs, that with tip 0 first."""
    every = frozenset(range(num_tips))
    behind = sorted({every - {0}, *splits}, key=len, reverse=True)
    limbs = {tips: [every - tips] for tips in behind}
    for child in (*behind[1:], *(frozenset({tip}) for tip in range(1, num_tips))):
        limbs[min((tips for tips in behind if child < tips), key=len)].append(child)
    return [tuple(limbs[tips]) for tips in behind]


def without_tip_zero(tips: Tips, every: Tips) -> Tips:
    """Return the side of a limb without tip 0, given the tips on one side and all tips."""
    return tips if 0 not in tips else every - tips


def number_nodes(graph: Tensor, num_samples: int) -> Tensor:
    """Return the nodes (L, num_samples) of the samples of limbs (L, 2); those of the graph keep their numbers."""
    inner = len(graph) + 1 + torch.arange(len(graph) * (num_samples - 2), device=graph.device)
    return torch.cat((graph[:, :1], inner.reshape(len(graph), num_samples - 2), graph[:, 1:]), dim=1)


def gather_nodes(values: Tensor, limb_nodes: Tensor) -> Tensor:
    """Return values per node (T, N, ...) of values along limbs (T, L, S, ...), each from the first limb that has it."""
    flat = limb_nodes.reshape(-1)
    sample = torch.arange(len(flat), device=flat.device)
    first = torch.full_like(sample[: int(flat.max()) + 1], len(flat)).scatter_reduce(0, flat, sample, "amin")
    return values.flatten(1, 2)[:, first]


def path_lengths(skeleton: Skeleton, starts: Tensor) -> Tensor:
    """Return the lengths (K, N) along the tree from the nodes ``starts`` (K,) to all nodes, float64."""
    first, second = skeleton.nodes.detach().cpu().double()[skeleton.edges.cpu()].unbind(1)
    return Graph.from_edges(skeleton.edges, (first - second).norm(dim=-1), len(skeleton)).distances(starts)


def tip_nodes(skeleton: Skeleton, labels: Sequence[int]) -> list[int]:
    """Return the node of each label's tip, -1 for labels without a tip; labels are K indices into `Skeleton.tips`."""
    tips = skeleton.tips.tolist()
    return [tips[index] if index >= 0 else -1 for index in labels]


def skeleton_splits(skeleton: Skeleton, labels: Sequence[int]) -> frozenset[Tips]:
    """Return the splits of the tree that joins the labeled tips; limbs to other tips are left out."""
    nodes = {node: label for label, node in enumerate(tip_nodes(skeleton, labels)) if node >= 0}
    present = frozenset(nodes.values())
    root = torch.tensor([next(iter(nodes), 0)])
    parents, order = (rows.tolist() for rows in rooted(skeleton.edges, root, len(skeleton)))
    behind: dict[int, set[int]] = {node: {nodes[node]} if node in nodes else set() for node in order}
    splits = set()
    for node in reversed(order[1:]):
        split = without_tip_zero(frozenset(behind[node]), present)
        if 2 <= len(split) <= len(present) - 2:
            splits.add(split)
        behind[parents[node]] |= behind[node]
    return frozenset(splits)


def most_frequent_splits(rows: Sequence[frozenset[Tips]]) -> frozenset[Tips]:
    """Return the most frequent set of splits; of several, the one whose splits are most frequent."""
    count, single = Counter(rows), Counter(split for row in rows for split in row)
    return max(count, key=lambda row: (count[row], sum(single[split] for split in row), sorted(sorted(s) for s in row)))


def place_junctions(skeleton: Skeleton, labels: Sequence[int], graph: LimbGraph) -> list[int]:
    """Return the node of a skeleton on which each junction lies: of least sum of mean paths to its limbs' tips."""
    nodes = tip_nodes(skeleton, labels)
    present = [label for label, node in enumerate(nodes) if node >= 0]
    lengths = path_lengths(skeleton, torch.tensor([nodes[label] for label in present]))
    positions = []
    for parts in graph.branches:
        sums = lengths.new_zeros(len(skeleton))
        for part in parts:
            rows = [row for row, label in enumerate(present) if label in part]
            if rows:
                sums = sums + lengths[rows].mean(0)
        best = (sums <= sums.min() + 1e-6 * lengths.max()).nonzero()[:, 0]
        middle = path_lengths(skeleton, best)[:, best].amax(-1).argmin()
        positions.append(int(best[middle]))
    return positions
