"""Tracks for animation programs."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from torchreg._checks import check_shape
from torchreg.errors import InputError
from torchreg.geometry.rigid import transform_points
from torchreg.geometry.upright import Direction
from torchreg.io.bvh import save_bvh
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.tracking.results import TrackResult


@torch.no_grad()
def save_track_bvh(
    path: str | Path, shape: ArticulatedShape, result: TrackResult, *, up: Direction | None = None
) -> Path:
    """Return the path of a .bvh file in which the shape's parts turn as tracked.

    In frames without a pose, which the format cannot leave out, the last one before is held. Lengths are metres; the
    skeleton at rest is that of the rest pose, and bones without others below them end beyond the middles of their
    solids.

    Args:
        path: to write; the suffix must be .bvh.
        shape: the articulated shape, with joints that turn.
        result: of a tracker of it, with times in seconds at equal intervals.
        up: the axis that is upright, turned to y; left as it is by default.

    Raises:
        InputError: if sizes do not fit, the suffix is not .bvh, the shape was never found or a joint slides.
    """
    check_shape(result.poses, "result.poses", ("T", shape.num_dofs))
    poses = _held(result.poses)
    parts = list(shape.part_index.tolist())
    parents = list(shape.part_parents)
    names = list(shape.part_names)
    centers = shape.primitives.centers
    if parents.count(-1) > 1:  # parts side by side on a frame without a solid
        parts.append(_common_frame(shape, [part for part, parent in zip(parts, parents, strict=True) if parent < 0]))
        parents = [len(parents) if parent < 0 else parent for parent in parents] + [-1]
        names.append("root")
        centers = torch.cat((centers, centers.new_zeros(1, 3)))
    rest = shape.frame_transforms(shape.rest_pose())[parts]
    moving = shape.frame_transforms(poses.to(shape.rest))[:, parts]
    ends = transform_points(rest, 2 * centers.unsqueeze(1)).squeeze(1)
    seconds = (result.times[-1] - result.times[0]) / max(1, len(poses) - 1)
    return save_bvh(path, names, parents, rest, moving, 1 / float(seconds) if seconds > 0 else 1.0, ends=ends, up=up)


def _held(poses: Tensor) -> Tensor:
    """Return poses (T, num_dofs) in which those of NaN are the last ones before, or the first ones after."""
    found = poses.isfinite().all(-1)
    if not bool(found.any()):
        raise InputError("result must hold a pose to be written, but the shape was never found")
    index = torch.where(found, torch.arange(len(poses), device=poses.device), -1).cummax(0).values
    return poses[index.clamp(min=int(found.nonzero()[0]))]


def _common_frame(shape: ArticulatedShape, frames: list[int]) -> int:
    """Return the last frame that carries all of some frames."""
    joints = shape.kinematics.tree.joints
    paths = []
    for frame in frames:
        path = [frame]
        while joints[path[-1]].parent >= 0:
            path.append(joints[path[-1]].parent)
        paths.append(path)
    return next(frame for frame in paths[0] if all(frame in path for path in paths))
