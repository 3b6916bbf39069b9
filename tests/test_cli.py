"""The command line: what it prints and writes, one line per error, exit codes, interruptions, a quick help."""

import json
import math
import os
import re
import subprocess
import sys
import time
import warnings

import pytest
import torch
from typer.testing import CliRunner

import torchreg
import torchreg.pipelines.align as align_module
import torchreg.pipelines.demo as demo_module
from torchreg import cli
from torchreg.datasets.hand import hand_sequence
from torchreg.io.gltf_write import save_animated_skin
from torchreg.io.points import load_points, save_points
from torchreg.models.articulated import ArticulatedShape
from torchreg.models.hand import Hand
from torchreg.pipelines.align import AlignConfig
from torchreg.pipelines.storage import load
from torchreg.results import Status

ROBOT = """<robot name="arm">
  <link name="base"><visual><geometry><box size="0.2 0.2 0.1"/></geometry></visual></link>
  <link name="upper"><visual><origin xyz="0 0 0.2"/><geometry><cylinder radius="0.04" length="0.4"/></geometry></visual>
  </link>
  <link name="slider"><visual><geometry><sphere radius="0.06"/></geometry></visual></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.05"/>
    <axis xyz="0 1 0"/><limit lower="-1.5707963267948966" upper="1.0" effort="1" velocity="1"/></joint>
  <joint name="rail" type="prismatic"><parent link="upper"/><child link="slider"/><origin xyz="0 0 0.4"/>
    <axis xyz="0 0 1"/><limit lower="0" upper="0.25" effort="1" velocity="1"/></joint>
</robot>"""


def run(*arguments):
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


