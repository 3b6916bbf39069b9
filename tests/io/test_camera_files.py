"""Calibrations: what is written is read again, other programs' files are understood, damaged ones are named."""

import json

import pytest
import torch

from torchreg.errors import FormatError, InputError
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import CameraRig
from torchreg.geometry.rigid import rigid_matrix, se3_exp
from torchreg.geometry.rotation import so3_exp
from torchreg.io.calibration import load_cameras, load_depth_camera, save_cameras, save_depth_camera
from torchreg.io.colmap import load_colmap, save_colmap
from torchreg.io.limits import FileLimits
from torchreg.io.opencv_yaml import load_opencv, save_opencv

PLAIN = {"width": 640, "height": 480, "fx": 600.0, "fy": 601.0, "cx": 319.5, "cy": 239.5}
MOTION = se3_exp(torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], dtype=torch.float64))


def rig(*lenses):
    twists = [torch.full((6,), 0.1 * (k + 1), dtype=torch.float64) for k in range(len(lenses))]
    values = torch.tensor([600.1, 590.7, 320.3, 240.9], dtype=torch.float64)
    return CameraRig(
        tuple(Camera(640, 480, values + k, se3_exp(twists[k]), lens, f"cam{k}") for k, lens in enumerate(lenses))
    )


def written_json(folder, document, name="c.json"):
    path = folder / name
    path.write_text(document if isinstance(document, str) else json.dumps(document), encoding="utf-8")
    return path


def same(first, second, atol=0.0):
    assert first.names == second.names
    for one, two in zip(first, second, strict=True):
        assert (one.width, one.height) == (two.width, two.height)
        for part in ("intrinsics", "world_to_camera", "distortion"):
            assert torch.allclose(getattr(one, part), getattr(two, part), rtol=0, atol=atol), part


def test_json_round_trip_is_exact(tmp_path):
    cameras = rig((), (0.1, 0.2, 0.3, 0.4), (0.1, 0.0, 0.0, 0.0, 0.3), (0, 0, 0, 0, 0, 0, 0, 1e-9))
    save_cameras(tmp_path / "c.json", cameras)
    same(load_cameras(tmp_path / "c.json"), cameras)


def test_depth_camera_round_trip(tmp_path):
    camera = rig(())[0]
    save_depth_camera(tmp_path / "k.json", camera, 2.5e-4)
    found, scale = load_depth_camera(tmp_path / "k.json")
    assert scale == 2.5e-4
    same(CameraRig((found,)), CameraRig((camera,)))
    # The same file is a calibration of one camera.
    same(load_cameras(tmp_path / "k.json"), CameraRig((camera,)))


def test_camera_to_world_is_the_inverse(tmp_path):
    path = written_json(tmp_path, PLAIN | {"camera_to_world": MOTION.tolist()})
    camera, scale = load_depth_camera(path)
    assert scale is None
    assert torch.allclose(camera.camera_to_world, MOTION)
    assert torch.allclose(camera.position, MOTION[:3, 3])


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ('{"width": 640, "hei', "cut off or no JSON"),
        ("[1]", "must hold a JSON object, got list"),
        ('{"width": NaN}', "numbers must be finite, got NaN"),
        (PLAIN | {"fx": 1e999}, "must be finite"),
        ({"width": 1, "height": 1, "fx": 1}, "lacks fy, cx, cy"),
        (PLAIN | {"distortions": [0]}, "holds distortions, which no camera has; is it distortion"),
        (PLAIN | {"fx": "wide"}, "fx must hold numbers"),
        (PLAIN | {"width": 640.5}, "width must be an integer"),
        (PLAIN | {"width": 64_000, "height": 1001}, "at most 64 megapixels"),
        (PLAIN | {"name": 3}, "name must be text"),
        (PLAIN | {"distortion": [1.0]}, "0, 4, 5 or 8 numbers"),
        (PLAIN | {"world_to_camera": [[1, 0], [0]]}, "all rows equally many"),
        (PLAIN | {"camera_to_world": [[1, 0], [0, 1]]}, r"camera_to_world must have shape \(4, 4\)"),
        (PLAIN | {"camera_to_world": [], "world_to_camera": []}, "keep one"),
        ({"cameras": [PLAIN]}, 'must hold "format"'),
        ({"format": "torchreg-cameras", "version": 1, "cameras": []}, "list of at least one"),
        ({"format": "torchreg-cameras", "version": 1, "cameras": [3]}, "camera 0 must be a JSON object"),
        (
            {"format": "torchreg-cameras", "version": 1, "cameras": [PLAIN | {"name": "a"}] * 2},
            "a more than once",
        ),
    ],
)
def test_what_is_wrong_with_a_file_is_said_and_the_file_named(tmp_path, document, message):
    text = document if isinstance(document, str) else json.dumps(document).replace("Infinity", "1e999")
    with pytest.raises(FormatError, match=message) as caught:
        load_cameras(written_json(tmp_path, text))
    assert "c.json" in str(caught.value)


