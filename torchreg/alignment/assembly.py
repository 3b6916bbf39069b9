"""The result of an alignment: how data lie on the shape, what speaks against the pose, and its status."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from torchreg.alignment.align_stages import AlignBatch, DataOnShape
from torchreg.alignment.config import AlignConfig
from torchreg.alignment.evidence.reliability import CALIBRATION, SurfaceError, judge
from torchreg.alignment.fit.annealed_em import StageResult
from torchreg.alignment.fit.problem import AlignProblem, alignment_cost
from torchreg.alignment.inputs import Observation, warn_about_degenerate
from torchreg.alignment.results import AlignResult
from torchreg.alignment.search.pose_search import mean_distances
from torchreg.result import Status
from torchreg.shapes.pose_algebra import shifted


@dataclass(frozen=True)
class _Limits:
    """When a pose means nothing."""

    min_inliers: int = 10  # with fewer
    min_share: float = 0.02  # the same, as a share of the data


_LIMITS = _Limits()


def assembled(
    batch: AlignBatch,
    found: StageResult,
    config: AlignConfig,
    lead: Tensor | None,
    uncropped: AlignProblem,
    seen: Observation,
    error: SurfaceError | None = None,
    rivals: Tensor | None = None,
) -> AlignResult:
    """Return the result of fitted poses, with what speaks against them and their status."""
    problem, pose = batch.problem, found.pose
    rivals = None if rivals is None else _different(batch, pose, rivals)
    fitted, posed = DataOnShape.of(batch, found, config, problem.data, problem.valid), problem.skin(pose)
    everything = fitted if seen.everything is None else DataOnShape.of_all(batch, found, config, *seen.everything)
    cost = alignment_cost(problem, pose, torch.where(problem.valid, fitted.distances, 0.0))
    inliers = fitted.inliers
    world = shifted(pose, batch.origin)
    # What lies off the surface tells nothing of the pose, unless all does.
    told = torch.where(inliers.any(-1, keepdim=True), inliers, problem.valid)
    degenerate = warn_about_degenerate(problem.data, told, problem.size, stacklevel=3)
    judgement = judge(uncropped, pose, lead, error, seen.frames, rivals)
    confidence = torch.where(degenerate, 0.0, judgement.confidence)
    converged = found.change <= config.pose_atol
    converged = converged | judgement.converged if config.surface_steps or error is not None else converged
    rows = (inliers.sum(-1), problem.valid.sum(-1), converged, degenerate, confidence)
    return AlignResult(
        pose=world,
        registered=posed + batch.origin.unsqueeze(1),
        keypoints=problem.skin.shape.keypoints(world),
        distances=everything.distances,
        inliers=everything.inliers,
        posterior=everything.posterior,
        sigma=found.sigma,
        cost=cost,
        status=tuple(_status(*row) for row in zip(*(row.tolist() for row in rows), strict=True)),
        history=tuple(batch.history),
        covariance=judgement.covariance,
        dof_confidence=judgement.dof_confidence,
        confidence=confidence,
        evidence=judgement.evidence.table(),
        doubt=judgement.doubt,
        rivals=rivals,
    )


def _different(batch: AlignBatch, pose: Tensor, rivals: Tensor) -> Tensor:
    """Return rivals (B, R, num_dofs), NaN where they are as right as the poses (B, num_dofs) found."""
    local = torch.cat([pose.unsqueeze(1), shifted(rivals, -batch.origin.unsqueeze(1))], dim=1)
    apart = mean_distances(batch.problem, local)[:, 0, 1:] > CALIBRATION.right * batch.problem.size
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


def unbatched(result: AlignResult) -> AlignResult:
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
