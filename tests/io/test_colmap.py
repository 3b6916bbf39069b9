import pytest
import torch

from torchreg.errors import FormatError, InputError
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import CameraRig
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation import so3_exp
from torchreg.io.colmap import load_colmap, save_colmap

CAMERA = "# a comment\n\n7 OPENCV 640 480 600 601 320 240 0.1 0.2 0.001 0.002\n"
# A quarter turn about z; the second image has no points at all, not even an empty line.
HALF = 0.5**0.5
IMAGES = f"# a comment\n1 {HALF} 0 0 {HALF} 0.1 0.2 0.3 7 a.png\n10 20 -1 30 40 5\n2 1 0 0 0 0 0 1 7 b c.png\n"


@pytest.fixture
def model(tmp_path):
    def write(cameras=CAMERA, images=IMAGES):
        (tmp_path / "cameras.txt").write_text(cameras, encoding="utf-8")
        (tmp_path / "images.txt").write_text(images, encoding="utf-8")
        return tmp_path

    return write


def test_images_become_cameras_in_our_convention(model):
    rig = load_colmap(model())
    assert rig.names == ("a.png", "b c.png")
    assert rig[0].intrinsics.tolist() == [600.0, 601.0, 319.5, 239.5]
    assert rig[0].distortion.tolist() == [0.1, 0.2, 0.001, 0.002, 0, 0, 0, 0]
    turned = rig[0].world_to_camera @ torch.tensor([1.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    assert torch.allclose(turned, turned.new_tensor([0.1, 1.2, 0.3, 1.0]))


@pytest.mark.parametrize(
    ("line", "values"),
    [
        ("SIMPLE_PINHOLE 640 480 600 320 240", [600, 600, 319.5, 239.5, 0, 0]),
        ("PINHOLE 640 480 600 601 320 240", [600, 601, 319.5, 239.5, 0, 0]),
        ("SIMPLE_RADIAL 640 480 600 320 240 0.1", [600, 600, 319.5, 239.5, 0.1, 0]),
        ("RADIAL 640 480 600 320 240 0.1 0.2", [600, 600, 319.5, 239.5, 0.1, 0.2]),
        ("FULL_OPENCV 640 480 600 601 320 240 1 2 3 4 5 6 7 8", [600, 601, 319.5, 239.5, 1, 2]),
    ],
)
def test_lens_models(model, line, values):
    camera = load_colmap(model(f"7 {line}\n"))[0]
    assert [*camera.intrinsics.tolist(), *camera.distortion[:2].tolist()] == values


def test_round_trip_at_all_kinds_of_rotations(tmp_path):
    turns = [(0, 0, 0), (3.14, 0, 0), (0, 3.14, 0), (0, 0, 3.14), (1.0, -2.0, 0.5)]
    lenses = [(), (0.1, 0.2, 0.3, 0.4), (0.1, 0.2, 0.3, 0.4, 0.5), (), tuple(range(8))]
    step = torch.tensor([1 / 3, 2.0, 3.0], dtype=torch.float64)
    rig = CameraRig(
        tuple(
            Camera(
                64, 48, (50.1, 50.2, 31.3, 23.4), rigid_matrix(so3_exp(step.new_tensor(turn)), step), lens, f"{k}.png"
            )
            for k, (turn, lens) in enumerate(zip(turns, lenses, strict=True))
        )
    )
    save_colmap(tmp_path, rig)
    found = load_colmap(tmp_path)
    assert found.names == rig.names
    for one, two in zip(rig, found, strict=True):
        assert torch.allclose(one.intrinsics, two.intrinsics, rtol=0, atol=1e-12)
        assert torch.allclose(one.world_to_camera, two.world_to_camera, rtol=0, atol=1e-14)
        assert torch.equal(one.distortion, two.distortion)


@pytest.mark.parametrize(
    ("cameras", "images", "message"),
    [
        ("7 OPENCV 640 480 600 601 320 240 0.1\n", IMAGES, "line 1: OPENCV has 8 parameters, got 5: it is cut off"),
        ("7 OPENCV 640\n", IMAGES, "must be CAMERA_ID MODEL"),
        ("7 FISHEYE 640 480 1\n", IMAGES, "lenses must be one of SIMPLE_PINHOLE, .*; got FISHEYE"),
        ("7 PINHOLE 640 480 nan 601 320 240\n", IMAGES, "must be finite"),
        ("7 PINHOLE 640 480 x 601 320 240\n", IMAGES, "must hold numbers"),
        ("7 PINHOLE 64000 48000 600 601 320 240\n", IMAGES, "64 megapixels"),
        (CAMERA + CAMERA, IMAGES, "camera 7 is there twice"),
        (CAMERA, "1 1 0 0 0 0.1 0.2\n", "line 1: must be IMAGE_ID QW"),
        (CAMERA, "1 2 0 0 0 0 0 0 7 a\n", "unit quaternion, got length 2"),
        (CAMERA, "1 1 0 0 0 0 0 inf 7 a\n", "must be finite"),
        (CAMERA, "1 1 0 0 0 0 0 0 8 a\n", "names camera 8, cameras.txt holds 7"),
        (CAMERA, "1 1 0 0 0 0 0 0 7 a\n\n2 1 0 0 0 0 0 0 7 a\n", "a more than once"),
        (CAMERA, "# nothing\n", "at least one camera"),
    ],
)
def test_damaged_models_are_refused(model, cameras, images, message):
    with pytest.raises(FormatError, match=message):
        load_colmap(model(cameras, images))


def test_binary_and_missing_files(model, tmp_path):
    model()
    (tmp_path / "images.txt").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(FormatError, match="is no text"):
        load_colmap(tmp_path)
    (tmp_path / "images.txt").unlink()
    with pytest.raises(FileNotFoundError):
        load_colmap(tmp_path)


def test_names_with_blanks_are_not_written(tmp_path):
    with pytest.raises(InputError, match="must not hold blanks"):
        save_colmap(tmp_path, CameraRig((Camera(4, 4, (1.0, 1.0, 1.0, 1.0), name="a b"),)))
