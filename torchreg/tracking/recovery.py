"""What a tracker tries when a fit is doubtful or lost, from cheap to expensive, and when it tries again."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.alignment.evidence.reliability import CALIBRATION
from torchreg.alignment.find_pose import FindPoseConfig, find_pose
from torchreg.alignment.fit.problem import centered_problem
from torchreg.alignment.fit.surface_fit import SURFACE_FIT
from torchreg.alignment.search.multi_start import SEARCH_BUDGET, Candidates, Plan
from torchreg.alignment.search.pose_search import PoseSearch
from torchreg.alignment.search.start_source import StartSource
from torchreg.geometry.neighbors import NeighborTree, sampling_distance
from torchreg.geometry.rotation import compose_rotation_vectors
from torchreg.shapes.pose_algebra import difference, shifted
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.tracking.evidence import is_doubtful, is_supported, presence, residual_too_large
from torchreg.tracking.frame import WIDTHS, Frame, FrameFit, FrameView, frame_generator, subsample
from torchreg.tracking.frame_fit import FrameFitter
from torchreg.tracking.motion_model import uncertainty_growth
from torchreg.tracking.results import TrackState


@dataclass(frozen=True)
class RecoveryPlan:
    """Numbers of the recovery. Lengths are shares of the model's size."""

    free_failures: int = 1  # failed searches after which the next, with the limbs placed anew, is due at once
    min_gain: float = 4.0  # soft inliers by which another pose must exceed the predicted one: less is chance
    max_doublings: int = 5  # of the cool-down after more failures, to 32 frames
    occluded: float = 0.6  # of the mean inliers missing from the mean number of data: the shape is probably occluded
    num_searched: int = 2  # known poses whose limbs are placed thoroughly
    max_data: int = 3000  # of a search everywhere: more tell no more
    equivalent: float = 0.03  # share of the data that a pose explains less than the best and still counts as good
    max_motion: float = 0.4  # of the base from its prediction per interval: on little data much seems to fit
    max_repetitions: int = 3  # of the first search everywhere, with other draws: nothing is known yet
    more_candidates: int = 2  # of a repetition, in those of the first search
    new_share: float = 0.02  # of the data that is new: something has come that may be the shape


_PLAN = RecoveryPlan()
# Surface fits from known poses.
_FROM_KNOWN = Plan(start=WIDTHS.coarse, stop=WIDTHS.stop, steps=2)


