"""Tracking from stereo pictures by the command line: what is written, refusals."""

import json

import pytest
import torch

from experiments.made_up.pictures import PictureStyle, stereo_cameras
from experiments.made_up.videos import shape_video
from torchreg.datasets.hand import hand_motion
from torchreg.geometry.camera_rig import CameraRig
from torchreg.io.calibration import save_cameras
from torchreg.io.images import load_image, save_image
from torchreg.storage import load

FRAMES = 2
FAST = ("--movie", "none", "--no-gltf", "--matcher", "block")


@pytest.fixture(scope="module")
def pictures(plain_hand, plain_hand_surface, tmp_path_factory):
    """Folders left/ and right/, calib.json, and the true poses."""
    place = tmp_path_factory.mktemp("stereo")
    pair = stereo_cameras(width=320, height=240, focal=400.0)
    poses = hand_motion(plain_hand, "rotation", FRAMES, distance=0.6)
    style = PictureStyle(wall=0.95, supersampling=1)
    for name in ("left", "right"):
        (place / name).mkdir()
    for number, frame in enumerate(shape_video(plain_hand, poses, pair, skin=plain_hand_surface, style=style)):
        for name, picture in zip(("left", "right"), frame, strict=True):
            save_image(place / name / f"{number}.png", picture.image)
    save_cameras(place / "calib.json", CameraRig((pair.left, pair.right)))
    (place / "start.json").write_text(json.dumps(poses[0].tolist()), encoding="utf-8")
    return place, poses


@pytest.fixture
def command(pictures, tmp_path):
    place, _ = pictures
    return lambda *options, sides=("left", "right"): (
        "track", "hand", "--stereo", *(place / side for side in sides), "--calibration", place / "calib.json",
        "--depth-range", 0.45, 0.8, "--start", place / "start.json", "-o", tmp_path / "r", *options,
    )  # fmt: skip


def test_pictures_are_tracked_and_what_was_seen_is_drawn(run, command, pictures, plain_hand, tmp_path):
    answer = run(*command(*FAST))
    assert answer.exit_code == 0, answer.output
    assert f"{FRAMES} frames: {FRAMES} tracked" in answer.output
    result = load(tmp_path / "r.safetensors")
    off = (result.keypoints - plain_hand.keypoints(pictures[1])).norm(dim=-1)
    assert off.mean() < 5e-3
    names = sorted(path.name for path in (tmp_path / "r_seen").iterdir())
    assert names == [f"{kind}_000{k}.png" for kind in ("disparity", "frame") for k in range(FRAMES)]
    drawn = load_image(tmp_path / "r_seen" / "frame_0000.png")
    assert drawn.shape == (240, 320, 3)
    for color in ([0.2, 1.0, 0.3], [0.1, 0.65, 1.0]):
        assert ((drawn - torch.tensor(color)).abs() < 0.01).all(-1).sum() > 100
    answer = run(*command(*FAST, "--resume", "--reach", 0.15))
    assert answer.exit_code == 2
    assert "--reach differ" in answer.output


def test_wrong_use_takes_one_line(error_of, command, pictures, tmp_path):
    place, _ = pictures
    assert "takes two folders as FRAMES" in error_of(*command(*FAST, sides=("left",)))
    assert "left and right pictures are swapped" in error_of(*command(*FAST, sides=("right", "left")))
    assert "--stereo takes --calibration" in error_of("track", "hand", "--stereo", place / "left", place / "right")
    assert "no meaning without --stereo" in error_of("track", "hand", place / "left", "--reach", 0.1)
    save_cameras(tmp_path / "one.json", CameraRig((stereo_cameras().left,)))
    folders = (place / "left", place / "right")
    one = ("track", "hand", "--stereo", *folders, "--calibration", tmp_path / "one.json", "-o", tmp_path / "x")
    assert "must hold the left and the right camera" in error_of(*one)
    pair = stereo_cameras(width=320, height=240, focal=400.0)
    save_cameras(tmp_path / "swapped.json", CameraRig((pair.right, pair.left)))
    swapped = ("track", "hand", "--stereo", *folders, "--calibration", tmp_path / "swapped.json", "-o", tmp_path / "x")
    assert "left and right are swapped" in error_of(*swapped)
    (tmp_path / "r_seen").mkdir()
    (tmp_path / "r_seen" / "old.png").touch()
    assert "holds pictures; pass --force" in error_of(*command(*FAST))
