"""Options of what is known of poses: locked degrees of freedom, encoders, detected keypoints, networks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Sized
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchreg.cli.outputs import check_used
from torchreg.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from torchreg.alignment.results import AlignResult
    from torchreg.alignment.search.pose_proposer import PoseProposer
    from torchreg.capture.depth_frame import DepthFrame
    from torchreg.shapes.articulated import ArticulatedShape

Initializer = Annotated[
    Path | None,
    typer.Option(
        metavar="WEIGHTS.safetensors",
        help="Network that proposes poses where there is no start, as `torchreg train-initializer` writes it for the "
        "shape; the shape hand has one.",
    ),
]


def read_initializer(path: Path | None, shape: ArticulatedShape, side: str | None = None) -> PoseProposer | None:
    """Return the network of a file for a shape, None for None; FormatError if it is for another shape."""
    if path is None:
        return None
    if side == "either":
        raise InputError("--initializer cannot be used with --side either; it is a network for one of the hands")
    from torchreg.alignment.search.pose_proposer import PoseProposer

    return PoseProposer.load(path, shape)


@dataclass(frozen=True)
class _Limits:
    """When the command says that data do not determine a joint."""

    default_std: float = math.radians(1)
    loose: float = math.radians(5)  # standard deviation from which on
    loose_slide: float = 0.02  # the same of joints that slide, metres


_LIMITS = _Limits()


@dataclass(frozen=True)
class Known:
    """What is known of the poses of all frames."""

    locked: tuple[str, ...] = ()
    rows: Sequence[Mapping[str, float]] = ()  # means by name, one for each frame, or one for all; empty without
    std: float = 0.0  # of the means
    keypoints: Tensor | None = None  # (F, K, C) that a detector measured
    keypoint_std: float | None = None

    def prior(self, number: int, origin: Tensor | None = None) -> tuple[Mapping[str, float], float] | None:
        """Return the prior of a frame, in coordinates that begin at an origin (3,)."""
        if not self.rows:
            return None
        row = self.rows[number if len(self.rows) > 1 else 0]
        begin = {} if origin is None else dict(zip(("base_x", "base_y", "base_z"), origin.tolist(), strict=True))
        return {name: value - begin.get(name, 0.0) for name, value in row.items() if math.isfinite(value)}, self.std

    def of(self, number: int) -> dict[str, Any]:
        """Return what is known of a frame as `align` takes it; no keypoints where none was measured."""
        known = {"locked": self.locked, "prior": self.prior(number)}
        row = None if self.keypoints is None else self.keypoints[number]
        if row is None or not bool(row.isfinite().all(-1).any()):
            return known
        return known | {"keypoints": row, "keypoint_std": self.keypoint_std}

    def part(self, numbers: range, origin: Tensor | None) -> dict[str, Any]:
        """Return what is known of some frames as a tracker's run takes it, about the origin (3,) of its clouds."""
        priors = [self.prior(number, origin) for number in numbers]
        known = {"priors": priors if any(priors) else None}
        if self.keypoints is None:
            return known
        rows = self.keypoints[numbers.start : numbers.stop]
        moved = rows if origin is None or rows.shape[-1] != len(origin) else rows - origin
        return known | {"keypoints": moved, "keypoint_std": self.keypoint_std}

    def job(self) -> dict[str, Any]:
        """Return what is known as plain data; nothing where that is nothing."""
        found: dict[str, Any] = {"--locked": list(self.locked)} if self.locked else {}
        if self.rows:
            found |= {"--joints": [dict(row) for row in self.rows], "--joint-std": self.std}
        if self.keypoints is not None:
            found |= {"--keypoints": str(self.keypoints.tolist()), "--keypoint-std": self.keypoint_std}
        return found


