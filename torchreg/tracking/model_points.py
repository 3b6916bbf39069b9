"""The model points of the next frame, from the data of this one."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.shapes.skin import bending_weights
from torchreg.tracking.frame import MIN_DATA, WIDTHS, FrameFit, frame_generator
from torchreg.tracking.frame_fit import FrameFitter
from torchreg.tracking.results import TrackState


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
    distances = torch.cdist(posed, data, compute_mode="donot_use_mm_for_euclid_dist")
    if fitter.config.model_points == "data":
        return _points_from_data(fitter, state, fit.pose[0], data, posed, distances)
    seen = distances.amin(-1) < _SELECTION.seen_distance * size
    if fit.num_inliers < _SELECTION.occluded * state.num_inliers:
        seen = seen | _are_among(skin.points, state.points)
    parts = skin.weights.argmax(-1)
    seen = seen | (_count_per_part(parts[seen], skin.weights) < _SELECTION.min_per_part)[parts]
    return skin.points[seen], skin.weights[seen], skin.reference_pose


def _points_from_data(
    fitter: FrameFitter, state: TrackState, pose: Tensor, data: Tensor, posed: Tensor, distances: Tensor
) -> ModelPoints:
    """Return data as model points, a bounded number per part, and the shape's own points of parts with few data.

    The data (M, 3) are near the surface in the pose (num_dofs,), at distances (N, M) from the posed points (N, 3).
    """
    skin, config = fitter.skin, fitter.config
    if fitter.shape.surface is None:
        weights = bending_weights(fitter.shape, data, pose, config.sharpness)
    else:
        weights = skin.weights[distances.argmin(0)]
    parts = weights.argmax(-1)
    # In random order within each part.
    order = (parts + torch.rand(len(parts), generator=frame_generator(state)).to(data)).argsort()
    counts = _count_per_part(parts, weights)
    rank = torch.arange(len(parts), device=data.device) - (counts.cumsum(0) - counts)[parts[order]]
    num_shown = max(1, int((counts >= _SELECTION.min_per_part).sum()))
    drawn = order[rank < _SELECTION.max_share * config.num_model_points / num_shown]
    unseen = (counts < _SELECTION.min_per_part)[skin.weights.argmax(-1)]
    return torch.cat([posed[unseen], data[drawn]]), torch.cat([skin.weights[unseen], weights[drawn]]), pose


def _count_per_part(parts: Tensor, weights: Tensor) -> Tensor:
    """Return the number of points (P,) that belong to each part, for part indices (N,) and weights (..., P)."""
    return torch.bincount(parts, minlength=weights.shape[-1])


def _are_among(points: Tensor, selected: Tensor) -> Tensor:
    """Return which points (N, 3) are exactly equal to one of the selected (K, 3), (N,)."""
    return (torch.cdist(points, selected, compute_mode="donot_use_mm_for_euclid_dist") == 0).any(-1)
