"""Aligning and tracking depth pictures from the command line: masks, folders and patterns, and what is refused."""

import json

import pytest
import torch

import torchreg as tr
from torchreg.datasets.hand import surface_skin
from torchreg.datasets.pose_labels import PoseLabels
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.visibility import rasterize
from torchreg.io.calibration import save_depth_camera
from torchreg.io.images import save_depth, save_image
from torchreg.storage import load

CAMERA = tr.Camera(160, 120, (200.0, 200.0, 79.5, 59.5))


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Two depth pictures of a hand before a wall with their masks, its camera and pose."""
    place = tmp_path_factory.mktemp("pictures")
    hand = tr.Hand()
    pose = hand.rest_pose()
    pose[:3], pose[3] = torch.tensor([0.0, 0.06, 0.5]), 1.5
    surface, keypoints = surface_skin(hand), []
    for folder in ("depth", "masks"):
        (place / folder).mkdir()
    for number in range(2):
        pose[0] = 0.004 * number
        with torch.no_grad():
            keypoints.append(CAMERA.project(hand.keypoints(pose))[0].tolist())
        raster = rasterize(TriangleMesh(surface(pose), surface.faces), CAMERA.view())
        shown = raster.face_index >= 0
        save_depth(place / "depth" / f"{number}.png", torch.where(shown, raster.depth, 0.9), 1e-4)
        save_image(place / "masks" / f"{number}.png", shown.float())
    keypoints[0][3] = None
    (place / "keypoints.json").write_text(json.dumps(keypoints), encoding="utf-8")
    save_depth_camera(place / "camera.json", CAMERA, 1e-4)
    (place / "start.json").write_text(json.dumps(pose.tolist()), encoding="utf-8")
    return place


def options(pictures, tmp_path, masks="masks"):
    return (
        "--depth", "--intrinsics", pictures / "camera.json", "--mask", pictures / masks, "--start",
        pictures / "start.json", "-o", tmp_path / "r", "--quiet",
    )  # fmt: skip


def test_pictures_of_a_pattern_are_aligned(run, pictures, tmp_path):
    answer = run(
        "align", "hand", pictures / "depth" / "*.png", *options(pictures, tmp_path), "--search", "never"
    )  # fmt: skip
    assert answer.exit_code == 0, answer.output
    first, second = (load(tmp_path / f"r_{number}.safetensors") for number in (1, 2))
    assert float(second.pose[0] - first.pose[0]) == pytest.approx(0.004, abs=1e-3)
    assert 0.5 < float(first.confidence) <= 1
    frame = tr.DepthFrame.load(
        pictures / "depth" / "0.png", pictures / "camera.json", pictures / "masks" / "0.png"
    )  # fmt: skip
    assert len(first.distances) == len(frame.points)


def test_a_shape_found_in_a_whole_picture_is_drawn_over_the_points_of_its_crop(run, pictures, tmp_path):
    answer = run(
        "align", "hand", pictures / "depth" / "0.png", "--depth", "--intrinsics", pictures / "camera.json", "-o",
        tmp_path / "r", "--picture", tmp_path / "p.png", "--quiet",
    )  # fmt: skip
    assert answer.exit_code == 0, answer.output
    assert (tmp_path / "p.png").stat().st_size > 0
    result = load(tmp_path / "r.safetensors")
    frame = tr.DepthFrame.load(pictures / "depth" / "0.png", pictures / "camera.json")
    assert result.inliers.shape == (len(result.points_of(frame)),) != (len(frame.points),)
    assert result.plot(frame).figure is not None


def test_a_folder_of_pictures_is_tracked_with_keypoints_in_them(run, pictures, tmp_path):
    answer = run(
        "track", "hand", pictures / "depth", *options(pictures, tmp_path), "--movie", "none", "--no-gltf",
        "--keypoints", pictures / "keypoints.json", "--keypoint-std", 4,
    )  # fmt: skip
    assert answer.exit_code == 0, answer.output
    assert all(status.usable for status in load(tmp_path / "r.safetensors").statuses)


def test_pictures_become_labels(run, pictures, tmp_path):
    picture, mask = pictures / "depth" / "1.png", pictures / "masks" / "1.png"
    answer = run(
        "label", "hand", picture, "--depth", "--intrinsics", pictures / "camera.json", "--mask", mask, "--start",
        pictures / "start.json", "--trusted", 0, "-o", tmp_path / "labels",
    )  # fmt: skip
    assert answer.exit_code == 0, answer.output
    (label,) = PoseLabels(tmp_path / "labels")
    torch.testing.assert_close(label["points"], tr.DepthFrame.load(picture, pictures / "camera.json", mask).points)
    assert float(label["pose"][0]) == pytest.approx(0.004, abs=1e-3)


DARK = ("--depth", "--intrinsics", "camera.json", "--mask", "depth/0.png", "--depth-range", "5", "6")


@pytest.mark.parametrize(
    ("command", "changed", "message"),
    [
        ("align", ("--depth",), "--depth takes --intrinsics FILE with the camera"),
        ("track", ("--depth",), "--depth takes --intrinsics FILE with the camera"),
        ("align", ("--intrinsics", "camera.json"), "--intrinsics has no meaning without --depth"),
        ("track", ("--intrinsics", "camera.json"), "--intrinsics has no meaning without --depth"),
        ("label", ("--intrinsics", "camera.json"), "--intrinsics has no meaning without --depth"),
        ("align", DARK, "0.png: depth"),
        (
            "align",
            (*DARK[:3], "--keypoints", "keypoints.json"),
            "keypoints.json must hold the keypoints of every frame, 1; got those of 2",
        ),
        ("track", (*DARK[:3], "--keypoint-std", "4"), "--keypoint-std has no meaning without --keypoints"),
    ],
)
def test_what_does_not_go_together_is_told(run, pictures, tmp_path, command, changed, message):
    given = [pictures / word if "." in word else word for word in changed]
    answer = run(command, "hand", pictures / "depth" / "0.png", *given, "-o", tmp_path / "r", "--quiet")
    assert answer.exit_code == 2
    assert message in answer.output.replace("\n", " ")