class Recovery:
    """Attempts to explain a frame better than descent from the prediction did; a source gives poses of a lost shape."""

    def __init__(self, fitter: FrameFitter, source: StartSource | None = None) -> None:
        self.fitter, self.level = fitter, fitter.config.recovery
        self.source = source or StartSource.of(fitter.shape)

    def __call__(
        self, state: TrackState, frame: Frame, view: FrameView | None, fit: FrameFit | None
    ) -> tuple[FrameFit | None, TrackState]:
        """Return the best fit of all attempts, None if the data do not support it, and the state after the attempts."""
        if state.tracked:
            fit, state = self._around(state, frame, view, fit)
        else:
            fit, state = self._first(state, frame)
        if is_supported(fit, state):
            return fit, replace(state, pending_checks=1) if fit.acquired == "found" else state
        return None, state

    def cross_check(self, state: TrackState, frame: Frame, fit: FrameFit | None) -> tuple[FrameFit | None, TrackState]:
        """Return the better of a fit and another search everywhere, and the state after the check.

        A search everywhere may find a wrong pose, which the search in another frame seldom repeats. Without pending
        checks the fit is returned as it is.
        """
        if state.pending_checks == 0 or (fit is not None and fit.acquired == "found"):
            return fit, state
        rival = self.everywhere(state, frame)
        if rival is not None and (fit is None or rival.soft_inliers >= fit.soft_inliers + _PLAN.min_gain):
            fit = rival
        return fit, replace(state, pending_checks=0)

    def everywhere(self, state: TrackState, frame: Frame, repetitions: int = _PLAN.max_repetitions) -> FrameFit | None:
        """Return the fit of a search everywhere, None where the data more probably show something else.

        Where the data do not lie on the surface of a fit, the first search is repeated with more effort.
        """
        best = self._find(state, frame, FindPoseConfig(seed=state.seed))
        for number in range(1, repetitions + 1):
            if state.lost or (best is not None and not residual_too_large(best, state)):
                break
            config = FindPoseConfig(
                seed=state.seed + number,
                num_candidates=_PLAN.more_candidates * FindPoseConfig.num_candidates,
                num_placed=_PLAN.more_candidates * FindPoseConfig.num_placed,
            )
            fits = [fit for fit in (best, self._find(state, frame, config)) if fit is not None]
            best = max(fits, key=lambda fit: fit.soft_inliers, default=None)
        return best if best is not None and presence(best) >= CALIBRATION.doubtful else None

    def _find(self, state: TrackState, frame: Frame, config: FindPoseConfig) -> FrameFit | None:
        """Return the fit of a search; of equivalent poses after a loss, that of the one nearest to the last."""
        shape = self.fitter.shape
        data = subsample(frame.data, _PLAN.max_data, frame_generator(state))
        seen = data if frame.picture is None else frame.picture
        starts = find_pose(
            shape, seen, initializer=self.source.proposer, config=config,
            **frame.prior_arguments, **frame.seen_keypoints,
        )  # fmt: skip
        poses = starts.poses
        if state.lost:
            poses = poses[starts.costs <= starts.costs.min() + _PLAN.equivalent * len(data)]
            distances = (shape.keypoints(poses) - shape.keypoints(state.pose)).norm(dim=-1).mean(-1)
            poses = poses[distances.argsort()]
        return self.fitter.fit_at(state, frame, poses[0], "found")

    def _propose(self, state: TrackState, frame: Frame) -> FrameFit | None:
        """Return the best fit from poses that a network proposes for all data, wherever the shape was before."""
        data = subsample(frame.data, _PLAN.max_data, frame_generator(state))
        valid = torch.ones_like(data[None, :, 0], dtype=torch.bool)
        origin = data.mean(0)
        problem = centered_problem(
            self.fitter.skin, data[None], valid, state.pose[None], origin[None], prior_std=FindPoseConfig.prior_std,
            pose_atol=0.0,
        )  # fmt: skip
        poses = self.source.proposed(problem, FindPoseConfig.num_searched).poses
        fits = [self.fitter.fit_at(state, frame, shifted(pose, origin), "found") for pose in poses[0].unique(dim=0)]
        return max((fit for fit in fits if fit is not None), key=lambda fit: fit.soft_inliers, default=None)

    def _first(self, state: TrackState, frame: Frame) -> tuple[FrameFit | None, TrackState]:
        """Return the fit and the state where the shape was never fitted: only a search everywhere helps.

        What came since the last search may be the shape: it is searched at once, but not as thoroughly.
        """
        due = state.cool_down == 0
        if self.level != "full" or not (due or self._shows_new(state, frame)):
            return None, after_pause(state)
        fit = self.everywhere(state, frame) if due else self.everywhere(state, frame, repetitions=0)
        successful = is_supported(fit, state)
        seen = None if successful else subsample(frame.data, _PLAN.max_data, frame_generator(state))
        return fit, replace(after_search(state, successful), searched=seen)

    def _shows_new(self, state: TrackState, frame: Frame) -> bool:
        """Return whether a frame has data that the last one searched had not."""
        if state.searched is None:
            return False
        apart = 3 * sampling_distance(state.searched)
        distance = NeighborTree(state.searched).nearest(frame.data)[1]
        new = distance > max(apart, SEARCH_BUDGET.same * self.fitter.size)
        return bool(new.float().mean() > _PLAN.new_share)

    def _around(
        self, state: TrackState, frame: Frame, view: FrameView | None, fit: FrameFit | None
    ) -> tuple[FrameFit | None, TrackState]:
        """Return the fit and the state after attempts around known poses and, in their turn, everywhere."""
        lost = not is_supported(fit, state)
        if self.level == "none" or not (lost or state.cool_down == 0):
            return fit, after_pause(state)
        best = self._best(state, frame, view, fit)
        good = is_supported(best, state) and not is_doubtful(best, state)
        searched = state.cool_down == 0 and (not lost or _may_show(state, frame))
        return best, after_search(state, good) if good or searched else after_pause(state)

    def _best(self, state: TrackState, frame: Frame, view: FrameView | None, fit: FrameFit | None) -> FrameFit | None:
        """Return the first attempt that is neither lost nor doubtful, or else the best of them and the fit."""
        best, was_lost = fit, not is_supported(fit, state)
        for attempt in self._attempts(state, frame, view, fit):
            if attempt is None or self._moves_too_far(state, frame, attempt):
                continue
            if best is None or self._is_better(state, attempt, best):
                best = attempt
            # After a loss, doubts are left to the next frames.
            if is_supported(best, state) and (was_lost or not is_doubtful(best, state)):
                break
        return best

    def _is_better(self, state: TrackState, attempt: FrameFit, best: FrameFit) -> bool:
        """Return whether an attempt explains more data: a limb without data may be anywhere, which is no reason."""
        if attempt.soft_inliers > best.soft_inliers + _PLAN.min_gain:
            return True
        return is_supported(attempt, state) and not is_supported(best, state)

    def _moves_too_far(self, state: TrackState, frame: Frame, fit: FrameFit) -> bool:
        """Return whether a fit near the prediction moves the base farther than it gets in the time elapsed."""
        if fit.acquired == "found":
            return False
        base = difference(fit.view.problem.prior.mean[0], fit.pose[0])[:6]
        motion = base[:3].norm() + SURFACE_FIT.lever * self.fitter.size * base[3:].norm()
        return bool(motion > _PLAN.max_motion * self.fitter.size * uncertainty_growth(state, frame.elapsed))

    def _attempts(
        self, state: TrackState, frame: Frame, view: FrameView | None, fit: FrameFit | None
    ) -> Iterator[FrameFit | None]:
        """Yield other fits of a frame, each more expensive than the one before."""
        lost = not is_supported(fit, state)
        thorough = self.level == "full" and state.cool_down == 0 and (not lost or _may_show(state, frame))
        if view is not None:
            known = torch.cat([view.problem.prior.mean[None], view.to_local(state.pose[None])], dim=1)
            known = known if fit is None else torch.cat([fit.pose[None], known], dim=1)
            fitted = Candidates.descended(view.problem, known, _FROM_KNOWN).poses
            yield self.fitter.fit(view, state, "surface", fitted[:, 0])
        if lost and thorough:
            yield self._propose(state, frame)
        if view is not None and (lost or state.failed_searches >= _PLAN.free_failures):
            yield from self._limb_searches(state, view, known, lost, thorough)
        if thorough and _is_due(state, lost, stage=3):
            yield self.everywhere(state, frame)

    def _limb_searches(
        self, state: TrackState, view: FrameView, known: Tensor, lost: bool, thorough: bool
    ) -> Iterator[FrameFit]:
        """Yield fits with the limbs placed anew from known poses; after a loss, from keyframes and flipped ones too."""
        if lost:
            flips = flipped_poses(self.fitter.skin, state.pose)
            known = torch.cat([known, view.to_local(state.keyframes), view.to_local(flips)], dim=1)
        search = PoseSearch(view.problem, frame_generator(state))
        candidates = search.prune(known, _PLAN.num_searched)
        yield self.fitter.fit(view, state, "starts", candidates[:, 0])
        if thorough and _is_due(state, lost, stage=2):
            yield self.fitter.fit(view, state, "search", search.refine(candidates, 1)[0][:, 0])


