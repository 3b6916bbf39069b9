"""Pseudo-labels: the frames of a motion with the poses found in them, frame from frame where that can be trusted."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from torchreg._checks import check_positive
from torchreg.alignment.pose_initializer import PoseInitializer
from torchreg.alignment.problem import INLIER_SHARE
from torchreg.datasets.pose_labels import PoseLabel


def label_frames(
    initializer: PoseInitializer, frames: Iterable[Tensor], *, trusted: float = 0.5, start: Tensor | None = None
) -> Iterator[PoseLabel]:
    """Yield a label for each frame of a motion.

    A frame starts from the pose of the frame before. Where that is not to be trusted, or what it leads to is not, the
    pose is searched for anew, and the surer of the two is kept.

    Args:
        initializer: of the shape.
        frames: clouds (M, 3), metres.
        trusted: least confidence of a pose that the next frame starts from.
        start: (num_dofs,) of the first frame, if known.

    Yields:
        a `PoseLabel` per frame.

    Raises:
        InputError: if ``trusted`` is negative or a cloud is empty or not finite.

    Differentiable: no.
    """
    check_positive(trusted, "trusted", allow_zero=True)
    shape = initializer.shape
    size = float((initializer.skin.points.amax(0) - initializer.skin.points.amin(0)).norm())
    for frame in frames:
        with torch.no_grad():
            points = frame.to(shape.rest)
            found = None if start is None else initializer(points, start=start)
            if found is None or float(found.confidence) < trusted:
                searched = initializer(points)
                found = searched if found is None or searched.confidence > found.confidence else found
            distances = shape.part_distances(points, found.pose)
            off = shape.distance(points, found.pose).abs() > INLIER_SHARE * size
            parts = distances.argmin(-1).masked_fill(off, -1)
        start = found.pose if float(found.confidence) >= trusted else None
        yield PoseLabel(points, found.pose, found.keypoints, parts, found.confidence)
