"""Cameras as other programs write them, and numbers that cannot be what they are taken for."""

import json
import math
from contextlib import nullcontext

import numpy as np
import pytest
import torch

import torchreg as tr
from tests.io.helpers import put
from tests.tables import each, each_row, refused, refusing
from torchreg.io.calibration import load_depth_camera

FileWarning, FormatError = tr.errors.FileWarning, tr.errors.FormatError

WANTED = [60.0, 61.0, 31.5, 23.5]
ROWS = [60.0, 0.0, 31.5, 0.0, 61.0, 23.5, 0.0, 0.0, 1.0]
COLUMNS = np.array(ROWS).reshape(3, 3).T.reshape(-1).tolist()
SIZE = {"width": 64, "height": 48}
PLAIN = SIZE | dict(zip(("fx", "fy", "cx", "cy"), WANTED, strict=True))
POSE = np.array([[0.0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3]])
CAMERA_INFO = "\n".join([
    "header:", "  frame_id: camera", "height: 48", "width: 64", "distortion_model: plumb_bob",
    "d:", *["- 0.0"] * 5, "k:", *[f"- {v}" for v in ROWS], "r:", *[f"- {v}" for v in np.eye(3).reshape(-1)],
    "p:", *[f"- {v}" for v in [*ROWS[:3], 0.0, *ROWS[3:6], 0.0, *ROWS[6:], 0.0]], "binning_x: 0", "---", "",
])  # fmt: skip
CALIBRATOR = (
    "image_width: 64\nimage_height: 48\ncamera_name: head\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
    f"  data: {ROWS}\ndistortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n"
    "  data: [0.01, -0.02, 0.0, 0.0, 0.0]\nrectification_matrix:\n  rows: 3\n  cols: 3\n"
    "  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nprojection_matrix:\n  rows: 3\n  cols: 4\n"
    "  data: [60, 0, 31.5, 0, 0, 61, 23.5, 0, 0, 0, 1, 0]\n"
)


def saved(tmp_path, content, name="camera.json"):
    return put(tmp_path, name, content)


@each(
    SIZE | {"intrinsic_matrix": COLUMNS},
    SIZE | {"intrinsic_matrix": COLUMNS, "color_mode": "MJPG_720P", "serial_number_": "1", "stream_length_usec": 9},
    {"class_name": "PinholeCameraParameters", "intrinsic": SIZE | {"intrinsic_matrix": COLUMNS}},
    SIZE | {"ppx": 31.5, "ppy": 23.5, "fx": 60.0, "fy": 61.0, "model": "distortion.inverse_brown_conrady",
            "coeffs": [0.0] * 5},
    PLAIN | {"blur_score": 71.2, "timestamp": 1234567, "neighbors": [1, 2], "center_depth": 1.0},
    {"w": 64, "h": 48, "K": COLUMNS, "fps": 30},
    {"w": 64.0, "h": 48.0, "fl_x": 60.0, "fl_y": 61.0, "cx": 31.5, "cy": 23.5, "camera_angle_x": 0.98},
    {"image_width": 64, "image_height": 48, "K": ROWS, "D": [0.0] * 5, "distortion_model": "plumb_bob",
     "R": [1, 0, 0, 0, 1, 0, 0, 0, 1], "P": [*ROWS, 0, 0, 0]},
     {"image_size": [64, 48], "K": np.array(ROWS).reshape(3, 3).tolist(), "dist": [[0.0] * 5]},
    SIZE | {"camera_matrix": np.array(ROWS).reshape(3, 3).tolist(), "dist_coeffs": []},
    SIZE | {"intrinsics": WANTED},
    SIZE | {"camera_matrix": {"rows": 3, "cols": 3, "data": ROWS}, "distortion_coefficients": {"data": [0.0] * 5}},
)  # fmt: skip
def test_json_of_other_programs(tmp_path, entry):
    path = saved(tmp_path, entry)
    camera, scale = load_depth_camera(path)
    assert (camera.width, camera.height) == (64, 48)
    assert camera.intrinsics.tolist() == WANTED
    assert not camera.is_distorted
    assert scale is None
    assert tr.load_cameras(path)[0].intrinsics.tolist() == WANTED


@pytest.mark.parametrize("name", ["ost.yaml", "head.yml"])
@pytest.mark.parametrize("text", [CAMERA_INFO, CALIBRATOR, f"# by hand\nwidth: 64\nheight: 48\nK: {ROWS}\nD: [0, 0]\n"])
def test_yaml_of_ros(tmp_path, name, text):
    (camera,) = tr.load_cameras(saved(tmp_path, text, name))
    assert (camera.width, camera.height, camera.intrinsics.tolist()) == (64, 48, WANTED)
    assert torch.equal(camera.world_to_camera, torch.eye(4, dtype=torch.float64))
    assert load_depth_camera(tmp_path / name)[0].intrinsics.tolist() == WANTED


