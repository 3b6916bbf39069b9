"""Fits a tracked shape to one frame: the data in reach, the descent from the prediction, the evidence at its end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchreg.alignment.config import AlignConfig
from torchreg.alignment.evidence.confidence import end_motions, end_variances, limb_ends, overlap, own_shares
from torchreg.alignment.evidence.coverage import unseen_share
from torchreg.alignment.evidence.curvature import hardly_gains
from torchreg.alignment.evidence.reliability import Evidence, weigh
from torchreg.alignment.fit.annealed_em import SigmaSchedule, anneal, narrowing
from torchreg.alignment.fit.free_space_term import INTRUSION, FreeSpaceTerm
from torchreg.alignment.fit.landmarks import keypoint_skin
from torchreg.alignment.fit.objectives import Factor, GaussianPosePrior
from torchreg.alignment.fit.problem import (
    INLIER_SHARE,
    PRIOR_SHARE,
    AlignProblem,
    alignment_cost,
    centered_problem,
    free_space_loss,
)
from torchreg.alignment.fit.surface_fit import (
    SURFACE_FIT,
    SurfaceResult,
    pose_covariance,
    refine_surface,
    surface_noise,
    surface_steps,
)
from torchreg.alignment.search.multi_start import SEARCH_BUDGET
from torchreg.geometry.neighbors import sampling_distance
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.limbs import Limb, find_limbs
from torchreg.shapes.pose_algebra import shifted
from torchreg.shapes.primitives import fuse
from torchreg.shapes.skin import LinearBlendSkin, sample_skin, stacked_rows
from torchreg.solvers.cover import best_covers
from torchreg.solvers.robust import welsch_loss, welsch_weight
from torchreg.tracking.config import TrackConfig
from torchreg.tracking.evidence import UnexplainedClusters, share_at_limits
from torchreg.tracking.frame import MIN_DATA, WIDTHS, Frame, FrameFit, FrameView, frame_generator, subsample
from torchreg.tracking.motion_model import FILTER, moves_fast, predict_pose, prediction_std, uncertainty_growth
from torchreg.tracking.person_filter import KnownPerson, Motion, OrientedScan, PersonFilter, PersonFit
from torchreg.tracking.results import TrackState


@dataclass(frozen=True)
class FastMotion:
    """Numbers of the fit of fast limbs. Lengths are shares of the model's size."""

    paces: tuple[float, ...] = (-1.0, 0.0, 0.5, 1.5, 2.0, 3.0)  # starts in velocities: joints turn back or speed up
    num_scattered: int = 2  # starts with the joints drawn at random
    score_width: float = 0.012  # kernel of the comparison: a limb on its neighbor's data misses its own by little
    beam: int = 32  # combinations kept from limb to limb


FAST_MOTION = FastMotion()