def test_depth_cameras_are_one_with_a_scale(tmp_path):
    two = {"format": "torchreg-cameras", "version": 1, "cameras": [PLAIN, PLAIN]}
    with pytest.raises(FormatError, match="must hold the one camera"):
        load_depth_camera(written_json(tmp_path, two))
    with pytest.raises(FormatError, match="depth_scale must be positive, got 0"):
        load_depth_camera(written_json(tmp_path, PLAIN | {"depth_scale": 0}))


def test_load_cameras_tells_formats_apart(tmp_path):
    cameras = rig((0.1, 0.2, 0.3, 0.4))
    save_opencv(tmp_path / "c.yml", cameras)
    save_colmap(tmp_path, cameras)
    assert load_cameras(tmp_path / "c.yml")[0].intrinsics.tolist() == cameras[0].intrinsics.tolist()
    same(load_cameras(tmp_path), cameras, atol=1e-12)
    with pytest.raises(FormatError, match=r"unknown ending '\.txt'.*known: \.json"):
        load_cameras(written_json(tmp_path, "", "c.txt"))
    with pytest.raises(FormatError, match=r"must end in \.json"):
        save_cameras(tmp_path / "c.txt", cameras)
    with pytest.raises(FileNotFoundError):
        load_cameras(tmp_path / "none.json")
    with pytest.raises(FormatError, match="the limit is 4"):
        load_cameras(written_json(tmp_path, PLAIN), limits=FileLimits(max_bytes=4))


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
        (CAMERA + CAMERA, IMAGES, "camera 7 is listed twice"),
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
    (tmp_path / "images.txt").write_bytes(b"\x80\x81\x00\xff")
    with pytest.raises(FormatError, match="is no text"):
        load_colmap(tmp_path)
    (tmp_path / "images.txt").unlink()
    with pytest.raises(FileNotFoundError):
        load_colmap(tmp_path)


def test_names_with_blanks_are_not_written(tmp_path):
    with pytest.raises(InputError, match="must not hold blanks"):
        save_colmap(tmp_path, CameraRig((Camera(4, 4, (1.0, 1.0, 1.0, 1.0), name="a b"),)))


HEAD = "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n"


def matrix(name, rows, columns, data):
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {data} ]\n"


LENS = matrix("camera_matrix", 3, 3, "600., 0., 320.,\n       0., 601., 240., 0., 0., 1.")
BENT = matrix("distortion_coefficients", 5, 1, "-1.0e-01, 2.0e-02, 1e-3, 2e-3, 0.")
EYE, K = "1, 0, 0, 0, 1, 0, 0, 0, 1", "600, 0, 320, 0, 600, 240, 0, 0, 1"
PAIR = matrix("M1", 3, 3, K) + matrix("M2", 3, 3, K) + matrix("R", 3, 3, EYE)


def written_yaml(folder, text):
    path = folder / "c.yml"
    path.write_text(text, encoding="utf-8")
    return path


def camera(twist, lens, name=""):
    values = torch.tensor([600.1, 590.7, 320.3, 240.9], dtype=torch.float64)
    return Camera(640, 480, values, se3_exp(torch.tensor(twist, dtype=torch.float64)), lens, name)


def test_single_camera_as_the_calibration_sample_writes_it(tmp_path):
    found = load_opencv(written_yaml(tmp_path, HEAD + 'calibration_time: "today"\nflags: 0\n' + LENS + BENT))
    assert len(found) == 1
    assert found[0].intrinsics.tolist() == [600.0, 601.0, 320.0, 240.0]
    assert found[0].distortion.tolist() == [-0.1, 0.02, 1e-3, 2e-3, 0, 0, 0, 0]
    assert torch.equal(found[0].world_to_camera, torch.eye(4, dtype=torch.float64))


def test_pair_in_millimeters_with_its_size_from_the_caller(tmp_path):
    path = written_yaml(tmp_path, "%YAML:1.0\n---\n" + PAIR + matrix("T", 3, 1, "-120, 0, 0"))
    rig = load_opencv(path, size=(640, 480), unit=1e-3)
    assert rig.names == ("left", "right")
    assert rig.stereo().baseline == pytest.approx(0.12)
    assert rig.stereo().is_rectified
    with pytest.raises(FormatError, match="write them into the file, as in `image_width: 640`"):
        load_opencv(path)
    with pytest.raises(InputError, match="unit must be positive"):
        load_opencv(path, unit=0.0)


