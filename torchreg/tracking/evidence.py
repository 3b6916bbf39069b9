"""The evidence for a fit: what it leaves unexplained, and criteria of loss and doubt, relative to the frames before."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeGuard

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchreg.alignment.evidence.confidence import CLUSTERS, OFF_SURFACE
from torchreg.alignment.evidence.coverage import unseen_share
from torchreg.alignment.fit.problem import AlignProblem
from torchreg.alignment.fit.surface_fit import SURFACE_FIT
from torchreg.alignment.search.multi_start import SEARCH_BUDGET
from torchreg.geometry.neighbors import nearest_neighbor, sampling_distance
from torchreg.geometry.rigid import invert_rigid, transform_points
from torchreg.shapes.limbs import Limb
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.solvers.calibration import Logistic
from torchreg.tracking.frame import MIN_DATA, FrameFit
from torchreg.tracking.motion_model import FILTER
from torchreg.tracking.results import TrackState


@dataclass(frozen=True)
class ClusterTest:
    """When data count as a cluster, and as one that was there before. Distances are shares of the model's size."""

    off_surface: float = OFF_SURFACE.noises  # standard deviations of residuals: data beyond are off the surface
    min_neighbors: int = CLUSTERS.neighbors  # of each datum of a cluster
    radius: float = CLUSTERS.radius  # within which they lie, in median distances between neighbors on the surface
    max_radius: float = CLUSTERS.max_radius  # the same, at most: on a sparse surface anything would be a cluster
    num_spacings: int = 100  # data on the surface whose nearest neighbors tell its density
    max_remembered: int = 300  # unexplained data in a state: more mark no more space
    num_poses: int = 512  # random poses that show what limbs reach: more fill no more cells


_TEST = ClusterTest()


class UnexplainedClusters:
    """Finds clusters of data off the surface, and separates limbs that a fit may have missed from background."""

    def __init__(self, skin: LinearBlendSkin, limbs: Sequence[Limb], size: float) -> None:
        self.size = size
        self._reach = LimbReach(skin, limbs, SEARCH_BUDGET.same * size)

    def scaled(self, size: float) -> UnexplainedClusters:
        """Return the same for a shape of another size but about the same proportions."""
        other = copy.copy(self)
        other.size, other._reach = size, self._reach.scaled(size / self.size)
        return other

    def find(self, data: Tensor, distance: Tensor, residual: Tensor) -> Tensor:
        """Return the data (K, 3) off the surface that lie as densely as those on it; most outliers are sparse.

        Distances (M,) are those of the data (M, 3) to the surface, the residual () is their standard deviation on it.
        """
        on_surface = distance.abs() < _TEST.off_surface * residual
        outliers, inliers = data[~on_surface], data[on_surface]
        if len(inliers) < 2 or not len(outliers):
            return outliers[:0]
        spacing = sampling_distance(inliers, inliers[:: max(1, len(inliers) // _TEST.num_spacings)])
        radius = min(_TEST.radius * spacing, _TEST.max_radius * self.size)
        # Every datum is within the radius of itself.
        return outliers[(torch.cdist(outliers, outliers) < radius).sum(-1) > _TEST.min_neighbors]

    def count_new(self, state: TrackState, clusters: Tensor, trunk: Tensor) -> int:
        """Return the number of data (K, 3) in reach of limbs and in no cluster that is known, for a trunk at (4, 4)."""
        known = transform_points(trunk, state.unexplained)
        new = nearest_distance(clusters, known) > SEARCH_BUDGET.same * self.size
        return int((new & self._reach(clusters, trunk)).sum())

    def remember(self, state: TrackState, clusters: Tensor, trunk: Tensor) -> Tensor:
        """Return the unexplained data (S, 3) to expect in the next frame, in the frame of the trunk at (4, 4)."""
        latest = transform_points(invert_rigid(trunk), clusters)
        # Where a cluster persists, its data of earlier frames show better how far it extends.
        persistent = nearest_distance(state.unexplained, latest) < SEARCH_BUDGET.same * self.size
        return torch.cat([latest, state.unexplained[persistent]])[: _TEST.max_remembered]


def nearest_distance(points: Tensor, targets: Tensor) -> Tensor:
    """Return the distances (N,) from points (N, 3) to the nearest of the targets (K, 3); infinite without any."""
    if not len(targets):
        return torch.full_like(points[:, 0], torch.inf)
    return nearest_neighbor(points, targets)[1]


class LimbReach:
    """The space that limbs can reach, as cells in the frame of the trunk, the first part; all space without any limb.

    Data out of reach belong to no limb that was missed.
    """

    def __init__(self, skin: LinearBlendSkin, limbs: Sequence[Limb], cell: float) -> None:
        shape = skin.shape
        self.cell = cell
        self.cells: Tensor | None = None
        parts = torch.tensor([part for limb in limbs for part in limb.parts], device=shape.rest.device)
        on_limbs = torch.isin(skin.weights.argmax(-1), parts)
        if not bool(on_limbs.any()):
            return
        low, high = shape.lower[6:].clamp_min(-math.pi), shape.upper[6:].clamp_max(math.pi)
        shares = (
            torch.quasirandom.SobolEngine(len(low), scramble=True, seed=0)
            .draw(_TEST.num_poses, dtype=torch.float32)
            .to(low)
        )
        poses = shape.rest.repeat(_TEST.num_poses, 1)
        poses[:, 6:] = low + (high - low) * shares
        to_trunk = invert_rigid(shape.part_transforms(poses)[:, 0])
        points = transform_points(to_trunk, skin(poses)[:, on_limbs]).flatten(0, 1)
        # A margin of one cell all around, which the dilation by one cell fills.
        self.low = points.amin(0) - 1.5 * cell
        index = ((points - self.low) / cell).long()
        cells = points.new_zeros((index.amax(0) + 2).tolist())
        cells[index.unbind(-1)] = 1.0
        self.cells = torch.nn.functional.max_pool3d(cells[None, None], 3, 1, 1)[0, 0] > 0

    def scaled(self, factor: float) -> LimbReach:
        """Return the reach of limbs larger by a factor."""
        other = copy.copy(self)
        other.cell = factor * self.cell
        if self.cells is not None:
            other.low = factor * self.low
        return other

    def __call__(self, points: Tensor, trunk: Tensor) -> Tensor:
        """Return which points (N, 3) a limb may reach, (N,), for a trunk at (4, 4)."""
        if self.cells is None:
            return torch.ones_like(points[:, 0], dtype=torch.bool)
        local = transform_points(invert_rigid(trunk), points)
        index = ((local - self.low) / self.cell).floor().long()
        size = torch.tensor(self.cells.shape, device=index.device)
        inside = ((index >= 0) & (index < size)).all(-1)
        return inside & self.cells[torch.minimum(index.clamp_min(0), size - 1).unbind(-1)]


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
    problem, viewpoint = fit.view.problem, fit.view.viewpoint
    toward = None if viewpoint is None else normalize(viewpoint.to(fit.pose) - problem.skin(fit.pose), dim=-1)
    unseen = unseen_share(problem, fit.pose, fit.distance, fit.jacobian, toward)[0]
    return torch.stack([unseen, SURFACE_FIT.relative_noise(fit.residual, problem.size)])


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
