"""Options of what is known of a pose beforehand: degrees of freedom that are held, and what encoders read."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchreg.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from torchreg.alignment.results import AlignResult
    from torchreg.shapes.articulated import ArticulatedShape

Locked = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        help="Degree of freedom that is held at its start (--start or --joints, else at rest), base for all six of the "
        "base; may be repeated.",
    ),
]
Joints = Annotated[
    Path | None,
    typer.Option(
        metavar="TABLE.csv",
        help="What is known of the pose, as encoders tell: a line of names, and a row for each cloud or one for all.",
    ),
]
JointStd = Annotated[
    str | None,
    typer.Option(metavar="STD", help="Standard deviation of --joints, as in 0.5deg, or radians; 1deg by default."),
]


@dataclass(frozen=True)
class _Told:
    """When the command says that data do not hold a joint."""

    default_std: float = math.radians(1)
    loose: float = math.radians(5)  # standard deviation from which on
    loose_slide: float = 0.02  # the same of joints that slide, metres


_TOLD = _Told()


@dataclass(frozen=True)
class Known:
    """What is known of the poses of some clouds.

    Args:
        locked: names of what is held.
        rows: means by name, one for each cloud, or one for all; empty without.
        std: of the means.
    """

    locked: tuple[str, ...]
    rows: Sequence[Mapping[str, float]]
    std: float

    @classmethod
    def nothing(cls) -> Known:
        """Return that nothing is known."""
        return cls((), (), 0.0)

    def prior(self, number: int, origin: Tensor | None = None) -> tuple[Mapping[str, float], float] | None:
        """Return the prior of a cloud, in coordinates that begin at an origin (3,)."""
        if not self.rows:
            return None
        row = self.rows[number if len(self.rows) > 1 else 0]
        begin = {} if origin is None else dict(zip(("base_x", "base_y", "base_z"), origin.tolist(), strict=True))
        return {name: value - begin.get(name, 0.0) for name, value in row.items() if math.isfinite(value)}, self.std

    def job(self) -> dict[str, Any]:
        """Return what is known as plain data; nothing where that is nothing."""
        told = {"--locked": list(self.locked), "--joints": [dict(row) for row in self.rows]}
        return {name: value for name, value in told.items() if value} | ({"--joint-std": self.std} if self.rows else {})


def read_known(
    shape: ArticulatedShape, locked: Sequence[str] | None, joints: Path | None, joint_std: str | None, count: int
) -> Known:
    """Return what the options say of ``count`` clouds; InputError if they do not fit the shape."""
    if joint_std is not None and joints is None:
        raise InputError("--joint-std has no meaning without --joints; leave it out")
    if joints is None:
        return Known(tuple(locked or ()), (), 0.0)
    from torchreg.io.pose_table import load_pose_table

    rows = load_pose_table(joints, shape.dof_names)
    if len(rows) not in (1, count):
        raise InputError(f"{joints} must hold a row for each of {count} clouds, or one for all; got {len(rows)}")
    lower, upper = (dict(zip(shape.dof_names, limit.tolist(), strict=True)) for limit in (shape.lower, shape.upper))
    for number, row in enumerate(rows):
        for name, value in row.items():
            if value < lower[name] - _TOLD.loose or value > upper[name] + _TOLD.loose:
                raise InputError(
                    f"{joints}: row {number + 2} has {name} at {value:g}, beyond its limits {lower[name]:.4g} to "
                    f"{upper[name]:.4g}; angles are radians"
                )
    return Known(tuple(locked or ()), rows, _read_angle(joint_std))


def _read_angle(text: str | None) -> float:
    """Return an angle in radians."""
    if text is None:
        return _TOLD.default_std
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
    from torchreg.alignment.observability import spread_of

    if result.covariance is None:
        return ""
    rows = zip(shape.dof_names[6:], result.std[6:].tolist(), shape.is_sliding[6:].tolist(), strict=True)
    words = [spread_of(*row) for row in rows if row[1] > (_TOLD.loose_slide if row[2] else _TOLD.loose)]
    return f"data and prior leave open {', '.join(words)}" if words else ""