def test_rotation_vectors_and_size_lists(tmp_path):
    text = "%YAML:1.0\n---\nimageSize: [ 640, 480 ]\n" + matrix("K", 3, 3, K) + matrix("R", 3, 1, "0.1, 0.2, 0.3")
    found = load_opencv(written_yaml(tmp_path, text + matrix("T", 1, 3, "1, 2, 3")))[0]
    vector, step = torch.tensor([[0.1, 0.2, 0.3], [1.0, 2.0, 3.0]], dtype=torch.float64)
    assert torch.allclose(found.world_to_camera, rigid_matrix(so3_exp(vector), step))
    assert (found.width, found.height) == (640, 480)


def test_round_trips_are_exact(tmp_path):
    one = CameraRig((camera([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], (0.1, 0.2, 0.3, 0.4, 0.5)),))
    two = CameraRig(
        (camera([0.0] * 6, (), "left"), camera([-0.1, 0.01, 0.0, 0.01, 0.02, 0.03], range(8), "right")),
    )
    for rig in (one, two):
        save_opencv(tmp_path / "c.yaml", rig)
        for before, after in zip(rig, load_opencv(tmp_path / "c.yaml"), strict=True):
            for part in ("intrinsics", "world_to_camera", "distortion"):
                assert torch.allclose(getattr(before, part), getattr(after, part), rtol=0, atol=1e-15)
    with pytest.raises(InputError, match="one or two cameras"):
        save_opencv(tmp_path / "c.yaml", CameraRig((*two, camera([0.0] * 6, ()))))


def test_opencv_reads_what_we_write_and_we_what_it_writes(tmp_path):
    cv2 = pytest.importorskip("cv2")
    rig = CameraRig((camera([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], (0.1, 0.2, 0.3, 0.4, 0.5)),))
    save_opencv(tmp_path / "ours.yml", rig)
    storage = cv2.FileStorage(str(tmp_path / "ours.yml"), cv2.FILE_STORAGE_READ)
    assert storage.getNode("camera_matrix").mat().tolist() == rig[0].matrix.tolist()
    assert int(storage.getNode("image_width").real()) == 640
    storage.release()
    storage = cv2.FileStorage(str(tmp_path / "theirs.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    for name, part in (("K", rig[0].matrix), ("D", rig[0].distortion.unsqueeze(0))):
        storage.write(name, part.numpy())
    storage.release()
    found = load_opencv(tmp_path / "theirs.yml")[0]
    assert torch.allclose(found.intrinsics, rig[0].intrinsics, rtol=1e-15)
    assert torch.allclose(found.distortion, rig[0].distortion, rtol=1e-15)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<opencv_storage>", "must begin with %YAML"),
        (HEAD, "holds neither camera_matrix nor M1"),
        (HEAD.replace("640", "64000").replace("480", "48000") + LENS, "at most 64 megapixels"),
        (HEAD + LENS[:-20], "no closing bracket: the file is cut off"),
        (HEAD + LENS[:40], "lacks rows, cols or data"),
        (HEAD + matrix("camera_matrix", 3, 3, "1, 2, 3"), "must hold 3 x 3 numbers, got 3"),
        (HEAD + matrix("camera_matrix", 1, 3, "1, 2, 3"), "must be a 3 x 3 matrix"),
        (HEAD + matrix("camera_matrix", 3, 3, K.replace("320", ".Nan")), "must be finite"),
        (HEAD + matrix("camera_matrix", 3, 3, K.replace("320", "x")), "must hold numbers"),
        (HEAD + matrix("camera_matrix", 3, 3, K.replace("600", "-600")), "must be positive"),
        (HEAD + matrix("camera_matrix", 3, 3, "600, 1, 320, 0, 600, 240, 0, 0, 1"), "must be fx 0 cx"),
        (HEAD + LENS + matrix("distortion_coefficients", 1, 3, "1, 2, 3"), "4, 5 or 8 numbers"),
        (HEAD + PAIR.split("R:", maxsplit=1)[0], "lacks R and T of the stereo pair"),
        (HEAD + PAIR, "R must be a 3 x 3 matrix or a rotation vector"),
        (HEAD + PAIR + matrix("T", 3, 1, "0.12, 0, 0"), r"swapped: the right camera stands 0\.12 to the left"),
    ],
)
def test_damaged_files_are_refused(tmp_path, text, message):
    with pytest.raises(FormatError, match=message) as caught:
        load_opencv(written_yaml(tmp_path, text))
    assert "c.yml" in str(caught.value)


def test_binary_files_are_refused(tmp_path):
    (tmp_path / "c.yml").write_bytes(b"\x80\x81\x00\xff")
    with pytest.raises(FormatError, match="is no text"):
        load_opencv(tmp_path / "c.yml")
