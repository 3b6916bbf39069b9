"""Aligning from the command line: what is printed and written, options, errors, interruptions."""

import json
import math
import warnings
from types import SimpleNamespace

import pytest
import torch

import torchreg
import torchreg.alignment.align as align_module
from torchreg.alignment.config import AlignConfig
from torchreg.cli.hand_side import better_hand
from torchreg.cli.shape_argument import load_shape
from torchreg.geometry.upright import guess_up
from torchreg.io.gltf import load_rig
from torchreg.io.points import load_points, save_points
from torchreg.result import Status
from torchreg.shapes.hand import Hand
from torchreg.storage import load

QUICK = ("--search", "never")


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


def test_one_cloud_is_aligned_and_everything_asked_for_is_written(run, folder, tmp_path):
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


def test_joints_that_the_data_do_not_determine_are_printed(run, folder, tmp_path):
    arm = torchreg.ArticulatedShape.from_urdf(folder / "arm.urdf")
    skin = arm.file_skin()
    save_points(tmp_path / "cloud.ply", skin(arm.rest_pose())[skin.weights.argmax(-1) < 2])
    (tmp_path / "start.json").write_text("{}")
    answer = run(
        "align", folder / "arm.urdf", tmp_path / "cloud.ply", "-o", tmp_path / "r", "--start", tmp_path / "start.json",
        *QUICK,
    )  # fmt: skip
    assert "not determined by the data: " in answer.output
    assert "rail (+- " in answer.output


def test_what_cannot_be_drawn_or_written_loses_no_result(run, folder, tmp_path, failing):
    failing("torchreg.viz.figures.save_scene", "torchreg.io.points.save_points")
    answer = run(
        "align", "hand", folder / "cloud0.ply", folder / "cloud1.ply", "-o", tmp_path / "r", "--start",
        folder / "truth0.json", "--pose", tmp_path / "pose.csv", "--ply", tmp_path / "skin.ply", "--picture",
        tmp_path / "p.png", "--gltf", tmp_path / "hand.glb", "--quiet", *QUICK,
    )  # fmt: skip
    assert answer.exit_code == 1
    assert [line.split("/")[-1] for line in answer.output.splitlines()] == [
        f"{name}_{number}.{ending} is not written: ArithmeticError: no room; the result does not suffer"
        for number in (1, 2) for name, ending in (("skin", "ply"), ("p", "png"))
    ]  # fmt: skip
    assert {path.name for path in tmp_path.iterdir()} == {
        "hand.glb", *(f"{name}_{number}.{end}" for number in (1, 2)
                      for name, end in (("pose", "csv"), ("r", "json"), ("r", "safetensors")))
    }  # fmt: skip


def test_clouds_are_numbered_and_each_starts_from_the_pose_before(run, folder, tmp_path, monkeypatch):
    starts = watch_align(monkeypatch)
    clouds = [folder / f"cloud{index}.ply" for index in range(3)]
    answer = run("align", "hand", *clouds, "-o", tmp_path / "r.safetensors", "--start", folder / "truth0.json", *QUICK)
    assert answer.exit_code == 0, answer.output
    assert sorted(path.name for path in tmp_path.glob("*.safetensors")) == [f"r_{k}.safetensors" for k in (1, 2, 3)]
    poses = [load(tmp_path / f"r_{k}.safetensors").pose for k in (1, 2, 3)]
    assert torch.equal(starts[1], poses[0])
    assert torch.equal(starts[2], poses[1])


def test_an_interruption_leaves_the_finished_clouds_on_disk(run, folder, tmp_path, monkeypatch):
    watch_align(monkeypatch, interrupted=2)
    clouds = [folder / f"cloud{index}.ply" for index in range(4)]
    out = ("-o", tmp_path / "r", "--gltf", tmp_path / "hand.glb", "--start", folder / "truth0.json")
    answer = run("align", "hand", *clouds, *out, *QUICK)
    assert answer.exit_code == 130
    assert "torchreg: interrupted; 2 of 4 clouds are done" in answer.output
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "hand.glb", "r_1.json", "r_1.safetensors", "r_2.json", "r_2.safetensors"
    ]  # fmt: skip


