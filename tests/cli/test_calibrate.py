"""Where a robot's base is in a camera, from the command line."""

import json
import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation

import torchreg as tr
from torchreg.geometry.visibility import sample_visible
from torchreg.io.points import save_points

BASE = torch.eye(4)
BASE[:3, :3] = torch.from_numpy(Rotation.from_rotvec([1.7, 0.3, -0.2]).as_matrix())
BASE[:3, 3] = torch.tensor([0.1, 0.2, 1.1])


def write_clouds(folder, robot, link=0):
    """Write two clouds of the robot's side towards a camera that a link carries, and the table of its joints."""
    arm = tr.ArticulatedShape.from_urdf(robot)
    skin, files = arm.file_skin(), [folder / "robot0.ply", folder / "robot1.ply"]
    for file, joints in zip(files, [(0.6, 0.05), (-0.9, 0.2)], strict=True):
        pose = torch.tensor([0.0] * 6 + list(joints))
        to_camera = BASE @ arm.part_transforms(pose)[link].inverse()
        vertices = skin(pose) @ to_camera[:3, :3].T + to_camera[:3, 3]
        save_points(file, sample_visible(tr.TriangleMesh(vertices, skin.faces), torch.zeros(3), 250)[0])
    (folder / "joints.csv").write_text("shoulder,rail,time\n0.6,0.05,0\n-0.9,0.2,1\n")
    return files


@pytest.fixture(scope="module")
def clouds(folder):
    return write_clouds(folder, folder / "arm.urdf")


def transform_of(path):
    """Return the camera's pose in its parent (4, 4), and the parent, of a robot's file."""
    joint = next(joint for joint in ET.parse(path).getroot().iter("joint") if joint.get("name") == "camera_joint")
    placed = torch.eye(4, dtype=torch.float64)
    numbers = {name: [float(word) for word in joint.find("origin").get(name).split()] for name in ("xyz", "rpy")}
    placed[:3, :3] = torch.from_numpy(Rotation.from_euler("xyz", numbers["rpy"]).as_matrix())
    placed[:3, 3] = torch.tensor(numbers["xyz"])
    return placed, joint.find("parent").get("link")


def test_the_base_is_written_for_ros_for_easy_handeye_and_into_the_file_of_the_robot(done, folder, clouds, tmp_path):
    output = done(
        "calibrate", folder / "arm.urdf", *clouds, "--joints", folder / "joints.csv", "-o", tmp_path / "base",
        "--urdf-out", tmp_path / "seen.urdf",
    )  # fmt: skip
    assert "base within" in output
    written, found = json.loads((tmp_path / "base_transform.json").read_text()), tr.load(tmp_path / "base.safetensors")
    assert written["T_camera_base"] == found.T_camera_base.tolist()
    assert "static_transform_publisher --x" in written["ros2"]
    assert written["ros2"].endswith("--child-frame-id base")
    assert list(written["offsets"]) == ["shoulder", "rail"]
    torch.testing.assert_close(found.T_camera_base[:3, 3].float(), BASE[:3, 3], rtol=0, atol=0.02)
    assert len(list((tmp_path / "base_seen").glob("*.png"))) == 2
    inverse = found.T_camera_base.inverse()
    placed, parent = transform_of(tmp_path / "seen.urdf")
    torch.testing.assert_close(placed, inverse)
    assert parent == "base"
    assert tr.ArticulatedShape.from_urdf(tmp_path / "seen.urdf").dof_names[6:] == ("shoulder", "rail")
    written = yaml_numbers(tmp_path / "base_handeye.yaml")
    assert (written["eye_on_hand"], written["robot_base_frame"]) == ("false", '"base"')
    quaternion = [float(written[name]) for name in ("qx", "qy", "qz", "qw")]
    torch.testing.assert_close(torch.from_numpy(Rotation.from_quat(quaternion).as_matrix()), inverse[:3, :3])
    assert [float(written[name]) for name in "xyz"] == pytest.approx(inverse[:3, 3].tolist())


