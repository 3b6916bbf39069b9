"""Files as users have them: how many give what a user should get.

    python benchmarks/users_files.py --cases FOLDER [--verbose] [NAME ...]

FOLDER holds cases.json, a list of {name, kind, command, expected} with the files of each case in FOLDER/NAME. A command
is one of torchreg's, or Python behind ``python:``; {dir} stands for the folder of the case. Without FOLDER nothing is
counted, and the program says so.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import re
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from torchreg.cli.application import app
from torchreg.errors import TorchregError


@dataclass(frozen=True)
class Answer:
    """What a command gave: its exit code (1 for an exception), and all that it said."""

    code: int
    text: str
    folder: Path

    @property
    def numbers(self) -> list[float]:
        """The numbers in the answer, in their order."""
        return [float(word) for word in re.findall(r"-?\d+\.?\d*(?:e[-+]?\d+)?", self.text)]

    def says(self, *patterns: str) -> bool:
        """Whether all patterns are found in what was said."""
        return all(re.search(pattern, self.text, re.IGNORECASE) for pattern in patterns)

    @property
    def warned(self) -> bool:
        """Whether a warning or an error of the library was told."""
        return self.says("warning|error")


Judge = Callable[[Answer], bool]


def near(wanted: list[float], tolerance: float = 0.02) -> Judge:
    """Return the judge of answers whose first numbers are these."""
    return lambda answer: (
        answer.code == 0
        and len(answer.numbers) >= len(wanted)
        and np.allclose(answer.numbers[: len(wanted)], wanted, atol=tolerance, rtol=0)
    )


def told(*patterns: str, without: str = "$^") -> Judge:
    """Return the judge of answers that say all patterns, and not another."""
    return lambda answer: answer.says(*patterns) and not answer.says(without)


def parts(count: int, *patterns: str) -> Judge:
    """Return the judge of `info` on a shape with so many parts."""
    return lambda answer: answer.code == 0 and answer.says(rf": {count} parts", *patterns)


def found_pose(shoulder: float, elbow: float) -> Judge:
    """Return the judge of the arm's pose."""

    def judge(answer: Answer) -> bool:
        if answer.code == 1:
            return answer.says("--start")
        pose = json.loads((answer.folder / "pose.json").read_text())
        angles = [pose["shoulder"], pose["elbow"]]
        return answer.code == 0 and np.allclose(angles, [shoulder, elbow], atol=0.06, rtol=0)

    return judge


def registered(answer: Answer) -> bool:
    """Return whether the far pair is registered as the near one."""
    from torchreg.storage import load

    near_by = run(f"register {answer.folder}/near_a.ply {answer.folder}/near_b.ply -o {answer.folder}/near.glb "
                  "--bones 3 --grid 20 --force", answer.folder)  # fmt: skip
    far, close = load(answer.folder / "out.safetensors"), load(answer.folder / "near.safetensors")
    step = far.deformed.double() - close.deformed.double() - far.points.double().mean(0) + close.points.double().mean(0)
    return near_by.code == answer.code == 0 and float(step.norm(dim=-1).median()) < 0.01


SET_697 = near([697, 3072], 3)
CAMERA = near([64, 48, 60, 61, 31.5, 23.5], 1e-6)
FIFTY = r"^50 points"

