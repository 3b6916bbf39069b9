"""Registration from the command line: files, their contents, exit codes, refusals."""

import functools
import math
import sys

import pytest
import torch

import torchreg as tr
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import jointed_toy
from torchreg.geometry.camera import Camera
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.visibility import rasterize
from torchreg.io.calibration import load_depth_camera, save_depth_camera
from torchreg.io.images import load_image, save_depth
from torchreg.io.points import load_points, save_points
from torchreg.registration import register as pipeline
from torchreg.registration import register_sequence
from torchreg.registration.robots.model import RobotModel


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    """Return two scans on disk, and a registration that starts from the truth."""
    folder = tmp_path_factory.mktemp("scans")
    pair = jointed_toy(2, seed=2, scanner=DepthScanner(num_points=800), step=math.radians(20)).pair(0, 1)
    for name, scan in (("source", pair.source), ("target", pair.target)):
        save_points(folder / f"{name}.ply", scan.points, faces=scan.faces)
    save_points(folder / "bare.ply", pair.source.points)
    return folder, functools.partial(pipeline.register, start=pair.truth)


def test_a_pair_becomes_a_scene_a_result_and_pictures(run, scans, tmp_path, monkeypatch):
    folder, known = scans
    monkeypatch.setattr(pipeline, "register", known)
    answer = run(
        "register", folder / "source.ply", folder / "target.ply", "-o", tmp_path / "out.glb", "--bones", 6,
        "--grid", 25, "--weights", tmp_path / "bones.ply", "--errors", tmp_path / "errors.ply",
    )  # fmt: skip
    assert answer.exit_code == 0, answer.output
    assert "bones" in answer.output
    assert "refine" in answer.output
    assert (tmp_path / "out.glb").read_bytes()[:4] == b"glTF"
    found = tr.load(tmp_path / "out.safetensors")
    assert 1 < found.model.num_bones <= 6
    for name in ("bones.ply", "errors.ply"):
        torch.testing.assert_close(load_points(tmp_path / name).points, found.deformed, atol=1e-5, rtol=0)


def test_what_scans_stand_on_is_left_out(run, error_of, scans, tmp_path, monkeypatch):
    folder, _ = scans
    asked = []
    monkeypatch.setattr(pipeline, "register", lambda *_, **given: asked.append(given["support"]) or sys.exit(3))
    for option in ([], ["--support", "keep"]):
        run("register", folder / "source.ply", folder / "target.ply", "-o", tmp_path / "out.glb", *option)
    assert asked == ["auto", "keep"]
    assert "no meaning with --urdf" in error_of("register", folder, "--urdf", "--support", "keep")


def test_what_cannot_be_drawn_or_written_loses_no_result(run, scans, tmp_path, monkeypatch, failing):
    folder, known = scans
    monkeypatch.setattr(pipeline, "register", known)
    failing("torchreg.viz.scan_gltf.save_grid_animation", "torchreg.viz.bone_colors.save_weight_ply")
    answer = run(
        "register", folder / "source.ply", folder / "target.ply", "-o", tmp_path / "out.glb", "--bones", 6, "--grid",
        25, "--weights", tmp_path / "bones.ply", "--errors", tmp_path / "errors.ply", "--quiet",
    )  # fmt: skip
    assert answer.exit_code == 1
    assert sum("is not written: ArithmeticError" in line for line in answer.output.splitlines()) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["errors.ply", "out.json", "out.safetensors"]


def test_what_cannot_be_written_is_told_first(run, error_of, scans, tmp_path, monkeypatch):
    folder, known = scans
    monkeypatch.setattr(pipeline, "register", known)
    pair = folder / "bare.ply", folder / "target.ply"
    assert "has no triangles" in error_of("register", *pair, "-o", tmp_path / "out.glb")
    assert "must end in" in error_of("register", *pair, "-o", tmp_path / "out.obj")
    answer = run("register", *pair, "-o", tmp_path / "out.safetensors", "--quiet", "--grid", 25)
    assert answer.exit_code == 0, answer.output
    assert answer.output == ""
    assert "exists" in error_of("register", *pair, "-o", tmp_path / "out.safetensors")
    assert "num_bones" in error_of("register", *pair, "-o", tmp_path / "no.safetensors", "--bones", 0)
    assert not (tmp_path / "no.safetensors").exists()


def test_scans_that_have_nothing_in_common_end_with_one(run, scans, tmp_path, monkeypatch):
    folder, known = scans
    monkeypatch.setattr(pipeline, "register", known)
    far = load_points(folder / "target.ply")
    save_points(tmp_path / "far.ply", far.points + 100.0)
    answer = run("register", folder / "source.ply", tmp_path / "far.ply", "-o", tmp_path / "far.safetensors")
    assert answer.exit_code == 1, answer.output
    assert "no_data" in answer.output


