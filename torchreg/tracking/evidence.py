"""Whether a frame's fit can be believed: losses, doubts, what is usual, and data that the shape leaves unexplained."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchreg.alignment.problem import AlignProblem
from torchreg.geometry.rigid import invert_rigid, transform_points
from torchreg.shapes.limbs import Limb
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.tracking.config import FrameFit
from torchreg.tracking.results import TrackState

# A loss: fewer inliers than the first, after a loss than this share of the usual; or half of the usual ratio.
_MIN_INLIERS, _LOST_COUNT, _LOST_RATIO = 10, 0.12, 0.5
# Residuals this many times the usual ones are a loss, or a doubt, but not below this share of the size.
_LOST_RESIDUAL, _DOUBT_RESIDUAL, _FINE_RESIDUAL = 1.8, 1.5, 0.006
# A doubt: more novel strays than this and than this share of the inliers; so many more joints at limits; so far off the
# prediction, as a share of the size.
_DOUBT_NOVEL, _DOUBT_NOVEL_SHARE, _DOUBT_HELD, _DOUBT_JUMP = 5, 0.012, 0.3, 0.15
# Strays that stay after so many attempts to explain them are background.
_LEARNED_AFTER = 6
# Kept from frame to frame of running means: they go back half a second.
_MEMORY = 0.9
# A joint this near to a limit is at it, radians.
_AT_LIMIT = 1e-3
# Strays have this many others within so many distances between neighbors on the surface, and this share of the size.
_CLUSTER_NEIGHBORS, _CLUSTER_RADIUS, _MAX_CLUSTER = 5, 4.0, 0.1
# Data whose neighbors tell how dense a surface is.
_NUM_SPACINGS = 100
# Poses that show where limbs reach: more fill no more cells.
_NUM_REACHES = 512


def is_far(state: TrackState, fit: FrameFit) -> bool:
    """Return whether a fit is farther from the prediction than shapes go."""
    return fit.jump > _DOUBT_JUMP * fit.view.problem.size * max(1, state.lost)


def is_lost(state: TrackState, fit: FrameFit) -> bool:
    """Return whether the data do not support a fit."""
    # What moved far must bring most of its data along; what stayed may be hidden but for a little.
    few = fit.inliers < max(_MIN_INLIERS, _LOST_COUNT * state.num_inliers if state.lost else 0)
    stray = is_far(state, fit) and fit.inliers < _LOST_RATIO * state.num_inliers
    vague = state.tracked and is_vague(state, fit)
    return few or stray or vague or fit.ratio < _LOST_RATIO * state.ratio_in_reach


def is_vague(state: TrackState, fit: FrameFit) -> bool:
    """Return whether data lie beside the surface, as those of something else do that the surface was drawn to."""
    loose = _DOUBT_RESIDUAL if state.lost else _LOST_RESIDUAL
    return float(fit.noise) > max(loose * state.residual, _FINE_RESIDUAL * fit.view.problem.size)


def is_doubtful(state: TrackState, fit: FrameFit) -> bool:
    """Return whether the evidence for a fit is worse than usual in any way."""
    if not state.tracked:
        return False
    return (
        fit.novel > max(_DOUBT_NOVEL, _DOUBT_NOVEL_SHARE * fit.inliers)
        or float(fit.noise) > _DOUBT_RESIDUAL * state.residual
        or fit.held > state.limit_share + _DOUBT_HELD
        or is_far(state, fit)
    )


def in_doubt(state: TrackState) -> bool:
    """Return whether what a frame shows may not yet be taken for usual."""
    return state.tracked and (state.lost > 0 or 0 < state.failed_searches < _LEARNED_AFTER)


def usual_after(state: TrackState, fit: FrameFit, total: int) -> TrackState:
    """Return the state with running means that a fit to ``total`` data has gone into."""
    anew = fit.how == "found" and state.lost == 0
    if in_doubt(state) and not anew:
        return state
    keep = 0.0 if anew or not state.tracked else _MEMORY
    pairs = (
        (state.num_data, total), (state.num_inliers, fit.inliers), (state.ratio_in_reach, fit.ratio),
        (state.residual, fit.noise), (state.limit_share, fit.held),
    )  # fmt: skip
    total_, inliers, ratio, residual, held = (keep * old + (1 - keep) * float(new) for old, new in pairs)
    return replace(
        state, num_data=total_, num_inliers=inliers, ratio_in_reach=ratio, residual=residual, limit_share=held
    )


def share_at_limits(problem: AlignProblem, pose: Tensor) -> float:
    """Return the share of the joints that lie at a limit."""
    joints = pose[..., 6:]
    at = (joints <= problem.lower[6:] + _AT_LIMIT) | (joints >= problem.upper[6:] - _AT_LIMIT)
    return float(at.float().mean()) if at.numel() else 0.0


def dense_strays(data: Tensor, near: Tensor, size: float) -> Tensor:
    """Return the data (K, 3) off the surface that lie as densely as those on it: outliers are thin in space.

    Args:
        data: (M, 3).
        near: (M,) which lie on the surface.
        size: of the shape, metres.
    """
    far, on = data[~near], data[near]
    if not len(on) or not len(far):
        return far[:0]
    some = on[:: max(1, len(on) // _NUM_SPACINGS)]
    spacing = torch.cdist(some, on).topk(2, largest=False).values[:, -1].median() if len(on) > 1 else data.new_zeros(())
    radius = (_CLUSTER_RADIUS * spacing).clamp_max(_MAX_CLUSTER * size)
    return far[(torch.cdist(far, far) < radius).sum(-1) > _CLUSTER_NEIGHBORS]


def nearest_distance(points: Tensor, others: Tensor) -> Tensor:
    """Return the distance (N,) of each point to the nearest of others (K, 3); infinite where there are none."""
    if not len(others):
        return torch.full_like(points[:, 0], torch.inf)
    return torch.cdist(points, others).amin(-1)


class LimbReach:
    """Where the limbs of a shape can be, given where its trunk lies: cells of space, in the trunk's frame.

    What no limb reaches is no limb that was missed: it is something else.

    Args:
        skin: points of the shape.
        limbs: the limbs; without any, every place is taken to be in reach.
        cell: width of a cell, metres.
    """

    def __init__(self, skin: LinearBlendSkin, limbs: Sequence[Limb], cell: float) -> None:
        shape = skin.shape
        self.shape, self.cell = shape, cell
        self.cells: Tensor | None = None
        parts = torch.tensor([part for limb in limbs for part in limb.parts], device=shape.rest.device)
        own = torch.isin(skin.weights.argmax(-1), parts)
        if not bool(own.any()):
            return
        low, high = shape.lower[6:].clamp_min(-math.pi), shape.upper[6:].clamp_max(math.pi)
        shares = torch.quasirandom.SobolEngine(len(low), scramble=True, seed=0).draw(_NUM_REACHES).to(low)
        poses = shape.rest.repeat(_NUM_REACHES, 1)
        poses[:, 6:] = low + (high - low) * shares
        trunk = invert_rigid(shape.part_transforms(poses)[:, 0])
        points = transform_points(trunk, skin(poses)[:, own]).flatten(0, 1)
        # A margin of one cell all around, which the widening by one cell fills.
        self.low = points.amin(0) - 1.5 * cell
        index = ((points - self.low) / cell).long()
        cells = points.new_zeros((index.amax(0) + 2).tolist())
        cells[index.unbind(-1)] = 1.0
        self.cells = torch.nn.functional.max_pool3d(cells[None, None], 3, 1, 1)[0, 0] > 0

    def __call__(self, points: Tensor, trunk: Tensor) -> Tensor:
        """Return which points (N, 3) a limb may reach where the trunk lies at (4, 4), as (N,)."""
        if self.cells is None:
            return torch.ones_like(points[:, 0], dtype=torch.bool)
        local = transform_points(invert_rigid(trunk), points)
        index = ((local - self.low) / self.cell).floor().long()
        size = torch.tensor(self.cells.shape, device=index.device)
        inside = ((index >= 0) & (index < size)).all(-1)
        return inside & self.cells[torch.minimum(index.clamp_min(0), size - 1).unbind(-1)]
