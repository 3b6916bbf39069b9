"""Aligning from the command line: what is printed and written, options, depth pictures, errors, interruptions."""

import json
import math

import pytest
import torch

import torchreg as tr
import torchreg.alignment.align as align_module
from tests.cli.conftest import depth_of, save_cameras, save_depth, save_picture
from tests.tables import each_row
from torchreg.io.points import save_points

QUICK = ("--search", "never")
CAMERA = tr.Camera(160, 120, (200.0, 200.0, 79.5, 59.5))


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


def test_one_cloud_is_aligned_and_everything_asked_for_is_written(done, folder, tmp_path):
    output = done(
        "align", "hand", folder / "cloud0.ply", "-o", tmp_path / "r", "--start", folder / "truth0.json",
        "--pose", tmp_path / "pose.json", "--ply", tmp_path / "skin.ply", "--picture", tmp_path / "p.png",
        "--gltf", tmp_path / "hand.glb", *QUICK,
    )  # fmt: skip
    names = ["hand.glb", "p.png", "pose.json", "r.json", "r.safetensors", "skin.ply"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    result = tr.load(tmp_path / "r.safetensors")
    near = result.distances[result.inliers].tolist()
    rms = f"rms {1000 * math.sqrt(sum(d * d for d in near) / len(near)):.2f} mm"
    sure = f"{result.status.value} (confidence {float(result.confidence):.2f})"
    assert f"{sure}, {len(near)} of 375 points inliers, {rms}" in output
    for name, file in (("pose", "pose.json"), ("ply", "skin.ply"), ("gltf", "hand.glb")):
        command = f"torchreg export {tmp_path / 'r.safetensors'} -o {tmp_path / file}"
        assert output.count(f"--{name} goes with the next release; `{command}` writes it") == 1
    named = json.loads((tmp_path / "pose.json").read_text(encoding="utf-8"))
    assert named == dict(zip(tr.Hand().dof_names, result.pose.tolist(), strict=True))
    torch.testing.assert_close(tr.load_points(tmp_path / "skin.ply").points, result.registered, atol=1e-6, rtol=0)
    truth = json.loads((folder / "truth0.json").read_text(encoding="utf-8"))
    assert abs(named["index_mcp_flexion"] - truth["index_mcp_flexion"]) < 0.15


def test_joints_that_the_data_do_not_determine_are_printed(run, folder, tmp_path):
    arm = tr.ArticulatedShape.from_urdf(folder / "arm.urdf")
    skin = arm.file_skin()
    save_points(tmp_path / "cloud.ply", skin(arm.rest_pose())[skin.weights.argmax(-1) < 2])
    command = "align", folder / "arm.urdf", tmp_path / "cloud.ply", "-o", tmp_path / "r", *QUICK
    answer = run(*command, "--start", folder / "zeros.json")
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
    failed = [line.split("/")[-1] for line in answer.output.splitlines() if "is not written" in line]
    assert failed == [
        f"{name}_{number}.{ending} is not written: ArithmeticError: no room; the result does not suffer"
        for number in (1, 2) for name, ending in (("skin", "ply"), ("p", "png"))
    ]  # fmt: skip
    assert {path.name for path in tmp_path.iterdir()} == {
        "hand.glb", *(f"{name}_{number}.{end}" for number in (1, 2)
                      for name, end in (("pose", "csv"), ("r", "json"), ("r", "safetensors")))
    }  # fmt: skip


def test_clouds_are_numbered_and_each_starts_from_the_pose_before(run, folder, tmp_path, monkeypatch):
    starts = watch_align(monkeypatch)
    clouds = [folder / f"cloud{index}.ply" for index in range(2)]
    command = "align", "hand", *clouds, "-o", tmp_path / "r.safetensors", "--quiet", *QUICK
    answer = run(*command, "--start", folder / "truth0.json")
    assert (answer.exit_code, answer.output) == (0, "")
    assert sorted(path.name for path in tmp_path.glob("*.safetensors")) == [f"r_{k}.safetensors" for k in (1, 2)]
    poses = [tr.load(tmp_path / f"r_{k}.safetensors").pose for k in (1, 2)]
    assert torch.equal(starts[1], poses[0])
    # A result is a start.
    run("align", "hand", clouds[0], "-o", tmp_path / "b", "--start", tmp_path / "r_2.safetensors", *QUICK)
    assert torch.equal(starts[2], poses[1])


def test_an_interruption_leaves_the_finished_clouds_on_disk(run, folder, tmp_path, monkeypatch):
    watch_align(monkeypatch, interrupted=1)
    clouds = [folder / f"cloud{index}.ply" for index in range(4)]
    out = ("-o", tmp_path / "r", "--gltf", tmp_path / "hand.glb", "--start", folder / "truth0.json")
    answer = run("align", "hand", *clouds, *out, *QUICK)
    assert answer.exit_code == 130
    assert "torchreg: interrupted; 1 of 4 clouds are done" in answer.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hand.glb", "r_1.json", "r_1.safetensors"]


def test_options_reach_the_alignment(run, error_of, folder, tmp_path, interrupted):
    meters = tr.load_points(folder / "cloud0.ply").points
    save_points(tmp_path / "mm.xyz", 1000 * meters)
    given = interrupted("torchreg.alignment.align.align")
    common = "-o", tmp_path / "r"
    options = "--sigma", "0.02:0.005:3", "--outlier", "volume", "--search", "always", "--support", "keep"
    run("align", "hand-left", tmp_path / "mm.xyz", "--scale", "0.001", *options, *common)
    (_, data, start), known = given.pop()
    torch.testing.assert_close(data, meters, atol=1e-6, rtol=0)
    schedule = tr.SigmaSchedule.geometric(0.02, 0.005, 3)
    assert known["config"] == tr.AlignConfig(schedule=schedule, outlier="volume", search="always")
    assert known["support"] == "keep"
    assert start is None  # the shape is searched for
    upright = "align", "hand", folder / "cloud0.ply", *common, "--upright"
    for more in (["--up", "x"], []):
        run(*upright, *more)
    told, guessed = (options["config"].upright for _, options in given)
    assert told == (1, 0, 0) != guessed
    assert "--upright is of a search" in error_of(*upright, "--start", folder / "truth0.json")


def test_points_that_are_not_finite_are_refused_or_left_out(run, error_of, folder, tmp_path):
    points = tr.load_points(folder / "cloud0.ply").points.tolist()
    (tmp_path / "c.xyz").write_text("nan 0 0\n" + "\n".join(" ".join(map(str, point)) for point in points))
    command = ("align", "hand", tmp_path / "c.xyz", "-o", tmp_path / "r", "--start", folder / "truth0.json", *QUICK)
    assert "1 of 376 points are not finite" in error_of(*command)
    assert run(*command, "--nan-policy", "omit").exit_code == 0
    (tmp_path / "damaged.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 5\n")
    assert "damaged.ply: " in error_of("align", "hand", tmp_path / "damaged.ply", "-o", tmp_path / "d")


def test_a_robot_is_aligned(run, folder, tmp_path):
    command = ("align", folder / "arm.urdf", folder / "arm.npz", *QUICK)
    answer = run(*command, "-o", tmp_path / "free", "--start", folder / "zeros.json")
    assert answer.exit_code == 0, answer.output
    assert abs(tr.load(tmp_path / "free.safetensors").pose[0].item() - 0.02) < 0.005
    # Its data lie two centimetres off where its base is held.
    answer = run(*command, "-o", tmp_path / "fixed", "--fixed-base")
    assert answer.exit_code == 1
    assert "data lie beside the shape's surface" in answer.output
    assert abs(tr.load(tmp_path / "fixed.safetensors").pose[0].item()) < 0.005


def test_known_joints_hold_a_robot_and_what_is_open_is_printed(run, error_of, folder, tmp_path):
    table, robot = tmp_path / "joints.csv", folder / "arm.urdf"
    table.write_text("shoulder,rail\n0.05,0.01\n")
    command = "align", robot, folder / "arm.npz", "-o", tmp_path / "known"
    answer = run(*command, "--locked", "base", "--joints", table, "--joint-std", "20deg", *QUICK)
    assert answer.exit_code in (0, 1), answer.output
    assert not tr.load(tmp_path / "known.safetensors").pose[:6].any()
    command = *command[:3], "-o", tmp_path / "bad"
    for options, message in [
        (["--joint-std", "1deg"], "no meaning without --joints"),
        (["--joints", table, "--joint-std", "wide"], "--joint-std must be a positive angle as in 0.5deg"),
        (["--locked", "elbow"], "locked names 'elbow', which is no degree of freedom"),
    ]:
        assert message in error_of(*command, *options)
    table.write_text("shoulder,rail\n50,0.01\n")
    assert "angles are radians" in error_of(*command, "--joints", table)


def test_a_rig_with_a_flat_hierarchy_is_aligned(done, error_of, folder, tmp_path):
    assert "3 roots" in error_of("info", folder / "flat.glb")
    rig = "align", folder / "flat.glb", folder / "flat.glb", "--parents", folder / "parents.json", *QUICK
    done(*rig, "-o", tmp_path / "r")
    assert tr.load(tmp_path / "r.safetensors").distances.abs().median() < 0.002


def test_the_file_of_a_rig_is_written_with_the_bones_found(folder, run, error_of, tmp_path):
    rig, parents = folder / "flat.glb", folder / "parents.json"
    save_points(tmp_path / "cloud.ply", tr.load_mesh(rig).vertices * 1.1)
    common = "align", rig, tmp_path / "cloud.ply", "--parents", parents, "-o", tmp_path / "r"
    answer = run(*common, "--fit-shape", "--start", folder / "zeros.json", "--rig", tmp_path / "new.glb", *QUICK)
    assert answer.exit_code in (0, 1), answer.output
    assert "; size -0.0" in answer.output or "; size 0." in answer.output
    found = tr.load(tmp_path / "r.safetensors")
    joined = json.loads(parents.read_text(encoding="utf-8"))
    written = tr.ArticulatedShape.from_gltf(tmp_path / "new.glb", parents=joined)
    torch.testing.assert_close(written(found.pose).points, found.shape(found.pose).points, atol=1e-5, rtol=0)
    assert "--rig has no meaning without --fit-shape" in error_of(*common, "--rig", tmp_path / "n.glb")
    assert "--clothed has no meaning without --fit-shape" in error_of(*common, "--clothed", "yes")
    assert "--clothed must be one of auto, yes, no" in error_of(*common, "--fit-shape", "--clothed", "maybe")
    hand = "align", "hand", tmp_path / "cloud.ply", "--fit-shape", "--rig", tmp_path / "n.glb"
    assert "--rig has no meaning for hand" in error_of(*hand)


@each_row(
    (("none.ply",), "none.ply: No such file or directory"),
    (("--start", "none.json"), "none.json: No such file or directory"),
    (("--start", "list.json"), "list.json must have shape (27)"),
    (("--sigma", "0.02:0.005"), "--sigma must be START:STOP:STEPS as in 0.02:0.005:5"),
    (("--sigma", "a:b:c"), "--sigma must be START:STOP:STEPS as in 0.02:0.005:5"),
    (("--sigma", "0.01:0.02:5"), "stop must not exceed start"),
    (("--search", "maybe"), "search must be one of auto, always, never; got 'maybe'"),
    (("--scale", "0"), "--scale must be positive and finite, got 0.0"),
    (("--fixed-base",), "--free-base/--fixed-base has no meaning for hand; leave it out"),
    (("--parents", "list.json"), "--parents has no meaning for hand"),
    (("-o", "no/r.x"), "no does not exist; create it first"),
    (("--picture", "p.bmp"), "p.bmp must end in .png, .pdf, .svg"),
    (("--pose", "r.json"), "two outputs would be called"),
    (("--ply", "r.obj"), "r.obj must end in .ply"),
    (("--side", "up"), "--side must be one of right, left, either"),
    (("--intrinsics", "list.json"), "--intrinsics has no meaning without --depth"),
    (("--depth",), "--depth takes --intrinsics FILE with the camera"),
    (("--depth", "--support", "keep"), "--support is of clouds"),
)
def test_errors_are_one_line(error_of, folder, tmp_path, arguments, message):
    (tmp_path / "list.json").write_text("[1]", encoding="utf-8")
    words = [
        tmp_path / word if "." in word and ":" not in word and not word[0].isdigit() else word for word in arguments
    ]
    assert message in error_of("align", "hand", folder / "cloud0.ply", "-o", tmp_path / "r", *words)
    assert [path.name for path in tmp_path.iterdir()] == ["list.json"]


def test_the_side_of_a_hand(done, error_of, folder, tmp_path):
    out = ("-o", tmp_path / "r", *QUICK, "--start", folder / "truth0.json")
    output = done("align", "hand", folder / "cloud0.ply", "--side", "either", *out)
    assert "cloud0.ply: a right hand" in output
    other = error_of("align", "hand-left", folder / "cloud0.ply", "--side", "left")
    assert "--side has no meaning for hand-left" in other


@pytest.fixture(scope="module")
def pictures(plain_hand, plain_hand_surface, tmp_path_factory):
    """Two depth pictures of a hand before a wall with their masks, its camera, keypoints and pose."""
    place = tmp_path_factory.mktemp("pictures")
    pose = plain_hand.rest_pose()
    pose[:3], pose[3] = torch.tensor([0.0, 0.06, 0.5]), 1.5
    keypoints = []
    for name in ("depth", "masks"):
        (place / name).mkdir()
    for number in range(2):
        pose[0] = 0.004 * number
        keypoints.append(CAMERA.project(plain_hand.keypoints(pose))[0].tolist())
        depth, shown = depth_of(tr.TriangleMesh(plain_hand_surface(pose), plain_hand_surface.faces), CAMERA)
        save_depth(place / "depth" / f"{number}.png", torch.where(shown, depth, 0.9), 1e-4)
        save_picture(place / "masks" / f"{number}.png", shown)
    keypoints[0][3] = None
    (place / "keypoints.json").write_text(json.dumps(keypoints), encoding="utf-8")
    save_cameras(place / "camera.json", CAMERA, depth_scale=1e-4)
    (place / "start.json").write_text(json.dumps(pose.tolist()), encoding="utf-8")
    return place


def of_pictures(pictures, tmp_path):
    return (
        "--depth", "--intrinsics", pictures / "camera.json", "--mask", pictures / "masks", "--start",
        pictures / "start.json", "-o", tmp_path / "r", "--quiet",
    )  # fmt: skip


def test_pictures_of_a_pattern_are_aligned(done, pictures, tmp_path):
    done("align", "hand", pictures / "depth" / "*.png", *of_pictures(pictures, tmp_path), *QUICK)
    first, second = (tr.load(tmp_path / f"r_{number}.safetensors") for number in (1, 2))
    assert float(second.pose[0] - first.pose[0]) == pytest.approx(0.004, abs=1e-3)
    assert 0.5 < float(first.confidence) <= 1
    frame = tr.DepthFrame.load(pictures / "depth/0.png", pictures / "camera.json", pictures / "masks/0.png")
    assert len(first.distances) == len(frame.points)


def test_a_shape_found_in_a_whole_picture_is_drawn_over_the_points_of_its_crop(done, pictures, tmp_path):
    done(
        "align", "hand", pictures / "depth" / "0.png", "--depth", "--intrinsics", pictures / "camera.json", "-o",
        tmp_path / "r", "--picture", tmp_path / "p.png", "--quiet",
    )  # fmt: skip
    assert (tmp_path / "p.png").stat().st_size > 0
    result = tr.load(tmp_path / "r.safetensors")
    frame = tr.DepthFrame.load(pictures / "depth" / "0.png", pictures / "camera.json")
    assert result.inliers.shape == (len(result.points_of(frame)),) != (len(frame.points),)


def test_a_folder_of_pictures_is_tracked_with_keypoints_in_them(done, error_of, pictures, tmp_path):
    command = "track", "hand", pictures / "depth", *of_pictures(pictures, tmp_path), "--movie", "none", "--no-gltf"
    done(*command, "--keypoints", pictures / "keypoints.json", "--keypoint-std", 4)
    assert all(status.usable for status in tr.load(tmp_path / "r.safetensors").statuses)
    one = "align", "hand", pictures / "depth" / "0.png", *of_pictures(pictures, tmp_path)[:3], "-o", tmp_path / "k"
    keypoints = "--keypoints", pictures / "keypoints.json"
    assert "keypoints.json must hold the keypoints of every frame, 1; got those of 2" in error_of(*one, *keypoints)
    assert "--keypoint-std has no meaning without --keypoints" in error_of(*one, "--keypoint-std", "4")
    dark = "--mask", pictures / "depth" / "0.png", "--depth-range", "5", "6"
    assert "0.png: depth" in error_of(*one, *dark)


def test_frames_become_labels(done, error_of, pictures, folder, plain_hand, tmp_path):
    picture, mask = pictures / "depth" / "1.png", pictures / "masks" / "1.png"
    depth = "--depth", "--intrinsics", pictures / "camera.json", "--mask", mask
    start = "--trusted", 0, "--start"
    given = "label", "hand", picture, *depth, *start, pictures / "start.json", "-o", tmp_path / "pictures"
    clouds = folder / "cloud0.ply", folder / "cloud1.ply"
    command = "label", "hand", *clouds, "-o", tmp_path / "clouds", *start, folder / "truth0.json"
    for words, count in ((given, 1), (command, 2)):
        output = done(*words)
        labels = sorted((words[words.index("-o") + 1]).glob("*.safetensors"))
        assert [path.name for path in labels] == [f"label_{number:06d}.safetensors" for number in range(count)]
        for path in labels:
            assert f"-> {path}" in output
    assert "exists; pass --force" in error_of(*command)
    assert "missing.ply" in error_of("label", "hand", "missing.ply")
    assert "--mask has no meaning without --depth" in error_of("label", "hand", *clouds, "--mask", mask)