def error_of(*arguments):
    """Return the one line with which a command fails."""
    answer = run(*arguments)
    assert answer.exit_code == 2, answer.output
    lines = [line for line in re.split(r"[\r\n]", answer.output) if line.startswith("torchreg: ")]
    assert len(lines) == 1
    assert "Traceback" not in answer.output
    return lines[0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with four clouds of a moving hand, a start, a robot and a rig whose nodes are flat."""
    place = tmp_path_factory.mktemp("files")
    for index, cloud in enumerate(hand_sequence("bend", 4, num_points=300, outlier_ratio=0.2, camera=torch.zeros(3))):
        save_points(place / f"cloud{index}.ply", cloud.points)
        truth = dict(zip(Hand().dof_names, cloud.pose.tolist(), strict=True))
        (place / f"truth{index}.json").write_text(json.dumps(truth), encoding="utf-8")
    (place / "arm.urdf").write_text(ROBOT, encoding="utf-8")
    arm = ArticulatedShape.from_urdf(place / "arm.urdf")
    save_points(place / "arm.npz", arm.surface_mesh(spacing=0.02).vertices[::4] + torch.tensor([0.02, 0.0, 0.0]))
    write_flat_rig(place / "flat.glb")
    (place / "parents.json").write_text('{"root": null, "middle": "root", "end": "middle"}', encoding="utf-8")
    return place


def write_flat_rig(path):
    """Write a bar along x, skinned to three joints none of which knows its parent."""
    along = torch.linspace(0, 0.3, 31)
    around = torch.linspace(0, 2 * math.pi, 9)[:-1]
    x, angle = torch.meshgrid(along, around, indexing="ij")
    vertices = torch.stack([x, 0.03 * angle.cos(), 0.03 * angle.sin()], dim=-1).reshape(-1, 3)
    first = (torch.arange(30)[:, None] * 8 + torch.arange(8)).reshape(-1)
    second = (torch.arange(30)[:, None] * 8 + (torch.arange(8) + 1) % 8).reshape(-1)
    triangles = torch.stack([first, second, first + 8], -1), torch.stack([second, second + 8, first + 8], -1)
    owner = (vertices[:, 0] / 0.1).floor().long().clamp(max=2)
    frames = torch.eye(4).repeat(3, 1, 1)
    frames[:, 0, 3] = torch.tensor([0.0, 0.1, 0.2])
    save_animated_skin(
        path, vertices, torch.cat(triangles), torch.nn.functional.one_hot(owner, 3).float(),
        ["root", "middle", "end"], [-1, -1, -1], frames, frames[None], torch.zeros(1),
    )  # fmt: skip


QUICK = ("--search", "never")


def test_help_is_quick():
    seconds = []
    for _ in range(3):
        started = time.perf_counter()
        answer = subprocess.run(
            [sys.executable, "-m", "torchreg", "--help"], capture_output=True, text=True, timeout=60
        )
        seconds.append(time.perf_counter() - started)
        assert answer.returncode == 0
        assert all(name in answer.stdout for name in ("align", "demo", "figure", "info"))
    assert min(seconds) < 0.6


def test_every_command_explains_itself():
    for command in ("align", "demo", "figure", "info"):
        assert "Usage:" in run(command, "--help").output
    assert "poses are not searched" in " ".join(run("align", "--help").output.split())
    assert run("--version").output == f"torchreg {torchreg.__version__}\n"
    assert run("algin").exit_code == 2


def test_main_runs_the_application_on_one_thread_unless_told_otherwise(monkeypatch):
    calls = []
    monkeypatch.setattr(cli, "app", lambda **options: calls.append((options, os.environ["OMP_NUM_THREADS"])))
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    cli.main()
    monkeypatch.delenv("OMP_NUM_THREADS")
    cli.main()
    assert calls == [({"prog_name": "torchreg"}, "3"), ({"prog_name": "torchreg"}, "1")]


def test_one_cloud_is_aligned_and_everything_asked_for_is_written(folder, tmp_path):
    answer = run(
        "align", "hand", folder / "cloud0.ply", "-o", tmp_path / "r", "--start", folder / "truth0.json",
        "--pose", tmp_path / "pose.json", "--ply", tmp_path / "skin.ply", "--picture", tmp_path / "p.png",
        "--gltf", tmp_path / "hand.glb", *QUICK,
    )  # fmt: skip
    assert answer.exit_code == 0, answer.output
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "hand.glb", "p.png", "pose.json", "r.json", "r.safetensors", "skin.ply"
    ]  # fmt: skip
    result = load(tmp_path / "r.safetensors")
    assert f"{int(result.inliers.sum())} of 375 points inliers, rms " in answer.output
    near = result.distances[result.inliers]
    assert f"rms {1000 * math.sqrt(sum(d * d for d in near.tolist()) / len(near)):.2f} mm" in answer.output
    assert result.status.value in answer.output
    named = json.loads((tmp_path / "pose.json").read_text(encoding="utf-8"))
    assert list(named) == list(Hand().dof_names)
    assert list(named.values()) == pytest.approx(result.pose.tolist())
    assert torch.allclose(load_points(tmp_path / "skin.ply").points, result.registered, atol=1e-6)
    truth = json.loads((folder / "truth0.json").read_text(encoding="utf-8"))
    assert abs(named["index_mcp_flexion"] - truth["index_mcp_flexion"]) < 0.15


def test_clouds_are_numbered_and_each_starts_from_the_pose_before(folder, tmp_path, monkeypatch):
    starts = watch_align(monkeypatch)
    clouds = [folder / f"cloud{index}.ply" for index in range(3)]
    answer = run("align", "hand", *clouds, "-o", tmp_path / "r.safetensors", "--start", folder / "truth0.json", *QUICK)
    assert answer.exit_code == 0, answer.output
    assert sorted(path.name for path in tmp_path.glob("*.safetensors")) == [f"r_{k}.safetensors" for k in (1, 2, 3)]
    poses = [load(tmp_path / f"r_{k}.safetensors").pose for k in (1, 2, 3)]
    assert torch.equal(starts[1], poses[0])
    assert torch.equal(starts[2], poses[1])


def watch_align(monkeypatch, interrupted=None):
    """Let `align` note its starts, and be interrupted in the given call."""
    original, starts = align_module.align, []

    def watched(shape, data, initial_pose, **options):
        if len(starts) == interrupted:
            raise KeyboardInterrupt
        starts.append(initial_pose)
        return original(shape, data, initial_pose, **options)

    monkeypatch.setattr(align_module, "align", watched)
    return starts


def test_an_interruption_leaves_the_finished_clouds_on_disk(folder, tmp_path, monkeypatch):
    watch_align(monkeypatch, interrupted=2)
    clouds = [folder / f"cloud{index}.ply" for index in range(4)]
    out = ("-o", tmp_path / "r", "--gltf", tmp_path / "hand.glb", "--start", folder / "truth0.json")
    answer = run("align", "hand", *clouds, *out, *QUICK)
    assert answer.exit_code == 130
    assert "torchreg: interrupted; 2 of 4 clouds are done" in answer.output
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "hand.glb", "r_1.json", "r_1.safetensors", "r_2.json", "r_2.safetensors"
    ]  # fmt: skip


def test_an_interruption_elsewhere_ends_with_the_same_code(monkeypatch):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "_load_shape", interrupted)
    answer = run("info", "hand")
    assert answer.exit_code == 130
    assert "torchreg: interrupted" in answer.output


def test_a_result_is_a_start_and_quiet_is_quiet(folder, tmp_path, monkeypatch):
    starts = watch_align(monkeypatch)
    command = ("align", "hand", folder / "cloud0.ply", "--quiet", *QUICK)
    answer = run(*command, "-o", tmp_path / "a", "--start", folder / "truth0.json")
    assert (answer.exit_code, answer.output) == (0, "")
    assert run(*command, "-o", tmp_path / "b", "--start", tmp_path / "a.safetensors").exit_code == 0
    assert torch.equal(starts[1], load(tmp_path / "a.safetensors").pose)


def test_the_unit_of_the_cloud_and_the_schedule_are_options(folder, tmp_path, monkeypatch):
    meters = load_points(folder / "cloud0.ply").points
    save_points(tmp_path / "mm.xyz", 1000 * meters)
    seen = []

    def noted(shape, data, initial_pose, *, config, model_points, on_step):
        seen.append((data, initial_pose, config))
        raise KeyboardInterrupt

    monkeypatch.setattr(align_module, "align", noted)
    run(
        "align", "hand-left", tmp_path / "mm.xyz", "--scale", "0.001", "--sigma", "0.02:0.005:3", "--outlier", "volume",
        "--search", "always", "-o", tmp_path / "r",
    )  # fmt: skip
    ((data, start, config),) = seen
    assert torch.allclose(data, meters, atol=1e-6)
    assert config == AlignConfig(
        schedule=torchreg.SigmaSchedule.geometric(0.02, 0.005, 3), outlier="volume", search="always"
    )
    # Without a start: at rest, in the middle of the cloud.
    assert torch.equal(start[3:], torch.zeros(24))
    hand = Hand("left")
    assert (hand.keypoints(start).mean(0) - meters.mean(0)).norm() < 0.08


def test_millimeters_taken_for_meters_are_warned_of(folder, tmp_path):
    save_points(tmp_path / "mm.ply", 1000 * load_points(folder / "cloud0.ply").points)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        answer = run("align", "hand", tmp_path / "mm.ply", "-o", tmp_path / "r", *QUICK)
    assert answer.exit_code == 1, answer.output
    assert "torchreg: warning: the data spread over" in answer.output
    assert load(tmp_path / "r.safetensors").status is Status.FEW_INLIERS


def test_points_that_are_not_finite_are_refused_or_left_out(folder, tmp_path):
    text = "nan 0 0\n" + "\n".join(" ".join(map(str, p)) for p in load_points(folder / "cloud0.ply").points.tolist())
    (tmp_path / "c.xyz").write_text(text, encoding="utf-8")
    command = ("align", "hand", tmp_path / "c.xyz", "-o", tmp_path / "r", "--start", folder / "truth0.json", *QUICK)
    assert "1 of 376 points are not finite" in error_of(*command)
    assert run(*command, "--nan-policy", "omit").exit_code == 0


def test_a_robot_is_aligned(folder, tmp_path):
    for options, base in (((), "free"), (("--fixed-base",), "fixed")):
        out = tmp_path / base
        answer = run("align", folder / "arm.urdf", folder / "arm.npz", "-o", out, *options, *QUICK)
        assert answer.exit_code == 0, answer.output
        pose = load(out.with_suffix(".safetensors")).pose
        assert abs(pose[0].item() - (0.02 if base == "free" else 0.0)) < 0.005


def test_a_rig_with_a_flat_hierarchy_is_aligned(folder, tmp_path):
    assert "3 roots" in error_of("info", folder / "flat.glb")
    command = ("align", folder / "flat.glb", folder / "flat.glb", "--parents", folder / "parents.json")
    answer = run(*command, "-o", tmp_path / "r", *QUICK)
    assert answer.exit_code == 0, answer.output
    assert load(tmp_path / "r.safetensors").distances.abs().median() < 0.002


def test_outputs_are_not_overwritten_unless_forced(folder, tmp_path):
    (tmp_path / "r.json").write_text("mine", encoding="utf-8")
    command = ("align", "hand", folder / "cloud0.ply", "-o", tmp_path / "r", *QUICK)
    assert "r.json exists; pass --force to overwrite it" in error_of(*command)
    assert (tmp_path / "r.json").read_text(encoding="utf-8") == "mine"
    assert run(*command, "--force", "--start", folder / "truth0.json").exit_code == 0
    assert load(tmp_path / "r.safetensors").pose.shape == (27,)


def test_errors_are_one_line(folder, tmp_path):
    cloud, out = folder / "cloud0.ply", ("-o", tmp_path / "r")
    damaged = tmp_path / "damaged.ply"
    damaged.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 5\n")
    (tmp_path / "list.json").write_text("[1]", encoding="utf-8")
    (tmp_path / "broken.json").write_text("{", encoding="utf-8")
    for arguments, message in [
        ((cloud, tmp_path / "none.ply", *out), "none.ply: No such file or directory"),
        ((damaged, *out), "damaged.ply: "),
        ((cloud, *out, "--start", tmp_path / "none.json"), "none.json: No such file or directory"),
        ((cloud, *out, "--start", tmp_path / "list.json"), "list.json must have shape (27)"),
        ((cloud, *out, "--sigma", "0.02:0.005"), "--sigma must be START:STOP:STEPS as in 0.02:0.005:5"),
        ((cloud, *out, "--sigma", "0.01:0.02:5"), "stop must not exceed start"),
        ((cloud, *out, "--search", "maybe"), "search must be one of auto, always, never; got 'maybe'"),
        ((cloud, *out, "--scale", "0"), "--scale must be positive and finite, got 0.0"),
        ((cloud, *out, "--fixed-base"), "--free-base/--fixed-base has no meaning for hand"),
        ((cloud, *out, "--parents", folder / "parents.json"), "--parents has no meaning for hand"),
        ((cloud, "-o", tmp_path / "no" / "r"), "no does not exist; create it first"),
        ((cloud, *out, "--picture", tmp_path / "p.bmp"), "p.bmp must end in .png, .pdf, .svg"),
        ((cloud, *out, "--pose", tmp_path / "r.json"), "two outputs would be called"),
    ]:
        assert message in error_of("align", "hand", *arguments), arguments
    assert "SHAPE must be hand, hand-left or a file ending in .urdf, .glb or .gltf" in error_of("info", "foot")
    flat = ("info", folder / "flat.glb", "--parents")
    assert "broken.json: cannot be read as JSON" in error_of(*flat, tmp_path / "broken.json")
    assert "list.json: must hold {joint: parent or null}" in error_of(*flat, tmp_path / "list.json")
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".json", ".json", ".ply"]


def test_other_warnings_say_where_they_come_from(capsys):
    cli._show_warning(UserWarning("a\n  b"), UserWarning, "file.py", 3)
    assert capsys.readouterr().err == "torchreg: warning: file.py:3: a b\n"


def test_broken_pipes_are_left_to_the_application(monkeypatch):
    def broken(*arguments):
        raise BrokenPipeError(32, "Broken pipe")

    monkeypatch.setattr(cli, "_load_shape", broken)
    answer = run("info", "hand")
    assert answer.exit_code != 0
    assert "torchreg: " not in answer.output


def test_the_demonstration_runs(tmp_path):
    out = tmp_path / "made" / "demo"
    command = [sys.executable, "-m", "torchreg", "demo", "--frames", "2", "-o", str(out)]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert answer.returncode == 0, answer.stderr
    names = ["alignment.gif", "hand.glb", "poses.json", "poses.safetensors"]
    assert sorted(path.name for path in out.iterdir()) == names
    result = load(out / "poses.safetensors")
    lines = answer.stdout.splitlines()
    assert lines[0].startswith(f"2 frames of 750 points: {2 / float(result.seconds.sum()):.1f} frames/s")
    mean, largest = 1000 * float(result.tip_errors.mean()), 1000 * float(result.tip_errors.max())
    assert lines[1] == f"fingertip error, all: mean {mean:.1f} mm, max {largest:.1f} mm (10 fingertips)"
    assert all(name in lines[-1] for name in names)
    assert run("demo", "--frames", "1", "-o", out).exit_code == 2
    skin = ArticulatedShape.from_gltf(out / "hand.glb")
    assert skin.part_names[0] == "palm"


def test_an_interrupted_demonstration_writes_what_is_done(tmp_path, monkeypatch):
    original, calls = demo_module.align, []

    def interrupted(*arguments, **options):
        if calls:
            raise KeyboardInterrupt
        calls.append(1)
        return original(*arguments, **{**options, "config": AlignConfig(search="never")})

    monkeypatch.setattr(demo_module, "align", interrupted)
    answer = run("demo", "--frames", "3", "-o", tmp_path, "--no-picture")
    assert answer.exit_code == 130
    assert "torchreg: interrupted; 1 of 3 frames are done" in answer.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hand.glb", "poses.json", "poses.safetensors"]
    assert load(tmp_path / "poses.safetensors").poses.shape == (1, 27)


def test_figures_are_drawn(tmp_path, monkeypatch):
    answer = run("figure", "bending", "-o", tmp_path / "fig2.png")
    assert answer.exit_code == 0, answer.output
    assert (tmp_path / "fig2.png").read_bytes().startswith(b"\x89PNG")
    assert "NAME must be one of bending, readme; got 'spine'" in error_of("figure", "spine")
    assert "fig2.png exists" in error_of("figure", "bending", "-o", tmp_path / "fig2.png")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("torchreg.viz.figures.readme_picture", lambda path: path)
    assert run("figure", "readme").output == "wrote readme.png\n"


def test_info_shows_limits_in_degrees_and_meters(folder):
    lines = [line.split() for line in run("info", folder / "arm.urdf", "--fixed-base").output.splitlines()]
    assert ["shoulder", "-90", "to", "57.2958", "deg"] in lines
    assert ["rail", "0", "to", "0.25", "m"] in lines
    assert ["base_x", "fixed"] in lines
    assert ["slider", "ellipsoid", "on", "upper"] in [[*line[:1], "ellipsoid", *line[2:]] for line in lines]
    answer = run("info", "hand-left").output
    assert "16 parts, 27 degrees of freedom, fused solids" in answer
    assert "base_rz               free" in answer
