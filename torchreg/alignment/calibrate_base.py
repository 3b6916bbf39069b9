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
from torchreg.alignment.base.among_others import BaseWindow, agreement, base_windows, everything
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

    max_points: int = 1500  # of a frame: more add neighbors that err together
    unseen: float = 2.0  # cost of a frame without data: the largest
    num_skin: int = 800  # points of the robot's surface in the search and against free space
    num_data: int = 600  # of each frame in fits of candidates, and by which its joints are compared with others
    least_seen: float = 0.2  # share of the side towards the camera that data show: a frame with less has no robot
    least_seen_in_hand: float = 0.02  # the same where the robot carries the camera, which shows little of it
    least_agreeing: float = 0.4  # the same of whole pictures, less what lies before free space; wrong bases reach .31
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
            things are outliers. Without masks the robot is sought in balls that it may fill, in whole pictures of a
            camera that stands still by what moves between them, see `Background`: three or more are asked.
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
        problem = BaseProblem.of(fitted_surface(shape), skin, model_size(skin), part)
        models = [PosedModel.of_skin(skin, frame.joints, part) for frame in given]
        found = _best_base(problem, given, models)
        whole, given = given, found.frames
        seen = found.seen(whole, models, problem.size)
        least = _NUMBERS.least_seen if part is None else _NUMBERS.least_seen_in_hand
        least = _NUMBERS.least_agreeing if found.is_whole else least
        used = (seen >= max(least, _NUMBERS.outlying * float(seen.median()))).tolist()
        kept = [frame for frame, is_used in zip(given, used, strict=True) if is_used]
        fit = _fitted(problem.of_frames(kept or given), found.base, offsets)
        wrong = iter(_wrong_joints(shape, fit)) if kept else iter(())
        used = [is_used and not next(wrong) for is_used in used]
        if sum(used) < len(kept):
            kept = [frame for frame, is_used in zip(given, used, strict=True) if is_used]
            fit = _fitted(problem.of_frames(kept), fit.base, offsets)
        outliers = tuple(number for number, is_used in enumerate(used) if not is_used)
        return _result(fit, given, outliers, camera_link, is_lost=not kept, is_sole=found.lead > _NUMBERS.rival)


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


@dataclass(frozen=True, eq=False)
class _Found:
    """The best base (4, 4) of a search, its relative lead over the next, and the frames with the data around it."""

    base: Tensor
    lead: float
    frames: list[BaseFrame]
    is_whole: bool = False

    def seen(self, frames: Sequence[BaseFrame], models: Sequence[PosedModel], size: float) -> Tensor:
        """Return the share (T,) of the robot that frames show, less in whole pictures what lies before free space."""
        if self.is_whole:
            return agreement(self.base[None], frames, models, size)[0]
        return seen_shares(self.base, self.frames, models, size)


def _best_base(problem: BaseProblem, frames: Sequence[BaseFrame], models: Sequence[PosedModel]) -> _Found:
    """Return the best of the bases in all windows of the frames' data."""
    windows = base_windows(frames, models) if problem.camera_part is None else [everything(frames)]
    is_whole = windows[0].ball is not None and all(frame.is_whole for frame in frames)
    found = []
    for window in windows:
        bases, costs = _bases(problem, window, models)
        missing = len(frames) - len(window.frames)
        costs = (costs * len(window.frames) + _NUMBERS.unseen * missing) / len(frames)
        if is_whole:
            costs = 1 - agreement(bases, frames, models, problem.size).mean(-1)
        found += [(float(cost), base, window) for cost, base in zip(costs, bases, strict=True)]
    found.sort(key=lambda each: each[0])
    cost, base, window = found[0]
    lead = found[1][0] / cost - 1 if len(found) > 1 else float("inf")
    near = window.near(frames, models, base, problem.size)
    return _Found(base, lead, [frame.thinned(_NUMBERS.max_points) for frame in near], is_whole)


def _bases(problem: BaseProblem, window: BaseWindow, models: Sequence[PosedModel]) -> tuple[Tensor, Tensor]:
    """Return the bases (K, 4, 4) of a search in a window, best first, and their costs (K,)."""
    frames = [frame.thinned(_NUMBERS.max_points) for frame in window.frames]
    models, size = [models[number] for number in window.numbers], problem.size
    coarse = problem.of_frames([frame.thinned(_NUMBERS.num_data) for frame in frames])
    candidates, _ = search_base(coarse.frames, models, size)
    widths = narrowing(BASE_FIT.start, BASE_FIT.stop)
    fitted = [base_of(approach_base(coarse, coarse.state(base), widths))[0] for base in candidates]
    return rank_bases(torch.stack(fitted), coarse.frames, models, size)


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
