"""Aligning an articulated shape to 3-D points: annealed EM with an outlier class, then surface fitting."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

import torchreg.pipelines.storage  # noqa: F401  (results of an alignment can be saved)
from torchreg._checks import as_float_tensor, check_choice, check_positive, check_shape
from torchreg.correspondence.em import OUTLIER_CONSTANT, expectation
from torchreg.correspondence.sigma import SigmaSchedule
from torchreg.errors import InputError, InputTypeError, UnitsWarning
from torchreg.models.articulated import ArticulatedShape
from torchreg.models.kinematics import stack_sizes
from torchreg.models.skin import BendingSkin, LinearBlendSkin, sample_skin
from torchreg.models.surface import FusedSurface, SkinSurface, Surface, dense_file_skin
from torchreg.pipelines.align_objectives import PosePrior
from torchreg.pipelines.align_search import FINAL_SIGMAS, PRIOR_SHARE, coarse_skin, explore, needs_search
from torchreg.pipelines.align_stages import CORRESPONDENCES, AlignProblem, OnStep, StageResult, fit_surface, register
from torchreg.results import AlignRecord, AlignResult, Status

# Shares of the model's size, the diagonal of its rest pose.
_START_SIGMA, _STOP_SIGMA = 0.08, 0.02
_INLIER_SHARE = 0.02
# Data and model that differ more than this in size are in different units.
_UNITS_RATIO = 30.0
# Fewer inliers than this, or than this share of the data, and the pose means nothing.
_MIN_INLIERS, _MIN_INLIER_SHARE = 10, 0.02
_DENSE_SKIN_POINTS = 2500
_BALL = 3
# Steps of the surface fit after a search, whose time they hardly add to.
_SEARCHED_STEPS = 4


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
        num_candidates: poses tried per round of the search.
        search_rounds: rounds of the search.
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
    num_candidates: int = 24
    search_rounds: int = 4
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
            _check_count(getattr(self, name), name, 1)
        _check_count(self.surface_steps, "surface_steps", 0)
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
    with torch.no_grad():
        data, valid = _check_data(shape, data, mask, config.nan_policy)
        pose = shape.rest_pose() if initial_pose is None else shape.check_pose(initial_pose, "initial_pose")
        if not bool(torch.isfinite(pose).all()):
            raise InputError("initial_pose must be finite")
        starts = _num_starts(data, pose)
        count = len(data) if data.ndim == 3 else max(starts, 1)
        pose = shape.clamp(pose.expand(count, shape.num_dofs))
        skin = _model_skin(shape, model_points, pose, config)
        batch_data = data.expand(count, *data.shape[-2:])
        batch_valid = valid.expand(count, valid.shape[-1])
        origin = _masked_mean(batch_data, batch_valid)
        problem = _centered_problem(shape, skin, batch_data, batch_valid, pose, origin, config)
        _warn_about_units(problem)
        pose = _shifted(pose, -origin)
        record = _Recorder(on_step, origin)
        final = _descend(problem, pose, config, record)
        if starts:
            best = alignment_cost(problem, final.pose).argmin().unsqueeze(0)
            problem, pose, origin, record = problem.rows(best), pose[best], origin[best], record.rows(best)
            final = StageResult(final.pose[best], final.sigma[best], final.change[best])
        final = _search_where_needed(problem, final, pose, config, record)
        result = _result(problem, final, origin, config, tuple(record.history))
        return _unbatched(result, 0) if data.ndim == 2 else result


class _Recorder:
    """Keeps the records of all stages and passes them on, with poses in the coordinates of the data."""

    def __init__(self, on_step: OnStep | None, origin: Tensor, history: list[AlignRecord] | None = None) -> None:
        self.on_step, self.origin = on_step, origin
        self.history: list[AlignRecord] = [] if history is None else history

    def __call__(self, step: AlignRecord) -> None:
        step = replace(step, pose=_shifted(step.pose, self.origin))
        self.history.append(step)
        if self.on_step is not None:
            self.on_step(step)

    def rows(self, index: Tensor) -> _Recorder:
        """Return a recorder for some rows of the batch, which writes into the same history."""
        return _Recorder(self.on_step, self.origin[index], self.history)


def _shifted(pose: Tensor, offset: Tensor) -> Tensor:
    return torch.cat([pose[:, :3] + offset, pose[:, 3:]], dim=-1)


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
    coarse = replace(part, skin=coarse_skin(problem.skin), surface=FusedSurface(problem.skin.shape))
    generator = torch.Generator().manual_seed(config.seed)
    found = explore(
        coarse,
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


def alignment_cost(problem: AlignProblem, pose: Tensor, distances: Tensor | None = None) -> Tensor:
    """Return the cost (B,) by which alignments of the same data are ranked: outliers, softly counted, and the prior."""
    distances = problem.surface.distance(problem.data, pose) if distances is None else distances
    lost = 1 - (-(distances / (_INLIER_SHARE * problem.size)).square()).exp()
    return (lost * problem.valid).sum(-1) + PRIOR_SHARE * problem.prior.cost(pose)


def _inlier_distance(problem: AlignProblem, config: AlignConfig) -> float:
    return config.inlier_distance or _INLIER_SHARE * problem.size


def _result(
    problem: AlignProblem, final: StageResult, origin: Tensor, config: AlignConfig, history: tuple[AlignRecord, ...]
) -> AlignResult:
    pose, shape = final.pose, problem.skin.shape
    distances = problem.surface.distance(problem.data, pose)
    cost = alignment_cost(problem, pose, distances)
    distances = torch.where(problem.valid, distances, torch.nan)
    inliers = distances.abs() < _inlier_distance(problem, config)
    posed = problem.skin(pose)
    observed = expectation(posed, problem.data, final.sigma, OUTLIER_CONSTANT, mask=problem.valid)
    world = _shifted(pose, origin)
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


def _check_data(shape: ArticulatedShape, data: Tensor, mask: Tensor | None, nan_policy: str) -> tuple[Tensor, Tensor]:
    """Return the data in the shape's dtype and which of them count."""
    data = as_float_tensor(data, "data", like=shape.rest)
    if data.ndim not in (2, 3):
        raise InputError(f"data must have shape (M, 3) or (B, M, 3), got {tuple(data.shape)}")
    check_shape(data, "data", ("M", 3), batch=True)
    if data.shape[-2] == 0 or data.shape[0] == 0:
        raise InputError(f"data must hold at least one point, got shape {tuple(data.shape)}")
    valid = torch.ones_like(data[..., 0], dtype=torch.bool)
    if mask is not None:
        if not isinstance(mask, Tensor) or mask.dtype != torch.bool:
            raise InputTypeError("mask must be a tensor of bool, False where data are padding")
        if mask.shape != valid.shape:
            raise InputError(f"mask must have shape {tuple(valid.shape)} like the data, got {tuple(mask.shape)}")
        valid = mask.to(data.device)
    finite = torch.isfinite(data).all(-1)
    bad = int((valid & ~finite).sum())
    if bad and nan_policy == "raise":
        raise InputError(f"data hold {bad} points that are not finite; drop them or set nan_policy='omit'")
    valid = valid & finite
    if not bool(valid.any()):
        raise InputError("data hold no point that is finite and not masked")
    return torch.where(valid.unsqueeze(-1), data, 0.0), valid


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