@dataclass(frozen=True)
class KnownOptions:
    """What users know of poses."""

    locked: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Degree of freedom that is held at its start (--start or --joints, else at rest), base for all six of "
            "the base; may be repeated.",
        ),
    ] = None
    joints: Annotated[
        Path | None,
        typer.Option(
            metavar="TABLE.csv",
            help="What is known of the pose, as from encoders: a line of names, and a row for each cloud or one for "
            "all.",
        ),
    ] = None
    joint_std: Annotated[
        str | None,
        typer.Option(metavar="STD", help="Standard deviation of --joints, as in 0.5deg, or radians; 1deg by default."),
    ] = None
    keypoints: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.json",
            help="Keypoints of the shape that a detector found, as evidence with the points: a list of [x, y, z] in "
            "metres or, with --depth, [column, row] in pixels, null for missing ones; or a list of such lists, one per "
            "frame. Of hands also what MediaPipe or OpenPose wrote, in one file or a folder of one for each frame.",
        ),
    ] = None
    keypoint_std: Annotated[
        float | None,
        typer.Option(
            metavar="STD",
            help="Standard deviation of --keypoints, in their unit; by default 5 pixels, or 3 % of the shape's size.",
        ),
    ] = None

    def read(
        self, shape: ArticulatedShape, frames: Sized, pictures: Sequence[DepthFrame] | None, *, any_side: bool = False
    ) -> Known:
        """Return what the options say of frames, of hands of any side or of the shape's; InputError if it is wrong."""
        check_used(self.joints is not None, "--joints", {"--joint-std": self.joint_std})
        check_used(self.keypoints is not None, "--keypoints", {"--keypoint-std": self.keypoint_std})
        rows = () if self.joints is None else _read_joints(self.joints, shape, len(frames))
        std = _read_angle(self.joint_std) if rows else 0.0
        if self.keypoints is None:
            return Known(tuple(self.locked or ()), rows, std)
        from torchreg._checks import check_positive
        from torchreg.io.keypoints import load_keypoints

        if self.keypoint_std is not None:
            check_positive(self.keypoint_std, "--keypoint-std")
        camera = pictures[0].camera if pictures else None
        size = None if camera is None else (camera.width, camera.height)
        side = None if any_side else getattr(shape, "side", None)
        table = load_keypoints(self.keypoints, side=side, picture=size)
        if len(table) != len(frames):
            raise InputError(
                f"{self.keypoints} must hold the keypoints of every frame, {len(frames)}; got those of {len(table)}"
            )
        return Known(tuple(self.locked or ()), rows, std, table, self.keypoint_std)


def _read_joints(path: Path, shape: ArticulatedShape, count: int) -> Sequence[Mapping[str, float]]:
    """Return the known joints of each frame, or of all."""
    from torchreg.io.pose_table import load_pose_table

    rows = load_pose_table(path, shape.dof_names)
    if len(rows) not in (1, count):
        raise InputError(f"{path} must hold a row for each of {count} clouds, or one for all; got {len(rows)}")
    lower, upper = (dict(zip(shape.dof_names, limit.tolist(), strict=True)) for limit in (shape.lower, shape.upper))
    for number, row in enumerate(rows):
        for name, value in row.items():
            if value < lower[name] - _LIMITS.loose or value > upper[name] + _LIMITS.loose:
                raise InputError(
                    f"{path}: row {number + 2} has {name} at {value:g}, beyond its limits {lower[name]:.4g} to "
                    f"{upper[name]:.4g}; angles are radians"
                )
    return rows


def _read_angle(text: str | None) -> float:
    """Return an angle in radians."""
    if text is None:
        return _LIMITS.default_std
    number, factor = (text[:-3], math.radians(1)) if text.endswith("deg") else (text.removesuffix("rad"), 1.0)
    try:
        value = float(number) * factor
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"--joint-std must be a positive angle as in 0.5deg or 0.01, got {text!r}")
    return value


def observability(shape: ArticulatedShape, result: AlignResult) -> str:
    """Return in a sentence which joints the data do not hold; empty if they hold all."""
    from torchreg.alignment.evidence.curvature import spread_of

    if result.covariance is None:
        return ""
    rows = zip(shape.dof_names[6:], result.std[6:].tolist(), shape.is_sliding[6:].tolist(), strict=True)
    words = [spread_of(*row) for row in rows if row[1] > (_LIMITS.loose_slide if row[2] else _LIMITS.loose)]
    return f"data and prior leave open {', '.join(words)}" if words else ""
