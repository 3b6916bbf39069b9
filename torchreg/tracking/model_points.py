"""The model points of the next frame, from what the data of this one showed."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.shapes.skin import bending_weights
from torchreg.tracking.config import FrameFit
from torchreg.tracking.frame_fit import MIN_DATA, FrameFitter, generator
from torchreg.tracking.results import TrackState

# Data this near the surface, as a share of the size, are harvested (5 mm on a hand); they show model points this near.
_HARVEST_SHARE, _SHOWN_SHARE = 0.022, 0.03
# A part that is shown at fewer points keeps the shape's own; a part gives at most this many times its even share.
_FEW_SHOWN, _PART_CAP = 4, 2.0
# With fewer than this share of the usual inliers, something hides the shape.
_HIDDEN = 0.7

ModelPoints = tuple[Tensor, Tensor, Tensor]


def points_after(fitter: FrameFitter, state: TrackState, fit: FrameFit) -> ModelPoints:
    """Return the model points (N, 3) for the next frame, their weights (N, P), and the pose that they are in.

    Args:
        fitter: of the frames.
        state: before the frame.
        fit: of the frame.

    References: Dewaele et al. 2006, section 3.
    """
    skin, pose, size = fitter.skin, fit.pose[0], fitter.size
    data = fit.view.problem.data[0]
    data = data[fit.distance[0].abs() < _HARVEST_SHARE * size]
    if fitter.config.model_points == "shape" or len(data) < MIN_DATA:
        return skin.points, skin.weights, skin.reference_pose
    posed = skin.place(fit.rows)
    near = torch.cdist(posed, data, compute_mode="donot_use_mm_for_euclid_dist")
    if fitter.config.model_points == "data":
        return _harvested(fitter, state, data, pose, posed, near)
    shown = near.amin(-1) < _SHOWN_SHARE * size
    if fit.inliers < _HIDDEN * state.num_inliers:
        # What something hides comes back as it went.
        shown = shown | _among(skin.points, state.points)
    parts = skin.weights.argmax(-1)
    shown = shown | (_count(parts[shown], skin.weights) < _FEW_SHOWN)[parts]
    return skin.points[shown], skin.weights[shown], skin.reference_pose


def _harvested(
    fitter: FrameFitter, state: TrackState, data: Tensor, pose: Tensor, posed: Tensor, near: Tensor
) -> ModelPoints:
    """Return data as model points, at most so many per part, and the shape's own where a part shows few."""
    skin, config = fitter.skin, fitter.config
    if fitter.shape.surface is None:
        weights = bending_weights(fitter.shape, data, pose, config.sharpness)
    else:
        weights = skin.weights[near.argmin(0)]
    parts = weights.argmax(-1)
    order = (parts + torch.rand(len(parts), generator=generator(state)).to(data)).argsort()
    ordered = parts[order]
    count = _count(parts, weights)
    rank = torch.arange(len(parts), device=data.device) - (count.cumsum(0) - count)[ordered]
    cap = _PART_CAP * config.num_model_points / max(1, int((count >= _FEW_SHOWN).sum()))
    kept = order[rank < cap]
    own = (count < _FEW_SHOWN)[skin.weights.argmax(-1)]
    return torch.cat([posed[own], data[kept]]), torch.cat([skin.weights[own], weights[kept]]), pose


def _count(parts: Tensor, weights: Tensor) -> Tensor:
    return torch.bincount(parts, minlength=weights.shape[-1])


def _among(points: Tensor, some: Tensor) -> Tensor:
    """Return which points (N,) are exactly among some of them (K, 3)."""
    return (torch.cdist(points, some, compute_mode="donot_use_mm_for_euclid_dist") == 0).any(-1)
