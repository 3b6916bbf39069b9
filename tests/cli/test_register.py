"""Registration and posing from the command line: files, their contents, exit codes, refusals."""

import functools
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

import torchreg as tr
from tests.cli.conftest import depth_of, save_cameras, save_depth
from torchreg.io.points import save_points
from torchreg.registration import register as pipeline

SMALL = ("--bones", 6, "--grid", 25)


@pytest.fixture
def pair(registered, monkeypatch):
    """Two scans on disk, whose registration starts from the truth."""
    place, _, truth = registered
    monkeypatch.setattr(pipeline, "register", functools.partial(pipeline.register, start=truth))
    return place / "source.ply", place / "target.ply"


def test_a_pair_becomes_a_scene_and_a_result(run, done, pair, tmp_path):
    old = {"--weights": "bones.ply", "--errors": "distance.ply"}
    given = [word if word in old else tmp_path / word for row in old.items() for word in row]
    output = done("register", *pair, "-o", tmp_path / "out.glb", *SMALL, *given)
    assert "bones" in output
    assert "refine" in output
    found = tr.load(tmp_path / "out.safetensors")
    assert 1 < found.model.num_bones <= 6
    for option, name in old.items():
        assert output.count(f"{option} goes with the next release") == 1
        run("export", tmp_path / "out", "-o", tmp_path / "e.ply", "--color", name[:-4], "--force")
        assert (tmp_path / "e.ply").read_bytes() == (tmp_path / name).read_bytes()
        torch.testing.assert_close(tr.load_points(tmp_path / name).points, found.deformed, atol=1e-5, rtol=0)
    run("export", tmp_path / "out", "-o", tmp_path / "e.glb")
    assert (tmp_path / "e.glb").read_bytes() == (tmp_path / "out.glb").read_bytes()


def test_what_scans_stand_on_is_left_out(run, error_of, registered, tmp_path, interrupted):
    given = interrupted("torchreg.registration.register.register")
    scans = [registered[0] / f"{name}.ply" for name in ("source", "target")]
    for option in ([], ["--support", "keep"]):
        run("register", *scans, "-o", tmp_path / "out.glb", *option)
    assert [options["support"] for _, options in given] == ["auto", "keep"]


def test_what_cannot_be_drawn_or_written_loses_no_result(run, pair, tmp_path, failing):
    failing("torchreg.viz.scan_gltf.save_grid_animation", "torchreg.viz.bone_colors.save_weight_ply")
    old = "--weights", tmp_path / "bones.ply", "--errors", tmp_path / "errors.ply"
    answer = run("register", *pair, "-o", tmp_path / "out.glb", *SMALL, *old, "--quiet")
    assert answer.exit_code == 1
    assert sum("is not written: ArithmeticError" in line for line in answer.output.splitlines()) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["errors.ply", "out.json", "out.safetensors"]


def test_clouds_without_triangles_and_what_is_refused_first(run, error_of, pair, tmp_path):
    source, target = pair
    bare = source.with_name("bare.ply"), target
    assert "has no triangles" in error_of("register", *bare, "-o", tmp_path / "out.glb")
    assert "must end in" in error_of("register", *bare, "-o", tmp_path / "out.obj")
    answer = run("register", *bare, "-o", tmp_path / "out.safetensors", "--quiet", "--grid", 25)
    assert (answer.exit_code, answer.output) == (0, "")
    assert "exists" in error_of("register", *bare, "-o", tmp_path / "out.safetensors")
    assert "has no triangles" in error_of("export", tmp_path / "out", "-o", tmp_path / "out.glb")
    assert "num_bones" in error_of("register", *bare, "-o", tmp_path / "no.safetensors", "--bones", 0)
    assert not (tmp_path / "no.safetensors").exists()


def test_scans_that_have_nothing_in_common_end_with_one(run, pair, tmp_path):
    save_points(tmp_path / "far.ply", tr.load_points(pair[1]).points + 100.0)
    answer = run("register", pair[0], tmp_path / "far.ply", "-o", tmp_path / "far.safetensors")
    assert answer.exit_code == 1, answer.output
    assert "no_data" in answer.output


def test_depth_images_are_registered_and_what_was_seen_is_drawn(run, error_of, toy, tmp_path, monkeypatch):
    view = toy.view
    center = (-view.corner / view.pitch - 0.5).tolist()
    camera = tr.Camera(view.width, view.height, [1 / view.pitch, 1 / view.pitch, *center])
    for frame in range(2):
        depth, _ = depth_of(toy.mesh(frame), view)
        save_depth(tmp_path / f"{frame}.png", depth, 2e-4)
    save_cameras(tmp_path / "k.json", camera, depth_scale=2e-4)
    original = pipeline.register
    monkeypatch.setattr(
        pipeline, "register", lambda first, *others, **given: original(first, *others, start=first.points, **given)
    )
    pair = ("register", "--depth", tmp_path / "0.png", tmp_path / "1.png")
    options = ("--intrinsics", tmp_path / "k.json", "-o", tmp_path / "out.glb", "--bones", 4, "--grid", 20)
    answer = run(*pair, *options)
    assert answer.exit_code in (0, 1), answer.output
    found = tr.load(tmp_path / "out.safetensors")
    assert len(found.points) > 300
    names = sorted(path.name for path in (tmp_path / "out_seen").iterdir())
    assert names == ["registered.png", "source.png", "target.png"]
    with Image.open(tmp_path / "out_seen" / "source.png") as file:
        source = torch.from_numpy(np.asarray(file) / 255.0)
    assert source.shape == (camera.height, camera.width, 3)
    cut = ((source - torch.tensor([1.0, 0.25, 0.15])).abs() < 0.01).all(-1)
    assert int(((source.amax(-1) > 0) & ~cut).sum()) == len(found.points)
    out = ("-o", tmp_path / "no.glb")
    assert "--depth takes --intrinsics" in error_of(*pair, *out)
    assert "no meaning without --depth" in error_of("register", "a.ply", "b.ply", "--smoothing", 0.001, *out)
    far = ("--intrinsics", tmp_path / "k.json", "--depth-range", 900, 901)
    assert "0.png: depth" in error_of(*pair, *far, *out, "--seen", tmp_path / "far")


