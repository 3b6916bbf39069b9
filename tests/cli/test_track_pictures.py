"""Pictures of calibrated cameras tracked from the command line."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

import torchreg as tr
from experiments.made_up.pictures import PictureStyle, stereo_cameras
from experiments.made_up.videos import shape_video
from tests.cli.conftest import save_cameras, save_picture
from torchreg.datasets.hand import hand_motion

FAST = ("--movie", "none", "--no-gltf")


@pytest.fixture(scope="module")
def pair(plain_hand, plain_hand_surface, tmp_path_factory):
    """Folders left/ and right/ with pictures of a hand, calib.json, and the true poses."""
    place = tmp_path_factory.mktemp("stereo")
    cameras = stereo_cameras(width=320, height=240, focal=400.0)
    poses = hand_motion(plain_hand, "rotation", 2, distance=0.6)
    style = PictureStyle(wall=0.95, supersampling=1)
    for name in ("left", "right"):
        (place / name).mkdir()
    for number, frame in enumerate(shape_video(plain_hand, poses, cameras, skin=plain_hand_surface, style=style)):
        for name, picture in zip(("left", "right"), frame, strict=True):
            save_picture(place / name / f"{number}.png", picture.image)
    save_cameras(place / "calib.json", cameras.left, cameras.right)
    save_cameras(place / "one.json", cameras.left)
    save_cameras(place / "swapped.json", cameras.right, cameras.left)
    (place / "start.json").write_text(json.dumps(poses[0].tolist()), encoding="utf-8")
    return place, poses


@pytest.fixture
def stereo(pair, tmp_path):
    """Return the arguments that track pictures, with other options after them."""
    place, _ = pair
    return lambda *options, sides=("left", "right"), calibration="calib.json": (
        "track", "hand", "--stereo", *(place / side for side in sides), "--calibration", place / calibration,
        "--depth-range", 0.45, 0.8, "--start", place / "start.json", "-o", tmp_path / "r", "--matcher", "block", *FAST,
        *options,
    )  # fmt: skip


def test_pictures_are_tracked_and_what_was_seen_is_drawn(done, error_of, stereo, pair, plain_hand, tmp_path):
    output = done(*stereo())
    assert "2 frames: 2 tracked" in output
    result = tr.load(tmp_path / "r.safetensors")
    assert (result.keypoints - plain_hand.keypoints(pair[1])).norm(dim=-1).mean() < 5e-3
    names = sorted(path.name for path in (tmp_path / "r_seen").iterdir())
    assert names == [f"{kind}_000{k}.png" for kind in ("disparity", "frame") for k in range(2)]
    with Image.open(tmp_path / "r_seen" / "frame_0000.png") as file:
        drawn = torch.from_numpy(np.asarray(file) / 255.0)
    assert drawn.shape == (240, 320, 3)
    for color in ([0.2, 1.0, 0.3], [0.1, 0.65, 1.0]):
        assert ((drawn - torch.tensor(color)).abs() < 0.01).all(-1).sum() > 100
    for option in (("--reach", 0.15), ("--volume", -1, -1, 0, 0, 1, 1)):
        assert f"{option[0]} differ" in error_of(*stereo("--resume", *option))


def test_wrong_pictures_are_refused(error_of, stereo, pair, tmp_path):
    left, right = (pair[0] / name for name in ("left", "right"))
    for command, message in [
        (stereo(sides=("left",)), "takes two folders as FRAMES"),
        (stereo(sides=("right", "left")), "left and right pictures are swapped"),
        (("track", "hand", "--stereo", left, right), "--stereo takes --calibration"),
        (stereo(calibration="one.json"), "must hold the left and the right camera"),
        (stereo(calibration="swapped.json"), "left and right are swapped"),
    ]:
        assert message in error_of(*command)
    (tmp_path / "r_seen").mkdir()
    (tmp_path / "r_seen" / "old.png").touch()
    assert "holds pictures; pass --force" in error_of(*stereo())
    assert "must be a folder, it is a file" in error_of(*stereo("--seen", pair[0] / "one.json"))
