"""A second pass over a tracked sequence, in which each frame also counts for those before it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchreg._threads import one_thread
from torchreg.alignment.evidence.curvature import correlated_count, neighbor_correlation
from torchreg.alignment.fit.landmarks import MeasuredKeypoints
from torchreg.alignment.fit.objectives import GaussianPosePrior, Objective
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, surface_noise, surface_objective
from torchreg.alignment.known_dofs import KnownDofs
from torchreg.capture.depth_frame import DepthFrame
from torchreg.errors import InputError
from torchreg.geometry.far_origin import to_local, to_world
from torchreg.geometry.loaded import as_points
from torchreg.result import normal_copy
from torchreg.shapes.pose_algebra import difference, retract
from torchreg.solvers.banded import BandedSystem
from torchreg.solvers.robust import welsch_weight
from torchreg.tracking.config import TrackConfig
from torchreg.tracking.frame import Frame
from torchreg.tracking.frame_fit import FrameFitter
from torchreg.tracking.motion_model import FILTER, initial_state
from torchreg.tracking.results import TrackResult


@dataclass(frozen=True)
class Smoothing:
    """Numbers of the second pass."""

    rounds: int = 3  # of linearizing the data and estimating how fast the shape accelerates
    tails: float = 4.0  # degrees of freedom of Student's t: a few frames may be those of another motion
    damping: float = 1e-5  # of the data's curvature, relative: single precision makes that of alike joints indefinite
    held: float = 1e-5  # deviation of what is the same in all frames, radians or metres


_SMOOTHING = Smoothing()


def smooth_track(
    track: TrackResult,
    frames: Sequence[Tensor | DepthFrame],
    *,
    config: TrackConfig | None = None,
    priors: Sequence[tuple[Any, Any] | None] | None = None,
    keypoints: Sequence[Tensor] | Tensor | None = None,
    keypoint_std: Tensor | float | None = None,
) -> TrackResult:
    """Return a tracked sequence whose poses rest on all frames, those before and those after.

    All poses of a stretch that was followed are estimated at once: least squares of the data of all frames, and of
    accelerations ``x_{t+1} - 2 x_t + x_{t-1} ~ t_4(0, q)``, whose scale q of each degree of freedom is estimated with
    the poses (expectation maximization). A frame in between that was not usable gets its pose from its neighbors;
    statuses and confidences stay those of the tracker. A stretch ends where more frames than three in a row were not
    usable. Coefficients are those that the tracker ended with.

    Args:
        track: of T frames, from `Tracker.run`.
        frames: the T frames that were tracked, as they were given to it.
        config: of the tracker.
        priors: see `Tracker.run`.
        keypoints: see `Tracker.run`.
        keypoint_std: see `Tracker.run`.

    Returns:
        The track with other poses, std and keypoints.

    Raises:
        InputError: if there are not as many frames as poses, or the track knows no shape.

    Differentiable: no.

    References: Rauch, Tung and Striebel 1965; Bell 1994, the iterated Kalman smoother as Gauss-Newton.
    """
    if track.shape is None:
        raise InputError("track must know its shape; give the result of a tracker")
    if len(frames) != len(track.statuses):
        raise InputError(f"frames must be the {len(track.statuses)} of the track, got {len(frames)}")
    local = to_local(track.poses, track.origin).to(track.shape.rest)
    poses, std = local.clone(), track.std.clone()
    given = _Given(frames, priors, keypoints, keypoint_std, track.origin)
    with torch.inference_mode(), one_thread(), track.shape.held_sizes():
        smoother = _Smoother(FrameFitter(track.shape, config or TrackConfig(), None), track, given)
        for stretch in _stretches(track):
            poses[stretch], std[stretch] = smoother(local[stretch], stretch)
        placed = track.shape.keypoints(poses)
    offset = 0 if track.origin is None else track.origin
    return normal_copy(replace(
        track, poses=to_world(poses, track.origin).to(track.poses), std=std.to(track.std),
        keypoints=(placed + offset).to(track.keypoints),
    ))  # fmt: skip


@dataclass(frozen=True)
class _Given:
    """What was measured in the frames of a track, whose results begin at an origin (3,)."""

    frames: Sequence[Tensor | DepthFrame]
    priors: Sequence[tuple[Any, Any] | None] | None
    keypoints: Sequence[Tensor] | Tensor | None
    keypoint_std: Tensor | float | None
    origin: Tensor | None

    def frame(self, number: int, fitter: FrameFitter) -> Frame:
        """Return a frame as it was tracked."""
        given = to_local(self.frames[number], self.origin)
        picture = given if isinstance(given, DepthFrame) else None
        cloud = as_points(given).to(fitter.shape.rest)
        known = KnownDofs.of(fitter.shape, (), None if self.priors is None else self.priors[number])
        seen = None if self.keypoints is None else torch.as_tensor(self.keypoints[number])
        measured = None
        if seen is not None and bool(seen.isfinite().all(-1).any()):
            camera = None if picture is None else picture.camera
            measured = MeasuredKeypoints.of(fitter.shape, seen, self.keypoint_std, camera, fitter.size)
        measured = to_local(measured, self.origin) if picture is None else measured
        return Frame(
            cloud=cloud, finite=cloud.isfinite().all(-1), elapsed=1.0, picture=picture,
            known=to_local(known, self.origin), keypoints=measured,
        )  # fmt: skip


def _stretches(track: TrackResult) -> Iterator[slice]:
    """Yield the frames from a usable one to another with no long gap between them, three at least."""
    usable = [number for number, status in enumerate(track.statuses) if status.usable]
    ends = [k for k in range(1, len(usable)) if usable[k] - usable[k - 1] > FILTER.max_ahead + 1]
    for first, last in zip([0, *ends], [*ends, len(usable)], strict=True):
        if last - first > 2:
            yield slice(usable[first], usable[last - 1] + 1)


class _Smoother:
    """Estimates the poses of a stretch of frames at once."""

    def __init__(self, fitter: FrameFitter, track: TrackResult, given: _Given) -> None:
        self.fitter, self.track, self.given = fitter, track, given
        self.state = initial_state(fitter.skin, fitter.shape.rest, fitter.config.seed)

    def __call__(self, poses: Tensor, stretch: slice) -> tuple[Tensor, Tensor]:
        """Return the poses (R, num_dofs) and their deviations from the tracked ones."""
        numbers = range(len(self.track.statuses))[stretch]
        usable = [self.track.statuses[number].usable for number in numbers]
        data = [self._objective(number, pose) if good else None
                for number, pose, good in zip(numbers, poses, usable, strict=True)]  # fmt: skip
        poses, times = poses.double(), self.track.times[stretch]
        # Of a gap's middle nothing is known but its neighbors.
        for row in (row for row, good in enumerate(usable) if not good):
            poses[row] = poses[row - 1]
        scale = _accelerations(poses, times).square().mean(0).clamp_min(_SMOOTHING.held**2)
        still = difference(poses[:1].expand_as(poses), poses).abs().amax(0) <= _SMOOTHING.held
        weights, system = torch.ones_like(times[2:]), None
        for _ in range(_SMOOTHING.rounds):
            gradient, blocks = self._data(data, poses, still)
            bend, steps = _accelerations(poses, times), _coefficients(times)
            precision = weights.unsqueeze(-1) / scale
            for first in range(3):
                rows = slice(first, first + len(bend))
                gradient[rows] += steps[:, first, None] * precision * bend
                for second in range(first + 1):
                    share = (steps[:, first] * steps[:, second]).unsqueeze(-1) * precision
                    blocks[first - second][rows].diagonal(dim1=-2, dim2=-1).add_(share)
            system = BandedSystem(blocks)
            poses = retract(poses, -system.solve(gradient))
            covariance = system.inverse()
            spread = sum(
                (1 if first == second else 2) * (steps[:, first] * steps[:, second]).unsqueeze(-1)
                * covariance[first - second][first : first + len(bend)].diagonal(dim1=-2, dim2=-1)
                for first in range(3) for second in range(first + 1)
            )  # fmt: skip
            # Rounding makes the small difference of large variances negative.
            squares = _accelerations(poses, times).square() + torch.as_tensor(spread).clamp_min(0)
            count = len(scale)
            weights = (_SMOOTHING.tails + count) / (_SMOOTHING.tails + (squares / scale).sum(-1))
            scale = (weights.unsqueeze(-1) * squares).mean(0).clamp_min(_SMOOTHING.held**2)
        std = covariance[0].diagonal(dim1=-2, dim2=-1).sqrt()
        return self.fitter.shape.clamp(poses.to(self.fitter.shape.rest)), std

    def _objective(self, number: int, pose: Tensor) -> tuple[Objective, Tensor] | None:
        """Return the cost of a pose (num_dofs,) in a frame, and the origin (3,) of its coordinates."""
        state = replace(self.state, frame=number + 1)
        view = self.fitter.view(state, self.given.frame(number, self.fitter), pose)
        if view is None:
            return None
        problem = view.problem
        local = view.to_local(pose[None])[0]
        distance = problem.surface.distance(problem.data, local)
        noise = surface_noise(distance, problem.valid, problem.size)
        sigma = SURFACE_FIT.width_per_noise * noise
        near = welsch_weight((distance / sigma.unsqueeze(-1)).square()) * problem.valid
        shared = correlated_count(neighbor_correlation(problem.data, distance, near)).clamp_min(1)
        known = torch.zeros_like(local[0])
        if problem.prior_precision is not None:
            known = torch.where(problem.prior_precision[0] > 0, problem.prior.precision, known)
        prior = GaussianPosePrior(problem.prior.mean, known)
        return surface_objective(problem, sigma, noise * shared.sqrt(), prior), view.origin

    def _data(
        self, data: Sequence[tuple[Objective, Tensor] | None], poses: Tensor, still: Tensor
    ) -> tuple[Tensor, list[Tensor]]:
        """Return the gradient (R, D) of the data's cost at poses (R, D), and the blocks of its Hessian."""
        count, dofs = poses.shape
        rest = self.fitter.shape.rest.double()
        # What no frame shows is near rest: one prior for the whole stretch.
        weak = self.fitter.joint_precision(FILTER.max_joint_std).double() / count
        weak = weak + torch.where(still, _SMOOTHING.held**-2, self.fitter.size**-2 / count)
        gradient = weak * torch.where(still | (torch.arange(dofs) < 6), 0.0, poses - rest)
        blocks = [poses.new_zeros(count, dofs, dofs) for _ in range(3)]
        blocks[0] += weak.diag()
        for row, term in enumerate(data):
            if term is None:
                continue
            objective, origin = term
            local = torch.cat([poses[row, :3] - origin, poses[row, 3:]]).to(self.fitter.shape.rest)
            around = objective(local[None])
            gradient[row] += around.gradient[0]
            blocks[0][row] += around.hessian[0]
            blocks[0][row].diagonal().add_(_SMOOTHING.damping * around.hessian[0].diagonal())
        return gradient, blocks


def _coefficients(times: Tensor) -> Tensor:
    """Return the shares (R - 2, 3) of three poses in an acceleration, in intervals, at times (R,)."""
    gaps = times.diff()
    gaps = gaps / gaps.median()
    before, after = gaps[:-1].reciprocal(), gaps[1:].reciprocal()
    return torch.stack([before, -before - after, after], dim=-1)


def _accelerations(poses: Tensor, times: Tensor) -> Tensor:
    """Return the changes of velocity (R - 2, D) at poses (R, D), per interval."""
    steps, shares = difference(poses[:-1], poses[1:]), _coefficients(times)
    return shares[:, 2:] * steps[1:] - shares[:, :1] * steps[:-1]