def test_a_camera_on_a_link_joins_this_link(done, folder, tmp_path):
    files = write_clouds(tmp_path, folder / "arm.urdf", 1)
    done(
        "calibrate", folder / "arm.urdf", *files, "--joints", tmp_path / "joints.csv", "-o", tmp_path / "base",
        "--camera-link", "upper", "--urdf-out", tmp_path / "seen.urdf",
    )  # fmt: skip
    found = tr.load(tmp_path / "base.safetensors")
    torch.testing.assert_close(found.T_camera_base[:3, 3].float(), BASE[:3, 3], rtol=0, atol=0.02)
    placed, parent = transform_of(tmp_path / "seen.urdf")
    torch.testing.assert_close(placed, found.T_camera_base.inverse())
    assert parent == "upper"
    assert yaml_numbers(tmp_path / "base_handeye.yaml")["robot_effector_frame"] == '"upper"'
    assert json.loads((tmp_path / "base_transform.json").read_text())["ros2"].endswith("--child-frame-id upper")


def yaml_numbers(path):
    """Return the entries of two levels of a YAML file by name."""
    return dict(line.strip().split(": ", 1) for line in path.read_text().splitlines() if ": " in line)


def test_joints_that_do_not_fit_are_told_by_the_name_of_their_file(done, folder, clouds, tmp_path):
    (tmp_path / "joints.csv").write_text("shoulder,rail\n0.6,0.05\n-0.5,0.2\n")
    output = done(
        "calibrate", folder / "arm.urdf", *clouds, "--joints", tmp_path / "joints.csv", "-o", tmp_path / "base"
    )  # fmt: skip
    assert "or in other joints: robot1.ply" in output
    assert json.loads((tmp_path / "base_transform.json").read_text())["outliers"] == [1]


def test_what_cannot_be_drawn_loses_no_result(run, folder, clouds, tmp_path, failing):
    failing("torchreg.viz.figures.save_scene")
    answer = run(
        "calibrate", folder / "arm.urdf", *clouds, "--joints", folder / "joints.csv", "-o", tmp_path / "base"
    )  # fmt: skip
    assert answer.exit_code == 1
    assert "base_seen is not written: ArithmeticError: no room" in answer.output
    assert (tmp_path / "base.safetensors").exists()
    assert (tmp_path / "base_transform.json").exists()


def test_what_does_not_fit_is_told(error_of, folder, clouds, tmp_path):
    robot, output = folder / "arm.urdf", ["-o", tmp_path / "out"]
    table = tmp_path / "joints.csv"
    assert "takes --joints TABLE.csv" in error_of("calibrate", robot, *clouds, *output)
    for rows, message in (
        ("shoulder,arm\n0.1,0.2\n0.1,0.2\n", "has no column rail; the robot's joints are shoulder, rail"),
        ("shoulder,rail\n0.1,0.2\n", "a row for every frame, 2, got 1"),
        ("shoulder,rail\n34.0,0.2\n-50.0,0.2\n", "as degrees all would fit"),
    ):
        table.write_text(rows)
        assert message in error_of("calibrate", robot, *clouds, "--joints", table, *output)
    given = *clouds, "--joints", table, *output
    assert "--joints has no meaning without a robot" in error_of("calibrate", "hand", *given)
    assert "--mask has no meaning without --depth" in error_of("calibrate", robot, *given, "--mask", table)


def test_a_hand_is_searched_and_fitted_to_clouds_and_what_is_left_out_is_told(done, folder, tmp_path, monkeypatch):
    clouds = folder / "cloud0.ply", folder / "cloud3.ply"
    output = done("calibrate", "hand", *clouds, "-o", tmp_path / "hand")
    assert float(re.search(r"lengths ([\d.]+) times those of the shape", output)[1]) == pytest.approx(1, abs=0.05)
    found = tr.load(tmp_path / "hand.safetensors")
    assert found.poses.shape == (2, 27)
    doubtful = replace(found, outliers=(1,), status=tr.Status.WITH_WARNINGS)
    monkeypatch.setattr("torchreg.alignment.calibrate.calibrate", lambda *given: doubtful)
    output = done("calibrate", "hand", *clouds, "-o", tmp_path / "hand", "--force", "--quiet")
    assert output == "torchreg: warning: not surely found in cloud3.ply, left out of 2 frames\n"