def scatter_joints(pose: Tensor, std: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return ``count`` poses (count, num_dofs) with joints drawn about a pose (1, num_dofs), of std (num_dofs - 6,)."""
    offsets = torch.randn(count, len(std), generator=generator, dtype=torch.float32).to(pose) * std
    return torch.cat([pose[:, :6].expand(count, -1), pose[:, 6:] + offsets], dim=-1)


def fit_limbs(problem: AlignProblem, starts: Tensor, limbs: Sequence[Limb], generator: torch.Generator) -> Tensor:
    """Return the pose (1, num_dofs) that explains most data, each limb fitted from the best of starts (S, num_dofs)."""
    rows = torch.zeros(len(starts), dtype=torch.long, device=starts.device)
    batch = problem.draw(SEARCH_BUDGET.num_coarse_data, generator).rows(rows)
    noise = torch.full_like(starts[:, 0], SEARCH_BUDGET.noise * problem.size)
    for share in narrowing(WIDTHS.coarse, WIDTHS.stop):
        solved = surface_steps(batch, starts, torch.full_like(noise, share * problem.size), noise, 1)
        starts = solved.state
    # A limb without data stays at its prediction.
    poses = torch.cat([starts, problem.prior.mean])
    return combine_limbs(problem, poses, int(solved.cost.argmin()), [limb for limb in limbs if limb.dofs])


def combine_limbs(problem: AlignProblem, poses: Tensor, best: int, limbs: Sequence[Limb]) -> Tensor:
    """Return one of the poses (S, num_dofs), as (1, num_dofs), with each limb as in the pose that suits it best.

    Limbs are chosen jointly, so that no two explain the same data. The base is that of the pose with index ``best``.
    """
    if not limbs:
        return poses[best : best + 1]
    shape = problem.skin.shape
    options = torch.cat([poses[best : best + 1, :6].expand(len(poses), -1), poses[:, 6:]], dim=-1)
    distances = shape.placed_distances(problem.data, shape.part_transforms(options))
    width = FAST_MOTION.score_width * problem.size
    dof_costs = PRIOR_SHARE * 0.5 * problem.prior.precision * (options - problem.prior.mean).square()
    limb_losses, limb_costs = [], []
    for limb in limbs:
        neighbors = shape.adjacency[limb.parts][:, limb.parts]
        limb_distances = fuse(distances[:, limb.parts].mT, neighbors, shape.fusion_length())[0]
        limb_losses.append(welsch_loss((limb_distances / width).square())[None])
        limb_costs.append(dof_costs[:, limb.dofs].sum(-1)[None])
    moved = {part for limb in limbs for part in limb.parts}
    trunk = [part for part in range(shape.num_parts) if part not in moved]
    trunk_loss = torch.ones_like(distances[0, 0])
    if trunk:
        trunk_loss = welsch_loss((distances[best, trunk].amin(0) / width).square())
    index, _ = best_covers(trunk_loss[None], limb_losses, limb_costs, count=1, beam=FAST_MOTION.beam, num_exchanged=0)
    pose = options[best : best + 1].clone()
    for limb, option in zip(limbs, index[0, 0].tolist(), strict=True):
        pose[0, limb.dofs] = options[option, limb.dofs]
    return pose


@dataclass(frozen=True)
class FrameSettings:
    """Numbers of the fit of a frame. Lengths are shares of the model's size."""

    reach: float = 0.12  # from the bounding box of the predicted model to data in reach, per interval
    sigma_ratio: float = 2.2  # of first and last sigma: with a larger one, a third sigma lies between them
    min_limb_data: float = 6.0  # soft count of a limb's inliers: with fewer, it stays at its prediction
    min_lever: float = 0.05  # from its joints to the inliers that count: nearer ones tell no angles
    deviation_quantile: float = 0.9  # of the model points' deviations: the rest may be limbs that were missed


_SETTINGS = FrameSettings()


class FrameFitter:
    """Fits a shape to frames, from predictions or from given poses.

    Args:
        shape: the articulated shape, in metres.
        config: see `TrackConfig`.
        skin: the model points; sampled by default.
        person: whose coefficients are fitted too.
        clusters: of a shape of about the same proportions, whose limbs reach as far in its own size.
    """

    def __init__(
        self, shape: ArticulatedShape, config: TrackConfig, skin: LinearBlendSkin | None,
        person: PersonFilter | None = None, clusters: UnexplainedClusters | None = None,
    ) -> None:  # fmt: skip
        self.shape, self.config, self.person = shape, config, person
        # About half of the shape's points are seen at a time.
        count = config.num_model_points * (2 if config.model_points == "seen" else 1)
        self.skin = skin or sample_skin(shape, count, sharpness=config.sharpness)
        self.limbs = find_limbs(shape)[0]
        self._ends = limb_ends(self.skin)
        self._skin_area = sampling_distance(self.skin.points) ** 2
        origin = torch.zeros_like(shape.rest[None, :3])
        self._template = centered_problem(
            self.skin, origin[None], torch.ones_like(origin[:, :1], dtype=torch.bool), shape.rest[None], origin,
            prior_std=1.0, pose_atol=AlignConfig().pose_atol, debias=config.debias,
        )  # fmt: skip
        self.size, self._at_rest = self._template.size, own_shares(self._template, shape.rest[None])
        self.inlier_distance = config.inlier_distance or INLIER_SHARE * self.size
        self.clusters = (
            clusters.scaled(self.size) if clusters else UnexplainedClusters(self.skin, self.limbs, self.size)
        )

    def predict(self, state: TrackState, elapsed: float) -> Tensor:
        """Return the pose (num_dofs,) expected after some intervals."""
        return state.pose if self.config.prediction == "none" else predict_pose(self.shape, state, elapsed)

    def view(
        self, state: TrackState, frame: Frame, pose: Tensor, skin: LinearBlendSkin | None = None
    ) -> FrameView | None:
        """Return the frame as seen from a pose (num_dofs,), with a wide prior about it; None without data in reach.

        What is known of the pose takes the place of what would be expected.
        """
        pose = pose if frame.known is None else frame.known.start(self.shape, pose)
        origin = pose[:3].clone()
        local = shifted(pose, -origin)
        rows = stacked_rows(self.shape.part_transforms(local))
        posed, reach = self.skin.place(rows), _SETTINGS.reach * self.size * uncertainty_growth(state, frame.elapsed)
        data = frame.cloud - origin
        in_reach = ((data > posed.amin(0) - reach) & (data < posed.amax(0) + reach)).all(-1)
        num_in_reach = int(in_reach.sum())
        data = subsample(data[in_reach], self.config.max_points, frame_generator(state))
        if len(data) < MIN_DATA:
            return None
        shift = torch.nn.functional.pad(origin, (0, self.shape.num_dofs - 3))
        problem = replace(
            self._template, skin=skin or self.skin, data=data[None],
            valid=torch.ones_like(data[None, :, 0], dtype=torch.bool),
            lower=self.shape.lower - shift, upper=self.shape.upper - shift,
            prior=GaussianPosePrior(local[None], self.joint_precision(FILTER.max_joint_std)),
            factors=self._factors(frame, skin or self.skin, origin, num_in_reach / len(data)),
        )  # fmt: skip
        if frame.known is not None:
            informed = frame.known.near(origin).with_prior(problem, local[None])
            prior = replace(informed.prior, precision=informed.prior.precision[0])
            problem = replace(informed, lower=informed.lower[0], upper=informed.upper[0], prior=prior)
        viewpoint = None if frame.picture is None else frame.picture.camera.position - origin
        return FrameView(
            problem=problem, origin=origin, rows=rows, in_reach=in_reach, elapsed=frame.elapsed, viewpoint=viewpoint,
            scan=None if self.person is None else OrientedScan.of(data, viewpoint),
        )  # fmt: skip

    @cached_property
    def _keypoints(self) -> LinearBlendSkin:
        return keypoint_skin(self.shape)

    def _factors(self, frame: Frame, skin: LinearBlendSkin, origin: Tensor, thinning: float) -> tuple[Factor, ...]:
        """Return what a frame says of poses about an origin (3,) beside data that each stand for some of its own."""
        factors: list[Factor] = []
        if frame.picture is not None:
            space = frame.picture.free_space.to(origin).moved(origin).thinned(origin.new_tensor([thinning]))
            factors.append(FreeSpaceTerm(space, skin, self._skin_area, INTRUSION.tolerance * self.size))
        if frame.keypoints is not None:
            factors.append(frame.keypoints.of_problems(self._keypoints, origin[None]))
        return tuple(factors)

    def look(self, state: TrackState, frame: Frame, pose: Tensor) -> FrameView | None:
        """Return the frame as seen from the predicted pose (num_dofs,), with the model points that were seen last.

        None without data in reach and before the first fit.
        """
        if not state.tracked:
            return None
        skin = LinearBlendSkin(self.shape, state.points, state.weights, state.reference_pose)
        return self.view(state, frame, pose, skin)

    def fit_at(self, state: TrackState, frame: Frame, pose: Tensor, acquired: str) -> FrameFit | None:
        """Return the fit of the surface from a pose (num_dofs,) of the world, None without data in reach."""
        view = self.view(state, frame, pose)
        return None if view is None else self.fit(view, state, acquired, view.problem.prior.mean)

    def descend(self, view: FrameView, state: TrackState, elapsed: float) -> FrameFit:
        """Return the fit by descent from a predicted view: annealed EM, or many starts for fast limbs; then surface."""
        problem = replace(view.problem, prior=self._prediction_prior(view.problem, state, elapsed))
        view = replace(view, problem=problem)
        if moves_fast(state, self.size):
            return self.fit(view, state, "tracked", self._fit_fast_limbs(view, state, elapsed), widths=())
        schedule = self._sigma_schedule(state, elapsed)
        registered = anneal(problem, problem.prior.mean, schedule, em_steps=self.config.em_steps, m_steps=1)
        return self.fit(view, state, "tracked", registered.pose)

    def fit(
        self, view: FrameView, state: TrackState, acquired: str, pose: Tensor,
        widths: Sequence[float] = (WIDTHS.surface,),
    ) -> FrameFit:  # fmt: skip
        """Return the fit of the surface from a pose (1, num_dofs) of the view, with the evidence for it.

        Kernel widths before the last are ``widths``, shares of the model's size.
        """
        problem, person = view.problem, None
        if self.person is None or acquired != "tracked":
            fitted = refine_surface(problem, pose, steps=self.config.surface_steps, widths=widths)
            pose = fitted.pose
        known = state.known_person
        if self.person is not None and view.scan is not None and known is not None:
            person = self._fitted_person(self.person, known, view, view.scan, state, acquired, pose[0])
            pose = person.pose.unsqueeze(0)
            fitted = SurfaceResult(
                pose, *problem.surface.distance_jacobian(problem.data, pose), person.last_step.unsqueeze(0)
            )  # fmt: skip
        residual = surface_noise(fitted.distance, problem.valid, self.size)
        if state.tracked and person is None:
            fitted = self._with_unseen_limbs_predicted(problem, fitted, residual)
        return replace(self._with_evidence(view, state, acquired, fitted, residual[0]), person=person)

    def _fitted_person(
        self, person: PersonFilter, known: KnownPerson, view: FrameView, scan: OrientedScan, state: TrackState,
        acquired: str, pose: Tensor,
    ) -> PersonFit:  # fmt: skip
        """Return the fit of pose and coefficients from a pose (num_dofs,)."""
        motion = None
        if not state.tracked and acquired == "tracked":
            return person.joined(known, scan, pose)
        if state.lost == 0 and acquired != "found":
            prior = self._prediction_prior(view.problem, state, view.elapsed)
            motion = Motion(view.problem.prior.mean[0], prior.precision.rsqrt())
        return person.fit(known, scan, pose, motion)

    def covariance(self, fit: FrameFit) -> tuple[Tensor, Tensor]:
        """Return the covariance (num_dofs, num_dofs) of a fit and its observed share (num_dofs,).

        The observed share is that of what is known of a degree of freedom which comes from the data, from 0 to 1.
        """
        prior = fit.view.problem.prior
        precision = prior.precision.clone()
        if not prior.holds_base:
            precision[:6] = precision.new_tensor([self.size] * 3 + [math.pi] * 3).square().reciprocal()
        weights = _inlier_weights(fit.distance[0], fit.residual)
        if fit.person is None:
            covariance = pose_covariance(fit.jacobian[0], weights, fit.residual, precision)
        else:
            covariance = fit.person.known.total[: len(precision), : len(precision)]
        return covariance, (1 - covariance.diagonal() * precision).clamp(0, 1)

    def judged(self, fit: FrameFit, covariance: Tensor) -> tuple[Evidence, bool]:
        """Return the evidence for a fit with a covariance (num_dofs, num_dofs), and whether it has converged.

        Where coefficients are fitted too, both rest on the errors of the surface, as in `align`.
        """
        problem, pose = fit.view.problem, fit.pose
        moves = end_motions(self.skin, pose, self._ends)
        evidence = weigh(
            problem, fit.distance, clustered=pose.new_tensor([len(fit.unexplained) / max(1, fit.num_inliers)]),
            spread=end_variances(moves, covariance[None]).clamp_min(torch.finfo(pose.dtype).tiny).sqrt().mean(-1),
            intruding=fit.intruding,
        )  # fmt: skip
        if fit.person is not None:
            error = fit.person.error
            return replace(evidence, unknown=error.unknown(self.size)), bool(error.converged)
        unseen = unseen_share(problem, pose, fit.distance, fit.jacobian).sqrt()
        # The view's skin may hold what was seen last alone.
        shared = overlap(replace(problem, skin=self.skin), pose, self._at_rest).sum(-1)
        evidence = replace(evidence, unseen=unseen, overlap=shared)
        converged = float(problem.change(fit.last_step)) <= problem.pose_atol or hardly_gains(
            problem, pose, fit.distance, fit.jacobian, fit.residual[None], covariance[None]
        )
        return evidence, bool(converged)

    def _with_evidence(
        self, view: FrameView, state: TrackState, acquired: str, fitted: SurfaceResult, residual: Tensor
    ) -> FrameFit:
        """Return a fitted surface, with its residual (), and the evidence for it."""
        problem, pose, distance = view.problem, fitted.pose, fitted.distance
        transforms = self.shape.part_transforms(pose[0])
        unexplained = self.clusters.find(problem.data[0], distance[0], residual)
        moved = (problem.skin.place(stacked_rows(transforms)) - problem.skin.place(view.rows)).norm(dim=-1)
        intruding = free_space_loss(problem, pose)
        wide_prior = GaussianPosePrior(problem.prior.mean, self.joint_precision(FILTER.max_joint_std))
        return FrameFit(
            view=view, pose=pose, distance=distance, jacobian=fitted.jacobian, transforms=transforms,
            residual=residual, last_step=fitted.last_step,
            cost=float(alignment_cost(replace(problem, prior=wide_prior), pose, distance)),
            intruding=intruding, num_inliers=int((distance.abs() < self.inlier_distance).sum()),
            unexplained=unexplained, num_new_unexplained=self.clusters.count_new(state, unexplained, transforms[0]),
            limit_share=share_at_limits(problem, pose),
            deviation=float(moved.quantile(_SETTINGS.deviation_quantile)), acquired=acquired,
        )  # fmt: skip

    def joint_precision(self, std: float) -> Tensor:
        """Return the prior's precision (num_dofs,) for a standard deviation of the joints; zero for the base."""
        return self._template.prior.precision / std**2

    def _prediction_prior(self, problem: AlignProblem, state: TrackState, elapsed: float) -> GaussianPosePrior:
        """Return the prior about the prediction, the base included: few data may not turn it away."""
        prior = problem.prior
        shift, turn, joints = prediction_std(state, elapsed, self.size, self.config.prior_std).tolist()
        precision = self.joint_precision(joints)
        precision[:3], precision[3:6] = shift**-2, turn**-2
        if problem.prior_precision is not None:
            precision = torch.where(problem.prior_precision[0] > 0, prior.precision, precision)
        return GaussianPosePrior(prior.mean, precision, holds_base=True)

    def _sigma_schedule(self, state: TrackState, elapsed: float) -> SigmaSchedule:
        error = uncertainty_growth(state, elapsed) * state.prediction_error
        share = FILTER.std_per_error * error / self.size
        start = self.size * min(max(share, WIDTHS.min_start), WIDTHS.max_start)
        stop = WIDTHS.stop * self.size
        return SigmaSchedule.geometric(start, stop, 2 if start < _SETTINGS.sigma_ratio * stop else 3)

    def _fit_fast_limbs(self, view: FrameView, state: TrackState, elapsed: float) -> Tensor:
        """Return a pose (1, num_dofs) with each limb from the best of many starts around the prediction."""
        problem, prior = view.problem, view.problem.prior
        generator = frame_generator(state)
        std = FILTER.max_joint_std * self._template.prior.precision[6:].rsqrt()
        scattered = scatter_joints(prior.mean, std, FAST_MOTION.num_scattered, generator)
        starts = [prior.mean, problem.clamp(scattered)]
        if self.config.prediction == "velocity":
            paced = predict_pose(self.shape, state, elapsed, prior.mean.new_tensor(FAST_MOTION.paces))
            starts.append(view.to_local(paced)[0])
        precision = prior.precision.clone()
        precision[:6] = 0
        base_free = replace(problem, prior=GaussianPosePrior(prior.mean, precision))
        return fit_limbs(base_free, torch.cat(starts), self.limbs, generator)

    def _with_unseen_limbs_predicted(
        self, problem: AlignProblem, fitted: SurfaceResult, residual: Tensor
    ) -> SurfaceResult:
        """Return the fit with limbs at their prediction that hardly any data show.

        What attracts such a limb are single outliers and the edges of its neighbors; unless keypoints of it were seen.
        """
        if not self.limbs:
            return fitted
        levers = [fitted.jacobian[0][:, limb.dofs].norm(dim=-1) for limb in self.limbs]
        shown = torch.stack(levers) > _SETTINGS.min_lever * self.size
        counts = (_inlier_weights(fitted.distance[0], residual) * shown).sum(-1).tolist()
        detected = set[int]().union(*(factor.seen_parts() for factor in problem.factors))
        unseen = [
            limb
            for limb, count in zip(self.limbs, counts, strict=True)
            if count < _SETTINGS.min_limb_data and detected.isdisjoint(limb.parts)
        ]
        dofs = [dof for limb in unseen for dof in limb.dofs]
        if not dofs:
            return fitted
        pose = fitted.pose.clone()
        pose[:, dofs] = problem.prior.mean[:, dofs]
        distance, jacobian = problem.surface.distance_jacobian(problem.data, pose)
        return replace(fitted, pose=pose, distance=distance, jacobian=jacobian)


def _inlier_weights(distance: Tensor, residual: Tensor) -> Tensor:
    """Return robust weights (M,) of data at distances (M,), from their standard deviation."""
    return welsch_weight((distance / (SURFACE_FIT.width_per_noise * residual)).square())