JUDGES: dict[str, Judge] = {
    "utm_scan": lambda a: a.code == 0 and a.numbers[0] < 1e-3,
    "utm_register": registered,
    "utm_align": found_pose(0.15, 0.3),
    "utm_frames": near([0.1, 0.1, 0, 0.1, 0.1, 0], 1e-4),
    "register_metres_to_mm": told("warning", "times as large", r"--scale 0\.001"),
    "align_mm": lambda a: a.code == 1 and a.says(r"--scale 0\.001"),
    "skin_posed_by_nodes": lambda a: a.code == 0 and np.allclose(a.numbers[3:5], [1, 1.15], atol=0.2),
    "skin_armature_cm": near([0.3, 2, 0.3], 0.01),
    "skin_quantized": near([-0.15, 0, -0.15, 0.15, 2, 0.15], 1e-3),
    "rig_quantized_info": parts(2, r"2\.0\d+ m across"),
    "skin_beside_prop": near([2, 2], 1e-3),
    "decimal_frames": near([0.5, 1.0, 1.25, 1.5, 10.0], 1e-6),
    "decimal_pictures": near([0.05, 0.1, 0.25, 0.3], 1e-6),
    "xyz_unit_colors": told("no normals colors"),
    "depth_float_npy": near([0.95, 1.2], 0.01),
    "depth_scale_5000": lambda a: a.code != 0 and a.says("5000|depth_scale"),
    "depth_scale_1": told("warning|error", "depth_scale"),
    "colmap_some_lines_missing": told(r"'a\.png', 'b\.png', 'c\.png'"),
    "ply_float_colors_255": lambda a: a.code == 0 and 0 <= a.numbers[0] < 0.2 and 0.8 < a.numbers[1] <= 1,
    "stereo_T_mm": told("warning|error", "60", "m apart|millimet"),
    **{f"mask_{name}": SET_697 for name in ("in_alpha", "zero_one", "zero_hundred", "palette", "16_bit")},
    "mask_soft": near([697, 3072], 40),
    "align_turned_base": found_pose(0.2, 0.5),
    "align_far_joints": found_pose(-1.2, 1.9),
    "hint_spine_nan": told("f1", without="nan_policy=|nan-policy raise"),
    "hint_register_nan": told(r"b\.ply|registered|converged", without="nan_policy="),
    "hint_two_skins": told("--skin", without="skin="),
    "hint_urdf_package": told("--package-dir", without="package_dirs=|meshes="),
    "hint_usecols": told("line 3", without="`usecols`"),
    "hint_opencv_size": told("image_width", without="size="),
    "cause_xacro_comment": told("well-formed|not closed", without="macros"),
    "cause_lfs_pointer": told("lfs"),
    "cause_decimal_comma": told(r"0\.\d+|decimal", without="normals must|unit normals"),
    "cause_wrong_ending": told("^700 faces|PLY"),
    "nan_normals": near([352, 700], 0),
    "zero_size_primitive": parts(3, "warning"),
    "obj_two_corner_face": near([352, 700], 0),
    "rig_zero_weight": parts(2, "warning"),
    "rig_two_roots": parts(2),
    "rig_empty_primitive": parts(2),
    "urdf_unbound_prefix": parts(3),
    "urdf_xmlns": parts(3),
    "urdf_comment_first": parts(3),
    "urdf_floating": lambda a: parts(3)(a) and (a.says("12 degrees of freedom|13 degrees of freedom") or a.warned),
    "urdf_missing_visual": parts(4),
    "urdf_comment_hyphens": parts(3),
    "csv_header": told(FIFTY, "with colors"),
    "numpy_array": told(FIFTY),
    "leica_pts": told(FIFTY, "with colors"),
    "off_mesh": told("^352 points"),
    "xyz_intensity": told(FIFTY, without="with normals"),
    "xyz_rgb": told(FIFTY, "with colors"),
    "open3d_intrinsics": CAMERA,
    "realsense_intrinsics": CAMERA,
    "polycam_camera": CAMERA,
    "record3d_metadata": CAMERA,
    "ros_camera_info": CAMERA,
    "new_fisheye": lambda a: a.code != 0 and a.says("equidistant|fisheye"),
    "new_depth_65535": near([0.95, 1.2], 0.01),
    "new_obj_some_colors": told("^352 points"),
    "new_leaf_identity": lambda a: a.says(r"'tip_end': \[0\.0, (2|1)\.0, 0\.0\]"),
    "new_limits_degrees": told("warning", "180", "degrees"),
    "new_intrinsics_other_size": told("warning|error", r"319\.5"),
    "new_bom_xyz": told(FIFTY),
}  # fmt: skip


def run(command: str, folder: Path) -> Answer:
    """Return what a command gives, run in this process."""
    command = command.replace("{dir}", str(folder))
    if not command.startswith("python:"):
        given = command.split()
        done = CliRunner().invoke(app, given if given[0] == "info" or "--force" in given else [*given, "--force"])
        return Answer(done.exit_code, done.output, folder)
    said, code = io.StringIO(), 0
    with contextlib.redirect_stdout(said), warnings.catch_warnings(record=True) as told_warnings:
        warnings.simplefilter("always")
        try:
            exec(command.removeprefix("python:").strip(), {})  # the cases are programs
        except (TorchregError, OSError) as error:
            said.write(f"error: {error}\n")
            code = 1
    said.writelines(f"warning: {row.message}\n" for row in told_warnings)
    return Answer(code, said.getvalue(), folder)


def main() -> None:
    """Print each case that is not right, and how many are."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--cases", type=Path)
    parser.add_argument("--verbose", action="store_true", help="also print what was said")
    options = parser.parse_args()
    if options.cases is None or not (options.cases / "cases.json").exists():
        print("no --cases FOLDER with cases.json: nothing is counted")
        return
    cases = json.loads((options.cases / "cases.json").read_text())
    cases = [case for case in cases if not options.names or case["name"] in options.names]
    right = 0
    for case in cases:
        answer = run(case["command"], options.cases / case["name"])
        good = case["name"] in JUDGES and bool(JUDGES[case["name"]](answer))
        right += good
        if options.verbose or not good:
            said = " | ".join(line.split("\r")[-1] for line in answer.text.splitlines() if line.strip())
            print(f"{'right' if good else 'WRONG'} {case['kind']} {case['name']}: exit {answer.code}: {said[-400:]}")
    print(f"{right} of {len(cases)} cases are right")


if __name__ == "__main__":
    sys.exit(main())