def test_a_result_is_a_start_and_quiet_is_quiet(run, folder, tmp_path, monkeypatch):
    starts = watch_align(monkeypatch)
    command = ("align", "hand", folder / "cloud0.ply", "--quiet", *QUICK)
    answer = run(*command, "-o", tmp_path / "a", "--start", folder / "truth0.json")
    assert (answer.exit_code, answer.output) == (0, "")
    assert run(*command, "-o", tmp_path / "b", "--start", tmp_path / "a.safetensors").exit_code == 0
    assert torch.equal(starts[1], load(tmp_path / "a.safetensors").pose)


def test_the_unit_of_the_cloud_and_the_schedule_are_options(run, folder, tmp_path, monkeypatch):
    meters = load_points(folder / "cloud0.ply").points
    save_points(tmp_path / "mm.xyz", 1000 * meters)
    seen = []

    def noted(shape, data, initial_pose, *, config, **others):
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
    assert start is None  # the shape is searched for


def test_millimeters_taken_for_meters_are_warned_of(run, folder, tmp_path):
    save_points(tmp_path / "mm.ply", 1000 * load_points(folder / "cloud0.ply").points)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        answer = run("align", "hand", tmp_path / "mm.ply", "-o", tmp_path / "r", *QUICK)
    assert answer.exit_code == 1, answer.output
    assert "torchreg: warning: the data spread over" in answer.output
    assert load(tmp_path / "r.safetensors").status is Status.FEW_INLIERS


def test_points_that_are_not_finite_are_refused_or_left_out(run, error_of, folder, tmp_path):
    text = "nan 0 0\n" + "\n".join(" ".join(map(str, p)) for p in load_points(folder / "cloud0.ply").points.tolist())
    (tmp_path / "c.xyz").write_text(text, encoding="utf-8")
    command = ("align", "hand", tmp_path / "c.xyz", "-o", tmp_path / "r", "--start", folder / "truth0.json", *QUICK)
    assert "1 of 376 points are not finite" in error_of(*command)
    assert run(*command, "--nan-policy", "omit").exit_code == 0


def test_a_robot_is_aligned(run, folder, tmp_path):
    (tmp_path / "rest.json").write_text('{"shoulder": 0.0}', encoding="utf-8")
    command = ("align", folder / "arm.urdf", folder / "arm.npz", *QUICK)
    answer = run(*command, "-o", tmp_path / "free", "--start", tmp_path / "rest.json")
    assert answer.exit_code == 0, answer.output
    assert abs(load(tmp_path / "free.safetensors").pose[0].item() - 0.02) < 0.005
    # Its data lie two centimetres beside where its base is held.
    answer = run(*command, "-o", tmp_path / "fixed", "--fixed-base")
    assert answer.exit_code == 1
    assert "data lie beside the shape's surface" in answer.output
    assert abs(load(tmp_path / "fixed.safetensors").pose[0].item()) < 0.005


@pytest.fixture(scope="module")
def rig_aligned(run, error_of, folder, tmp_path_factory):
    """The answer to a rig whose joints know no parents, aligned to its own vertices, and the result."""
    assert "3 roots" in error_of("info", folder / "flat.glb")
    out = tmp_path_factory.mktemp("rig") / "r"
    answer = run(
        "align", folder / "flat.glb", folder / "flat.glb", "--parents", folder / "parents.json", "-o", out, *QUICK
    )
    return answer, load(out.with_suffix(".safetensors"))


def test_the_file_of_a_rig_is_written_with_the_bones_found(folder, run, error_of, tmp_path):
    rig, parents = folder / "flat.glb", folder / "parents.json"
    cloud = load_rig(rig).vertices * 1.1
    save_points(tmp_path / "cloud.ply", cloud)
    common = "align", rig, tmp_path / "cloud.ply", "--parents", parents, "-o", tmp_path / "r"
    answer = run(*common, "--fit-shape", "--start", zeros(tmp_path, rig, parents), "--rig", tmp_path / "new.glb")
    assert answer.exit_code in (0, 1), answer.output
    found = load(tmp_path / "r.safetensors")
    written = load_shape(str(tmp_path / "new.glb"), parents)
    torch.testing.assert_close(written(found.pose).points, found.shape(found.pose).points, atol=1e-5, rtol=0)
    assert "--rig has no meaning without --fit-shape" in error_of(*common, "--rig", tmp_path / "n.glb")
    hand = "align", "hand", tmp_path / "cloud.ply", "--fit-shape", "--rig", tmp_path / "n.glb"
    assert "--rig has no meaning for hand" in error_of(*hand)


