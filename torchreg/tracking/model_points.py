"""The model points of the next frame, from the data of this one."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.neighbors import nearest_neighbor
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