def test_scans_of_a_robot_become_its_description(done, error_of, registered, tmp_path, monkeypatch):
    three = ("register", *(registered[0] / f"{name}.ply" for name in ("source", "target", "bare")))
    kinds = [SimpleNamespace(name="joint_1", kind="revolute")]
    robot = SimpleNamespace(
        tree=type("Tree", (list,), {"joints": [None, *kinds]})([0, 1]), loose=("joint_1",), undetermined=("joint_1",),
        joint_values=torch.tensor([[0.0], [0.25], [-0.5]]), residuals=torch.tensor([0.0, 0.001, 0.002]),
    )  # fmt: skip
    asked = []

    class Found:
        points, status, confidence = torch.eye(3), tr.Status.CONVERGED, torch.tensor([1.0, 0.9, 0.7])

        def to_urdf(self, path):
            asked.append(path)
            return robot

        def save(self, path):
            asked.append(path)

    def known(given, bones, grid, on_step, reference):
        asked.append((len(given), bones, grid, reference))
        return Found()

    monkeypatch.setattr("torchreg.registration.register_sequence.register_sequence", known)
    output = done(*three, "-o", tmp_path / "robot", "--urdf", "--bones", 8, "--grid", 25)
    assert asked == [(3, 8, 25, "auto"), tmp_path / "robot.safetensors", tmp_path / "robot.urdf"]
    assert "converged, confidence 70% in the worst scan: 2 links, 1 hinges and 0 sliders" in output
    assert "joint_1 does not explain how its two links move" in output
    assert "the axis of joint_1 is not determined" in output
    lines = (tmp_path / "robot_joints.csv").read_text().splitlines()
    assert lines == ["scan,joint_1", "source.ply,0.0", "target.ply,0.25", "bare.ply,-0.5"]
    for options, message in [
        (["-o", tmp_path / "robot.urdf", "--urdf"], "exists"),
        (["-o", tmp_path / "many.glb"], "more need --urdf"),
        (["--urdf", "--weights", tmp_path / "w.ply"], "--weights has no meaning with --urdf"),
        (["--urdf", "--support", "keep"], "--support has no meaning with --urdf"),
        (["--urdf", "-o", tmp_path / "a", "--scale", 1, "--scale", 2], "--scale is given once for all scans"),
    ]:
        assert message in error_of(*three, *options)
    pair = *three[:3], "-o", tmp_path / "no.glb", "--scale", 1, "--scale", 1, "--scale", 1
    assert "--scale is given once for both scans, or twice, got 3" in error_of(*pair)


def _text(place, mark):
    return mark.join(str(number) for number in place.tolist())


def test_handles_come_to_their_targets(done, error_of, registered, tmp_path):
    place, found, _ = registered
    ends = [int(found.points[:, 1].argmin()), int(found.points[:, 1].argmax())]
    targets = found.deformed[ends] + 0.01
    options = []
    for end, target in zip(ends, targets, strict=True):
        options += ["--handle", _text(found.points[end], ","), "--to", _text(target, " ")]
    output = done("pose", place / "found", *options, "-o", tmp_path / "posed.ply")
    assert "miss" in output
    posed = tr.load_points(tmp_path / "posed.ply").points
    assert float((posed[ends] - targets).norm(dim=-1).max()) < 0.005
    tr.PoseStarts(torch.zeros(1, 6), torch.zeros(1), torch.tensor(1.0)).save(tmp_path / "starts.safetensors")
    one = ["--handle", "0,0,0", "--to", "0,0,0"]
    for words, message in [
        ([place / "found", *one, "--to", "0,0,1"], "equally often"),
        ([place / "found", "--handle", "0,0", "--to", "0,0,up"], "three numbers"),
        ([place / "found", *one, "-o", tmp_path / "no.obj"], "must end in"),
        ([tmp_path / "starts", *one], "holds a PoseStarts"),
    ]:
        assert message in error_of("pose", "-o", tmp_path / "no.ply", *words)


def test_without_handles_a_page_opens(done, error_of, registered, tmp_path, interrupted):
    pytest.importorskip("viser", reason="the viewer needs viser")
    place, found, _ = registered
    interrupted("torchreg.cli.view.time.sleep")
    tr.solve_pose(found.model, found.points[:1], found.deformed[:1] + 0.05).save(tmp_path / "start.safetensors")
    page = "--no-browser", "--port", "0", "-o", tmp_path / "p.ply"
    output = done("pose", place / "found", "--start", tmp_path / "start", *page)
    assert "http://127.0.0.1:" in output
    assert "a pose to start from" in error_of("pose", place / "found", "--start", place / "found", *page)
