"""What is reported of a frame, fitted or not, and of a sequence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchreg.alignment.evidence.curvature import dof_confidence
from torchreg.alignment.evidence.reliability import CALIBRATION, SHAPE_CALIBRATION
from torchreg.alignment.fit.annealed_em import outlier_level
from torchreg.geometry.neighbors import nearest_neighbor
from torchreg.result import Status
from torchreg.shapes.skin import bending_weights
from torchreg.solvers.e_step import expectation
from torchreg.tracking.frame import MIN_DATA, WIDTHS, Frame, FrameFit, frame_generator
from torchreg.tracking.frame_fit import FrameFitter
from torchreg.tracking.results import FrameResult, TrackResult, TrackState


def fitted_result(
    fitter: FrameFitter,
    state: TrackState,
    frame: Frame,
    fit: FrameFit,
    covariance: Tensor,
) -> FrameResult:
    """Return the result of a frame with a fit, and its covariance (num_dofs, num_dofs)."""
    problem, in_reach, origin = fit.view.problem, fit.view.in_reach, fit.view.origin
    data, distance = problem.data, fit.distance[0]
    if int(in_reach.sum()) > len(distance):
        data = (frame.cloud[in_reach] - origin)[None]
        distance = problem.surface.distance(data, fit.pose)[0]
    posed = problem.skin.place(fit.rows)
    evidence, converged = fitter.judged(fit, covariance)
    calibration = CALIBRATION if fit.person is None else SHAPE_CALIBRATION
    confidence = calibration.probability(evidence.table())[0]
    sigma = posed.new_tensor(WIDTHS.stop * problem.size)
    outlier = outlier_level(problem, posed[None], sigma[None])
    distances = _distances_out_of_reach(frame)
    distances[in_reach] = distance
    posterior = torch.zeros_like(distances)
    posterior[in_reach] = expectation(posed[None], data, sigma[None], outlier).inlier_posterior[0]
    return _frame_result(
        fitter, state, frame, pose=fit.world_pose, registered=posed + origin,
        keypoints=fitter.shape.placed_keypoints(fit.transforms) + origin, distances=distances, posterior=posterior,
        sigma=sigma, cost=posed.new_tensor(fit.cost), covariance=covariance, acquired=fit.acquired,
        status=CALIBRATION.status(converged, float(confidence)), residual=float(fit.residual), confidence=confidence,
        evidence=evidence.table()[0], dof_confidence=dof_confidence(fitter.shape, covariance, fitter.size),
    )  # fmt: skip


def predicted_result(fitter: FrameFitter, state: TrackState, frame: Frame, pose: Tensor, status: Status) -> FrameResult:
    """Return the result of a frame without a fit, with the predicted pose (num_dofs,) in its place."""
    unknown = pose.new_tensor(torch.nan)
    distances = _distances_out_of_reach(frame)
    return _frame_result(
        fitter, state, frame, pose=pose, registered=fitter.skin(pose), keypoints=fitter.shape.keypoints(pose),
        distances=distances, posterior=torch.zeros_like(distances), sigma=unknown, cost=unknown,
        covariance=unknown.expand(len(pose), len(pose)).clone(), status=status,
        acquired="lost" if status in (Status.LOST, Status.NOT_FOUND) else "held",
        residual=math.nan, confidence=torch.zeros_like(unknown),
        dof_confidence=torch.zeros_like(pose),
    )  # fmt: skip


def _distances_out_of_reach(frame: Frame) -> Tensor:
    """Return distances (M,) of points of which none is near the shape: infinite, NaN where a point is not finite."""
    return torch.where(frame.finite, torch.inf, torch.nan).to(frame.cloud)


def _frame_result(
    fitter: FrameFitter, state: TrackState, frame: Frame, distances: Tensor, **values: Any
) -> FrameResult:
    inliers = distances.abs() < fitter.inlier_distance
    return FrameResult(
        distances=distances, inliers=inliers, inlier_ratio=int(inliers.sum()) / max(1, int(frame.finite.sum())),
        history=(), frame=state.frame - 1, time=state.time, shape=fitter.shape, **values,
    )  # fmt: skip


def track_result(results: Sequence[FrameResult], seconds: Sequence[float]) -> TrackResult:
    """Return the results of T frames as one, with the seconds (T,) that each took."""
    return TrackResult(
        poses=torch.stack([result.pose for result in results]),
        std=torch.stack([result.std for result in results]),
        keypoints=torch.stack([result.keypoints for result in results]),
        inlier_ratios=torch.tensor([result.inlier_ratio for result in results], dtype=torch.float64),
        residuals=torch.tensor([result.residual for result in results], dtype=torch.float64),
        times=torch.tensor([result.time for result in results], dtype=torch.float64),
        seconds=torch.tensor(list(seconds), dtype=torch.float64),
        statuses=tuple(result.statuses[0] for result in results),
        acquired=tuple(result.acquired for result in results),
        origin=results[-1].origin,
        shape=results[-1].shape,
        coefficients=results[-1].coefficients,
        coefficient_covariance=results[-1].coefficient_covariance,
    )


@dataclass(frozen=True)
class PointSelection:
    """Numbers of the choice of model points."""

    seen_distance: float = 0.03  # from a seen model point to data near the surface, as a share of the size
    min_per_part: int = 4  # seen points or data: a part with fewer keeps the shape's own points
    max_share: float = 2.0  # data of a part, in even shares: large parts would leave few points to small ones
    occluded: float = 0.7  # inliers, in means, below which the shape is occluded: hidden points will reappear


_SELECTION = PointSelection()


ModelPoints = tuple[Tensor, Tensor, Tensor]


def next_model_points(fitter: FrameFitter, state: TrackState, fit: FrameFit) -> ModelPoints:
    """Return model points (N, 3) for the next frame, their weights (N, P), and the pose (num_dofs,) that they are in.

    References: Dewaele et al. 2006, section 3.
    """
    skin, size = fitter.skin, fitter.size
    data = fit.view.problem.data[0]
    data = data[fit.distance[0].abs() < WIDTHS.surface * size]
    if fitter.config.model_points == "shape" or len(data) < MIN_DATA:
        return skin.points, skin.weights, skin.reference_pose
    posed = skin.place(fit.rows)
    if fitter.config.model_points == "data":
        return _points_from_data(fitter, state, fit.pose[0], data, posed)
    seen = nearest_neighbor(posed, data)[1] < _SELECTION.seen_distance * size
    if fit.num_inliers < _SELECTION.occluded * state.num_inliers:
        seen = seen | (nearest_neighbor(skin.points, state.points)[1] == 0)
    parts, num_parts = skin.weights.argmax(-1), fitter.shape.num_parts
    seen = seen | (parts[seen].bincount(minlength=num_parts) < _SELECTION.min_per_part)[parts]
    return skin.points[seen], skin.weights[seen], skin.reference_pose


def _points_from_data(fitter: FrameFitter, state: TrackState, pose: Tensor, data: Tensor, posed: Tensor) -> ModelPoints:
    """Return data as model points, a bounded number per part, and the shape's own points of parts with few data.

    The data (M, 3) are near the surface in the pose (num_dofs,), as are the shape's own points (N, 3) when posed.
    """
    skin, config = fitter.skin, fitter.config
    if fitter.shape.surface is None:
        weights = bending_weights(fitter.shape, data, pose, config.sharpness)
    else:
        weights = skin.weights[nearest_neighbor(data, posed)[0]]
    parts = weights.argmax(-1)
    # In random order within each part.
    order = (parts + torch.rand(len(parts), generator=frame_generator(state), dtype=torch.float32).to(data)).argsort()
    counts = parts.bincount(minlength=fitter.shape.num_parts)
    rank = torch.arange(len(parts), device=data.device) - (counts.cumsum(0) - counts)[parts[order]]
    num_shown = max(1, int((counts >= _SELECTION.min_per_part).sum()))
    drawn = order[rank < _SELECTION.max_share * config.num_model_points / num_shown]
    unseen = (counts < _SELECTION.min_per_part)[skin.weights.argmax(-1)]
    return torch.cat([posed[unseen], data[drawn]]), torch.cat([skin.weights[unseen], weights[drawn]]), pose
