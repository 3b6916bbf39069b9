"""Where a robot's base is in a camera's coordinates: one base over many frames with known joints."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad
from torch.nn.utils.rnn import pad_sequence

from torchreg._threads import one_thread
from torchreg.alignment.align import align
from torchreg.alignment.base.fit import (
    BASE_FIT,
    BaseFit,
    BaseProblem,
    approach_base,
    base_covariance,
    base_of,
    fit_base,
    fit_offsets,
)
from torchreg.alignment.base.frames import BaseFrame, read_frames
from torchreg.alignment.base.search import PosedModel, rank_bases, search_base, seen_shares
from torchreg.alignment.config import AlignConfig
from torchreg.alignment.fit.annealed_em import narrowing
from torchreg.alignment.fit.problem import fitted_surface, model_size
from torchreg.alignment.fit.surface_fit import SURFACE_FIT
from torchreg.alignment.results import BaseCalibration
from torchreg.capture.depth_frame import DepthFrame
from torchreg.errors import InputError, TorchregWarning
from torchreg.geometry.rigid import invert_rigid, transform_points
from torchreg.result import Status
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.pose_algebra import BASE_DOFS
from torchreg.shapes.skin import sample_skin
from torchreg.solvers.robust import welsch_weight


@dataclass(frozen=True)
class _Numbers:
    """Numbers of a calibration."""

    num_skin: int = 800  # points of the robot's surface in the search and against free space
    num_data: int = 600  # of each frame in fits of candidates, and by which its joints are compared with others
    least_seen: float = 0.2  # share of the side towards the camera that data show: a frame with less has no robot
    least_seen_in_hand: float = 0.02  # the same where the robot carries the camera, which shows little of it
    outlying: float = 0.5  # of the frames' median share, below which a frame is outlying
    gained: float = 0.04  # share of them that other joints of a frame explain beyond what they do of other frames
    least_gained: int = 12  # the same in data
    rival: float = 0.2  # relative lead of the best candidate over a different one: less is a doubt


_NUMBERS = _Numbers()


def calibrate_base(
    shape: ArticulatedShape,
    frames: Sequence[Tensor | DepthFrame] | Tensor,
    poses: Any,
    offsets: bool = False,
    *,
    camera_link: str | None = None,
) -> BaseCalibration:
    """Return where a robot's base is in a camera's coordinates, from one or more frames with known joints.

    With ``camera_link`` the camera moves with a link and sees other parts of the robot (eye in hand): the pose of this
    link in camera coordinates is sought, the same in all frames.

    All frames together are searched for the base, without a start: rotations from all around, iterated closest points,
    and the side of the robot that faces the camera. The best candidates are fitted to the exact surfaces of the links,
    robustly, together with the depth by which the camera sees all surfaces too far or too near. Depth frames also say
    where nothing is. Then the joints of each frame are let go: where others explain more of its data, and not so in the
    other frames, its joints are wrong, and the fit is repeated without it.

    Args:
        shape: the robot, in metres.
        frames: T clouds (M, 3) in camera coordinates (right, down, forward), metres, or depth frames. Points of other
            things are outliers; the search wants most points to be the robot's, as a mask gives.
        poses: joints of each frame, metres and radians: (T, J) in the order of ``shape.dof_names[6:]``, (T, num_dofs),
            whose base is not used, or T dictionaries by name of joint; of any floating-point type.
        offsets: whether to look for constant offsets of the joints, too; those that the data do not tell stay zero.
        camera_link: link that carries the camera; None for a camera that stands beside the robot.

    Returns:
        a `BaseCalibration`. Frames that do not show the robot where the others have it, or not in the joints given, do
            not count and are named in its ``outliers``; the status is WITH_WARNINGS then, and where another base
            explains the data as well, and FEW_INLIERS if no frame shows the robot.

    Raises:
        InputError: if the robot has no such link, there is no frame, one is empty, or joints lie beyond their limits,
            lack, or are not finite.
        InputTypeError: if an argument has the wrong type.

    Differentiable: no.

    Cost: 5 s for five frames on one CPU core.

    References: Chen and Medioni 1992 for point-to-plane distances; Alexa 2022 for the rotations.
    """
    with torch.no_grad(), one_thread():
        given = read_frames(shape, frames, poses)
        part = _camera_part(shape, camera_link)
        skin = sample_skin(shape, _NUMBERS.num_skin)
        size, surface = model_size(skin), fitted_surface(shape)
        models = [PosedModel.of_skin(skin, frame.joints, part) for frame in given]
        coarse = BaseProblem.of([frame.thinned(_NUMBERS.num_data) for frame in given], surface, skin, size, part)
        base, lead = _best_base(coarse, models)
        seen = seen_shares(base, given, models, size)
        least = _NUMBERS.least_seen if part is None else _NUMBERS.least_seen_in_hand
        used = (seen >= max(least, _NUMBERS.outlying * float(seen.median()))).tolist()
        kept = [frame for frame, is_used in zip(given, used, strict=True) if is_used]
        problem = BaseProblem.of(kept or given, surface, skin, size, part)
        fit = _fitted(problem, base, offsets)
        wrong = iter(_wrong_joints(shape, fit)) if kept else iter(())
        used = [is_used and not next(wrong) for is_used in used]
        if sum(used) < len(kept):
            kept = [frame for frame, is_used in zip(given, used, strict=True) if is_used]
            fit = _fitted(BaseProblem.of(kept, surface, skin, size, part), fit.base, offsets)
        outliers = tuple(number for number, is_used in enumerate(used) if not is_used)
        return _result(fit, given, outliers, camera_link, is_lost=not kept, is_sole=lead > _NUMBERS.rival)


def _camera_part(shape: ArticulatedShape, link: str | None) -> int | None:
    """Return the number of the part that carries the camera."""
    if link is not None and link not in shape.part_names:
        raise InputError(f"camera_link must be a link of the robot, {', '.join(shape.part_names)}; got {link!r}")
    return None if link is None else shape.part_names.index(link)


def _fitted(problem: BaseProblem, base: Tensor, offsets: bool) -> BaseFit:
    """Return the fit from a base (4, 4) near the best."""
    fit = fit_base(problem, problem.state(base), (BASE_FIT.stop,))
    return fit_offsets(fit) if offsets else fit


def _wrong_joints(shape: ArticulatedShape, fit: BaseFit) -> list[bool]:
    """Return of each frame of a fit whether other joints explain more of its data, compared with the other frames."""
    surface = fit.problem.surface
    thinned = [frame.thinned(_NUMBERS.num_data) for frame in fit.problem.frames]
    bases = base_of(fit.problem.poses(fit.state))
    rows = [
        transform_points(invert_rigid(base), frame.points).to(shape.rest)
        for base, frame in zip(bases, thinned, strict=True)
    ]
    data = pad_sequence(rows, batch_first=True)
    valid = torch.arange(data.shape[1]) < torch.tensor([len(row) for row in rows]).unsqueeze(-1)
    joints = torch.stack([frame.joints for frame in thinned]) + fit.offsets
    starts = pad(joints, (BASE_DOFS, 0)).to(shape.rest)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchregWarning)  # what is odd about a frame was told when it was read
        config = AlignConfig(search="never", prior_std=None)
        moved = align(shape, data, starts, model_points=fit.problem.skin, mask=valid, locked="base", config=config)
    width = SURFACE_FIT.width_per_noise * fit.noise
    before, after = (
        (welsch_weight(((surface.distance(data, pose) - fit.depth) / width).square()) * valid).sum(-1)
        for pose in (starts, moved.pose)
    )
    gain = (after - before) / after.clamp_min(1)
    usual = gain.median() if len(gain) > 2 else gain.min()
    wrong = (gain > usual.clamp_min(0) + _NUMBERS.gained) & (after - before > _NUMBERS.least_gained)
    return (wrong & (len(gain) > 1)).tolist()


def _best_base(problem: BaseProblem, models: Sequence[PosedModel]) -> tuple[Tensor, float]:
    """Return the best base (4, 4) of a search, and its relative lead over the next."""
    frames, size = problem.frames, problem.size
    candidates, _ = search_base(frames, models, size)
    widths = narrowing(BASE_FIT.start, BASE_FIT.stop)
    fitted = [base_of(approach_base(problem, problem.state(base), widths))[0] for base in candidates]
    bases, costs = rank_bases(torch.stack(fitted), frames, models, size)
    lead = float(costs[1] / costs[0]) - 1 if len(costs) > 1 else float("inf")
    return bases[0], lead


def _result(
    fit: BaseFit,
    frames: Sequence[BaseFrame],
    outliers: tuple[int, ...],
    link: str | None,
    *,
    is_lost: bool,
    is_sole: bool,
) -> BaseCalibration:
    everything = replace(fit.problem, frames=tuple(frames))
    residuals = everything.residuals(fit.state).abs().nanmedian(-1).values
    status = Status.CONVERGED if fit.converged else Status.MAX_STEPS
    if outliers or not is_sole:
        status = Status.WITH_WARNINGS
    covariance, offset_std = base_covariance(fit)
    return BaseCalibration(
        T_camera_base=fit.base,
        offsets=fit.offsets,
        offset_std=offset_std,
        covariance=covariance,
        residuals=residuals,
        depth_offset=torch.tensor(fit.depth, dtype=torch.float64),
        outliers=outliers,
        status=Status.FEW_INLIERS if is_lost else status,
        camera_link=link,
    )