def test_lenses_are_kept(tmp_path):
    lens = [0.1, -0.2, 0.01, 0.02, 0.3]
    nested = {"fov": 60, "type": "depth", "is_fisheye": False, "xi": None}
    nested["distortion"] = {"model": "radtan", "coeffs": lens}
    by_name = dict(zip(("k1", "k2", "p1", "p2", "k3"), lens, strict=True))
    for other in (nested, {"coeffs": lens, "model": "brown_conrady"}, by_name, {"D": [lens]}):
        entry = PLAIN | other
        assert tr.load_cameras(saved(tmp_path, entry))[0].distortion.tolist() == [*lens, 0, 0, 0]


def test_poses_of_polycam_and_open3d(tmp_path):
    entries = {f"t_{row}{column}": POSE[row, column] for row in range(3) for column in range(4)}
    camera = load_depth_camera(saved(tmp_path, PLAIN | entries))[0]
    # Polycam's cameras look along -z, y up: its third column is backwards.
    np.testing.assert_allclose(camera.camera_to_world[:3], POSE * [1, -1, -1, 1], atol=1e-12)
    whole = np.vstack([POSE, [0, 0, 0, 1]])
    trajectory = {
        "class_name": "PinholeCameraTrajectory",
        "parameters": [{"extrinsic": whole.T.reshape(-1).tolist(), "intrinsic": SIZE | {"intrinsic_matrix": COLUMNS}}],
    }
    np.testing.assert_allclose(tr.load_cameras(saved(tmp_path, trajectory))[0].world_to_camera, whole)


FISHEYE = [0.01, -0.02, 0.005, -0.002]  # as small as k1 k2 p1 p2
K4 = dict(zip(("k1", "k2", "k3", "k4"), FISHEYE, strict=True))
KALIBR_CAMERA = (
    "  camera_model: {0}\n  distortion_coeffs: [0.1, -0.2, 0.001, 0.002]\n  distortion_model: {1}\n"
    "  intrinsics: [60.0, 61.0, 31.5, 23.5]\n  resolution: [64, 48]\n"
)
KALIBR = f"cam0:\n  cam_overlaps: [1]\n{KALIBR_CAMERA}  rostopic: /cam0/raw\ncam1:\n  T_cn_cnm1:\n" + (
    "  - [1.0, 0.0, 0.0, -0.11]\n  - [0.0, 1.0, 0.0, 0.0]\n  - [0.0, 0.0, 1.0, 0.0]\n  - [0.0, 0.0, 0.0, 1.0]\n"
    f"{KALIBR_CAMERA}"
)


@pytest.mark.parametrize("model", ["equidistant", "distortion.kannala_brandt4", "inverse_brown_conrady", "kb4"])
def test_lenses_of_other_kinds_are_refused(tmp_path, model):
    words = rf"'{model}' is not a pinhole camera's"
    for entry in (
        PLAIN | {"distortion_model": model, "D": FISHEYE},
        PLAIN | {"camera_model": "pinhole", "distortion_model": model} | K4,
        PLAIN | {"distortion": {"model": model, "coefficients": FISHEYE}},
    ):
        path = saved(tmp_path, entry)
        refused((lambda path=path: tr.load_cameras(path), rf"camera\.json.*{words}"))
    for text in (
        f"width: 64\nheight: 48\ndistortion_model: {model}\nK: {ROWS}\nD: {FISHEYE}\n",
        f"%YAML:1.0\n---\nimage_width: 64\nimage_height: 48\ncamera_model: {model}\nM: {ROWS}\nD: {FISHEYE}\n",
        CAMERA_INFO.replace("plumb_bob", model).replace("- 0.0\n" * 5, "- 0.1\n" + "- 0.0\n" * 3),
        KALIBR.format("pinhole", model),
    ):
        path = saved(tmp_path, text, "camera.yml")
        refused((lambda path=path: tr.load_cameras(path), rf"camera\.yml: .*{words}"))


@each(
    PLAIN | {"camera_type": "fisheye", "D": FISHEYE},
    PLAIN | {"lens_model": "Equidistant", "D": FISHEYE},
    PLAIN | {"projection": "equidistant", "coeffs": FISHEYE},
    PLAIN | {"type": "KannalaBrandt8", "coeffs": FISHEYE},
    PLAIN | {"fisheye": True, "D": FISHEYE},
    PLAIN | {"w": 64, "is_fisheye": True} | K4,
    PLAIN | {"camera_model": "OPENCV_FISHEYE"} | K4,
    PLAIN | {"camera_model": "OPENCV_FISHEYE"},  # without numbers it is still no pinhole
    PLAIN | {"camera_model": "OPENCV"} | K4,  # k4 belongs to a fisheye, or to a longer polynomial
    PLAIN | K4,
    PLAIN | {"xi": 1.2, "D": FISHEYE},
    PLAIN | {"lens": {"model": "fisheye", "k": FISHEYE}},
    PLAIN | {"intrinsics": PLAIN | {"camera_type": "ds"}},
)
def test_lenses_are_named_in_many_ways(tmp_path, entry):
    with pytest.raises(FormatError, match=r"camera\.json.*is not a pinhole camera's"):
        tr.load_cameras(saved(tmp_path, entry))


