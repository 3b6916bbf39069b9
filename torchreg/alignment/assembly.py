"""The result of an alignment: how data lie on the shape, what speaks against the pose, and its status."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchreg.alignment.evidence.reliability import CALIBRATION, SurfaceError, judge
from torchreg.alignment.fit.annealed_em import outlier_level
from torchreg.alignment.fit.problem import INLIER_SHARE, alignment_cost
from torchreg.alignment.inputs import warn_about_degenerate
from torchreg.alignment.results import AlignResult
from torchreg.alignment.search.multi_start import mean_distances
from torchreg.geometry.budget import BUDGET
from torchreg.result import Status
from torchreg.shapes.pose_algebra import shifted
from torchreg.solvers.e_step import expectation

if TYPE_CHECKING:
    from torchreg.alignment.pose_rows import PoseRows


@dataclass(frozen=True)
class _Limits:
    """When a pose means nothing."""

    min_inliers: int = 10  # with fewer
    min_share: float = 0.02  # the same, as a share of the data


_LIMITS = _Limits()


@dataclass(frozen=True, eq=False)
class DataOnShape:
    """How data lie on a shape, (B, M) each, see `AlignResult`."""

    distances: Tensor
    inliers: Tensor
    posterior: Tensor

    @classmethod
    def of(cls, rows: PoseRows, data: Tensor, valid: Tensor) -> DataOnShape:
        """Return how data (B, M, 3), in the coordinates of the problem, lie on the shape found."""
        problem, found = rows.problem, rows.found
        posed = problem.skin(found.pose)
        outlier = outlier_level(problem, posed, found.sigma)
        distances = torch.where(valid, problem.surface.distance(data, found.pose), torch.nan)
        return cls(
            distances=distances,
            inliers=distances.abs() < (rows.task.config.inlier_distance or INLIER_SHARE * problem.size),
            posterior=expectation(posed, data, found.sigma, outlier, mask=valid).inlier_posterior,
        )

    @classmethod
    def of_all(cls, rows: PoseRows, clouds: Tensor, valid: Tensor) -> DataOnShape:
        """Return the same for whole clouds ((B,) M, 3), in the world, of which the problem's data are a draw."""
        count = len(rows.found.pose)
        clouds, valid = clouds.expand(count, *clouds.shape[-2:]), valid.expand(count, valid.shape[-1])
        size, parts = max(1, BUDGET.field_points // count), []
        for points, chosen in zip(clouds.split(size, 1), valid.split(size, 1), strict=True):
            local = torch.where(chosen.unsqueeze(-1), points - rows.origin.unsqueeze(1), 0.0)
            parts.append(cls.of(rows, local, chosen))
        return cls(*(torch.cat([getattr(part, item.name) for part in parts], 1) for item in fields(cls)))


def assembled(rows: PoseRows, error: SurfaceError | None = None) -> AlignResult:
    """Return the result of fitted poses, with what speaks against them and their status; ``error`` is a person's."""
    problem, pose, config, seen = rows.problem, rows.found.pose, rows.task.config, rows.task.seen
    rivals = None if rows.rivals is None else _different(rows, rows.rivals)
    fitted = DataOnShape.of(rows, problem.data, problem.valid)
    everything = fitted if seen.everything is None else DataOnShape.of_all(rows, *seen.everything)
    cost = alignment_cost(problem, pose, torch.where(problem.valid, fitted.distances, 0.0))
    inliers, world = fitted.inliers, shifted(pose, rows.origin)
    # What lies off the surface tells nothing of the pose, unless all does.
    told = torch.where(inliers.any(-1, keepdim=True), inliers, problem.valid)
    degenerate = warn_about_degenerate(problem.data, told, problem.size, stacklevel=5)
    judgement = judge(rows.uncropped, pose, rows.lead, error, seen.frames, rivals)
    confidence = torch.where(degenerate, 0.0, judgement.confidence)
    converged = rows.found.change <= config.pose_atol
    converged = converged | judgement.converged if config.surface_steps or error is not None else converged
    states = (inliers.sum(-1), problem.valid.sum(-1), converged, degenerate, confidence)
    result = AlignResult(
        pose=world,
        registered=problem.skin(pose) + rows.origin.unsqueeze(1),
        keypoints=problem.skin.shape.keypoints(world),
        distances=everything.distances,
        inliers=everything.inliers,
        posterior=everything.posterior,
        sigma=rows.found.sigma,
        cost=cost,
        status=tuple(_status(*row) for row in zip(*(row.tolist() for row in states), strict=True)),
        history=tuple(rows.history),
        covariance=judgement.covariance,
        dof_confidence=judgement.dof_confidence,
        confidence=confidence,
        evidence=judgement.evidence.table(),
        doubt=judgement.doubt,
        rivals=rivals,
    )
    return result if rows.batched else _unbatched(result)


def _different(rows: PoseRows, rivals: Tensor) -> Tensor:
    """Return rivals (B, R, num_dofs), NaN where they are as right as the poses (B, num_dofs) found."""
    local = torch.cat([rows.found.pose.unsqueeze(1), shifted(rivals, -rows.origin.unsqueeze(1))], dim=1)
    apart = mean_distances(rows.problem, local)[:, 0, 1:] > CALIBRATION.right * rows.problem.size
    return torch.where(apart.unsqueeze(-1), rivals, torch.nan)


def _status(num_inliers: int, num_data: int, converged: bool, degenerate: bool, confidence: float) -> Status:
    if num_data == 0:
        return Status.NO_DATA
    if degenerate:
        return Status.DEGENERATE
    if num_inliers < max(_LIMITS.min_inliers, _LIMITS.min_share * num_data):
        return Status.FEW_INLIERS
    if confidence < CALIBRATION.doubtful:
        return Status.DOUBTFUL
    return Status.CONVERGED if converged else Status.MAX_STEPS


def _unbatched(result: AlignResult) -> AlignResult:
    """Return the result of the single problem of a batch."""
    first = {
        item.name: getattr(result, item.name)[0]
        for item in fields(result)
        if item.name not in ("history", "origin", "shape") and getattr(result, item.name) is not None
    }
    rivals = first.get("rivals")
    if rivals is not None:
        first["rivals"] = rivals[rivals.isfinite().all(-1)]
    return replace(result, **first)
