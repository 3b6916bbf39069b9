"""Smooth weights from labels, the bones' motions given: the last step of scan registration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchreg._checks import check_count, check_positive
from torchreg.geometry.rigid import transform_points
from torchreg.registration.bones.correspondences import Correspondences
from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.registration.bones.grid_losses import closeness_energy, normalization_energy, smoothness_energy
from torchreg.solvers.nnls import nnls


@dataclass(frozen=True)
class WeightsConfig:
    """Weights of the terms of the refinement against the mean squared residual, in cells, per cell of the grid.

    The paper's values in cells: mu 0.5 to 1, nu 1, closeness 0.1 to 0.5 (Chang and Zwicker 2009, section 5).

    Args:
        smoothness: mu, of the squared differences between neighboring corners.
        normalization: nu, of the squared deviations of the sums from one.
        closeness: of the squared differences from the labels.
        reach: a bone may get weight at corners up to that many edges from where it has a label.
    """

    smoothness: float = 0.5
    normalization: float = 1.0
    closeness: float = 0.2
    reach: int = 3

    def __post_init__(self) -> None:
        check_positive(self.smoothness, "smoothness", allow_zero=True)
        # With these two there is one solution, whatever the matches say.
        check_positive(self.normalization, "normalization")
        check_positive(self.closeness, "closeness")
        check_count(self.reach, "reach", 0)


@dataclass(frozen=True)
class RefinedWeights:
    """Weights (K, B), rows divided by their sums, the least objective before that, and whether the solver converged."""

    weights: Tensor
    objective: float
    converged: bool


@torch.no_grad()
def refine_weights(
    model: GridLBS, points: Tensor, correspondences: Correspondences, config: WeightsConfig | None = None
) -> RefinedWeights:
    """Return weights that fit correspondences, vary smoothly, add up to one and stay near the labels (eqs. 8 and 13).

    ``argmin_{v >= 0} a E_dist + mu E_smooth + nu E_norm + lambda E_disc`` over the corners times the bones in reach,
    the motions fixed, all poses together. The residual is that of ``sum_j w_j (T_j x - y)``, independent of the origin.
    """
    config = WeightsConfig() if config is None else config
    problem = _WeightsProblem(model, points, correspondences, config)
    solved = nnls(*problem.least_squares(), start=problem.start)
    weights = problem.corner_weights(solved.x)
    total = weights.sum(-1, keepdim=True)
    weights = torch.where(total > 0, weights / total.clamp_min(1e-30), problem.labels)
    return RefinedWeights(weights.to(model.weights), float(problem.cost(solved.x)), solved.converged)


class _Rows(NamedTuple):
    """Entries of some rows of a sparse least-squares problem, and the right sides of the rows."""

    row: Tensor
    column: Tensor
    value: Tensor
    right: Tensor


class _WeightsProblem:
    """The refinement as a function of the V weights in reach, in cells of the grid and double precision."""

    def __init__(self, model: GridLBS, points: Tensor, correspondences: Correspondences, config: WeightsConfig) -> None:
        grid = model.grid
        self._config, self._edges = config, grid.edges()
        self.labels = model.corner_weights().double()
        self._corner, self._bone = _in_reach(self.labels > 0, self._edges, config.reach).nonzero().unbind(-1)
        self.start = self.labels[self._corner, self._bone]
        self._variables = torch.arange(len(self._corner), device=points.device)
        # Of corners and bones (K, B), -1 out of reach.
        self._variable = torch.full(self.labels.shape, -1, device=points.device)
        self._variable[self._corner, self._bone] = self._variables
        location = grid.locate(points)
        self._corners, self._coefficients = grid.cell_corners[location.cell], location.coefficients.double()
        moved = transform_points(model.transforms.detach(), points.unsqueeze(-3)).double().transpose(-2, -3)
        offsets = (moved - correspondences.targets.unsqueeze(-2)) / grid.spacing
        residuals = _weighted_residuals(offsets, correspondences, float(grid.num_cells))
        self._residuals = residuals.reshape(-1, *residuals.shape[-3:])

    def corner_weights(self, x: Tensor) -> Tensor:
        """Return weights (K, B) of the variables (V,)."""
        return torch.zeros_like(self.labels).index_put((self._corner, self._bone), x)

    def cost(self, x: Tensor) -> Tensor:
        """Return the objective, from the losses."""
        weights, config = self.corner_weights(x), self._config
        at_points = (self._coefficients.unsqueeze(-1) * weights[self._corners]).sum(-2)
        distance = (at_points.unsqueeze(-1) * self._residuals).sum(-2).square().sum()
        smooth = config.smoothness * smoothness_energy(weights, self._edges)
        normal = config.normalization * normalization_energy(weights)
        return distance + smooth + normal + config.closeness * closeness_energy(weights, self.labels)

    def least_squares(self) -> tuple[Tensor, Tensor]:
        """Return sparse A and b with the objective ``|A x - b|^2``."""
        terms = (self._distance(), self._smoothness(), self._normalization(), self._closeness())
        indices, num_rows = [], 0
        for term in terms:
            indices.append(torch.stack([term.row + num_rows, term.column]))
            num_rows += len(term.right)
        values, size = torch.cat([term.value for term in terms]), (num_rows, len(self.start))
        matrix = torch.sparse_coo_tensor(torch.cat(indices, dim=1), values, size, check_invariants=False)
        return matrix.coalesce(), torch.cat([term.right for term in terms])

    def _distance(self) -> _Rows:
        variable = self._variable[self._corners]
        point, slot, bone = (variable >= 0).nonzero().unbind(-1)
        poses, points, _, parts = self._residuals.shape
        value = self._coefficients[point, slot].unsqueeze(-1) * self._residuals[:, point, bone]
        pose = torch.arange(poses, device=point.device).view(-1, 1, 1)
        row = (pose * points + point.unsqueeze(-1)) * parts + torch.arange(parts, device=point.device)
        column = variable[point, slot, bone].view(1, -1, 1).expand(row.shape)
        return _homogeneous(row, column, value, value != 0)

    def _smoothness(self) -> _Rows:
        """Differences along edges, of all bones in reach of either end."""
        ends = self._variable[self._edges]
        edge, bone = (ends >= 0).any(1).nonzero().unbind(-1)
        column = ends[edge, :, bone]
        row = torch.arange(len(edge), device=edge.device).unsqueeze(-1).expand(column.shape)
        sign = torch.tensor([1.0, -1.0], dtype=torch.float64, device=edge.device).expand(column.shape)
        return _homogeneous(row, column, self._config.smoothness**0.5 * sign, column >= 0)

    def _normalization(self) -> _Rows:
        root = self._config.normalization**0.5
        right = torch.full_like(self.labels[:, 0], root)
        return _Rows(self._corner, self._variables, torch.full_like(self.start, root), right)

    def _closeness(self) -> _Rows:
        root = self._config.closeness**0.5
        return _Rows(self._variables, self._variables, torch.full_like(self.start, root), root * self.start)


def _homogeneous(row: Tensor, column: Tensor, value: Tensor, kept: Tensor) -> _Rows:
    """Return the entries that a mask keeps, of rows whose right sides are zero."""
    row, column, value = row[kept], column[kept], value[kept]
    return _Rows(row, column, value, value.new_zeros(int(row.max()) + 1 if len(row) else 0))


def _weighted_residuals(offsets: Tensor, correspondences: Correspondences, scale: float) -> Tensor:
    """Return residuals (..., N, B, m) of which the squared sums are `squared_residuals`, weighted."""
    share, normals = correspondences.point_to_point, correspondences.normals
    weights = correspondences.weights.double().expand(offsets.shape[:-2])
    root = (scale * weights / weights.sum().clamp_min(1e-300)).sqrt()[..., None, None]
    offsets = torch.where(root > 0, offsets, 0.0)
    parts = [] if share == 0 else [share**0.5 * offsets]
    if normals is not None and share < 1:
        along = (offsets * torch.where(root > 0, normals.double().unsqueeze(-2), 0.0)).sum(-1, keepdim=True)
        parts.append((1 - share) ** 0.5 * along)
    return root * torch.cat(parts, dim=-1)


def _in_reach(present: Tensor, edges: Tensor, steps: int) -> Tensor:
    """Return a mask (K, B) grown along the edges."""
    for _ in range(steps):
        either = present[edges].any(1).to(torch.uint8)
        count = present.to(torch.uint8).index_add(0, edges[:, 0], either).index_add(0, edges[:, 1], either)
        present = count > 0
    return present
