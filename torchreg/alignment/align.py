"""Aligning an articulated shape to 3-D points: annealed EM with an outlier class, then surface fitting."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchreg._threads import one_thread
from torchreg.alignment.config import AlignConfig
from torchreg.alignment.fit.annealed_em import OnStep
from torchreg.alignment.inputs import Task
from torchreg.alignment.known_dofs import KnownDofs
from torchreg.alignment.pose_rows import ROWS, PoseRows
from torchreg.alignment.results import AlignResult
from torchreg.alignment.search.in_picture import align_in_picture
from torchreg.alignment.search.landmark_fit import KeypointRows
from torchreg.alignment.search.pose_proposer import HoldsProposer, PoseProposer
from torchreg.alignment.search.start_source import StartSource
from torchreg.alignment.shape.clothing import may_be_clothed
from torchreg.alignment.shape.person_proposer import PersonProposer
from torchreg.alignment.shape.person_rows import PersonRows
from torchreg.alignment.shape.shape_fit import fitted_rig
from torchreg.capture.depth_frame import DepthFrame
from torchreg.errors import InputError
from torchreg.geometry.camera import Camera
from torchreg.geometry.far_origin import to_world
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import LinearBlendSkin


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
    clothed: bool | str = "auto",
    keypoints: Tensor | None = None,
    keypoint_std: Tensor | float | None = None,
    initializer: PoseProposer | HoldsProposer | PersonProposer | None = None,
    support: str = "auto",
    config: AlignConfig | None = None,
    on_step: OnStep | None = None,
) -> AlignResult:
    """Return the pose in which an articulated shape lies on 3-D data, with inliers, distances and posterior.

    Annealed EM registers model points to data points and rejects outliers; then the surface is fitted to the data.
    Where that cannot be trusted, candidates around the start are refined in one batch and recombined limb by limb;
    where the result is still in doubt, or turned far from its start, the shape is sought everywhere, and the surer pose
    returned.

    Args:
        shape: the articulated shape, in metres.
        data: (M, 3), metres, or a cloud, scan or mesh as loaders return; or (B, M, 3) for a batch of clouds. Or a
            `DepthFrame`, whose free space counts too, or a sequence of B of them. In a single frame without a mask and
            without a start, surfaces of about the shape's size, and ends of larger ones, are tried, likeliest first;
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
        clothed: of a body of anny whose shape is fitted, whether clothes lie between its skin and the data, see
            `AlignResult.clothing_offset`; by default where the data are likelier with clothes. Others wear none.
        keypoints: where a detector saw the shape's keypoints (of a hand 21, see `AlignResult.keypoints`), as evidence
            beside the data: (K, 3), metres, or with depth frames of one camera (K, 2), pixels as (column, row); NaN for
            those not seen. (B, K, 3) or (B, K, 2) for a batch.
        keypoint_std: their standard deviation, () or (K,), in metres or pixels; by default 3 % of the shape's size, or
            5 pixels. Beyond three of them a keypoint is taken for wrong.
        initializer: a network that proposes poses where there is no start, see `find_pose`; the built-in hand has one,
            and anny's body one of people, which counts with ``fit_shape``.
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
    people = initializer if isinstance(initializer, PersonProposer) else None
    if initializer is not None and (people is None) == (fit_shape is not False):
        raise InputError("initializer must be a PersonProposer with fit_shape, and a PoseProposer without")
    network = None if isinstance(initializer, PersonProposer) else initializer
    source = StartSource()
    if initial_pose is None or network is not None:
        source = StartSource.of(shape, initializer=network, upright=config.upright)
    known = KnownDofs.of(shape, locked, prior)
    if fit_shape is not False or clothed != "auto":
        clothed = may_be_clothed(shape, clothed, fit_shape)
    if fit_shape is not False:
        shape = fitted_rig(shape, fit_shape, plain=known is None and model_points is None and keypoints is None)
    start = shape.pose_from_dict(initial_pose) if isinstance(initial_pose, Mapping) else initial_pose
    task = Task(
        shape=shape, source=source, config=config, model_points=model_points, known=known, start=start,
        fit_shape=fit_shape is not False, people=people, clothed=clothed, support=support, on_step=on_step,
    )  # fmt: skip
    options: dict[str, Any] = {"keypoints": keypoints, "keypoint_std": keypoint_std}
    if isinstance(data, DepthFrame) and data.mask is None and initial_pose is None and mask is None:
        skin = task.skin()

        def aligned(crop: DepthFrame, *, config: AlignConfig, start: Tensor | None = None) -> AlignResult:
            # What is known holds of what is found, not of a start.
            start = start if known is None else None
            asked = replace(task, model_points=skin, config=config, start=start, in_picture=True)
            return _aligned(asked, crop, **options)

        return align_in_picture(data, skin, aligned, config, source.with_known(known))
    return _aligned(task, data, mask, **options)


def _aligned(task: Task, data: Any, mask: Tensor | None = None, **keypoints: Any) -> AlignResult:
    """Return the alignment to one observation, in seven steps."""
    task = task.observed(data, mask, **keypoints)
    rows = _starts(task)
    is_small = rows.problem.valid.numel() < ROWS.many_data
    # A sixth faster than without gradients alone, as most of the time goes to small operations.
    with torch.inference_mode(), one_thread(is_small):
        rows = rows.annealed()  # E-step (17, 18), M-step (20), annealed sigma: sections 3.1 to 3.3
        rows = rows.fitted()  # eqs. 21 and 22: section 3.4
        found = rows.restarted().finished().judged()
        found = rows.searched_in_doubt(found)
    person = task.shape if found.coefficients is None else task.shape.with_coefficients(found.coefficients)
    return replace(to_world(found, task.seen.origin), shape=person)


def _starts(task: Task) -> PoseRows | PersonRows | KeypointRows:
    """Return the rows of all starts: of keypoints alone, of a person's pose and coefficients, or of poses."""
    if task.seen.points is None:
        start = None if task.start is None else task.starts(task.shape.rest[None, :3], task.start)
        return KeypointRows.of(task.skin(), task.seen.keypoints, start, task.known)
    return PersonRows.of(task) if task.fit_shape else PoseRows.of(task)
