"""Alignment to measured keypoints alone, without any points: annealed least squares from poses all around."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.alignment.evidence.confidence import end_motions, end_variances, limb_ends
from torchreg.alignment.evidence.curvature import dof_confidence, plausible_precision, told_open
from torchreg.alignment.evidence.reliability import CALIBRATION
from torchreg.alignment.fit.annealed_em import narrowing
from torchreg.alignment.fit.landmarks import Landmarks, MeasuredKeypoints
from torchreg.alignment.fit.objectives import Objective
from torchreg.alignment.fit.problem import BROAD_PRIOR, PRIOR_SHARE, AlignProblem, centered_problem
from torchreg.alignment.known_dofs import KnownDofs
from torchreg.alignment.results import AlignResult, PoseStarts
from torchreg.alignment.search.multi_start import SEARCH_BUDGET, Candidates
from torchreg.alignment.search.rough_poses import UniformRotations, typical_poses
from torchreg.errors import InputError
from torchreg.geometry.rotation import so3_log, spread_rotations
from torchreg.result import Status, normal_copy
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.pose_algebra import BASE_DOFS, shifted
from torchreg.shapes.skin import LinearBlendSkin


@dataclass(frozen=True)
class _Search:
    """Numbers of a fit to keypoints alone; lengths are shares of the model's size."""

    start: float = 0.3  # by which keypoints may be off beside their own errors, from poses all around
    near: float = 0.08  # the same from a pose that is given
    ranked: float = 0.04  # the same where the best candidates are taken
    stop: float = 0.005  # the same of these in the end
    steps: int = 2  # at each width
    refined: int = 24  # best candidates, of which each is refined
    refine_steps: int = 15
    least: int = 4  # keypoints that agree with a pose, at least: three hold a rigid body, and leave two ways


_SEARCH = _Search()


@dataclass(frozen=True, eq=False)
class KeypointRows:
    """Poses (S, num_dofs) of keypoints alone, for `align`: candidates, in the end the different ones, best first.

    ``widths`` are those of the first step; ``costs`` (S,), and the lead () over the next different pose, of the last.
    """

    problem: AlignProblem
    poses: Tensor
    widths: tuple[float, ...]
    costs: Tensor
    lead: Tensor

    @classmethod
    @torch.no_grad()
    def of(
        cls, skin: LinearBlendSkin, measured: MeasuredKeypoints | None, start: Tensor | None, known: KnownDofs | None
    ) -> KeypointRows:
        """Return the rows of given starts (S, num_dofs), or else of typical poses all around."""
        if measured is None:
            raise InputError("data must be given, or keypoints: there is nothing to align to")
        if measured.targets.ndim != 2:
            got = tuple(measured.targets.shape)
            raise InputError(f"keypoints alone must be of one frame, (K, 2) or (K, 3), got {got}")
        shape = skin.shape
        origin = _center(shape, measured)[None]
        near = typical_poses(shape).mean(0) if start is None else start[0]
        problem = centered_problem(
            skin, origin.unsqueeze(1), torch.zeros_like(origin[:, :1], dtype=torch.bool), near[None], origin,
            prior_std=BROAD_PRIOR.typical, pose_atol=1e-4, keypoints=measured,
        )  # fmt: skip
        if known is not None:
            given = known.start(shape, None if start is None else near)
            problem = known.with_prior(problem, shifted(given[None], -origin))
        pool = _all_around(problem) if start is None else shifted(start, -origin)
        pool = problem.clamp_candidates(pool[None])[0]
        widths = narrowing(_SEARCH.start if start is None else _SEARCH.near, _SEARCH.ranked)
        return cls(problem, pool, widths, costs=pool[:, 0], lead=pool[0, 0])

    def annealed(self) -> KeypointRows:
        """Return the best rows after damped steps at narrowing widths."""
        pool = _descended(self.problem, self.poses, self.widths)
        best = _objective(self.problem.repeated(len(pool)), 0.0).cost(pool).argsort()[: _SEARCH.refined]
        return replace(self, poses=pool[best])

    def fitted(self) -> KeypointRows:
        """Return the rows fitted down to the keypoints' own errors alone."""
        pool = _descended(self.problem, self.poses, narrowing(_SEARCH.ranked, _SEARCH.stop))
        wide = self.problem.repeated(len(pool))
        objective = _objective(wide, 0.0)
        poses = wide.solve(objective, pool, _SEARCH.refine_steps, objective(pool)).state
        # The weak prior ranks as it does beside data.
        return replace(self, poses=poses, costs=wide.factor_score(poses, 0.0) + PRIOR_SHARE * wide.prior.cost(poses))

    def restarted(self) -> KeypointRows:
        """Return the rows, which began all around."""
        return self

    def finished(self) -> KeypointRows:
        """Return the rows, best first, duplicates of better ones last."""
        ranked = Candidates.ranked(self.problem, self.poses[None], self.costs[None])
        first = ranked.distinct(SEARCH_BUDGET.same)
        return replace(self, poses=first.poses[0], costs=first.costs[0], lead=ranked.lead()[0])

    def judged(self) -> AlignResult:
        """Return the alignment of the first row; it has no data."""
        skin, size, landmarks, covariance = self.problem.skin, self.problem.size, self._landmarks, self._covariance()
        confidence = self._confidence(covariance)
        pose, none = shifted(self.poses[0], self.problem.origin[0]), skin.points.new_zeros(0)
        sure, right = float(confidence) >= CALIBRATION.doubtful, int(landmarks.agree(self.poses[:1])[0].sum())
        wrong = int(landmarks.seen.sum()) - right
        reasons = [f"{wrong} of the seen keypoints do not agree with the pose"] * (wrong > 0)
        reasons += ["keypoints alone do not tell where the limbs end"] * (not sure)
        reasons += filter(None, [told_open(skin.shape, covariance[0], size)])
        status = Status.CONVERGED if sure else Status.DOUBTFUL
        return normal_copy(AlignResult(
            pose=pose, registered=skin(pose), keypoints=skin.shape.keypoints(pose), distances=none,
            inliers=none.bool(), posterior=none, sigma=none.sum(), cost=self.costs[0],
            status=Status.FEW_INLIERS if right < _SEARCH.least else status,
            covariance=covariance[0], confidence=confidence,
            doubt="; ".join(reasons), dof_confidence=dof_confidence(skin.shape, covariance[0], size),
        ))  # fmt: skip

    def searched_in_doubt(self, found: AlignResult) -> AlignResult:
        """Return the result: rows of given starts are meant."""
        return found

    def found(self, count: int) -> PoseStarts:
        """Return the first rows as starts."""
        poses = shifted(self.poses[:count], self.problem.origin)
        return PoseStarts(poses=poses, costs=self.costs[:count], confidence=self._confidence(self._covariance()))

    @property
    def _landmarks(self) -> Landmarks:
        return next(factor for factor in self.problem.factors if isinstance(factor, Landmarks))

    def _covariance(self) -> Tensor:
        """Return the covariance (1, num_dofs, num_dofs) of the first pose, in tangent coordinates."""
        pose = self.poses[:1]
        precision = plausible_precision(self.problem, pose).double()
        information = self._landmarks.linearized(pose, 0.0).hessian.double() + torch.diag_embed(precision)
        return torch.linalg.inv(information).to(pose)

    def _confidence(self, covariance: Tensor) -> Tensor:
        """Return the probability () that the limbs end where the first pose has them, by a Rayleigh distribution."""
        skin = self.problem.skin
        moves = end_motions(skin, self.poses[:1], limb_ends(skin))
        variance = end_variances(moves, covariance).sqrt().mean().square()
        known = 1 - (-((CALIBRATION.right * self.problem.size) ** 2) / variance).exp()
        return known * torch.sigmoid(self.lead.clamp_max(1 / torch.finfo(variance.dtype).eps))