def test_an_upright_shape_is_sought_about_the_vertical(run, error_of, folder, tmp_path, monkeypatch):
    asked = []

    def noted(shape, data, initial_pose, *, config, **options):
        asked.append(config.upright)
        raise KeyboardInterrupt

    monkeypatch.setattr("torchreg.alignment.align.align", noted)
    common = "align", "hand", folder / "cloud0.ply", "-o", tmp_path / "r", "--upright"
    run(*common, "--up", "x")
    run(*common)
    assert asked == [(1, 0, 0), guess_up([load_points(folder / "cloud0.ply").points])]
    assert "--upright is of a search" in error_of(*common, "--start", folder / "truth0.json")


def zeros(place, rig, parents):
    """Return the file of a pose at rest."""
    names = load_shape(str(rig), parents).dof_names
    (place / "rest.json").write_text(json.dumps(dict.fromkeys(names, 0.0)), encoding="utf-8")
    return place / "rest.json"


def test_a_rig_with_a_flat_hierarchy_is_aligned(rig_aligned):
    assert rig_aligned[1].distances.abs().median() < 0.002


def test_an_exact_fit_of_a_rig_is_not_doubtful(rig_aligned):
    assert rig_aligned[0].exit_code == 0, rig_aligned[0].output


def test_errors_are_one_line(error_of, folder, tmp_path):
    cloud, out = folder / "cloud0.ply", ("-o", tmp_path / "r")
    damaged = tmp_path / "damaged.ply"
    damaged.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 5\n")
    (tmp_path / "list.json").write_text("[1]", encoding="utf-8")
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
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".json", ".ply"]


def test_either_hand_is_the_one_that_leaves_less_unexplained():
    def align(hand, costs=(2.0, 1.0), confidences=(0.9, 0.5), counts=(9, 9)):
        left = hand.side == "left"
        return SimpleNamespace(
            cost=torch.tensor(costs[left]), confidence=torch.tensor(confidences[left]), distances=[0] * counts[left]
        )

    assert better_hand(align).side == "left"
    assert better_hand(lambda hand: align(hand, counts=(9, 8))).side == "right"


def test_the_side_of_a_hand(run, error_of, folder, tmp_path):
    out = ("-o", tmp_path / "r", *QUICK, "--start", folder / "truth0.json")
    answer = run("align", "hand", folder / "cloud0.ply", "--side", "either", *out)
    assert answer.exit_code == 0
    assert "cloud0.ply: a right hand" in answer.output
    assert "--side must be one of right, left, either" in error_of(
        "align", "hand", folder / "cloud0.ply", "--side", "up"
    )
    assert "--side has no meaning for hand-left" in error_of(
        "align", "hand-left", folder / "cloud0.ply", "--side", "left"
    )


def test_known_joints_hold_a_robot_and_what_is_open_is_told(run, error_of, folder, tmp_path):
    table, robot = tmp_path / "joints.csv", folder / "arm.urdf"
    table.write_text("shoulder,rail\n0.05,0.01\n")
    known = ["--locked", "base", "--joints", table, "--joint-std", "20deg"]
    answer = run("align", robot, folder / "arm.npz", *known, "--search", "never", "-o", tmp_path / "known")
    assert answer.exit_code in (0, 1), answer.output
    pose = load(tmp_path / "known.safetensors").pose
    assert not pose[:6].any()
    out = ["-o", tmp_path / "bad"]
    assert "no meaning without --joints" in error_of("align", robot, folder / "arm.npz", "--joint-std", "1deg", *out)
    wrong = error_of("align", robot, folder / "arm.npz", "--joints", table, "--joint-std", "wide", *out)
    assert "--joint-std must be a positive angle as in 0.5deg" in wrong
    named = error_of("align", robot, folder / "arm.npz", "--locked", "elbow", *out)
    assert "locked names 'elbow', which is no degree of freedom" in named
    table.write_text("shoulder,rail\n50,0.01\n")
    assert "angles are radians" in error_of("align", robot, folder / "arm.npz", "--joints", table, *out)