def _centered_problem(
    shape: ArticulatedShape,
    skin: LinearBlendSkin,
    data: Tensor,
    valid: Tensor,
    pose: Tensor,
    origin: Tensor,
    config: AlignConfig,
) -> AlignProblem:
    """Return the batch with every cloud's mean at the origin, where float32 is most precise."""
    size = float((skin.points.amax(0) - skin.points.amin(0)).norm())
    shift = torch.nn.functional.pad(origin, (0, shape.num_dofs - 3))
    lower, upper = shape.lower, shape.upper
    if not bool(torch.isinf(shape.lower[:3]).all()):
        lower, upper = shape.lower - shift, shape.upper - shift
    precision = torch.zeros_like(shape.rest)
    if config.prior_std is not None:
        slides = shape.chain.couplings.abs().mT @ (1 - shape.chain.is_revolute) > 0
        joints = torch.where(slides, config.prior_std * size, config.prior_std)
        precision[6:] = joints.square().reciprocal()
        # The three axes of a ball joint share the deviation of its one rotation.
        balls = [6 + dof for dof, size in enumerate(stack_sizes(shape.chain.tree)) if size >= _BALL]
        precision[balls] *= _BALL
    return AlignProblem(
        skin=skin,
        surface=_surface(shape, skin),
        data=torch.where(valid.unsqueeze(-1), data - origin.unsqueeze(1), 0.0),
        valid=valid,
        size=size,
        lower=lower,
        upper=upper,
        prior=PosePrior(pose - shift, precision),
        pose_atol=config.pose_atol,
        outlier=config.outlier,
        debias=config.debias,
        correspondence=config.correspondence,
    )


def _surface(shape: ArticulatedShape, skin: LinearBlendSkin) -> Surface:
    """Return what is fitted: the file's own surface where there is one, else the fused solids."""
    if shape.surface is None:
        return FusedSurface(shape)
    dense = skin if len(skin) >= _DENSE_SKIN_POINTS and skin.normals is not None else dense_file_skin(shape)
    return SkinSurface(dense)


def _masked_mean(data: Tensor, valid: Tensor) -> Tensor:
    return (data * valid.unsqueeze(-1)).sum(-2) / valid.sum(-1, keepdim=True).clamp_min(1)


def _warn_about_units(problem: AlignProblem) -> None:
    """Warn if the spread of the data does not fit the size of the model, as with millimeters for metres."""
    radius = problem.data.norm(dim=-1)
    spread = 2 * torch.where(problem.valid, radius, torch.nan).nanmedian(-1).values
    ratio = float(spread.nanmedian()) / problem.size
    if int(problem.valid.sum(-1).max()) >= _MIN_INLIERS and not 1 / _UNITS_RATIO < ratio < _UNITS_RATIO:
        warnings.warn(
            f"the data spread over {ratio:.3g} times the model's size of {problem.size:.3g} m: are they in metres? "
            f"Scale them, by 0.001 if they are in millimeters",
            UnitsWarning,
            stacklevel=3,
        )


def _check_count(value: int, name: str, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int):
        raise InputTypeError(f"{name} must be an integer, got {type(value).__name__}")
    if value < least:
        raise InputError(f"{name} must be at least {least}, got {value}")