@each_row(
    (SIZE | {"K": ROWS, "D": [0.2, -0.1, 0.05, -0.02]}, "p1 and p2 are hardly as large"),
    (SIZE | {"intrinsics": [20.0, 20.0, 31.5, 23.5], "D": FISHEYE}, "the view is as wide as its"),
)
def test_four_numbers_without_a_model_must_be_like_those_of_a_pinhole(tmp_path, entry, words):
    path, text = saved(tmp_path, entry), saved(tmp_path, as_yaml(entry), "camera.yml")
    refused(
        (lambda: tr.load_cameras(path), rf"four numbers .*{words}; add distortion_model: plumb_bob"),
        (lambda: tr.load_cameras(text), rf"camera\.yml: four numbers .*{words}"),
    )
    lens = tr.load_cameras(saved(tmp_path, entry | {"distortion_model": "plumb_bob"}))[0].distortion
    assert lens.tolist() == [*entry["D"], 0, 0, 0, 0]
    own = PLAIN | {"distortion": entry["D"]}  # k1 k2 p1 p2 by the format's own definition
    assert tr.load_cameras(saved(tmp_path, own))[0].distortion.tolist()[:4] == entry["D"]


def test_chains_of_kalibr(tmp_path):
    first, second = tr.load_cameras(saved(tmp_path, KALIBR.format("pinhole", "radtan"), "camchain.yaml"))
    assert first.intrinsics.tolist() == second.intrinsics.tolist() == WANTED
    assert first.distortion.tolist()[:4] == [0.1, -0.2, 0.001, 0.002]
    np.testing.assert_allclose(second.position, [0.11, 0, 0], atol=1e-15)
    path = saved(tmp_path, KALIBR.format("pinhole", "radtan").replace("T_cn_cnm1", "T_imu"), "c.yaml")
    refused((lambda: tr.load_cameras(path), "cam1 lacks T_cn_cnm1"))


def rectified(*, lens, fx=50.0, baseline=0.0, turn=0.0):
    """Return ROS's camera_info: K, D, R about y, and P with a baseline."""
    cos, sin = math.cos(turn), math.sin(turn)
    return {
        "width": 64, "height": 48, "distortion_model": "plumb_bob", "D": [lens, 0.0, 0.0, 0.0, 0.0], "K": ROWS,
        "R": [cos, 0.0, sin, 0.0, 1.0, 0.0, -sin, 0.0, cos],
        "P": [fx, 0.0, 30.0, -fx * baseline, 0.0, fx, 22.0, 0.0, 0.0, 0.0, 1.0, 0.0],
    }  # fmt: skip


def as_yaml(entry):
    return "".join(f"{name}: {value}\n" for name, value in entry.items())


def projected(entry, points):
    """Return the pixels (N, 2) of points in the rectified frame of the left camera, by K, R and P themselves."""
    rows = np.array(entry["P"]).reshape(3, 4)
    if not any(entry["D"]):
        pixels = np.c_[points, np.ones(len(points))] @ rows.T
        return pixels[:, :2] / pixels[:, 2:]
    place = -rows[0, 3] / rows[0, 0]
    raw = (points - [place, 0, 0]) @ np.array(entry["R"]).reshape(3, 3)  # the inverse of R
    x, y = raw[:, 0] / raw[:, 2], raw[:, 1] / raw[:, 2]
    bent = 1 + entry["D"][0] * (x**2 + y**2)
    return np.c_[60 * bent * x + 31.5, 61 * bent * y + 23.5]


@pytest.mark.parametrize("lens", [0.0, 0.1])
@pytest.mark.parametrize("baseline", [0.0, 0.12])
@pytest.mark.parametrize("written", [json.dumps, as_yaml])
def test_the_baseline_of_ros_is_in_p(tmp_path, lens, baseline, written):
    entry = rectified(lens=lens, baseline=baseline, turn=0.05 if lens else 0.0)
    path = saved(tmp_path, written(entry), "camera.json" if written is json.dumps else "camera.yaml")
    told = nullcontext() if lens else pytest.warns(FileWarning, match="fx, fy, cx, cy are those of P.*not of K")
    with told:
        (camera,) = tr.load_cameras(path)
    np.testing.assert_allclose(camera.position, [baseline, 0, 0], atol=1e-12)
    points = np.array([[0.1, 0.2, 1.0], [-0.3, 0.1, 2.0], [0.4, -0.2, 1.5]])
    np.testing.assert_allclose(camera.project(torch.from_numpy(points))[0], projected(entry, points), atol=1e-9)