def flipped_poses(skin: LinearBlendSkin, pose: Tensor) -> Tensor:
    """Return a pose (num_dofs,) after half a turn about each principal axis of its points, (3, num_dofs)."""
    points = skin(pose)
    center = points.mean(0)
    axes = torch.linalg.eigh((points - center).mT @ (points - center)).eigenvectors.mT
    turns = 2 * axes.unsqueeze(-1) * axes.unsqueeze(-2) - torch.eye(3).to(axes)
    moved = center + (turns @ (pose[:3] - center).unsqueeze(-1)).squeeze(-1)
    rotations = compose_rotation_vectors(math.pi * axes, pose[3:6].expand(3, 3))
    return torch.cat([moved, rotations, pose[6:].expand(3, -1)], dim=-1)


def after_search(state: TrackState, successful: bool) -> TrackState:
    """Return the state after a search: the next is due at once after a success, ever later after failures."""
    failed = 0 if successful else state.failed_searches + 1
    return replace(state, cool_down=_cool_down(failed), failed_searches=failed)


def after_pause(state: TrackState) -> TrackState:
    """Return the state after a frame without a search."""
    return replace(state, cool_down=max(0, state.cool_down - 1))


def _is_due(state: TrackState, lost: bool, stage: int) -> bool:
    """Return whether it is the turn of a stage of attempts: from as many lost frames on, or at every second failure."""
    return state.lost >= stage if lost else state.failed_searches == 2 * stage - 1


def _may_show(state: TrackState, frame: Frame) -> bool:
    """Return whether a frame has enough data for the shape to be among them, or a search is due in any case."""
    num_hidden = _PLAN.occluded * state.num_inliers
    return len(frame.data) > state.num_data - num_hidden or _doublings(state.failed_searches) == _PLAN.max_doublings


def _cool_down(failed: int) -> int:
    """Return the frames before the next search, after failed ones."""
    return 2 ** _doublings(failed) if _doublings(failed) else 0


def _doublings(failed: int) -> int:
    return min(max(failed - _PLAN.free_failures, 0), _PLAN.max_doublings)
