"""Alignment to measured keypoints alone, without any points: annealed least squares from poses all around."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchreg.alignment.evidence.confidence import end_motions, end_variances, limb_ends
from torchreg.alignment.evidence.curvature import plausible_precision
from torchreg.alignment.evidence.observability import dof_confidence, told_open
from torchreg.alignment.evidence.reliability import CALIBRATION
from torchreg.alignment.fit.landmarks import Landmarks, MeasuredKeypoints, keypoint_extent
from torchreg.alignment.fit.objectives import Objective
from torchreg.alignment.fit.problem import PRIOR_SHARE, AlignProblem, centered_problem
from torchreg.alignment.known_dofs import KnownDofs
from torchreg.alignment.results import AlignResult, PoseStarts
from torchreg.alignment.search.limb_search import distinct_first
from torchreg.alignment.search.pose_search import mean_distances
from torchreg.alignment.search.rough_poses import bent_pose, spread_rotations, typical_poses
from torchreg.errors import InputError
from torchreg.geometry.camera import Camera
from torchreg.geometry.rotation import so3_log
from torchreg.result import Status, normal_copy
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.pose_algebra import BASE_DOFS, shifted
from torchreg.shapes.skin import LinearBlendSkin


@dataclass(frozen=True)
class _Search:
    """Numbers of a fit to keypoints alone; lengths are shares of the model's size."""

    rotations: int = 200  # of each typical pose, evenly spread
    widths: tuple[float, ...] = (0.3, 0.15, 0.08, 0.04)  # by which keypoints may be off beside their own errors
    near_widths: tuple[float, ...] = (0.08, 0.04)  # the same from a pose that is given
    fine_widths: tuple[float, ...] = (0.02, 0.01, 0.005)  # of the best candidates
    steps: int = 3  # at each width
    refined: int = 24  # best candidates, of which each is refined
    refine_steps: int = 15
    joint_std: float = 0.4  # of a weak prior about a typical pose, radians
    same: float = 0.05  # poses whose points differ by less are one
    least: int = 4  # keypoints that agree with a pose, at least: three hold a rigid body, and leave two ways


_SEARCH = _Search()


@dataclass(frozen=True, eq=False)
class KeypointFit:
    """Poses (S, num_dofs), best and different ones first, costs (S,), and the lead () over the next different one."""

    problem: AlignProblem
    poses: Tensor
    costs: Tensor
    lead: Tensor

    @property
    def landmarks(self) -> Landmarks:
        """The measured keypoints."""
        found = self.problem.factor(Landmarks)
        if found is None:
            raise InputError("keypoints are needed where there are no data; give both, or data")
        return found

    @property
    def right(self) -> Tensor:
        """Mask (K,) of the keypoints that agree with the first pose."""
        return self.landmarks.agree(self.poses[:1])[0]

    def covariance(self) -> Tensor:
        """Return the covariance (1, num_dofs, num_dofs) of the first pose, in tangent coordinates."""
        pose = self.poses[:1]
        precision = plausible_precision(self.problem, pose).double()
        information = self.landmarks.linearized(pose, 0.0).hessian.double() + torch.diag_embed(precision)
        return torch.linalg.inv(information).to(pose)

    def confidence(self, covariance: Tensor) -> Tensor:
        """Return the probability () that the limbs end where the first pose has them, by a Rayleigh distribution."""
        skin = self.problem.skin
        moves = end_motions(skin, self.poses[:1], limb_ends(skin))
        variance = end_variances(moves, covariance).sqrt().mean().square()
        known = 1 - (-((CALIBRATION.right * self.problem.size) ** 2) / variance).exp()
        return known * torch.sigmoid(self.lead.clamp_max(1 / torch.finfo(variance.dtype).eps))


def fit_keypoints(
    shape: ArticulatedShape,
    skin: LinearBlendSkin,
    measured: MeasuredKeypoints,
    start: Tensor | None,
    known: KnownDofs | None,
) -> KeypointFit:
    """Return the poses that explain the keypoints of a frame, from starts ((S,) num_dofs) or a global search."""
    if measured.targets.ndim != 2:
        raise InputError(f"keypoints alone must be of one frame, (K, 2) or (K, 3), got {tuple(measured.targets.shape)}")
    origin = _center(shape, measured)[None]
    near = bent_pose(shape, 0.5) if start is None else start.reshape(-1, shape.num_dofs)[0]
    problem = centered_problem(
        skin, origin.unsqueeze(1), torch.zeros_like(origin[:, :1], dtype=torch.bool), near[None], origin,
        prior_std=_SEARCH.joint_std, pose_atol=1e-4, keypoints=measured,
    )  # fmt: skip
    if known is not None:
        given = known.start(shape, start if start is None else near)
        problem = known.with_prior(problem, shifted(given[None], -origin))
    if start is None:
        pool, widths = _all_around(problem), _SEARCH.widths
    else:
        pool, widths = shifted(start.reshape(-1, shape.num_dofs), -origin), _SEARCH.near_widths
    pool = problem.clamp_candidates(pool[None])[0]
    for width in widths:
        pool = _descended(problem, pool, width * problem.size)
    best = _objective(problem.repeated(len(pool)), 0.0).cost(pool).argsort()[: _SEARCH.refined]
    return _refined(problem, pool[best])


