"""Smooth weights from labels, the bones' motions given: the last step of scan registration."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_choice, check_count, check_finite, check_positive, check_same_kind, check_shape
from torchreg.errors import InputError
from torchreg.geometry.rigid import transform_points
from torchreg.registration.bones.distance_loss import check_share
from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.registration.bones.grid_losses import WeightCloseness, WeightNormalization, WeightSmoothness
from torchreg.registration.bones.sparse_grid import SparseGrid
from torchreg.solvers.nnls import nnls
from torchreg.solvers.projected_gradient import projected_gradient

METHODS = ("active_set", "gradient")


@dataclass(frozen=True)
class RefineConfig:
    """How much each term of the refinement counts.

    Args:
        distance: of the mean squared distance of matches, in cells and per cell of the grid.
        smoothness: mu, of the differences between neighboring corners.
        normalization: nu, of the sums that differ from one.
        closeness: of the differences from the labels.
        reach: a bone may get weight at corners up to that many edges from where it has a label.
        point_to_point: share of the point-to-point distance, see `ScanDistance`.
        method: "active_set", see `nnls`, or "gradient", see `projected_gradient`: both lead to the same weights.
        max_steps: of the method; 50 rounds or 2,000 gradient steps by default.

    References: Chang and Zwicker 2009, section 5, for the values in cells: mu 0.5 to 1, nu 1, closeness 0.1 to 0.5.
    """

    distance: float = 1.0
    smoothness: float = 0.5
    normalization: float = 1.0
    closeness: float = 0.2
    reach: int = 3
    point_to_point: float = 0.0
    method: str = "active_set"
    max_steps: int | None = None

    def __post_init__(self) -> None:
        for name in ("distance", "smoothness"):
            check_positive(getattr(self, name), name, allow_zero=True)
        # With these two there is one solution, whatever the matches say.
        check_positive(self.normalization, "normalization")
        check_positive(self.closeness, "closeness")
        check_count(self.reach, "reach", 0)
        check_share(self.point_to_point, "point_to_point")
        check_choice(self.method, "method", METHODS)
        if self.max_steps is not None:
            check_count(self.max_steps, "max_steps", 1)


@dataclass(frozen=True)
class RefinedWeights:
    """Weights that a refinement found.

    Args:
        weights: (K, B) rows divided by their sums.
        objective: least value found, before that division.
        start_objective: at the labels' weights.
        num_steps: of the method.
        converged: whether the method met its tolerance.
    """

    weights: Tensor
    objective: float
    start_objective: float
    num_steps: int
    converged: bool


@torch.no_grad()
def refine_weights(
    model: GridLBS,
    points: Tensor,
    targets: Tensor,
    normals: Tensor | None = None,
    match_weights: Tensor | None = None,
    *,
    config: RefineConfig | None = None,
) -> RefinedWeights:
    """Return weights that fit matches, vary smoothly, add up to one and stay near the labels.

    ``argmin_{v >= 0} a E_dist + mu E_smooth + nu E_norm + lambda E_disc`` over the corners times the bones in reach,
    the motions fixed. The distance of a match is that of ``sum_j w_j (T_j x - y)``: the same as of the moved point
    where weights add up to one, and where they do not, independent of the origin.

    Args:
        model: the bones' motions, and the labels' weights, see `GridLBS.from_labels`; it is not changed. A batch of
            poses counts together.
        points: (N, 3) before they are moved.
        targets: (..., N, 3) what each is matched with, in every pose.
        normals: (..., N, 3) unit normals at the targets; not needed where only point to point counts.
        match_weights: (..., N) not negative, zero for dropped matches; ones by default.
        config: see `RefineConfig`.

    Returns:
        `RefinedWeights`.

    Raises:
        InputError: if a shape does not fit or normals are missing.
        InputTypeError: if dtypes or devices differ.
        SolverError: if the system cannot be solved.

    Differentiable: no.

    Cost: 0.15 s for 1,000 cells, 10 bones and 1,500 matches by the active set, three times that by gradients.

    References: Chang and Zwicker 2009, eqs. 8 and 13.
    """
    config = RefineConfig() if config is None else config
    problem = _Problem(model, points, targets, normals, match_weights, config)
    if config.method == "active_set":
        solved = nnls(*problem.least_squares(), start=problem.start, max_steps=config.max_steps or 50, tol=1e-6)
        x, steps, converged = solved.x, solved.num_steps, solved.converged
    else:
        matrix = problem.least_squares()[0]
        curvature = torch.sparse.sum(matrix * matrix, dim=0).to_dense()
        found = projected_gradient(
            problem.cost, problem.start, scale=1 / curvature, max_steps=config.max_steps or 2000, tol=1e-5
        )
        x, steps, converged = found.x, found.num_steps, bool(found.converged)
    weights, labels = problem.spread(x), problem.labels
    total = weights.sum(-1, keepdim=True)
    weights = torch.where(total > 0, weights / total.clamp_min(1e-30), labels)
    return RefinedWeights(
        weights.to(model.weights), float(problem.cost(x)), float(problem.cost(problem.start)), steps, converged
    )


class _Problem:
    """The refinement as a function of the weights in reach, in cells of the grid and double precision."""

    def __init__(
        self,
        model: GridLBS,
        points: Tensor,
        targets: Tensor,
        normals: Tensor | None,
        match_weights: Tensor | None,
        config: RefineConfig,
    ) -> None:
        _check(model, points, targets, normals, match_weights, config)
        grid = model.grid
        self.config, self.edges = config, grid.edges()
        self.labels = model.corner_weights().double()
        self.corner, self.bone = _in_reach(self.labels > 0, self.edges, config.reach).nonzero().unbind(-1)
        self.start = self.labels[self.corner, self.bone]
        self._number = torch.full(self.labels.shape, -1, device=points.device)
        self._number[self.corner, self.bone] = torch.arange(len(self.corner), device=points.device)
        place = grid.locate(points)
        self._place = grid.cell_corners[place.cell], place.coefficients.double()
        moved = transform_points(model.transforms.detach(), points.unsqueeze(-3)).double().transpose(-2, -3)
        off = (moved - targets.unsqueeze(-2)) / grid.spacing
        measured = self._measured(off, normals, match_weights, grid)
        self._off = measured.reshape(-1, *measured.shape[-3:])

    def _measured(self, off: Tensor, normals: Tensor | None, match_weights: Tensor | None, grid: SparseGrid) -> Tensor:
        """Return offsets (..., N, B, m), of which the squared sums are each bone's share of the distance term."""
        share = self.config.point_to_point
        weights = torch.ones_like(off[..., 0, 0]) if match_weights is None else match_weights.double()
        weights = weights.expand(off.shape[:-2])
        root = (self.config.distance * grid.num_cells * weights / weights.sum().clamp_min(1e-300)).sqrt()[
            ..., None, None
        ]
        off = torch.where(root > 0, off, 0.0)
        parts = [] if share == 0 else [share**0.5 * off]
        if normals is not None and share < 1:
            along = (off * torch.where(root > 0, normals.double().unsqueeze(-2), 0.0)).sum(-1, keepdim=True)
            parts.append((1 - share) ** 0.5 * along)
        return root * torch.cat(parts, dim=-1)

    def spread(self, x: Tensor) -> Tensor:
        """Return weights (K, B) of the values in reach."""
        return torch.zeros_like(self.labels).index_put((self.corner, self.bone), x)

    def cost(self, x: Tensor) -> Tensor:
        """Return the objective, from the losses."""
        weights, config = self.spread(x), self.config
        corners, coefficients = self._place
        at_points = (coefficients.unsqueeze(-1) * weights[corners]).sum(-2)
        distance = (at_points.unsqueeze(-1) * self._off).sum(-2).square().sum()
        smooth = config.smoothness * WeightSmoothness()(weights, self.edges)
        normal = config.normalization * WeightNormalization()(weights)
        return distance + smooth + normal + config.closeness * WeightCloseness()(weights, self.labels)

    def least_squares(self) -> tuple[Tensor, Tensor]:
        """Return sparse A and b with the objective ``|A x - b|^2``."""
        count = len(self.corner)
        variables = torch.arange(count, device=self.corner.device)
        config = self.config
        blocks = [
            (*self._distance_rows(), None),
            (*self._smoothness_rows(), None),
            (self.corner, variables, torch.full_like(self.start, config.normalization**0.5), "sums"),
            (variables, variables, torch.full_like(self.start, config.closeness**0.5), "labels"),
        ]
        right = {
            "sums": torch.full_like(self.labels[:, 0], config.normalization**0.5),
            "labels": config.closeness**0.5 * self.start,
        }
        indices, values, targets, rows = [], [], [], 0
        for row, column, value, name in blocks:
            target = value.new_zeros(int(row.max()) + 1 if len(row) else 0) if name is None else right[name]
            indices.append(torch.stack([row + rows, column]))
            values.append(value)
            targets.append(target)
            rows += len(target)
        matrix = torch.sparse_coo_tensor(
            torch.cat(indices, dim=1), torch.cat(values), (rows, count), check_invariants=False
        )
        return matrix.coalesce(), torch.cat(targets)

    def _distance_rows(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return row, variable and value of the entries of the distance term."""
        corners, coefficients = self._place
        number = self._number[corners]
        point, slot, bone = (number >= 0).nonzero().unbind(-1)
        poses, points, _, parts = self._off.shape
        value = coefficients[point, slot].unsqueeze(-1) * self._off[:, point, bone]
        pose = torch.arange(poses, device=point.device).view(-1, 1, 1)
        row = (pose * points + point.unsqueeze(-1)) * parts + torch.arange(parts, device=point.device)
        variable = number[point, slot, bone].view(1, -1, 1).expand(row.shape)
        some = value != 0
        return row[some], variable[some], value[some]

    def _smoothness_rows(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return row, variable and value of the differences along edges, of all bones in reach of either end."""
        ends = self._number[self.edges]
        edge, bone = (ends >= 0).any(1).nonzero().unbind(-1)
        variable = ends[edge, :, bone]
        row = torch.arange(len(edge), device=edge.device).unsqueeze(-1).expand(variable.shape)
        sign = torch.tensor([1.0, -1.0], dtype=torch.float64, device=edge.device).expand(variable.shape)
        some = variable >= 0
        return row[some], variable[some], self.config.smoothness**0.5 * sign[some]


def _in_reach(present: Tensor, edges: Tensor, steps: int) -> Tensor:
    """Return a mask (K, B) grown along the edges."""
    for _ in range(steps):
        either = present[edges].any(1).to(torch.uint8)
        count = present.to(torch.uint8).index_add(0, edges[:, 0], either).index_add(0, edges[:, 1], either)
        present = count > 0
    return present


def _check(
    model: GridLBS,
    points: Tensor,
    targets: Tensor,
    normals: Tensor | None,
    match_weights: Tensor | None,
    config: RefineConfig,
) -> None:
    check_shape(points, "points", ("N", 3))
    check_same_kind(points, "points", model.weights, "the model")
    check_finite(points, "points")
    shape = (*model.base_transforms.shape[:-3], len(points), 3)
    check_shape(targets, "targets", shape)
    check_same_kind(targets, "targets", points, "points")
    if normals is not None:
        check_shape(normals, "normals", shape)
    elif config.point_to_point < 1:
        raise InputError("normals are needed for point to plane; pass them, or set point_to_point=1 in the config")
    if match_weights is not None:
        check_shape(match_weights, "match_weights", shape[:-1])