def test_two_files_of_ros_are_a_pair(tmp_path):
    for side, baseline in (("left", 0.0), ("right", 0.12)):
        saved(tmp_path, as_yaml(rectified(lens=0.1, baseline=baseline, turn=0.03)), f"{side}.yaml")
    rig = tr.load_cameras(tmp_path)
    assert rig.names == ("left", "right")
    assert rig.stereo().baseline == pytest.approx(0.12)
    np.testing.assert_allclose(rig.stereo().rotation, np.eye(3), atol=1e-12)  # turned alike


ORB_SLAM = (
    '%YAML:1.0\n\n# Camera Parameters\nCamera.type: "{}"\nCamera.fx: 60.0 # pixels\nCamera.fy: 61.0\n'
    "Camera.cx: 31.5\nCamera.cy: 23.5\nCamera.k1: 0.2\nCamera.k2: -0.1\nCamera.p1: 0.01\nCamera.p2: 0.02\n"
    "Camera.k3: 0.3\nCamera.width: 64\nCamera.height: 48\nDepthMapFactor: 5000.0\n"
)


def test_settings_of_orb_slam(tmp_path):
    camera, scale = load_depth_camera(saved(tmp_path, ORB_SLAM.format("PinHole"), "TUM1.yaml"))
    assert camera.intrinsics.tolist() == WANTED
    assert camera.distortion.tolist() == [0.2, -0.1, 0.01, 0.02, 0.3, 0, 0, 0]
    assert scale == pytest.approx(1 / 5000)
    path = saved(tmp_path, ORB_SLAM.format("KannalaBrandt8"), "TUM1.yaml")
    refused((lambda: tr.load_cameras(path), "'KannalaBrandt8' is not a pinhole camera's"))


test_what_is_no_camera_is_refused = refusing(lambda folder, entry: tr.load_cameras(saved(folder, entry)))(
    (PLAIN | {"distorsion": [0.1, 0, 0, 0]}, "holds distorsion, which no camera has; is it distortion?"),
    (PLAIN | {"depthscale": 0.001}, "is it depth_scale?"),
    (SIZE | {"K": [1, 2, 3]}, r"K must hold 3 x 3 numbers \(or fx, fy, cx, cy\), got 3"),
    (SIZE | {"K": [60, 5, 31.5, 0, 61, 23.5, 0, 0, 1]}, "K must be fx 0 cx, 0 fy cy, 0 0 1"),
    (SIZE | {"K": ["a"] * 9}, "K must hold numbers, got"),
    ({"K": ROWS}, "lacks width, height"),
)


def pair(step):
    lines = ["%YAML:1.0", "---", "image_width: 64", "image_height: 48"]
    for name, values, columns in (
        ("M1", ROWS, 3), ("D1", [0.0] * 5, 5), ("M2", ROWS, 3), ("D2", [0.0] * 5, 5),
        ("R", np.eye(3).reshape(-1).tolist(), 3), ("T", [step, 0.3, 0.1], 1),
    ):  # fmt: skip
        lines.append(f"{name}: !!opencv-matrix\n   rows: {len(values) // columns}\n   cols: {columns}\n   dt: d")
        lines.append(f"   data: {values}")
    return "\n".join(lines) + "\n"


def test_a_baseline_in_millimeters_is_told_and_scaled(tmp_path):
    path = saved(tmp_path, pair(-60.02), "stereo.yml")
    with pytest.warns(FileWarning, match=r"stereo\.yml: the cameras of the pair are 60\.02 m apart.*scale=0\.001"):
        tr.load_cameras(path)
    rig = tr.load_cameras(path, scale=0.001)
    assert float(rig[1].world_to_camera[:3, 3].norm()) == pytest.approx(0.06002, abs=1e-5)


def test_images_of_colmap_are_told_by_what_their_lines_hold(tmp_path):
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 64 48 60 60 32 24\n")
    image = "{} 1 0 0 0 0 0 {} 1 {}.png"
    points = "1.5 2.5 -1 3.5 4.5 7"
    lines = [image.format(k, k, name) for k, name in enumerate("abcd", start=1)]
    for text in (
        lines,
        [lines[0], points, lines[1], lines[2], "", lines[3], points],
        [lines[0], "", *lines[1:]],
        ["", "# comment", lines[0], points, *lines[1:]],
    ):
        (tmp_path / "images.txt").write_text("\n".join(text) + "\n")
        assert [camera.name for camera in tr.load_cameras(tmp_path)] == ["a.png", "b.png", "c.png", "d.png"]