def _center(shape: ArticulatedShape, measured: MeasuredKeypoints) -> Tensor:
    """Return about where the measured keypoints are (3,); in a picture, by how large they look."""
    targets = measured.targets[measured.targets.isfinite().all(-1)].double()
    middle = targets.median(0).values
    if measured.camera is None:
        return middle.to(shape.rest)
    points = shape.keypoints(bent_pose(shape, 0.5)).double()
    spread = (points - points.median(0).values).norm(dim=-1).median()
    seen = (targets - middle).norm(dim=-1).median().clamp_min(1.0)
    depth = measured.camera.intrinsics[:2].mean().double() * spread / seen
    return measured.camera.unproject(middle, depth).to(shape.rest)


def _all_around(problem: AlignProblem) -> Tensor:
    """Return typical poses at evenly spread rotations about the origin (S, num_dofs)."""
    shape = problem.skin.shape
    poses = typical_poses(shape).repeat_interleave(_SEARCH.rotations, 0)
    turns = so3_log(spread_rotations(_SEARCH.rotations).to(poses))
    poses[:, 3:BASE_DOFS] = turns.repeat(len(poses) // len(turns), 1)
    return shifted(poses, -shape.keypoints(poses).mean(-2))


def _objective(wide: AlignProblem, width: float) -> Objective:
    """Return the likelihood of the keypoints and the prior, at a width in metres."""
    sigma = torch.full_like(wide.prior.mean[:, 0], width)
    return Objective(None, wide.factors, wide.prior, sigma, sigma)


def _descended(problem: AlignProblem, pool: Tensor, width: float) -> Tensor:
    """Return candidates (S, num_dofs) after damped steps at one width, metres."""
    wide = problem.repeated(len(pool))
    objective = _objective(wide, width)
    for _ in range(_SEARCH.steps):
        pool = wide.step(objective(pool), pool).state
    return pool


def _refined(problem: AlignProblem, pool: Tensor) -> KeypointFit:
    """Return candidates (S, num_dofs) refined down to the keypoints' own errors alone, best first."""
    for width in _SEARCH.fine_widths:
        pool = _descended(problem, pool, width * problem.size)
    wide = problem.repeated(len(pool))
    objective = _objective(wide, 0.0)
    poses = wide.solve(objective, pool, _SEARCH.refine_steps, objective(pool)).state
    # The weak prior ranks as it does beside data.
    costs = wide.factor_score(poses, 0.0) + PRIOR_SHARE * wide.prior.cost(poses)
    order = costs.argsort()
    poses, costs = poses[order], costs[order]
    apart = mean_distances(problem, poses[None])[0] > _SEARCH.same * problem.size
    lead = torch.where(apart[0], costs, torch.inf).amin() - costs[0]
    first = distinct_first(~apart[None])[0]
    return KeypointFit(problem, poses[first], costs[first], lead)


def align_keypoints(
    shape: ArticulatedShape,
    skin: LinearBlendSkin,
    measured: MeasuredKeypoints,
    start: Tensor | None,
    known: KnownDofs | None,
) -> AlignResult:
    """Return the alignment to keypoints alone, see `fit_keypoints`; it has no data."""
    with torch.no_grad():
        fit = fit_keypoints(shape, skin, measured, start, known)
        covariance = fit.covariance()
        confidence = fit.confidence(covariance)
        pose, none = shifted(fit.poses[0], fit.problem.origin[0]), skin.points.new_zeros(0)
        sure, right = float(confidence) >= CALIBRATION.doubtful, int(fit.right.sum())
        wrong = int(fit.landmarks.seen.sum()) - right
        reasons = [f"{wrong} of the seen keypoints do not agree with the pose"] * (wrong > 0)
        reasons += ["keypoints alone do not tell where the limbs end"] * (not sure)
        reasons += filter(None, [told_open(shape, covariance[0], fit.problem.size)])
        status = Status.CONVERGED if sure else Status.DOUBTFUL
        found = AlignResult(
            pose=pose, registered=skin(pose), keypoints=skin.shape.keypoints(pose), distances=none,
            inliers=none.bool(), posterior=none, sigma=none.sum(), cost=fit.costs[0],
            status=Status.FEW_INLIERS if right < _SEARCH.least else status,
            covariance=covariance[0], confidence=confidence,
            doubt="; ".join(reasons), dof_confidence=dof_confidence(shape, covariance[0], fit.problem.size),
        )  # fmt: skip
        return normal_copy(found)


def find_keypoints(
    shape: ArticulatedShape,
    skin: LinearBlendSkin,
    measured: MeasuredKeypoints,
    num_starts: int,
    known: KnownDofs | None,
) -> PoseStarts:
    """Return the poses that keypoints alone allow, see `fit_keypoints`."""
    with torch.no_grad():
        fit = fit_keypoints(shape, skin, measured, None, known)
        poses = shifted(fit.poses[:num_starts], fit.problem.origin)
        return PoseStarts(poses=poses, costs=fit.costs[:num_starts], confidence=fit.confidence(fit.covariance()))


def measured_alone(
    shape: ArticulatedShape, camera: Camera | None, keypoints: Any, keypoint_std: Any
) -> MeasuredKeypoints:
    """Return keypoints that are the only measurement, checked."""
    if keypoints is None:
        raise InputError("data must be given, or keypoints: there is nothing to align to")
    return MeasuredKeypoints.of(shape, keypoints, keypoint_std, camera, keypoint_extent(shape))
