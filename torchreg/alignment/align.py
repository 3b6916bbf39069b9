"""Aligning an articulated shape to 3-D points: annealed EM with an outlier class, then surface fitting."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_choice, check_count, check_positive
from torchreg._threads import one_thread
from torchreg.alignment.annealed_em import (
    CORRESPONDENCES,
    OnStep,
    StageResult,
    fit_surface,
    outlier_level,
    register,
)
from torchreg.alignment.local_search import FINAL_SIGMAS, explore, needs_search
from torchreg.alignment.problem import (
    INLIER_SHARE,
    AlignProblem,
    alignment_cost,
    centered_problem,
    check_data,
    masked_mean,
    shifted,
    warn_about_units,
)
from torchreg.alignment.results import AlignRecord, AlignResult
from torchreg.alignment.sigma_schedule import SigmaSchedule
from torchreg.errors import InputError
from torchreg.result import Status, normal_copy
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import BendingSkin, LinearBlendSkin, sample_skin
from torchreg.solvers.e_step import expectation

# Shares of the model's size, the diagonal of its rest pose.
_START_SIGMA, _STOP_SIGMA = 0.08, 0.02
# Fewer inliers than this, or than this share of the data, and the pose means nothing.
_MIN_INLIERS, _MIN_INLIER_SHARE = 10, 0.02
# Steps of the surface fit after a search, whose time they hardly add to.
_SEARCHED_STEPS = 4
# With as many data or more, all threads of torch are of use.
_MANY = 10_000


@dataclass(frozen=True)
class AlignConfig:
    """How an alignment runs. Lengths default to shares of the model's size, so one configuration fits all shapes.

    Args:
        schedule: sigma over the EM steps; by default geometric from 8 % to 2 % of the model's size in five steps.
        em_steps: EM iterations per sigma, at most.
        m_steps: Levenberg-Marquardt steps per M-step.
        surface_steps: Levenberg-Marquardt steps at each width of the surface fit; 0 leaves the surface fit out.
        search: look for better poses around the start: "always", "never", or "auto": when the descent
            went far from its start or leaves a dense cluster of data unexplained.
        num_candidates: poses that a search starts from.
        search_rounds: rounds of the search's last stage, which places every limb thoroughly.
        inlier_distance: data nearer to the fitted surface are inliers, metres; 2 % of the model's size by default.
        correspondence: who matches whom: "em", the posterior; for comparison "softassign", one to one, or "closest",
            the closest point as in ICP, trimmed at 1.5 sigma.
        outlier: "limit" for c = 3 sqrt(pi / 2), "volume" for eq. 18 with the working volume.
        debias: share of the pull of a wide kernel on the model itself that is taken from the EM's targets; 0 is the
            paper's EM, which shrinks the model while sigma is wide.
        prior_std: standard deviation of a weak prior that holds joints near the initial pose, radians (of the whole
            rotation of a ball joint; sliding joints: as a share of the model's size); None for no prior.
        num_model_points: points sampled on the shape when none are given.
        sharpness: of the bending skin.
        pose_atol: a pose that changes by no more than this is final, radians (metres: as a share of the model's size).
        nan_policy: "raise", or "omit" to leave out non-finite data.
        seed: of the search.
    """

    schedule: SigmaSchedule | None = None
    em_steps: int = 2
    m_steps: int = 1
    surface_steps: int = 2
    search: str = "auto"
    num_candidates: int = 32
    search_rounds: int = 2
    inlier_distance: float | None = None
    correspondence: str = "em"
    outlier: str = "limit"
    debias: float = 0.8
    prior_std: float | None = 0.3
    num_model_points: int = 500
    sharpness: float = 2.0
    pose_atol: float = 3e-3
    nan_policy: str = "raise"
    seed: int = 0

    def __post_init__(self) -> None:
        check_choice(self.search, "search", ("auto", "always", "never"))
        check_choice(self.correspondence, "correspondence", tuple(CORRESPONDENCES))
        check_choice(self.outlier, "outlier", ("limit", "volume"))
        check_choice(self.nan_policy, "nan_policy", ("raise", "omit"))
        for name in ("em_steps", "m_steps", "num_candidates", "search_rounds", "num_model_points"):
            check_count(getattr(self, name), name, 1)
        check_count(self.surface_steps, "surface_steps", 0)
        check_positive(self.sharpness, "sharpness")
        check_positive(self.pose_atol, "pose_atol", allow_zero=True)
        check_positive(self.debias, "debias", allow_zero=True)
        for name in ("inlier_distance", "prior_std"):
            if getattr(self, name) is not None:
                check_positive(getattr(self, name), name)


def align(
    shape: ArticulatedShape,
    data: Tensor,
    initial_pose: Tensor | None = None,
    *,
    model_points: Tensor | LinearBlendSkin | None = None,
    mask: Tensor | None = None,
    config: AlignConfig | None = None,
    on_step: OnStep | None = None,
) -> AlignResult:
    """Return the pose in which an articulated shape lies on 3-D data, with what was found on the way.

    Annealed EM registers model points to data points and rejects outliers; then the surface is fitted to the data.
    Where that cannot be trusted, candidates around the start are refined in one batch and recombined limb by limb.

    Args:
        shape: the articulated shape, in metres.
        data: (M, 3), metres; or (B, M, 3) for a batch of clouds.
        initial_pose: (num_dofs,) start, the rest pose by default; moved inside the limits first. (B, num_dofs) with a
            batch of clouds. (S, num_dofs) with one cloud: several starts, of which the best alignment is returned.
        model_points: a skin of the shape (see `sample_skin`; reuse it when aligning many clouds), or (N, 3) points in
            the initial pose; sampled on the surface by default.
        mask: (M,) or (B, M), False where data are padding.
        config: see `AlignConfig`.
        on_step: called with an `AlignRecord` after each iteration.

    Returns:
        an `AlignResult`; with a batch of clouds every tensor has a leading dimension B and the status is a tuple.

    Raises:
        InputError: if the data are empty, not finite, or do not fit the pose.
        InputTypeError: if an argument has the wrong type.

    Warns:
        UnitsWarning: if the data are more than thirty times larger or smaller than the shape.

    Differentiable: no; use `EMLoss` for gradients.

    Cost: O(N M) per EM iteration, in bounded memory.

    References: Dewaele et al. 2006, section 3.
    """
    config = config or AlignConfig()
    # A sixth faster than without gradients alone, as most of the time goes to small operations.
    with torch.inference_mode():
        data, valid = check_data(shape, data, mask, config.nan_policy)
        pose = shape.rest_pose() if initial_pose is None else shape.check_pose(initial_pose, "initial_pose")
        if not bool(torch.isfinite(pose).all()):
            raise InputError("initial_pose must be finite")
        starts = _num_starts(data, pose)
        count = len(data) if data.ndim == 3 else max(starts, 1)
        pose = shape.clamp(pose.expand(count, shape.num_dofs))
        skin = _model_skin(shape, model_points, pose, config)
        batch_data = data.expand(count, *data.shape[-2:])
        batch_valid = valid.expand(count, valid.shape[-1])
        origin = masked_mean(batch_data, batch_valid)
        problem = centered_problem(
            skin, batch_data, batch_valid, pose, origin, prior_std=config.prior_std, pose_atol=config.pose_atol,
            outlier=config.outlier, debias=config.debias, correspondence=config.correspondence,
        )  # fmt: skip
        warn_about_units(problem)
        pose = shifted(pose, -origin)
        record = _Recorder(on_step, origin)
        with one_thread(batch_valid.numel() < _MANY):
            final = _descend(problem, pose, config, record)
            if starts:
                best = alignment_cost(problem, final.pose).argmin().unsqueeze(0)
                problem, pose, origin, record = problem.rows(best), pose[best], origin[best], record.rows(best)
                final = StageResult(final.pose[best], final.sigma[best], final.change[best])
            final = _search_where_needed(problem, final, pose, config, record)
        result = _result(problem, final, origin, config, tuple(record.history))
        return normal_copy(_unbatched(result, 0) if data.ndim == 2 else result)


class _Recorder:
    """Keeps the records of all stages and passes them on, with poses in the coordinates of the data."""

    def __init__(self, on_step: OnStep | None, origin: Tensor, history: list[AlignRecord] | None = None) -> None:
        self.on_step, self.origin = on_step, origin
        self.history: list[AlignRecord] = [] if history is None else history

    def __call__(self, step: AlignRecord) -> None:
        step = normal_copy(replace(step, pose=shifted(step.pose, self.origin)))
        self.history.append(step)
        if self.on_step is not None:
            with torch.inference_mode(False), torch.no_grad():
                self.on_step(step)

    def rows(self, index: Tensor) -> _Recorder:
        """Return a recorder for some rows of the batch, which writes into the same history."""
        return _Recorder(self.on_step, self.origin[index], self.history)


def _descend(problem: AlignProblem, pose: Tensor, config: AlignConfig, record: OnStep) -> StageResult:
    """Return the pose after registration and surface fit, the paper's two stages."""
    schedule = config.schedule or SigmaSchedule.geometric(_START_SIGMA * problem.size, _STOP_SIGMA * problem.size)
    final = register(problem, pose, schedule, em_steps=config.em_steps, m_steps=config.m_steps, on_step=record)
    if config.surface_steps == 0:
        return final
    fitted = fit_surface(problem, final.pose, steps=config.surface_steps, on_step=record)
    return replace(fitted, sigma=final.sigma)


def _search_where_needed(
    problem: AlignProblem, final: StageResult, start: Tensor, config: AlignConfig, record: _Recorder
) -> StageResult:
    """Return the result with better poses where a search found any."""
    if config.search == "never":
        return final
    wanted = torch.ones_like(final.change, dtype=torch.bool)
    if config.search == "auto":
        wanted = needs_search(problem, start, final.pose)
    rows = wanted.nonzero()[:, 0]
    if len(rows) == 0:
        return final
    part = problem.rows(rows)
    generator = torch.Generator().manual_seed(config.seed)
    found = explore(
        part,
        start[rows],
        final.pose[rows],
        candidates=config.num_candidates,
        rounds=config.search_rounds,
        generator=generator,
    )
    steps = max(config.surface_steps, _SEARCHED_STEPS)
    refined = fit_surface(part, found, steps=steps, sigmas=FINAL_SIGMAS, on_step=record.rows(rows))
    better = alignment_cost(part, refined.pose) < alignment_cost(part, final.pose[rows])
    pose, change = final.pose.clone(), final.change.clone()
    pose[rows] = torch.where(better.unsqueeze(-1), refined.pose, final.pose[rows])
    change[rows] = torch.where(better, refined.change, final.change[rows])
    return StageResult(pose, final.sigma, change)


def _inlier_distance(problem: AlignProblem, config: AlignConfig) -> float:
    return config.inlier_distance or INLIER_SHARE * problem.size


def _result(
    problem: AlignProblem, final: StageResult, origin: Tensor, config: AlignConfig, history: tuple[AlignRecord, ...]
) -> AlignResult:
    pose, shape = final.pose, problem.skin.shape
    distances = problem.surface.distance(problem.data, pose)
    cost = alignment_cost(problem, pose, distances)
    distances = torch.where(problem.valid, distances, torch.nan)
    inliers = distances.abs() < _inlier_distance(problem, config)
    posed = problem.skin(pose)
    outlier = outlier_level(problem, posed, final.sigma)
    observed = expectation(posed, problem.data, final.sigma, outlier, mask=problem.valid)
    world = shifted(pose, origin)
    statuses = zip(inliers.sum(-1).tolist(), problem.valid.sum(-1).tolist(), final.change.tolist(), strict=True)
    return AlignResult(
        pose=world,
        registered=posed + origin.unsqueeze(1),
        keypoints=shape.keypoints(world),
        distances=distances,
        inliers=inliers,
        posterior=observed.inlier_posterior,
        sigma=final.sigma,
        cost=cost,
        status=tuple(_status(near, count, change, config) for near, count, change in statuses),
        history=history,
    )


def _status(num_inliers: int, num_data: int, change: float, config: AlignConfig) -> Status:
    if num_data == 0:
        return Status.NO_DATA
    if num_inliers < max(_MIN_INLIERS, _MIN_INLIER_SHARE * num_data):
        return Status.FEW_INLIERS
    return Status.CONVERGED if change <= config.pose_atol else Status.MAX_STEPS


def _unbatched(result: AlignResult, row: int) -> AlignResult:
    status = result.status if isinstance(result.status, Status) else result.status[row]
    tensors = {
        item.name: getattr(result, item.name)[row] for item in fields(result) if item.name not in ("status", "history")
    }
    return AlignResult(**tensors, status=status, history=result.history)


def _num_starts(data: Tensor, pose: Tensor) -> int:
    """Return how many starts one cloud has (0: not a multi-start problem); check that poses fit the clouds."""
    if pose.ndim > 2:
        raise InputError(f"initial_pose must have one or two dimensions, got shape {tuple(pose.shape)}")
    if data.ndim == 2:
        return len(pose) if pose.ndim == 2 else 0
    if pose.ndim == 2 and len(pose) not in (1, len(data)):
        raise InputError(f"initial_pose must hold one pose per cloud ({len(data)}), got {len(pose)}")
    return 0


def _model_skin(
    shape: ArticulatedShape, model_points: Tensor | LinearBlendSkin | None, pose: Tensor, config: AlignConfig
) -> LinearBlendSkin:
    if isinstance(model_points, LinearBlendSkin):
        if model_points.shape is not shape:
            raise InputError("model_points is a skin of another shape; build it from the shape that is aligned")
        return model_points
    if model_points is None:
        return sample_skin(shape, config.num_model_points, sharpness=config.sharpness)
    if len(pose) != 1:
        raise InputError("model_points given as a tensor need a single initial_pose; pass a skin for several poses")
    return BendingSkin(shape, as_float_tensor(model_points, "model_points", like=shape.rest), pose[0], config.sharpness)
