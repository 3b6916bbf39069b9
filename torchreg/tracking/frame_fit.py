"""Fitting a tracked shape to one frame: what is in reach, the descent from the prediction, the evidence for its end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchreg.alignment.align import AlignConfig
from torchreg.alignment.annealed_em import (
    SIGMA_PER_NOISE,
    pose_covariance,
    register,
    settle_surface,
    surface_noise,
)
from torchreg.alignment.objectives import PosePrior
from torchreg.alignment.problem import INLIER_SHARE, AlignProblem, alignment_cost, centered_problem, shifted
from torchreg.alignment.sigma_schedule import SigmaSchedule
from torchreg.geometry.rigid import invert_rigid, transform_points
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.limbs import find_limbs
from torchreg.shapes.skin import LinearBlendSkin, sample_skin, stacked_rows
from torchreg.solvers.robust import welsch_weight
from torchreg.tracking.config import Frame, FrameFit, FrameView, TrackConfig, thinned
from torchreg.tracking.evidence import (
    LimbReach,
    dense_strays,
    in_doubt,
    nearest_distance,
    share_at_limits,
)
from torchreg.tracking.limb_mixing import fit_limbs, scattered
from torchreg.tracking.motion_model import moves_fast, predicted, prior_std, spread
from torchreg.tracking.results import TrackState

# Less data are none.
MIN_DATA = 10
# Last kernel width of a frame's EM, near the noise, as a share of the size.
STOP_SIGMA = 0.02
# Range of the first, this many times the error of the prediction; two that differ by more have one between them.
_START_RANGE, _START_PER_ERROR, _SIGMA_RATIO = (0.03, 0.08), 2.0, 2.2
# Width of the surface fit before the last, which follows from the noise.
_SURFACE_SIGMAS = (0.022,)
# Joints about the last pose where nothing is sure, radians.
_WIDE_PRIOR = 0.3
# Paces at which fast joints go on instead, back to three times as fast; others are scattered by this, so often.
_PACES, _SCATTER, _NUM_SCATTERED = (-1.0, 0.0, 0.5, 1.5, 2.0, 3.0), 0.3, 2
# Data that lie this near the bounds of the predicted model count, as a share of its size.
_REACH = 0.12
# A limb is shown by this many data at least, this far from its joints, as a share of the size.
_MIN_SHOWN, _LEVER = 6.0, 0.05
# Data farther from the surface are off it, standard deviations; strays this near are the same as before, share of size.
_FAR_NOISES, _SAME_STRAY = 3.0, 0.05
# Strays that are remembered: more tell no more.
_MAX_STRAYS = 300
# Most model points: the rest may be limbs that were missed.
_MOST = 0.9


class FrameFitter:
    """What a tracker knows of its shape, and how it fits a frame.

    Args:
        shape: the articulated shape, in metres.
        config: see `TrackConfig`.
        skin: the model points; sampled by default.
    """

    def __init__(self, shape: ArticulatedShape, config: TrackConfig, skin: LinearBlendSkin | None) -> None:
        self.shape, self.config = shape, config
        # About half of the shape's points are seen at a time.
        count = config.num_model_points * (2 if config.model_points == "seen" else 1)
        self.skin = skin or sample_skin(shape, count, sharpness=config.sharpness)
        self.limbs = find_limbs(shape)[0]
        nowhere = torch.zeros_like(shape.rest[None, :3])
        self._template = centered_problem(
            self.skin, nowhere[None], torch.ones_like(nowhere[:, :1], dtype=torch.bool), shape.rest[None], nowhere,
            prior_std=1.0, pose_atol=AlignConfig().pose_atol, debias=config.debias,
        )  # fmt: skip
        self.size = self._template.size
        self.inlier_distance = config.inlier_distance or INLIER_SHARE * self.size
        self._reach = LimbReach(self.skin, self.limbs, _SAME_STRAY * self.size)

    def view(
        self, state: TrackState, frame: Frame, pose: Tensor, skin: LinearBlendSkin | None = None
    ) -> FrameView | None:
        """Return the frame as seen from a pose (num_dofs,), if any data are in reach; the prior holds joints there."""
        origin = pose[:3].clone()
        local = shifted(pose, -origin)
        rows = stacked_rows(self.shape.part_transforms(local))
        posed, reach = self.skin.place(rows), _REACH * self.size * spread(state, frame.gap)
        data = frame.cloud - origin
        near = ((data > posed.amin(0) - reach) & (data < posed.amax(0) + reach)).all(-1)
        data = thinned(data[near], self.config.max_points, generator(state))
        if len(data) < MIN_DATA:
            return None
        shift = torch.nn.functional.pad(origin, (0, self.shape.num_dofs - 3))
        problem = replace(
            self._template, skin=skin or self.skin, data=data[None],
            valid=torch.ones_like(data[None, :, 0], dtype=torch.bool),
            lower=self.shape.lower - shift, upper=self.shape.upper - shift,
            prior=PosePrior(local[None], self._precision(_WIDE_PRIOR)),
        )  # fmt: skip
        return FrameView(problem, origin, rows, near)

    def view_ahead(self, state: TrackState, frame: Frame) -> FrameView | None:
        """Return the frame as seen from the prediction, with the model points that were seen last."""
        seen = LinearBlendSkin(self.shape, state.points, state.weights, state.reference_pose)
        return self.view(state, frame, self.predicted(state, frame.gap), seen)

    def predicted(self, state: TrackState, gap: float) -> Tensor:
        """Return the pose (num_dofs,) expected after some intervals."""
        return state.pose if self.config.prediction == "none" else predicted(self.shape, state, gap)

    def fit_at(self, state: TrackState, frame: Frame, pose: Tensor, how: str) -> FrameFit | None:
        """Return the fit from a pose (num_dofs,), if any data are in reach."""
        view = self.view(state, frame, pose)
        return None if view is None else self.fit(view, state, how, view.problem.prior.mean)

    def descend(self, view: FrameView, state: TrackState, gap: float) -> FrameFit:
        """Return the fit that descent from the prediction leads to: annealed EM, then the surface."""
        problem = replace(view.problem, prior=self._tight_prior(view.problem.prior, state, gap))
        view = replace(view, problem=problem)
        if not moves_fast(state, self.size):
            schedule = self._schedule(state, gap)
            moved = register(problem, problem.prior.mean, schedule, em_steps=self.config.em_steps, m_steps=1).pose
            return self.fit(view, state, "tracked", moved)
        drawn = generator(state)
        starts = [problem.prior.mean, self._scattered(problem, drawn)]
        if self.config.prediction == "velocity":
            # Joints that fast turn back or speed up within a frame, each at another time.
            others = predicted(self.shape, state, gap, problem.prior.mean.new_tensor(_PACES))
            starts.append(view.local(others)[0])
        free = problem.prior.precision.clone()
        free[:6] = 0
        open_ = replace(problem, prior=PosePrior(problem.prior.mean, free))
        moved = fit_limbs(open_, torch.cat(starts), self.limbs, drawn)
        return self.fit(view, state, "tracked", moved, sigmas=())

    def fit(
        self,
        view: FrameView,
        state: TrackState,
        how: str,
        pose: Tensor,
        sigmas: Sequence[float] = _SURFACE_SIGMAS,
    ) -> FrameFit:
        """Return the fit of the surface from a pose (1, num_dofs), and the evidence for it."""
        problem = view.problem
        fitted = settle_surface(problem, pose, steps=self.config.surface_steps, sigmas=sigmas)
        distance, jacobian = fitted.distance, fitted.jacobian
        noise = surface_noise(distance, problem.valid, self.size)
        pose = fitted.pose
        if state.tracked:
            pose = self._modest(problem, fitted.pose, distance, jacobian, noise)
        if pose is not fitted.pose:
            distance, jacobian = problem.surface.distance_jacobian(problem.data, pose)
        transforms = self.shape.part_transforms(pose[0])
        strays = dense_strays(problem.data[0], distance[0].abs() < _FAR_NOISES * noise, self.size)
        known = transform_points(transforms[0], state.unexplained)
        novel = (nearest_distance(strays, known) > _SAME_STRAY * self.size) & self._reach(strays, transforms[0])
        moved = (problem.skin.place(stacked_rows(transforms)) - problem.skin.place(view.rows)).norm(dim=-1)
        wide = replace(problem, prior=PosePrior(problem.prior.mean, self._precision(_WIDE_PRIOR)))
        return FrameFit(
            view, pose, distance, jacobian, transforms, noise=noise[0], change=float(fitted.change),
            cost=float(alignment_cost(wide, pose, distance)),
            inliers=int((distance.abs() < self.inlier_distance).sum()), strays=strays, novel=int(novel.sum()),
            held=share_at_limits(problem, pose), jump=float(moved.quantile(_MOST)), how=how,
        )  # fmt: skip

    def covariance(self, fit: FrameFit) -> tuple[Tensor, Tensor]:
        """Return the covariance of a fit, and which share (num_dofs,) of what is known then the data say."""
        prior = fit.view.problem.prior
        precision = prior.precision.clone()
        if not prior.holds_base:
            precision[:6] = precision.new_tensor([self.size] * 3 + [math.pi] * 3).square().reciprocal()
        weights = welsch_weight((fit.distance[0] / (SIGMA_PER_NOISE * fit.noise)).square())
        covariance = pose_covariance(fit.jacobian[0], weights, fit.noise, precision)
        return covariance, (1 - covariance.diagonal() * precision).clamp(0, 1)

    def strays_after(self, state: TrackState, fit: FrameFit) -> Tensor:
        """Return the strays to be expected in the next frame, in the trunk's frame.

        Those of a doubtful fit may be what the fit missed, and are expected only after attempts to explain them.
        """
        if in_doubt(state) and fit.how != "found":
            return state.unexplained
        strays = transform_points(invert_rigid(fit.transforms[0]), fit.strays)
        # Where there are some still, those of earlier frames show better how far they reach.
        lasting = state.unexplained[nearest_distance(state.unexplained, strays) < _SAME_STRAY * self.size]
        return torch.cat([strays, lasting])[:_MAX_STRAYS]

    def _precision(self, joints: float) -> Tensor:
        return self._template.prior.precision / joints**2

    def _tight_prior(self, prior: PosePrior, state: TrackState, gap: float) -> PosePrior:
        """Return the prior about the prediction, the base included: few data may not turn it away."""
        shift, turn, bend = prior_std(state, gap, self.size, self.config.prior_std).tolist()
        precision = self._precision(bend)
        precision[:3], precision[3:6] = shift**-2, turn**-2
        return PosePrior(prior.mean, precision, holds_base=True)

    def _schedule(self, state: TrackState, gap: float) -> SigmaSchedule:
        low, high = _START_RANGE
        start = self.size * min(
            max(_START_PER_ERROR * spread(state, gap) * state.prediction_error / self.size, low), high
        )
        stop = STOP_SIGMA * self.size
        return SigmaSchedule.geometric(start, stop, 2 if start < _SIGMA_RATIO * stop else 3)

    def _scattered(self, problem: AlignProblem, drawn: torch.Generator) -> Tensor:
        std = _SCATTER * self._template.prior.precision[6:].rsqrt()
        return problem.clamp(scattered(problem.prior.mean, std, _NUM_SCATTERED, drawn))

    def _modest(self, problem: AlignProblem, pose: Tensor, distance: Tensor, jacobian: Tensor, noise: Tensor) -> Tensor:
        """Return a pose (1, num_dofs) with limbs where they are expected that hardly any data show.

        What pulls at such a limb are single outliers and the rims of its neighbors.
        """
        near = welsch_weight((distance[0] / (SIGMA_PER_NOISE * noise)).square())
        levers = [jacobian[0][:, limb.dofs].norm(dim=-1) > _LEVER * self.size for limb in self.limbs]
        if not levers:
            return pose
        shown = (near * torch.stack(levers)).sum(-1).tolist()
        hidden = [dof for limb, count in zip(self.limbs, shown, strict=True) if count < _MIN_SHOWN for dof in limb.dofs]
        if not hidden:
            return pose
        modest = pose.clone()
        modest[:, hidden] = problem.prior.mean[:, hidden]
        return modest


def generator(state: TrackState) -> torch.Generator:
    """Return the randomness of a frame, the same whenever it is asked for."""
    return torch.Generator().manual_seed(state.seed + state.frame)
