"""Random segmentations: bones from best-candidate seeds, and regions halved at random for unused labels."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.registration.bones.labels import CellData

# Candidates per seed that is there already: Mitchell's algorithm keeps their density by more of them for later seeds.
_CANDIDATES_PER_SEED = 10


def best_candidates(points: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return indices (count,) of points (N, 3) drawn at random but far apart: each the best of several candidates.

    References: Mitchell 1991, "Spectrally optimal sampling for distribution ray tracing".
    """
    chosen = torch.randint(len(points), (1,), generator=generator)
    while len(chosen) < count:
        drawn = torch.randint(len(points), (_CANDIDATES_PER_SEED * len(chosen),), generator=generator)
        distances = torch.cdist(points[drawn], points[chosen]).amin(1)
        chosen = torch.cat([chosen, drawn[distances.argmax()][None]])
    return chosen


def nearest_seed(positions: Tensor, seeds: Tensor) -> Tensor:
    """Return the number (N,) of the seed (B, 3) nearest to each position (N, 3)."""
    return torch.cdist(positions, seeds).argmin(1)


def reuse_labels(
    data: CellData, squares: Tensor, labels: Tensor, num_bones: int, *, least_error: float, generator: torch.Generator
) -> Tensor:
    """Return labels (C,) in which unused labels take over random halves of the regions with the largest errors.

    References: Chang and Zwicker 2009, section 4.2, "Reusing Labels".
    """
    labels, centers, whole = labels.clone(), data.grid.cell_centers(), set()
    while int(labels.max()) + 1 < num_bones:
        used = int(labels.max()) + 1
        region = labels[data.cell]
        sums = squares.new_zeros(used).index_add(0, region, squares)
        counts = torch.bincount(region, minlength=used).clamp_min(1)
        sums[(sums / counts <= least_error**2) | torch.tensor([label in whole for label in range(used)])] = 0.0
        worst = int(sums.argmax())
        if not float(sums[worst]) > 0:
            break
        cells = (labels == worst).nonzero()[:, 0]
        seeds = centers[cells][best_candidates(centers[cells], 2, generator)]
        second = cells[nearest_seed(centers[cells], seeds) == 1]
        if len(second) == 0:
            whole.add(worst)
        labels[second] = used
    return labels