@pytest.fixture(scope="module")
def depth_images(tmp_path_factory):
    """Depth images of a toy in two poses, their camera, and a registration that starts from the truth."""
    folder = tmp_path_factory.mktemp("depth")
    sequence = jointed_toy(2, seed=2, scanner=DepthScanner(num_points=800, num_holes=0), step=math.radians(20))
    view = sequence.view
    center = (-view.corner / view.pitch - 0.5).tolist()
    camera = Camera(view.width, view.height, [1 / view.pitch, 1 / view.pitch, *center])
    for frame in range(2):
        depth = rasterize(sequence.mesh(frame), view, cull_back=True).depth
        save_depth(folder / f"{frame}.png", depth.where(depth.isfinite(), 0.0), 2e-4)
    save_depth_camera(folder / "k.json", camera, 2e-4)
    return folder


def test_depth_images_are_registered_and_what_was_seen_is_drawn(run, error_of, depth_images, tmp_path, monkeypatch):
    folder = depth_images

    def still(source, target, bones, grid, **given):
        return register(source, target, bones, grid, start=source.points, **given)

    register = pipeline.register
    monkeypatch.setattr(pipeline, "register", still)
    pair = ("register", "--depth", folder / "0.png", folder / "1.png")
    options = ("--intrinsics", folder / "k.json", "-o", tmp_path / "out.glb", "--bones", 4, "--grid", 20)
    answer = run(*pair, *options)
    assert answer.exit_code in (0, 1), answer.output
    found = tr.load(tmp_path / "out.safetensors")
    assert len(found.points) > 300
    names = sorted(path.name for path in (tmp_path / "out_seen").iterdir())
    assert names == ["registered.png", "source.png", "target.png"]
    source = load_image(tmp_path / "out_seen" / "source.png")
    camera, _ = load_depth_camera(folder / "k.json")
    assert source.shape == (camera.height, camera.width, 3)
    colored = (source.amax(-1) > 0) & ~((source - torch.tensor([1.0, 0.25, 0.15])).abs() < 0.01).all(-1)
    assert int(colored.sum()) == len(found.points)
    out = ("-o", tmp_path / "no.glb")
    assert "--depth takes --intrinsics" in error_of(*pair, *out)
    assert "no meaning without --depth" in error_of("register", "a.ply", "b.ply", "--smoothing", 0.001, *out)
    far = ("--intrinsics", folder / "k.json", "--depth-range", 900, 901)
    assert "0.png: depth" in error_of(*pair, *far, *out, "--seen", tmp_path / "far")


def test_scans_of_a_robot_become_its_description(run, error_of, scans, tmp_path, monkeypatch):
    folder, _ = scans
    three = ("register", folder / "source.ply", folder / "target.ply", folder / "bare.ply")
    arm = KinematicTree((
        Joint("base", -1, torch.eye(4)),
        Joint("joint_1", 0, torch.eye(4), "revolute", (0.0, 0.0, 1.0), lower=-1.0, upper=1.0),
    ))  # fmt: skip
    robot = RobotModel(
        arm, torch.zeros(4, dtype=torch.long), torch.tensor([[0.0], [0.25], [-0.5]]), torch.eye(4).repeat(3, 1, 1),
        torch.tensor([0.0, 0.001, 0.002]), ("joint_1",),
    )  # fmt: skip
    asked = []

    class Found:
        points, status, confidence = torch.eye(3), tr.Status.CONVERGED, torch.tensor([1.0, 0.9, 0.7])

        def to_urdf(self, path):
            asked.append(path)
            return robot

        def save(self, path):
            asked.append(path)

    def known(given, bones, grid, on_step):
        asked.append((len(given), bones, grid))
        return Found()

    monkeypatch.setattr(register_sequence, "register_sequence", known)
    answer = run(*three, "-o", tmp_path / "robot", "--urdf", "--bones", 8, "--grid", 25)
    assert answer.exit_code == 0, answer.output
    assert asked == [(3, 8, 25), tmp_path / "robot.safetensors", tmp_path / "robot.urdf"]
    assert "converged, confidence 70% in the worst scan: 2 links, 1 hinges and 0 sliders" in answer.output
    assert "joint_1 does not explain how its two links move" in answer.output
    lines = (tmp_path / "robot_joints.csv").read_text().splitlines()
    assert lines == ["scan,joint_1", "source.ply,0.0", "target.ply,0.25", "bare.ply,-0.5"]
    assert "exists" in error_of(*three, "-o", tmp_path / "robot.urdf", "--urdf")
    assert "more need --urdf" in error_of(*three, "-o", tmp_path / "many.glb")
    assert "--weights has no meaning with --urdf" in error_of(*three, "--urdf", "--weights", tmp_path / "w.ply")
    assert "--scale is given once" in error_of(*three, "--urdf", "-o", tmp_path / "a", "--scale", 1, "--scale", 2)
