"""Aligning an articulated shape to 3-D points: annealed EM with an outlier class, then surface fitting."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, warn_about_rounding
from torchreg._threads import one_thread
from torchreg.alignment.align_stages import (
    AlignBatch,
    anneal_batch,
    best_start,
    continue_unconverged,
    fit_batch_surface,
    prefer_start_fit,
    refit_uncropped,
    search_where_needed,
)
from torchreg.alignment.assembly import assembled, unbatched
from torchreg.alignment.config import AlignConfig
from torchreg.alignment.evidence.observability import dof_confidence
from torchreg.alignment.evidence.reliability import without_cut
from torchreg.alignment.find_pose import FindPoseConfig, FoundStarts, search_everywhere
from torchreg.alignment.fit.annealed_em import OnStep, StageResult
from torchreg.alignment.fit.problem import centered_problem, masked_mean
from torchreg.alignment.inputs import (
    Observation,
    check_clouds,
    check_skin,
    floating_origin,
    warn_about_units,
)
from torchreg.alignment.known_dofs import KnownDofs
from torchreg.alignment.results import AlignRecord, AlignResult
from torchreg.alignment.search.in_picture import align_in_picture
from torchreg.alignment.search.landmark_fit import align_keypoints, measured_alone
from torchreg.alignment.search.pose_proposer import HoldsProposer, PoseProposer
from torchreg.alignment.search.start_source import StartSource
from torchreg.alignment.shape.person_gradient import person_with_gradients
from torchreg.alignment.shape.shape_fit import fit_coefficients, fitted_rig
from torchreg.capture.depth_frame import DepthFrame
from torchreg.errors import InputError, UnitsWarning
from torchreg.geometry.camera import Camera
from torchreg.geometry.far_origin import to_local, to_world
from torchreg.result import normal_copy
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.pose_algebra import shifted
from torchreg.shapes.skin import BendingSkin, LinearBlendSkin, sample_skin


@dataclass(frozen=True)
class _Limits:
    """Limits of an alignment."""

    many_data: int = 10_000  # in a batch, from which all threads of torch are of use
    num_starts: int = 4  # of a search, of which rivals are told: a box looks alike from as many sides


_LIMITS = _Limits()


def align(
    shape: ArticulatedShape,
    data: Tensor | DepthFrame | Sequence[DepthFrame] | Camera | None,
    initial_pose: Tensor | Mapping[str, float] | None = None,
    *,
    model_points: Tensor | LinearBlendSkin | None = None,
    mask: Tensor | None = None,
    locked: Sequence[str] | Tensor = (),
    prior: tuple[Any, Any] | None = None,
    fit_shape: bool | str = False,
    keypoints: Tensor | None = None,
    keypoint_std: Tensor | float | None = None,
    initializer: PoseProposer | HoldsProposer | None = None,
    support: str = "auto",
    config: AlignConfig | None = None,
    on_step: OnStep | None = None,
) -> AlignResult:
    """Return the pose in which an articulated shape lies on 3-D data, with inliers, distances and posterior.

    Annealed EM registers model points to data points and rejects outliers; then the surface is fitted to the data.
    Where that cannot be trusted, candidates around the start are refined in one batch and recombined limb by limb.

    Args:
        shape: the articulated shape, in metres.
        data: (M, 3), metres, or a cloud, scan or mesh as loaders return; or (B, M, 3) for a batch of clouds. Or a
            `DepthFrame`, whose free space counts too, or a sequence of B of them. In a single frame without a mask and
            without a start, surfaces of about the shape's size, and the ends of larger ones, are tried, nearest first;
            the status is NOT_FOUND where the best pose is wrong with 95 %: it is not there, or the search missed it.
            None, or the `Camera` of keypoints in pixels, where keypoints are all there is.
        initial_pose: (num_dofs,) start, or numbers by name of degree of freedom with the others at rest, moved inside
            the limits first; without one, `find_pose` looks for it.
            (B, num_dofs) with a batch of clouds. (S, num_dofs) with one cloud: several starts, of which the best
            alignment is returned.
        model_points: a skin of the shape (see `sample_skin`; reuse it when aligning many clouds), or (N, 3) points in
            the initial pose; sampled on the surface by default.
        mask: (M,) or (B, M), False where data are padding.
        locked: degrees of freedom that are held at the start's value: their names, "base" for all six of the base, or a
            mask (num_dofs,). Without a start they are held at the prior's mean, or as at rest.
        prior: what is known of the pose, as by encoders: mean and standard deviation, metres and radians, in place of
            ``config.prior_std``. Each is a tensor (num_dofs,) or (B, num_dofs), or a dictionary by name of degree of
            freedom; the deviation also one number, for all that a dictionary names or for all joints. The data count
            against it as errors that neighbors share, not one by one.
        fit_shape: True to fit the shape's coefficients too, with their prior: a body to a person. "bones" does so for
            any rig, whose coefficients are then the lengths and radii of its parts. For one cloud or depth frame
            without keypoints, locked degrees of freedom and prior; a start is given for the mean coefficients. Without
            one, people of different sizes are sought everywhere.
        keypoints: where a detector saw the shape's keypoints (of a hand 21, see `AlignResult.keypoints`), as evidence
            beside the data: (K, 3), metres, or with depth frames of one camera (K, 2), pixels as (column, row); NaN for
            those not seen. (B, K, 3) or (B, K, 2) for a batch.
        keypoint_std: their standard deviation, () or (K,), in metres or pixels; by default 3 % of the shape's size, or
            5 pixels. Beyond three of them a keypoint is taken for wrong.
        initializer: a network that proposes poses where there is no start, see `find_pose`; the built-in hand has one.
        support: of clouds: "auto" leaves out the table or floor that a scanned thing stands on, see `split_support`, as
            if masked; not where the shape has a flat foot itself. "keep" takes all points for what was given.
        config: see `AlignConfig`.
        on_step: called with an `AlignRecord` after each iteration.

    Returns:
        an `AlignResult`; with a batch of clouds every tensor has a leading dimension B and the status is a tuple. Data
        in float64 far from the origin, as in maps, are aligned about an origin near them, which the result tells.

    Raises:
        InputError: if the data are empty, not finite, or do not fit the pose.
        InputTypeError: if an argument has the wrong type.

    Warns:
        DegenerateDataWarning: if the inliers lie at one place, on a line or on a plane; the status is DEGENERATE.
        FileWarning: if a support is left out.
        UnitsWarning: if the data are more than thirty times larger or smaller than the shape.

    Differentiable: with ``fit_shape``, ``pose`` and ``coefficients`` once in ``data``, by the implicit function; which
    points of the surface data belong to is held fixed. Nothing else; use `EMLoss`, or `PoseInitializer` for a layer.

    Cost: O(N M) per EM iteration, in bounded memory; that of `find_pose` beside, without a start. Of a
    cloud of more than 10,000 data as many are drawn, of dense places fewer, and pose, covariance, confidence and status
    follow from these; distances, inliers and posterior are those of all. Five million take some 20 s and 1 GB.

    References: Dewaele et al. 2006, section 3.
    """
    config = config or AlignConfig()
    source = StartSource.of(shape, initializer=initializer, upright=config.upright)
    if isinstance(initial_pose, Mapping):
        initial_pose = shape.pose_from_dict(initial_pose)
    if data is None or isinstance(data, Camera):
        skin = _model_skin(shape, model_points, shape.rest[None], config)
        measured = measured_alone(shape, data, keypoints, keypoint_std)
        start = None if initial_pose is None else _check_start(shape, initial_pose, shape.rest[None, :3])[0]
        found = align_keypoints(shape, skin, measured, start, KnownDofs.of(shape, locked, prior))
        return replace(found, shape=shape)
    if isinstance(data, DepthFrame) and data.mask is None and initial_pose is None and mask is None:
        skin = _model_skin(shape, model_points, shape.rest[None], config)
        aligned = partial(
            align, shape, model_points=skin, locked=locked, prior=prior, keypoints=keypoints, keypoint_std=keypoint_std,
            fit_shape=fit_shape, initializer=initializer, on_step=on_step,
        )  # fmt: skip
        return align_in_picture(data, skin, aligned, config, partial(source.crop_score, skin))
    seen = Observation.of(data, mask).without_support(shape, support).with_keypoints(shape, keypoints, keypoint_std)
    known = KnownDofs.of(shape, locked, prior)
    origin = floating_origin(shape, seen.points)
    seen, known = to_local(seen, origin), to_local(known, origin)
    start = initial_pose if origin is None or initial_pose is None else to_local(torch.as_tensor(initial_pose), origin)
    on_local_step = on_step if origin is None or on_step is None else partial(_in_world, on_step, origin)
    if fit_shape is not False:
        if initializer is not None:
            raise InputError("initializer has no meaning with fit_shape; people are sought without one")
        shape = fitted_rig(shape, fit_shape, plain=known is None and model_points is None and seen.keypoints is None)
        found = _align_person(shape, seen, start, config, on_local_step)
        shape = shape if found.coefficients is None else shape.with_coefficients(found.coefficients)
    else:
        points = to_local(model_points, origin) if isinstance(model_points, Tensor) else model_points
        found = _align(shape, seen, start, points, known, source, config, on_local_step)
    return replace(to_world(found, origin), shape=shape)


def _align(
    shape: ArticulatedShape,
    seen: Observation,
    initial_pose: Tensor | None,
    model_points: Tensor | LinearBlendSkin | None,
    known: KnownDofs | None,
    source: StartSource,
    config: AlignConfig,
    on_step: OnStep | None,
) -> AlignResult:
    """Return the alignment to data near the origin."""
    lead, rivals, seen = None, None, seen.drawn(shape, config.nan_policy, config.seed)
    if initial_pose is None and known is not None and known.places_base:
        initial_pose = known.start(shape)
    if initial_pose is None:
        search = _found_pose(shape, seen, model_points, known, source, config)
        initial_pose, lead, rivals = search.starts.best, search.lead, search.rivals
    # A sixth faster than without gradients alone, as most of the time goes to small operations.
    with torch.inference_mode():
        clouds, valid = check_clouds(shape, seen.points, seen.mask, config.nan_policy)
        pose, several = _check_start(shape, initial_pose, clouds)
        skin = _model_skin(shape, model_points, pose, config)  # the X_i of eq. 3
        batch = _centered_batch(skin, clouds, valid, pose, config, on_step, seen)
        if known is not None:
            batch = replace(batch, problem=known.with_prior(batch.problem, batch.start))
        warn_about_rounding(clouds, "data", batch.problem.size, stacklevel=3)
        warn_about_units(batch.problem.data, batch.problem.valid, batch.problem.size, stacklevel=3)
        with one_thread(batch.problem.valid.numel() < _LIMITS.many_data):
            found = anneal_batch(batch, config)  # E-step (17, 18), M-step (20), annealed sigma: sections 3.1 to 3.3
            found = fit_batch_surface(batch, found, config)  # eqs. 21 and 22: section 3.4
            batch, found = best_start(batch, found) if several else (batch, found)
            found = found if lead is None else prefer_start_fit(batch, found, config)
            found = search_where_needed(batch, found, config)
            uncropped = without_cut(batch.problem, found.pose, seen.frames)
            found = refit_uncropped(batch, uncropped, found, config)
            found = continue_unconverged(batch, uncropped, found, config)
        # Inliers by eq. 2, the posterior by eq. 17.
        result = assembled(batch, found, config, lead, uncropped, seen, rivals=rivals)
        return normal_copy(unbatched(result) if clouds.ndim == 2 else result)


def _align_person(
    shape: ArticulatedShape, seen: Observation, initial_pose: Tensor | None, config: AlignConfig, on_step: OnStep | None
) -> AlignResult:
    """Return the alignment of a rig whose coefficients are fitted together with its pose."""
    by_data = torch.is_grad_enabled() and isinstance(seen.points, Tensor) and seen.points.requires_grad
    seen = seen if by_data else seen.drawn(shape, config.nan_policy, config.seed)
    with torch.inference_mode():
        clouds, valid = check_clouds(shape, seen.points, seen.mask, config.nan_policy)
        if clouds.ndim != 2:
            raise InputError("fit_shape takes one cloud; calibrate fits several scans of one person")
    pose = None if initial_pose is None else _check_start(shape, initial_pose, clouds[None])[0]
    history = _History(on_step)
    viewpoints = torch.stack([frame.camera.position for frame in seen.frames]) if seen.frames else None
    fitted = fit_coefficients(
        shape, clouds[None], valid[None], pose, config=config, viewpoints=viewpoints, on_step=history
    )
    person = shape.with_coefficients(fitted.coefficients)
    with torch.inference_mode():
        skin = _model_skin(person, None, fitted.poses, config)
        batch = _centered_batch(skin, clouds, valid, fitted.poses, config, on_step, seen)
        found = StageResult(pose=batch.start, sigma=fitted.sigma, change=fitted.change)
        result = unbatched(assembled(batch, found, config, fitted.lead, batch.problem, seen, fitted.error))
        dofs = shape.num_dofs
        result = normal_copy(replace(
            result,
            history=tuple(history.steps),
            coefficients=fitted.coefficients,
            covariance=fitted.covariance[0, :dofs, :dofs],
            dof_confidence=dof_confidence(shape, fitted.covariance[0, :dofs, :dofs], batch.problem.size),
            coefficient_covariance=fitted.covariance[0, dofs:, dofs:],
        ))  # fmt: skip
    if not by_data:
        return result
    found_pose, coefficients = person_with_gradients(shape, fitted, seen.points, valid)
    return replace(result, pose=found_pose, coefficients=coefficients)


class _History:
    """Keeps the records of an alignment, and passes them on."""

    def __init__(self, on_step: OnStep | None) -> None:
        self.steps, self._on_step = list[AlignRecord](), on_step

    def __call__(self, step: AlignRecord) -> None:
        self.steps.append(step)
        if self._on_step is not None:
            self._on_step(step)


def _in_world(on_step: OnStep, origin: Tensor | None, step: AlignRecord) -> None:
    """Pass a record on whose coordinates begin at an origin (3,)."""
    on_step(replace(step, pose=to_world(step.pose, origin)))


def _found_pose(
    shape: ArticulatedShape,
    seen: Observation,
    model_points: Tensor | LinearBlendSkin | None,
    known: KnownDofs | None,
    source: StartSource,
    config: AlignConfig,
) -> FoundStarts:
    """Return the best pose that a search without a start finds, and its lead over others."""
    if model_points is not None and not isinstance(model_points, LinearBlendSkin):
        raise InputError("model_points given as a tensor need a single initial_pose, that they are in; give both")
    search = FindPoseConfig(num_model_points=config.num_model_points, nan_policy=config.nan_policy, seed=config.seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnitsWarning)  # the alignment tells it
        return search_everywhere(shape, seen, _LIMITS.num_starts, source, model_points, search, known)


def _check_start(shape: ArticulatedShape, initial_pose: Tensor | None, clouds: Tensor) -> tuple[Tensor, bool]:
    """Return starts (B, num_dofs) within the limits, and whether they are several starts of a single cloud."""
    pose = shape.rest_pose() if initial_pose is None else shape.check_pose(initial_pose, "initial_pose")
    if not bool(torch.isfinite(pose).all()):
        raise InputError("initial_pose must be finite")
    if pose.ndim > 2:
        raise InputError(f"initial_pose must have one or two dimensions, got shape {tuple(pose.shape)}")
    several = clouds.ndim == 2 and pose.ndim == 2
    if clouds.ndim == 3 and pose.ndim == 2 and len(pose) not in (1, len(clouds)):
        raise InputError(f"initial_pose must hold one pose per cloud ({len(clouds)}), got {len(pose)}")
    count = len(pose) if several else len(clouds) if clouds.ndim == 3 else 1
    return shape.clamp(pose.expand(count, shape.num_dofs)), several


def _model_skin(
    shape: ArticulatedShape, model_points: Tensor | LinearBlendSkin | None, pose: Tensor, config: AlignConfig
) -> LinearBlendSkin:
    """Return the model points as a skin: given, built from points in a pose (1, num_dofs), or sampled."""
    if isinstance(model_points, LinearBlendSkin):
        return check_skin(shape, model_points)
    if model_points is None:
        return sample_skin(shape, config.num_model_points, sharpness=config.sharpness)
    if len(pose) != 1:
        raise InputError("model_points given as a tensor need a single initial_pose; pass a skin for several poses")
    return BendingSkin(shape, as_float_tensor(model_points, "model_points", like=shape.rest), pose[0], config.sharpness)


def _centered_batch(
    skin: LinearBlendSkin,
    clouds: Tensor,
    valid: Tensor,
    pose: Tensor,
    config: AlignConfig,
    on_step: OnStep | None,
    seen: Observation,
) -> AlignBatch:
    """Return the alignments of clouds ((B,) M, 3) from starts (B, num_dofs), each about the mean of its data."""
    data, valid = clouds.expand(len(pose), *clouds.shape[-2:]), valid.expand(len(pose), valid.shape[-1])
    origin = masked_mean(data, valid)
    free_space = seen.free_space
    if free_space is not None and len(free_space.picture) < len(pose):
        free_space = free_space.rows(torch.zeros(len(pose), dtype=torch.int64, device=free_space.picture.device))
    problem = centered_problem(
        skin, data, valid, pose, origin, prior_std=config.prior_std, pose_atol=config.pose_atol,
        outlier=config.outlier, debias=config.debias, correspondence=config.correspondence, free_space=free_space,
        keypoints=seen.keypoints,
    )  # fmt: skip
    return AlignBatch(problem=problem, start=shifted(pose, -origin), origin=origin, on_step=on_step, history=[])
