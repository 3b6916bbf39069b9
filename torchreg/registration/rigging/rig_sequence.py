"""One rig with a clip from a sequence of meshes that share nothing."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import check_count
from torchreg._threads import one_thread
from torchreg.errors import FramesWarning
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.upright import Direction
from torchreg.registration.frame_tree import FrameTree
from torchreg.registration.register_sequence import aligned_frames
from torchreg.registration.rigging.bones import BoneTree
from torchreg.registration.rigging.config import RigConfig
from torchreg.registration.rigging.distances import SurfaceSamples, two_way_distance
from torchreg.registration.rigging.frames import RigFrames, usable_frames
from torchreg.registration.rigging.poses import SurfaceFitter, poses_of_motions
from torchreg.registration.rigging.results import SequenceRig
from torchreg.result import Status
from torchreg.shapes.articulated import ArticulatedShape

# Called with the name of the stage that a step belongs to.
OnStep = Callable[[str], None]


@torch.no_grad()
@one_thread()
def rig_sequence(
    meshes: Sequence[Any],
    *,
    template: int | None = None,
    num_bones: int | None = None,
    config: RigConfig | None = None,
    up: Direction | None = None,
    on_step: OnStep | None = None,
) -> SequenceRig:
    """Return one skinned shape and its poses from meshes of one moving thing that share neither vertices nor faces.

    1. Frames of another unit, empty ones and those of another thing's size are left out, with a sentence each.
    2. The template is the frame of most surface: where limbs touch, surface is lost.
    3. The template is aligned with all frames, from neighbor to neighbor, as in `register_sequence`. Parts that neither
       move rigidly with a neighbor nor as a blend of two are bones, see `moving_parts`; weights explain how the surface
       moves between them, and the strongest joints make a tree.
    4. The rig of balls at these joints is fitted to every frame's surface by matches both ways, from the alignment
       and from the neighbor in time; the better is kept.

    Args:
        meshes: T frames, two at least, in one unit and coordinate frame, in the order of time: meshes, scans or clouds
            as loaders return; the template must have triangles.
        template: number of the frame whose surface is rigged; by default it is chosen.
        num_bones: most bones; fewer where the motion needs no more.
        config: see `RigConfig`.
        up: (3,) what is upright, kept for files.
        on_step: called with a word for each stage and frame that is done.

    Returns:
        a `SequenceRig`.

    Raises:
        InputError: if fewer than two frames show one thing, none has triangles, or a number is out of range.
        InputTypeError: if a frame is neither mesh, scan nor cloud.

    Warns:
        FramesWarning: if frames are left out or not explained by the rig, or nothing bends.

    Differentiable: no.

    Cost: 2 to 4 s a frame on one core, whatever its size.

    References: Le and Deng 2014, Robust and accurate skeletal rigging from mesh sequences; Chang and Zwicker 2009,
    section 3, for weights.
    """
    config = RigConfig() if config is None else config
    count = config.num_bones if num_bones is None else num_bones
    check_count(count, "num_bones", 1)
    step = (lambda _: None) if on_step is None else on_step
    meshes = list(meshes)
    frames = usable_frames(meshes, template, config.num_points)
    step("frames")
    rows = list(range(len(frames.scans)))
    shape, poses, errors = _rigged(frames, rows, count, config, up, step)
    good = errors <= config.doubtful
    if len(rows) // 2 < int(good.sum()) < len(rows):
        # Another thing in between spoils what follows it; the rig of the others tells which frames those are.
        shape, poses, errors = _rigged(frames, good.nonzero()[:, 0].tolist(), count, config, up, step)
    return _result(shape, poses, errors, frames, len(meshes), config, up)


def _rigged(
    frames: RigFrames, rows: list[int], count: int, config: RigConfig, up: Direction | None, step: OnStep
) -> tuple[ArticulatedShape, Tensor, Tensor]:
    """Return the rig of some frames, poses (T, D) of all that are used, and their errors (T,)."""
    scan, tree = frames.scans[frames.template], FrameTree.in_turn(rows.index(frames.template), len(rows))
    moved, confidence, _ = aligned_frames(
        tuple(frames.scans[row] for row in rows), tree, count, config.cells, config.register,
        on_step=lambda record: step(record.stage),
    )  # fmt: skip
    bones = BoneTree.of_alignment(moved, confidence, frames.mesh, scan, count, config)
    bones = bones.pruned(config.alike * float(scan.diagonal), count)
    fitter = SurfaceFitter(bones.shape(frames.mesh.faces, up), scan, config)
    starts = dict(zip(rows, poses_of_motions(fitter.shape, bones.motions), strict=True))
    return fitter.shape, *_fitted_poses(fitter, starts, frames, step)


def _fitted_poses(
    fitter: SurfaceFitter, starts: Mapping[int, Tensor], frames: RigFrames, step: OnStep
) -> tuple[Tensor, Tensor]:
    """Return poses (T, D) of all frames and their errors (T,), from the template outward, from starts of some."""
    shape, skin = fitter.shape, fitter.shape.file_skin()
    poses = shape.rest_pose().repeat(len(frames.scans), 1)
    errors = poses.new_zeros(len(poses))
    for direction, end in ((1, len(poses)), (-1, -1)):
        neighbor = poses[frames.template]
        for frame in range(frames.template + direction, end, direction):
            best = fitter.fit(frames.scans[frame], [*([starts[frame]] if frame in starts else []), neighbor])
            poses[frame] = best.pose
            rig = SurfaceSamples.of_mesh(TriangleMesh(skin(best.pose), frames.mesh.faces))
            errors[frame] = two_way_distance(rig, frames.surfaces[frame], frames.scans[frame]) / fitter.size
            if errors[frame] <= fitter.config.doubtful:
                neighbor = poses[frame]
            step("poses")
    return poses, errors


def _result(
    shape: ArticulatedShape, poses: Tensor, errors: Tensor, frames: RigFrames, count: int,
    config: RigConfig, up: Direction | None,
) -> SequenceRig:  # fmt: skip
    """Return the rig with the frames that were left out, and a sentence for each that is not explained."""
    numbers = list(frames.numbers)
    doubtful, foreign = errors > config.doubtful, errors > 2 * config.doubtful
    notes = [
        f"frame {numbers[row]}: {'left out' if foreign[row] else 'doubtful'}: the rig's surface is "
        f"{100 * float(errors[row]):.2g} % of its size away: another thing, or limbs that touch"
        for row in doubtful.nonzero()[:, 0].tolist()
    ]
    notes = sorted([*frames.notes, *notes], key=lambda note: int(note.split(":")[0].removeprefix("frame ")))
    if shape.num_parts == 1:
        notes.append("nothing bends in these frames: the rig is one bone, which a round thing or a rigid one needs")
    if notes:
        warnings.warn("; ".join(notes), FramesWarning, stacklevel=4)
    all_poses = poses.new_full((count, poses.shape[1]), torch.nan)
    all_errors, confidence = errors.new_full((count,), torch.nan), errors.new_zeros(count)
    all_poses[numbers], all_errors[numbers] = poses.masked_fill(foreign[:, None], torch.nan), errors
    confidence[numbers] = (1 + (errors / config.doubtful) ** 2).reciprocal()
    status = Status.WITH_WARNINGS if notes else Status.CONVERGED
    if bool((doubtful & ~foreign).any()) or 2 * int(foreign.sum()) >= len(errors):
        status = Status.DOUBTFUL
    skin = shape.file_skin()
    return SequenceRig(
        shape=shape,
        poses=all_poses,
        weights=skin.weights,
        joints=shape.part_transforms(shape.rest_pose())[:, :3, 3],
        errors=all_errors,
        confidence=confidence,
        status=status,
        template=numbers[frames.template],
        warnings=tuple(notes),
        up=None if up is None else tuple(float(value) for value in up),  # type: ignore[arg-type]
    )
