"""``torchreg register S0 S1 S2 ... --urdf``: scans of one robot to its description."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from torchreg.cli.outputs import check_outputs, with_ending
from torchreg.cli.reporting import OptionalOutput
from torchreg.errors import InputError

if TYPE_CHECKING:
    from torchreg.geometry.range_scan import RangeScan
    from torchreg.registration.results import SequenceRegistration
    from torchreg.registration.robots.model import RobotModel


@dataclass(frozen=True)
class RobotFiles:
    """The files that become of scans of a robot."""

    urdf: Path
    result: Path
    table: Path

    @classmethod
    def named(cls, output: Path, force: bool) -> RobotFiles:
        """Return the files of an output, which must not exist yet unless ``force``."""
        urdf = with_ending(output, (".urdf",), add=True)
        files = cls(urdf, urdf.with_suffix(".safetensors"), urdf.with_name(f"{urdf.stem}_joints.csv"))
        check_outputs([files.urdf, files.result, files.result.with_suffix(".json"), files.table], force)
        return files


def write_scanned_robot(
    scans: Sequence[RangeScan], names: Sequence[Path], bones: int, grid: int, files: RobotFiles,
    on_step: Callable[[Any], None], tell: bool,
) -> bool:  # fmt: skip
    """Register scans, write the robot and its joint values in all of them, and return whether the result is usable."""
    from torchreg.io.pose_table import save_pose_table
    from torchreg.registration.register_sequence import register_sequence

    found = register_sequence(scans, bones, grid, on_step=on_step)
    found.save(files.result)
    with OptionalOutput(files.urdf):
        robot = found.to_urdf(files.urdf)
        with OptionalOutput(files.table):
            joints = [joint.name for joint in robot.tree.joints[1:]]
            rows = [[name.name, *row] for name, row in zip(names, robot.joint_values.tolist(), strict=True)]
            save_pose_table(files.table, ["scan", *joints], rows)
        if tell:
            typer.echo(f"{_summary(found, robot)} -> {files.urdf}, {files.table}")
            for name in robot.loose:
                typer.echo(
                    f"torchreg: {name} does not explain how its two links move: a part between may be missing",
                    err=True,
                )
    return found.status.usable


def check_alone(options: dict[str, Any]) -> None:
    """Raise InputError if options are given that a robot has no use for."""
    for name, value in options.items():
        if value:
            raise InputError(f"{name} has no meaning with --urdf; leave it out")


def _summary(found: SequenceRegistration, robot: RobotModel) -> str:
    kinds = [joint.kind for joint in robot.tree.joints[1:]]
    size = float((found.points.amax(0) - found.points.amin(0)).norm())
    sure = "" if found.confidence is None else f", confidence {float(found.confidence.min()):.0%} in the worst scan"
    return (
        f"{found.status}{sure}: {len(robot.tree)} links, {kinds.count('revolute')} hinges and "
        f"{kinds.count('prismatic')} sliders; the joints leave the scans a median of "
        f"{100 * float(robot.residuals.max()) / size:.2g} % of the size apart in the worst scan"
    )
