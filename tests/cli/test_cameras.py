"""Options of commands that begin at pictures."""

import pytest
import torch

from experiments.made_up.pictures import PictureStyle, render, stereo_cameras
from torchreg.cli.cameras import check_used, load_calibration, seen_folder, stereo_job, stereo_source
from torchreg.errors import InputError
from torchreg.geometry.camera_rig import CameraRig
from torchreg.geometry.mesh import TriangleMesh, unit_sphere
from torchreg.io.calibration import save_cameras
from torchreg.io.images import save_image


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """One pair of pictures of a ball in left/ and right/, and calib.json."""
    place = tmp_path_factory.mktemp("ball")
    pair = stereo_cameras(width=160, height=120, focal=190.0)
    mesh = unit_sphere(3, dtype=torch.float64)
    mesh = TriangleMesh(0.1 * mesh.vertices + mesh.vertices.new_tensor([0.0, 0.0, 0.6]), mesh.faces)
    for name, camera in (("left", pair.left), ("right", pair.right)):
        (place / name).mkdir()
        save_image(place / name / "0.png", render(mesh, camera, style=PictureStyle(wall=0.9)).image)
    save_cameras(place / "calib.json", CameraRig((pair.left, pair.right)))
    return place


def test_options_without_their_flag_are_refused():
    check_used(True, "--stereo", {"--reach": 0.1})
    check_used(False, "--stereo", {"--reach": None})
    with pytest.raises(InputError, match="--reach has no meaning without --stereo"):
        check_used(False, "--stereo", {"--volume": None, "--reach": 0.1})


def test_pictures_go_beside_the_result_and_are_not_overwritten(tmp_path):
    folder = seen_folder(None, tmp_path / "r.safetensors", force=False)
    assert folder == tmp_path / "r_seen"
    assert folder.is_dir()
    assert seen_folder(folder, tmp_path / "other.glb", force=False) == folder
    (folder / "a.png").touch()
    with pytest.raises(InputError, match="holds pictures; pass --force"):
        seen_folder(None, tmp_path / "r.safetensors", force=False)
    assert seen_folder(None, tmp_path / "r.safetensors", force=True) == folder
    with pytest.raises(InputError, match="must be a folder, it is a file"):
        seen_folder(folder / "a.png", tmp_path / "r.safetensors", force=True)


def test_calibrations_are_called_for(ball):
    assert load_calibration(ball / "calib.json", "--stereo").names == ("left", "right")
    with pytest.raises(InputError, match="--stereo takes --calibration FILE"):
        load_calibration(None, "--stereo")


def test_stereo_source_is_what_options_say(ball, plain_hand):
    folders = [ball / "left", ball / "right"]
    options = (ball / "calib.json", plain_hand, (0.45, 0.8), (-1.0, -1.0, 0.0, 0.0, 1.0, 1.0), "block")
    source = stereo_source(folders, *options, None)
    assert source.reach == plain_hand.length
    assert (source.config.nearest, source.config.farthest, source.config.method) == (0.45, 0.8, "block")
    assert (source[0][:, 0] <= 0).all()
    assert stereo_source(folders, *options, 0.0).reach is None
    job = stereo_job(source)
    assert job["--reach"] == plain_hand.length
    assert job["--volume"] == [[-1.0, -1.0, 0.0], [0.0, 1.0, 1.0]]
    assert job["cameras"][0][0] == [190.0, 190.0, 79.5, 59.5]
    with pytest.raises(InputError, match="takes two folders as FRAMES"):
        stereo_source(folders[:1], *options, None)
