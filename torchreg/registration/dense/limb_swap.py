"""Limbs that may have been taken for one another: starts in which two of them change places."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.registration.dense.graph_limbs import FARTHEST, LONGEST, Limbs, shift_onto
from torchreg.registration.dense.problem import ScanAlignProblem

# Pairs of limbs at most, those with the nearest tips.
_MOST_PAIRS = 8


def exchanged_limbs(problem: ScanAlignProblem, transforms: Tensor) -> list[Tensor]:
    """Return motions of the nodes, in each of which two limbs lie roughly where the other one lay.

    Legs that pass each other between two scans end on each other's places, which nearest matches do not mend. A limb is
    what is nearer to its tip, along the graph, than half the way to the other limb's tip.

    Args:
        problem: the scans.
        transforms: (J, 4, 4) to change.

    Returns:
        motions (J, 4, 4), those of limbs whose tips are nearest to each other first; none without two limbs.

    Cost: 10 ms for each pair of limbs of a graph of 60 nodes.
    """
    limbs, moved = Limbs.of(problem.graph), problem.graph(transforms)
    places = limbs.places(transforms)
    apart = torch.cdist(places, places)
    pairs = torch.combinations(torch.arange(len(places)))
    pairs = pairs[apart[pairs[:, 0], pairs[:, 1]] < FARTHEST]
    pairs = pairs[apart[pairs[:, 0], pairs[:, 1]].argsort(stable=True)[:_MOST_PAIRS]]
    targets = [_exchanged(limbs, moved, *pair.tolist()) for pair in pairs]
    return [limbs.laid(transforms, there) for there in targets if there is not None]


def _exchanged(limbs: Limbs, moved: Tensor, first: int, second: int) -> Tensor | None:
    """Return places (S, 3) of samples with two limbs exchanged, none if there is too little of one."""
    length = min(float(limbs.between[first, second]) / 2, LONGEST)
    one, other = limbs.levels[first], limbs.levels[second]
    shifts = shift_onto(moved, one, moved, other, length), shift_onto(moved, other, moved, one, length)
    return None if shifts[0] is None or shifts[1] is None else moved + shifts[0] + shifts[1]
