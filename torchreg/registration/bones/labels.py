"""Which bone each cell of a grid follows: parts merged from patches, the W-step by graph cuts, labels used again."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchreg.geometry.rigid import transform_points
from torchreg.geometry.rigid_moments import RigidMoments, rigid_moments
from torchreg.registration.bones.grid_patches import grid_patches
from torchreg.registration.bones.rigid_parts import merge_rigid
from torchreg.registration.bones.sparse_grid import SparseGrid
from torchreg.solvers.graph_cut import alpha_expansion

# Pieces of a scan that come this near, in cells, belong together: holes of scans cut limbs in two.
_GAP = 3.0
# Rounds of labels and motions take turns anyway.
_MAX_SWEEPS = 1


@dataclass(frozen=True, eq=False)
class CellData:
    """A grid, and sample points of the surface in it.

    Args:
        grid: the grid, C cells.
        points: (n, 3) samples before they are moved.
        num_patches: about how many patches the cells make, from which parts are merged.
        linked: whether labels of what is cut off should agree with those of the cells nearest to it.
    """

    grid: SparseGrid
    points: Tensor
    num_patches: int = 100
    linked: bool = False

    @cached_property
    def cell(self) -> Tensor:
        """The cell (n,) of each sample."""
        return self.grid.locate(self.points).cell

    @cached_property
    def neighbors(self) -> Tensor:
        """Pairs (A, 2) of cells whose labels should agree."""
        beside = self.grid.neighbors()
        return torch.cat([beside, self.grid.links()]) if self.linked else beside

    @cached_property
    def bridged(self) -> Tensor:
        """Pairs (A, 2) of cells, also across small gaps."""
        return self.grid.neighbors(_GAP)

    @cached_property
    def patches(self) -> Tensor:
        """The patch (C,) of each cell."""
        return grid_patches(self.grid, self.num_patches, _GAP)

    def scale(self, weights: Tensor) -> float:
        """Return what makes a mean per cell, in squared cells, of a sum of squares with weights (F, n)."""
        return self.grid.num_cells / float(weights.sum().clamp_min(1e-300)) / self.grid.spacing**2

    def moments(self, moved: Tensor, weights: Tensor) -> RigidMoments:
        """Return the moments of the patches, for moved samples (F, n, 3) with weights (F, n)."""
        return rigid_moments(self.points, moved, weights, self.patches[self.cell], int(self.patches.max()) + 1)


@dataclass(frozen=True)
class LabelCosts:
    """What the W-step weighs against the distance of samples, which is a mean per cell, in squared cells.

    Args:
        smoothness: mu, of two neighboring cells with different labels.
        label: of each label in use: the number of bones is a cap, not a goal.
        truncation: no sample is farther off than this, in cells.
        seam: of two neighboring cells with different labels, per cell by which these take the side between them apart,
        seam_cap: up to this many cells.
    """

    smoothness: float
    label: float
    truncation: float
    seam: float = 0.0
    seam_cap: float = 0.5


@dataclass(frozen=True)
class Pull:
    """Where samples should go in each of F frames.

    Args:
        targets: (F, n, 3).
        normals: (F, n, 3) unit normals there, or None: distances to the targets count alone.
        weights: (F, n) not negative.
        point_to_point: share of the distance to the targets in that along the normals, see `ScanDistance`.
    """

    targets: Tensor
    normals: Tensor | None
    weights: Tensor
    point_to_point: float = 1.0

    def squares(self, places: Tensor) -> Tensor:
        """Return the squared distances (F, ..., n) of places (F, ..., n, 3) by which a fit is judged."""
        lead = places.ndim - self.targets.ndim
        off = places - self.targets.reshape(len(self.targets), *(1,) * lead, -1, 3)
        square = off.square().sum(-1)
        if self.normals is None:
            return square
        along = (off * self.normals.reshape(len(self.normals), *(1,) * lead, -1, 3)).sum(-1).square()
        return (1 - self.point_to_point) * along + self.point_to_point * square


def labels_of_parts(data: CellData, points: Tensor, parts: Tensor) -> Tensor:
    """Return the part (C,) that most of the points (N, 3) in each patch of cells belong to; parts (N,) from zero."""
    patch = data.patches[data.grid.locate(points).cell]
    votes = torch.zeros(int(data.patches.max()) + 1, int(parts.max()) + 1, dtype=torch.int64, device=parts.device)
    votes.index_put_((patch, parts), torch.ones_like(parts), accumulate=True)
    return votes.argmax(1)[data.patches].unique(return_inverse=True)[1]


def first_labels(data: CellData, moved: Tensor, weights: Tensor, num_bones: int, costs: LabelCosts) -> Tensor:
    """Return labels (C,) of at most ``num_bones`` parts that move rigidly, in all frames.

    Unlike the paper's random segmentation this one follows the motion: patches that move together belong together.

    Args:
        data: the grid and its samples.
        moved: (F, n, 3) where the samples go.
        weights: (F, n) how far that can be trusted.
        num_bones: most parts; fewer where a part saves less than a label costs.
        costs: see `LabelCosts`.
    """
    moments, patches = data.moments(moved, weights), data.patches
    part = merge_rigid(moments, patches[data.bridged], num_bones, tolerance=costs.label / data.scale(weights))
    if int(part.max()) >= num_bones:
        # Regions that touch nothing: what moves most alike is one part all the same.
        joined = moments.joined(part, int(part.max()) + 1)
        pairs = torch.combinations(torch.arange(joined.num_groups, device=part.device))
        part = merge_rigid(joined, pairs, num_bones)[part]
    return part[patches]


def relabel(data: CellData, pull: Pull, transforms: Tensor, labels: Tensor, costs: LabelCosts) -> tuple[Tensor, float]:
    """Return labels (C,) of least distance, smooth and few: the W-step; and the energy.

    ``sum_C W(C, f_C) + sum_{(C, D)} (mu [f_C != f_D] + nu min(|T_{f_C} x_CD - T_{f_D} x_CD|, cap)) + h |used labels|``
    with W the sum of truncated squared distances of the cell's samples under the motion of a bone, in all frames, and
    x_CD in the middle between two cells; correspondences stay while labels change. Near a joint both bones move a
    sample alike, so that distances alone cut anywhere there: unlike in the paper, a cut where two bones would tear the
    surface apart costs more, so that it passes through the joint. Where parts touch that are not joined this is capped.

    Args:
        data: the grid and its samples.
        pull: where samples should go.
        transforms: (F, B, 4, 4) motions of the bones.
        labels: (C,) to start from.
        costs: see `LabelCosts`.

    References: Chang and Zwicker 2009, eq. 11; Delong et al. 2012 for the costs of labels.
    """
    size, grid = transforms.shape[-3], data.grid
    squares = pull.squares(transform_points(transforms, data.points))
    share = data.scale(pull.weights) * pull.weights
    per_sample = (share.unsqueeze(1) * squares.clamp(max=(costs.truncation * grid.spacing) ** 2)).sum(0)
    unary = squares.new_zeros(grid.num_cells, size).index_add(0, data.cell, per_sample.mT)
    count = len(data.neighbors)
    found = alpha_expansion(
        unary,
        data.neighbors,
        unary.new_full((count,), costs.smoothness),
        positions=_seam_places(data, transforms, costs.seam_cap),
        position_weights=unary.new_full((count,), costs.seam * costs.seam_cap),
        label_costs=unary.new_full((size,), costs.label),
        initial=labels,
        max_sweeps=_MAX_SWEEPS,
    )
    return found.labels, found.energy


def _seam_places(data: CellData, transforms: Tensor, cap: float) -> Tensor:
    """Return where motions (F, B, 4, 4) take the middles between neighboring cells, (A, B, 3 F), in caps.

    Distances between them are root mean squares over the frames.
    """
    middles = data.grid.cell_centers()[data.neighbors].mean(1)
    places = transform_points(transforms, middles) / (cap * data.grid.spacing * len(transforms) ** 0.5)
    return places.permute(2, 1, 0, 3).flatten(2)


def reuse_labels(data: CellData, pull: Pull, labels: Tensor, num_bones: int, costs: LabelCosts) -> Tensor:
    """Return labels (C,) in which bones that lost all their cells take over half of the regions that fit worst.

    The region is split where two motions fit best, not at random as in the paper, if it saves more than a label costs.

    Args:
        data: the grid and its samples.
        pull: where samples should go.
        labels: (C,) from 0 without gaps.
        num_bones: most labels.
        costs: see `LabelCosts`.

    References: Chang and Zwicker 2009, section 4.2, "Reusing Labels".
    """
    labels, used = labels.clone(), int(labels.max()) + 1
    if used >= num_bones:
        return labels
    scale = data.scale(pull.weights)
    whole = rigid_moments(data.points, pull.targets, pull.weights, labels[data.cell], used).cost().sum(0)
    splits = []
    # No split saves more than all that a region costs.
    for label in (whole * scale > costs.label).nonzero()[:, 0].tolist():
        gain, other = _split(data, pull, labels == label)
        if gain * scale > costs.label:
            splits.append((gain, label, other))
    splits.sort(key=lambda split: (-split[0], split[1]))
    for number, (_, _, other) in enumerate(splits[: num_bones - used]):
        labels[other] = used + number
    return labels


def _split(data: CellData, pull: Pull, inside: Tensor) -> tuple[float, Tensor]:
    """Return what two motions save in a region of cells (C,) bool, and which of them follow the second."""
    number = data.patches[inside].unique()
    sampled = inside[data.cell]
    if len(number) < 2 or not bool(sampled.any()):
        return 0.0, inside & ~inside
    local = torch.full((int(data.patches.max()) + 1,), 0, device=inside.device)
    local[number] = torch.arange(len(number), device=inside.device)
    groups = local[data.patches[data.cell[sampled]]]
    moments = rigid_moments(
        data.points[sampled], pull.targets[:, sampled], pull.weights[:, sampled], groups, len(number)
    )
    pairs = data.bridged[inside[data.bridged].all(1)]
    part = merge_rigid(moments, local[data.patches[pairs]], 2)
    whole = float(moments.joined(torch.zeros_like(part), 1).cost().sum())
    gain = whole - float(moments.joined(part.clamp(max=1), 2).cost().sum())
    return gain, inside & (part.clamp(max=1)[local[data.patches]] == 1)
