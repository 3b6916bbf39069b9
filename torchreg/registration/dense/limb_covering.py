"""Limbs of the target that nothing covers: starts in which a limb of the source is laid there."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.graphs import connected_components
from torchreg.geometry.neighbors import NeighborTree
from torchreg.registration.dense.config import ChoiceConfig
from torchreg.registration.dense.graph_limbs import FARTHEST, LONGEST, Limbs, finite_ways, shift_onto
from torchreg.registration.dense.problem import ScanAlignProblem
from torchreg.registration.dense.stages import embedded

# Target samples looked at, and neighbors of each on its surface.
_NUM_TARGETS, _NEIGHBORS = 800, 8
# Target samples to which distances tell what is far out.
_NUM_FROM = 60
# Patches that nothing covers, at most and with at least this share of the samples, and limbs tried for each.
_MOST_PATCHES, _LEAST_SHARE, _MOST_LIMBS = 2, 0.02, 3


def covering_limbs(problem: ScanAlignProblem, transforms: Tensor, config: ChoiceConfig) -> list[Tensor]:
    """Return motions of the nodes, in each of which a limb lies roughly where nothing covered the target.

    Two legs that end on one leg of the target leave its other leg bare, and each covers what it covers: nothing pulls
    them apart. The tip of a bare patch is its sample farthest from all others in the mean, along the target's surface;
    around it the limbs are laid whose tips are nearest.

    Args:
        problem: the scans.
        transforms: (J, 4, 4) to change.
        config: what covers a sample.

    Returns:
        motions (J, 4, 4); none where all is covered.

    Cost: 20 ms, and 10 ms for each limb tried, of up to six.
    """
    target = problem.target.first(_NUM_TARGETS)
    moved = problem.moved(transforms)
    bare = NeighborTree(embedded(moved, config)).nearest(embedded(target, config))[1] >= config.cap
    if not bare.any():
        return []
    surface = GeodesicGraph.from_points(target.points, min(_NEIGHBORS, len(target) - 1))
    limbs = Limbs.of(problem.graph)
    # A limb ends half the way to the next tip.
    lengths = (limbs.between.masked_fill(limbs.between == 0, torch.inf).amin(1) / 2).clamp(max=LONGEST)
    places, found = limbs.places(transforms), []
    for tip in _bare_tips(surface, bare):
        levels = surface.distances([tip])[0]
        apart = (places - target.points[tip]).norm(dim=-1)
        nearest = apart.argsort(stable=True)[:_MOST_LIMBS]
        for limb in nearest[apart[nearest] < FARTHEST].tolist():
            shift = shift_onto(moved.points, limbs.levels[limb], target.points, levels, float(lengths[limb]))
            if shift is not None:
                found.append(limbs.laid(transforms, moved.points + shift))
    return found


def _bare_tips(surface: GeodesicGraph, bare: Tensor) -> list[int]:
    """Return the sample farthest out in each patch of samples (T,) that nothing covers, of the largest patch first."""
    pairs, _ = surface.edges()
    within = bare[pairs].all(1)
    patch = connected_components(pairs[within], len(bare))
    count = torch.bincount(patch[bare], minlength=len(bare))
    largest = count.argsort(descending=True, stable=True)[:_MOST_PATCHES]
    largest = largest[count[largest] >= max(1, _LEAST_SHARE * len(bare))]
    out = finite_ways(surface.distances(torch.arange(min(_NUM_FROM, len(bare))))).mean(0)
    return [int(torch.where(bare & (patch == one), out, -1.0).argmax()) for one in largest]
