"""Trees of tips merged as printed: from supernodes at the tips inwards to metanodes."""

from __future__ import annotations

from collections.abc import Sequence

from torchreg.spines.labeled_tree import Tips, junctions_from_splits, without_tip_zero
from torchreg.spines.skeleton.tip_trees import TipTree


def metanode_junctions(trees: Sequence[TipTree]) -> list[tuple[Tips, ...]]:
    """Return the junctions of all trees after contradicting nodes are merged (Brostow et al. 2004, figure 3B)."""
    if len(trees) == 2:
        return []
    every = frozenset(range(len(trees)))
    shown = [
        {
            without_tip_zero(branch.tips, every)
            for branch in tree.branches
            if 1 < len(branch.tips) < len(trees) - 1 and len(branch.rings) > 1
        }
        for tree in trees
    ]
    return junctions_from_splits(set.intersection(*shown), len(trees))
