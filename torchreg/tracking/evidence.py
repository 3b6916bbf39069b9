"""The evidence for a fit: criteria of a loss and of doubt, relative to running means of the frames before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeGuard

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchreg.alignment.evidence.confidence import CLUSTERS
from torchreg.alignment.evidence.picture_agreement import visible_points
from torchreg.alignment.fit.problem import INLIER_SHARE, AlignProblem
from torchreg.alignment.fit.surface_fit import SURFACE_FIT
from torchreg.geometry.neighbors import NeighborTree
from torchreg.solvers.calibration import Logistic
from torchreg.tracking.frame import MIN_DATA, FrameFit
from torchreg.tracking.motion_model import FILTER
from torchreg.tracking.results import TrackState

Criterion = Callable[[FrameFit, TrackState], bool]


@dataclass(frozen=True)
class EvidenceLimits:
    """Limits of the criteria, in running means of the same quantity unless they have another unit."""

    min_regained: float = 0.12  # inliers after a loss
    min_inliers: float = 0.5  # inliers after a large deviation, and inlier ratio in reach
    max_residual: float = 1.8  # beyond, the surface was fitted to another object
    doubtful_residual: float = 1.5  # of a doubtful fit, and of one after a loss, when other objects are as near
    fine_residual: float = 0.006  # residual, as a share of the size, that noise and model error explain anyhow
    new_share: float = 0.012  # new unexplained data, as a share of the inliers
    limit_share: float = 0.3  # share of the joints at a limit beyond its mean
    deviation: float = 0.15  # from the prediction per interval, as a share of the size
    at_limit: float = 1e-3  # from a joint to its limit, radians
    max_searches: int = 6  # that may explain unexplained data before these count as background


_LIMITS = EvidenceLimits()


@dataclass(frozen=True)
class PresenceModel(Logistic):
    """The logistic model of whether data show the shape where a search fitted it: ``bias - sum_k weight_k e_k``.

    ``e`` are the `unseen_share` and the relative noise: background suits a part of the shape only, and another thing
    not exactly. How well the data determine the pose does not matter. Fitted to 165 searches for a hand or a robot arm
    among tubes, walls and points in the air: 77 show it, some with up to a third cut off, and 13 show the other one.
    ``benchmarks/calibrate_confidence.py --only presence`` draws such searches anew, not these very ones.
    """

    bias: float = 5.59
    weights: tuple[float, ...] = (8.76, 4.52)


PRESENCE = PresenceModel()


def presence(fit: FrameFit) -> float:
    """Return the probability that the data show the shape where it was fitted, perhaps in another of its poses."""
    return float(PRESENCE.probability(presence_evidence(fit)))


def presence_evidence(fit: FrameFit) -> Tensor:
    """Return the evidence (2,) of a `PresenceModel`."""
    return torch.stack([unseen_share(fit), SURFACE_FIT.relative_noise(fit.residual, fit.view.problem.size)])


def unseen_share(fit: FrameFit) -> Tensor:
    """Return the share () that no data lie near of the surface that a camera sees from the side of the data.

    Where no camera is known, that side is where the surface faces on which the data lie.
    """
    problem = fit.view.problem
    near = fit.distance[0].abs() < INLIER_SHARE * problem.size
    posed = problem.skin(fit.pose)[0]
    if fit.view.viewpoint is None:
        toward = normalize(-normalize(fit.jacobian[0, near, :3], dim=-1).sum(0), dim=0)
    else:
        toward = normalize(fit.view.viewpoint.to(posed) - posed, dim=-1)
    visible = visible_points(problem, fit.pose, toward)
    if not bool(near.any()) or not bool(visible.any()):
        return torch.ones_like(fit.residual)
    apart = NeighborTree(problem.data[0, near]).nearest(posed[visible])[1]
    return (apart > 2 * INLIER_SHARE * problem.size).to(posed).mean()


def deviates_far(fit: FrameFit, state: TrackState) -> bool:
    """Return whether a fit is farther from the prediction than shapes move."""
    return fit.deviation > _LIMITS.deviation * fit.view.problem.size * max(1, state.lost)


def is_continuous(fit: FrameFit, state: TrackState) -> bool:
    """Return whether a fit goes on from the frame before."""
    return state.tracked and state.lost == 0 and fit.acquired != "found" and not deviates_far(fit, state)


def residual_too_large(fit: FrameFit, state: TrackState) -> bool:
    """Return whether the data lie near the surface rather than on it, as those of another object do."""
    share = _LIMITS.doubtful_residual if state.lost else _LIMITS.max_residual
    return float(fit.residual) > max(share * state.residual, _LIMITS.fine_residual * fit.view.problem.size)


# A fit is lost if one of these holds.
_LOSS: tuple[Criterion, ...] = (
    # Few inliers determine no pose; after a loss, they are found in any cluster of data.
    lambda fit, state: fit.num_inliers < max(MIN_DATA, _LIMITS.min_regained * state.num_inliers if state.lost else 0),
    # A shape that moves far takes its data along; one that stays may be occluded but for a little.
    lambda fit, state: deviates_far(fit, state) and fit.num_inliers < _LIMITS.min_inliers * state.num_inliers,
    # Where hardly any data in reach lie on the surface, they are those of another object.
    lambda fit, state: fit.ratio_in_reach < _LIMITS.min_inliers * state.ratio_in_reach,
    # Before the first fit, there is no residual to compare with.
    lambda fit, state: state.tracked and residual_too_large(fit, state),
)
# A fit is doubtful if one of these holds.
_DOUBT: tuple[Criterion, ...] = (
    # A cluster where a limb could be, and was not in the frame before, may be that limb.
    lambda fit, state: fit.num_new_unexplained > max(CLUSTERS.neighbors, _LIMITS.new_share * fit.num_inliers),
    lambda fit, state: float(fit.residual) > _LIMITS.doubtful_residual * state.residual,
    # Joints that follow wrong data run into their limits.
    lambda fit, state: fit.limit_share > state.limit_share + _LIMITS.limit_share,
    deviates_far,
)


def is_supported(fit: FrameFit | None, state: TrackState) -> TypeGuard[FrameFit]:
    """Return whether there is a fit, and the data support it."""
    return fit is not None and not any(criterion(fit, state) for criterion in _LOSS)


def is_doubtful(fit: FrameFit, state: TrackState) -> bool:
    """Return whether the evidence for a fit is worse than usual in any way; never before the first fit."""
    return state.tracked and any(criterion(fit, state) for criterion in _DOUBT)


def is_unreliable(state: TrackState) -> bool:
    """Return whether the next fit may change no running mean: after a loss, and while searches go on."""
    return state.tracked and (state.lost > 0 or 0 < state.failed_searches < _LIMITS.max_searches)


def update_means(state: TrackState, fit: FrameFit, num_data: int) -> TrackState:
    """Return the state with running means that include a fit to a frame of ``num_data`` data."""
    restarted = fit.acquired == "found" and state.lost == 0
    if is_unreliable(state) and not restarted:
        return state
    memory = 0.0 if restarted or not state.tracked else FILTER.memory
    names = ("num_inliers", "ratio_in_reach", "residual", "limit_share")
    latest: dict[str, Any] = {"num_data": num_data, **{name: getattr(fit, name) for name in names}}
    means = {name: memory * getattr(state, name) + (1 - memory) * float(value) for name, value in latest.items()}
    return replace(state, **means)


def share_at_limits(problem: AlignProblem, pose: Tensor) -> float:
    """Return the share of the joints of a pose (..., num_dofs) that are at a limit; 0 without joints."""
    joints = pose[..., 6:]
    at_limit = (joints <= problem.lower[6:] + _LIMITS.at_limit) | (joints >= problem.upper[6:] - _LIMITS.at_limit)
    return float(at_limit.float().mean()) if at_limit.numel() else 0.0
