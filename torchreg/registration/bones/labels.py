"""Labels of cells by bones: parts merged from patches, the W-step by graph cuts, label reinitialization."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from torchreg.geometry.rigid import transform_points
from torchreg.geometry.rigid_moments import RigidMoments, rigid_moments
from torchreg.registration.bones.correspondences import Correspondences
from torchreg.registration.bones.rigid_parts import grid_patches, merge_rigid
from torchreg.registration.bones.sparse_grid import SparseGrid
from torchreg.solvers.graph_cut import alpha_expansion


@dataclass(frozen=True, eq=False)
class CellData:
    """A grid of C cells, and sample points (n, 3) of the surface in it, before they are moved."""

    # Patches for each bone, which may then begin and end nearly anywhere.
    PER_BONE: ClassVar[int] = 10

    grid: SparseGrid
    points: Tensor
    num_patches: int = 100  # of the cells, about, from which parts are merged
    linked: bool = False  # whether labels of separate regions should agree with those of the cells nearest to them
    gap: float = 3.0  # most empty cells between regions that count as connected: holes of scans cut limbs in two

    @cached_property
    def cell(self) -> Tensor:
        """The cell (n,) of each sample."""
        return self.grid.locate(self.points).cell

    @cached_property
    def neighbors(self) -> Tensor:
        """Pairs (A, 2) of cells whose labels should agree."""
        touching = self.grid.neighbors()
        return torch.cat([touching, self.grid.links()]) if self.linked else touching

    @cached_property
    def bridged(self) -> Tensor:
        """Pairs (A, 2) of neighboring cells, also across gaps."""
        return self.grid.neighbors(self.gap)

    @cached_property
    def patches(self) -> Tensor:
        """The patch (C,) of each cell."""
        return grid_patches(self.grid, self.num_patches, self.gap)

    @cached_property
    def patch_count(self) -> int:
        """Number of patches."""
        return int(self.patches.max()) + 1

    def per_cell(self, weights: Tensor) -> float:
        """Return the factor from a sum of squares with weights (F, n) to their mean per cell, in squared cells."""
        return self.grid.num_cells / float(weights.sum().clamp_min(1e-300)) / self.grid.spacing**2

    def moments(self, moved: Tensor, weights: Tensor) -> RigidMoments:
        """Return the moments of the patches, for moved samples (F, n, 3) with weights (F, n)."""
        return rigid_moments(self.points, moved, weights, self.patches[self.cell], self.patch_count)


@dataclass(frozen=True)
class LabelCosts:
    """Costs of the W-step in addition to the squared residuals, which are a mean per cell, in squared cells."""

    smoothness: float  # mu, of two neighboring cells with different labels
    label: float  # of each label in use: the number of bones is a cap, not a goal
    truncation: float = math.inf  # largest distance of a sample, in cells; the paper's
    # nu, of neighboring cells with different labels, per cell of the gap, up to one, that their motions open
    seam: float = 0.0


def labels_of_parts(data: CellData, points: Tensor, parts: Tensor) -> Tensor:
    """Return the part (C,) that most of the points (N, 3) in each patch of cells belong to; parts (N,) from zero."""
    patch = data.patches[data.grid.locate(points).cell]
    votes = torch.zeros(data.patch_count, int(parts.max()) + 1, dtype=torch.int64, device=parts.device)
    votes.index_put_((patch, parts), torch.ones_like(parts), accumulate=True)
    return votes.argmax(1)[data.patches].unique(return_inverse=True)[1]


def first_labels(data: CellData, moved: Tensor, weights: Tensor, num_bones: int, costs: LabelCosts) -> Tensor:
    """Return labels (C,) of at most ``num_bones`` parts that move rigidly, in all frames of moved samples (F, n, 3)."""
    moments, patches = data.moments(moved, weights), data.patches
    part = merge_rigid(moments, patches[data.bridged], num_bones, tolerance=costs.label / data.per_cell(weights))
    if int(part.max()) >= num_bones:
        # Of regions that touch nothing, those that move most alike become one part.
        joined = moments.joined(part, int(part.max()) + 1)
        pairs = torch.combinations(torch.arange(joined.num_groups, device=part.device))
        part = merge_rigid(joined, pairs, num_bones)[part]
    return part[patches]


def relabel(
    data: CellData, correspondences: Correspondences, transforms: Tensor, labels: Tensor, costs: LabelCosts
) -> tuple[Tensor, float]:
    """Return labels (C,) of least energy, and the energy: the W-step.

    ``sum_C W(C, f_C) + sum_{(C, D)} (mu [f_C != f_D] + nu min(|T_{f_C} x_CD - T_{f_D} x_CD|, 1)) + h |used labels|``
    with W the squared residuals of the cell's samples under the motion of a bone, in all frames, and x_CD midway
    between two cells. Unlike in the paper, the pairwise term is the discontinuity of the deformation across the border,
    which thus passes through the joint; it is truncated, as not all parts that touch are joined (Chang and Zwicker
    2009, eq. 11; Delong et al. 2012 for the costs of labels).
    """
    size, grid = transforms.shape[-3], data.grid
    squares = correspondences.squared_residuals(transform_points(transforms, data.points))
    weights = data.per_cell(correspondences.weights) * correspondences.weights
    per_sample = (weights.unsqueeze(1) * squares.clamp(max=(costs.truncation * grid.spacing) ** 2)).sum(0)
    unary = squares.new_zeros(grid.num_cells, size).index_add(0, data.cell, per_sample.mT)
    count = len(data.neighbors)
    found = alpha_expansion(
        unary,
        data.neighbors,
        unary.new_full((count,), costs.smoothness),
        positions=_seam_positions(data, transforms),
        position_weights=unary.new_full((count,), costs.seam),
        label_costs=unary.new_full((size,), costs.label),
        initial=labels,
        # The rounds of labels and motions repeat it.
        max_sweeps=1,
    )
    return found.labels, found.energy


def _seam_positions(data: CellData, transforms: Tensor) -> Tensor:
    """Return images (A, B, 3 F) of the middles between neighboring cells under motions (F, B, 4, 4), in cells."""
    middles = data.grid.cell_centers()[data.neighbors].mean(1)
    images = transform_points(transforms, middles) / (data.grid.spacing * len(transforms) ** 0.5)
    return images.permute(2, 1, 0, 3).flatten(2)
