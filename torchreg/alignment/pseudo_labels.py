"""Pseudo-labels: the frames of a motion with the poses found in them, tracked from frame to frame where reliable."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from torchreg._checks import check_positive
from torchreg.alignment.align import align
from torchreg.alignment.fit.problem import INLIER_SHARE, model_size
from torchreg.alignment.inputs import floating_origin
from torchreg.alignment.pose_initializer import InitialPose, PoseInitializer
from torchreg.alignment.results import AlignResult
from torchreg.capture.depth_frame import DepthFrame
from torchreg.datasets.pose_labels import PoseLabel
from torchreg.geometry.far_origin import to_local, to_world
from torchreg.geometry.loaded import as_points


def label_frames(
    initializer: PoseInitializer,
    frames: Iterable[Tensor | DepthFrame],
    *,
    trusted: float = 0.5,
    start: Tensor | None = None,
) -> Iterator[PoseLabel]:
    """Yield a `PoseLabel` for each frame of a motion, a cloud (M, 3) in metres or a depth frame, from the frame before.

    Where the confidence is below ``trusted`` the pose is searched from scratch, and the more confident one is kept.
    """
    check_positive(trusted, "trusted", allow_zero=True)
    origin, is_first = None, True
    for frame in frames:
        if is_first:
            origin, is_first = floating_origin(initializer.shape, as_points(frame)), False
            start = to_local(start, origin)
        with torch.no_grad():
            near = to_local(frame, origin)
            if isinstance(near, DepthFrame):
                crop, found = _pose_in_picture(initializer, near, start, trusted)
                points = crop.points.to(initializer.shape.rest)
            else:
                points = near.to(initializer.shape.rest)
                found = _pose_of(initializer, points, start, trusted)
            parts = _part_labels(initializer, points, found.pose)
        start = found.pose if float(found.confidence) >= trusted else None
        label = PoseLabel(
            points=points, pose=found.pose, keypoints=found.keypoints, parts=parts, confidence=found.confidence
        )
        yield to_world(label, origin)


def _pose_of(initializer: PoseInitializer, points: Tensor, start: Tensor | None, trusted: float) -> InitialPose:
    """Return the pose from a start, or the better one of it and of a search where its confidence is too low."""
    found = None if start is None else initializer(points, start=start)
    if found is not None and float(found.confidence) >= trusted:
        return found
    searched = initializer(points)
    return searched if found is None or searched.confidence > found.confidence else found


def _pose_in_picture(
    initializer: PoseInitializer, frame: DepthFrame, start: Tensor | None, trusted: float
) -> tuple[DepthFrame, InitialPose]:
    """Return the crop of a picture that shows the shape, and the pose: from a start or, where not sure, without one."""
    crop, found = frame, None
    if start is not None:
        found = _as_pose(align(initializer.shape, frame, start, model_points=initializer.skin))
    if found is None or float(found.confidence) < trusted:
        aligned = align(initializer.shape, frame, model_points=initializer.skin)
        searched = _as_pose(aligned)
        if found is None or searched.confidence > found.confidence:
            crop, found = frame if aligned.crop is None else frame.cropped(aligned.crop), searched
    return crop, found


def _as_pose(aligned: AlignResult) -> InitialPose:
    confidence = aligned.pose.new_zeros(()) if aligned.confidence is None else aligned.confidence
    return InitialPose(
        pose=aligned.pose, confidence=confidence, keypoints=aligned.keypoints, registered=aligned.registered
    )


def _part_labels(initializer: PoseInitializer, points: Tensor, pose: Tensor) -> Tensor:
    """Return the nearest part (M,) of points on the surface; -1 for those off it."""
    shape, limit = initializer.shape, INLIER_SHARE * model_size(initializer.skin)
    outliers = shape.distance(points, pose).abs() > limit
    return shape.part_distances(points, pose).argmin(-1).masked_fill(outliers, -1)
