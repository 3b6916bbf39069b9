"""What a tracker tries when a fit is in doubt or lost, from what is cheap to what is not, and when it tries again."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from torchreg.alignment.find_pose import FindPoseConfig, find_pose
from torchreg.alignment.pose_search import PoseSearch, fit_candidates, score_candidates
from torchreg.geometry.rotation import compose_rotation_vectors
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.tracking.config import Frame, FrameFit, FrameView, thinned
from torchreg.tracking.evidence import is_doubtful, is_lost, is_vague
from torchreg.tracking.frame_fit import STOP_SIGMA, FrameFitter, generator
from torchreg.tracking.motion_model import difference, spread
from torchreg.tracking.results import TrackState

# Data that another pose must explain beyond those that the prediction led to.
MIN_GAIN = 4.0
# Attempts in a row that left doubts, before starts, a search around, and a search everywhere are tried.
_STARTS_FAILS, _SEARCH_FAILS, _FIND_FAILS = 1, 3, 5
# What did not help is tried again at once so many times, then after longer and longer rests, frames.
_FREE_FAILS, _LONGEST_REST = 1, 32
# Frames after a loss before searching around the last pose, and everywhere.
_SEARCH_AFTER, _FIND_AFTER = 2, 3
# A frame with this share of the usual inliers less data hides the shape.
_HIDDEN_SHARE = 0.6
# Kernel widths of surface fits from poses known, and steps at each; how many of the starts are searched thoroughly.
_WIDTHS, _STEPS, _NUM_SEARCHED = (0.06, 0.04, 0.03), 2, 2
# More data tell a search everywhere no more.
_MAX_FOUND_DATA = 3000
# Found poses compete by how near they are if they leave at most this share of the data more unexplained than the best.
_AS_GOOD = 0.03
# How far a trunk gets from where it is expected in one frame, and the lever at which turns count; shares of the size.
_LONGEST_LEAP, _TURN_LEVER = 0.4, 0.25
# Searches everywhere in one frame, beyond the first, with other draws and twice the candidates.
_MORE_SEARCHES = 3


class Recovery:
    """Attempts to explain a frame better than descent from the prediction did.

    Args:
        fitter: of the frames.
    """

    def __init__(self, fitter: FrameFitter) -> None:
        self.fitter, self.level = fitter, fitter.config.recovery

    def __call__(
        self, state: TrackState, frame: Frame, view: FrameView | None, fit: FrameFit | None
    ) -> tuple[FrameFit | None, TrackState]:
        """Return the best fit of what is tried, and what the attempts leave of the state.

        Args:
            state: before the frame.
            frame: the frame.
            view: from the prediction, if any data are in reach.
            fit: what descent in the view led to.
        """
        lost = fit is None or is_lost(state, fit)
        if self.level == "none" or not (lost or state.cool_down == 0):
            return fit, waited(state)
        fit = self._best(state, frame, view, fit, lost)
        tried = state.cool_down == 0 and (not lost or _may_show(state, frame))
        good = fit is not None and not is_lost(state, fit) and not is_doubtful(state, fit)
        return fit, rested(state, good) if good or tried else waited(state)

    def everywhere(self, state: TrackState, frame: Frame) -> FrameFit | None:
        """Return the fit that a search everywhere leads to; among poses as good, the one nearest to the last.

        A fit whose data lie off the surface is no pose of the shape, and is sought again with more effort.
        """
        best = self._found(state, frame, FindPoseConfig(seed=state.seed))
        for again in range(1, _MORE_SEARCHES + 1):
            if state.lost or (best is not None and not is_vague(state, best)):
                break
            config = FindPoseConfig(seed=state.seed + again, num_candidates=128, num_placed=32)
            other = self._found(state, frame, config)
            best = max((fit for fit in (best, other) if fit is not None), key=lambda fit: fit.explained, default=None)
        return best

    def _found(self, state: TrackState, frame: Frame, config: FindPoseConfig) -> FrameFit | None:
        shape = self.fitter.shape
        data = thinned(frame.data, _MAX_FOUND_DATA, generator(state))
        starts = find_pose(shape, data, config=config)
        poses = starts.poses
        if state.lost:
            poses = poses[starts.costs <= starts.costs.min() + _AS_GOOD * len(data)]
            away = (shape.keypoints(poses) - shape.keypoints(state.pose)).norm(dim=-1).mean(-1)
            poses = poses[away.argsort()]
        return self.fitter.fit_at(state, frame, poses[0], "found")

    def _best(
        self, state: TrackState, frame: Frame, view: FrameView | None, fit: FrameFit | None, was_lost: bool
    ) -> FrameFit | None:
        best = fit
        for attempt in self._attempts(state, frame, view, fit):
            if attempt is None or self._leaps(state, frame, attempt):
                continue
            # What is hidden may be anywhere; only what explains more data is worth a jump.
            if (
                best is None
                or attempt.explained > best.explained + MIN_GAIN
                or (is_lost(state, best) and not is_lost(state, attempt))
            ):
                best = attempt
            # After a loss, doubts are left to the next frames.
            if not is_lost(state, best) and (was_lost or not is_doubtful(state, best)):
                break
        return best

    def _leaps(self, state: TrackState, frame: Frame, fit: FrameFit) -> bool:
        """Return whether a fit takes the trunk farther than it gets: where little is seen, much seems to fit."""
        if fit.how == "found":
            return False
        base = difference(fit.view.problem.prior.mean[0], fit.pose[0])[:6]
        gone = base[:3].norm() + _TURN_LEVER * self.fitter.size * base[3:].norm()
        return bool(gone > _LONGEST_LEAP * self.fitter.size * spread(state, frame.gap))

    def _attempts(
        self, state: TrackState, frame: Frame, view: FrameView | None, fit: FrameFit | None
    ) -> Iterator[FrameFit | None]:
        """Yield other fits of a frame, each costing more than the one before."""
        lost = fit is None or is_lost(state, fit)
        dear = self.level == "full" and state.cool_down == 0 and (not lost or _may_show(state, frame))
        if view is not None:
            known = torch.cat([view.problem.prior.mean[None], view.local(state.pose[None])], dim=1)
            known = known if fit is None else torch.cat([fit.pose[None], known], dim=1)
            wide = fit_candidates(view.problem, known, _WIDTHS, _STEPS)
            best = score_candidates(view.problem, wide, STOP_SIGMA)[0].argmin()
            yield self.fitter.fit(view, state, "surface", wide[:, best])
            if lost or state.failed_searches >= _STARTS_FAILS:
                thorough = dear and (state.lost >= _SEARCH_AFTER if lost else state.failed_searches == _SEARCH_FAILS)
                yield from self._searched(state, view, known, lost, thorough)
        overdue = state.lost >= _FIND_AFTER if lost else state.failed_searches == _FIND_FAILS
        if dear and overdue:
            yield self.everywhere(state, frame)

    def _searched(
        self, state: TrackState, view: FrameView, known: Tensor, lost: bool, thorough: bool
    ) -> Iterator[FrameFit]:
        """Yield fits after placing the limbs anew, from poses known and, after a loss, from earlier and turned ones."""
        if lost:
            turned = flipped(self.fitter.skin, state.pose)
            known = torch.cat([known, view.local(state.keyframes), view.local(turned)], dim=1)
        search = PoseSearch(view.problem, generator(state))
        narrowed = search.narrow(known, _NUM_SEARCHED)
        yield self.fitter.fit(view, state, "starts", narrowed[:, 0])
        if thorough:
            yield self.fitter.fit(view, state, "search", search.settle(narrowed, 1)[0][:, 0])


def flipped(skin: LinearBlendSkin, pose: Tensor) -> Tensor:
    """Return the pose (num_dofs,) turned by half around each principal axis of its points, (3, num_dofs)."""
    points = skin(pose)
    center = points.mean(0)
    axes = torch.linalg.eigh((points - center).mT @ (points - center)).eigenvectors.mT
    turns = 2 * axes.unsqueeze(-1) * axes.unsqueeze(-2) - torch.eye(3).to(axes)
    moved = center + (turns @ (pose[:3] - center).unsqueeze(-1)).squeeze(-1)
    rotations = compose_rotation_vectors(math.pi * axes, pose[3:6].expand(3, 3))
    return torch.cat([moved, rotations, pose[6:].expand(3, -1)], dim=-1)


def rested(state: TrackState, good: bool) -> TrackState:
    """Return the state after an attempt: what helped may be tried at once, what did not, later and later."""
    if good:
        return replace(state, cool_down=0, failed_searches=0)
    return replace(state, cool_down=_rest_after(state.failed_searches + 1), failed_searches=state.failed_searches + 1)


def waited(state: TrackState) -> TrackState:
    """Return the state after a frame without an attempt."""
    return replace(state, cool_down=max(0, state.cool_down - 1))


def _may_show(state: TrackState, frame: Frame) -> bool:
    """Return whether enough data came for the shape to be among them, or it is time to look in any case."""
    return (
        len(frame.data) > state.num_data - _HIDDEN_SHARE * state.num_inliers
        or _rest_after(state.failed_searches) >= _LONGEST_REST
    )


def _rest_after(fails: int) -> int:
    return 0 if fails <= _FREE_FAILS else min(2 ** min(fails - _FREE_FAILS, 16), _LONGEST_REST)