def _center(shape: Articulation, measured: MeasuredKeypoints) -> Tensor:
    """Return about where the measured keypoints are (3,); in a picture, by how large they look."""
    targets = measured.targets[measured.targets.isfinite().all(-1)].double()
    middle = targets.median(0).values
    if measured.camera is None:
        return middle.to(shape.rest)
    points = shape.keypoints(typical_poses(shape).mean(0)).double()
    spread = (points - points.median(0).values).norm(dim=-1).median()
    seen = (targets - middle).norm(dim=-1).median().clamp_min(1.0)
    depth = measured.camera.intrinsics[:2].mean().double() * spread / seen
    return measured.camera.unproject(middle, depth).to(shape.rest)


def _all_around(problem: AlignProblem) -> Tensor:
    """Return typical poses at evenly spread rotations about the origin (S, num_dofs)."""
    shape = problem.skin.shape
    poses = typical_poses(shape).repeat_interleave(UniformRotations.count, 0)
    turns = so3_log(spread_rotations(UniformRotations.count).to(poses))
    poses[:, 3:BASE_DOFS] = turns.repeat(len(poses) // len(turns), 1)
    return shifted(poses, -shape.keypoints(poses).mean(-2))


def _objective(wide: AlignProblem, width: float) -> Objective:
    """Return the likelihood of the keypoints and the prior, at a width in metres."""
    sigma = torch.full_like(wide.prior.mean[:, 0], width)
    return Objective((*wide.factors, wide.prior), sigma, sigma)


def _descended(problem: AlignProblem, pool: Tensor, widths: tuple[float, ...]) -> Tensor:
    """Return candidates (S, num_dofs) after damped steps at some widths, shares of the size."""
    wide = problem.repeated(len(pool))
    for width in widths:
        objective = _objective(wide, width * problem.size)
        for _ in range(_SEARCH.steps):
            pool = wide.step(objective(pool), pool).state
    return pool


@torch.inference_mode()
def find_keypoints(rows: KeypointRows, count: int) -> PoseStarts:
    """Return the first poses that keypoints alone allow; in the mode of `align`, the same to the last bit."""
    return normal_copy(rows.annealed().fitted().finished().found(count))
