"""Calibrations: what is written is read again by us and by OpenCV, damaged files are named."""

import json

import pytest
import torch
from scipy.spatial.transform import Rotation

import torchreg as tr
from tests.io.helpers import put
from tests.tables import each_row, refused, refusing
from torchreg.io.calibration import load_depth_camera, save_cameras, save_depth_camera
from torchreg.io.cameras.colmap import save_colmap
from torchreg.io.cameras.opencv_yaml import save_opencv
from torchreg.io.limits import FileLimits

FormatError, InputError = tr.errors.FormatError, tr.errors.InputError
PLAIN = {"width": 640, "height": 480, "fx": 600.0, "fy": 601.0, "cx": 319.5, "cy": 239.5}


def motion(turn, step):
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3], matrix[:3, 3] = torch.from_numpy(Rotation.from_rotvec(turn).as_matrix()), torch.tensor(step)
    return matrix


MOTION = motion([0.4, 0.5, 0.6], [0.1, 0.2, 0.3])


def rig(*lenses, names="cam{}"):
    """Return cameras with lenses, at all kinds of rotations."""
    turns = [(0, 0, 0), (3.14, 0, 0), (0, 3.14, 0), (0, 0, 3.14), (1.0, -2.0, 0.5)]
    values = torch.tensor([600.1, 590.7, 320.3, 240.9], dtype=torch.float64)
    return tr.CameraRig(tuple(
        tr.Camera(640, 480, values + k, motion(turn, [1 / 3, 2.0, k / 7]), lens, names.format(k))
        for k, (turn, lens) in enumerate(zip(turns, lenses, strict=False))
    ))  # fmt: skip


def same(first, second, atol=0.0, names=True):
    assert not names or first.names == second.names
    for one, two in zip(first, second, strict=True):
        assert (one.width, one.height) == (two.width, two.height)
        for part in ("intrinsics", "world_to_camera", "distortion"):
            assert torch.allclose(getattr(one, part), getattr(two, part), rtol=0, atol=atol), part


LENSES = ((), (0.1, 0.2, 0.3, 0.4), (0.1, 0.0, 0.0, 0.0, 0.3), (0, 0, 0, 0, 0, 0, 0, 1e-9), tuple(range(8)))


def test_round_trips(tmp_path):
    cameras = rig(*LENSES)
    save_cameras(tmp_path / "c.json", cameras)
    same(tr.load_cameras(tmp_path / "c.json"), cameras)
    save_colmap(tmp_path, cameras)
    same(tr.load_cameras(tmp_path), cameras, atol=1e-12)
    one, other = rig(LENSES[2]), motion([0.01, 0.02, 0.03], [-0.1, 0.01, 0.0])
    second = tr.Camera(640, 480, one[0].intrinsics + 1, other, LENSES[4], "right")
    pair = tr.CameraRig((tr.Camera(640, 480, one[0].intrinsics, torch.eye(4).double(), (), "left"), second))
    for cameras in (one, pair):
        save_opencv(tmp_path / "c.yaml", cameras)
        same(tr.load_cameras(tmp_path / "c.yaml"), cameras, atol=1e-15, names=cameras is pair)
    save_depth_camera(tmp_path / "k.json", one[0], 2.5e-4)
    found, scale = load_depth_camera(tmp_path / "k.json")
    assert scale == 2.5e-4
    same((found,), one, names=False)
    same(tr.load_cameras(tmp_path / "k.json"), one)  # a calibration of one camera
    blank = tr.CameraRig((tr.Camera(4, 4, (1.0, 1.0, 1.0, 1.0), name="a b"),))
    refused(
        (lambda: save_opencv(tmp_path / "c.yaml", tr.CameraRig((*pair, one[0]))), "one or two cameras"),
        (lambda: save_colmap(tmp_path, blank), "must not hold blanks"),
        error=InputError,
    )


def test_camera_to_world_is_the_inverse(tmp_path):
    camera, scale = load_depth_camera(put(tmp_path, "c.json", PLAIN | {"camera_to_world": MOTION.tolist()}))
    assert scale is None
    assert torch.allclose(camera.camera_to_world, MOTION)
    assert torch.allclose(camera.position, MOTION[:3, 3])


def several(*cameras, **entries):
    return {"format": "torchreg-cameras", "version": 1, "cameras": list(cameras)} | entries


test_damaged_cameras = refusing(lambda folder, content: tr.load_cameras(put(folder, "c.json", content)), file="c.json")(
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
    (several(), "list of at least one"),
    (several(3), "camera 0 must be a JSON object"),
    (several(*[PLAIN | {"name": "a"}] * 2), "a more than once"),
)


@pytest.mark.parametrize("name", [*PLAIN, "depth_scale"])
@pytest.mark.parametrize("value", ["1" + "0" * 400, "[]", "[1, 2]", "9" * 4400, '"1"', "null", "{}", "1e999"])
def test_numbers_of_cameras_are_numbers(tmp_path, name, value):
    text = json.dumps(PLAIN | {"depth_scale": 1.0} | {name: "HERE"}).replace('"HERE"', value)
    with pytest.raises(tr.errors.TorchregError):
        load_depth_camera(put(tmp_path, "camera.json", text))


def test_endings_sizes_and_scales(tmp_path):
    plain, two = put(tmp_path, "p.json", PLAIN), put(tmp_path, "two.json", several(PLAIN, PLAIN))
    zero, text = put(tmp_path, "z.json", PLAIN | {"depth_scale": 0}), put(tmp_path, "c.txt", "")
    binary = put(tmp_path, "b.yml", b"\x80\x81\x00\xff")
    refused(
        (lambda: load_depth_camera(two), "must hold the one camera"),
        (lambda: load_depth_camera(zero), "depth_scale must be positive, got 0"),
        (lambda: tr.load_cameras(text), r"unknown ending '\.txt'.*known: \.json"),
        (lambda: save_cameras(tmp_path / "c.txt", rig(())), r"must end in \.json"),
        (lambda: tr.load_cameras(plain, limits=FileLimits(max_bytes=4)), "the limit is 4"),
        (lambda: tr.load_cameras(binary), "is no text"),
    )
    refused((lambda: tr.load_cameras(tmp_path / "none.json"), "none"), error=FileNotFoundError)


CAMERA = "# a comment\n\n7 OPENCV 640 480 600 601 320 240 0.1 0.2 0.001 0.002\n"
# A quarter turn about z; the second image has no points at all, not even an empty line.
HALF = 0.5**0.5
IMAGES = f"# a comment\n1 {HALF} 0 0 {HALF} 0.1 0.2 0.3 7 a.png\n10 20 -1 30 40 5\n2 1 0 0 0 0 0 1 7 b c.png\n"


def colmap(folder, cameras=CAMERA, images=IMAGES):
    put(folder, "cameras.txt", cameras)
    return put(folder, "images.txt", images).parent


@each_row(
    (CAMERA, [600, 601, 319.5, 239.5, 0.1, 0.2, 0.001, 0.002]),
    ("7 SIMPLE_PINHOLE 640 480 600 320 240", [600, 600, 319.5, 239.5, 0, 0, 0, 0]),
    ("7 PINHOLE 640 480 600 601 320 240", [600, 601, 319.5, 239.5, 0, 0, 0, 0]),
    ("7 SIMPLE_RADIAL 640 480 600 320 240 0.1", [600, 600, 319.5, 239.5, 0.1, 0, 0, 0]),
    ("7 RADIAL 640 480 600 320 240 0.1 0.2", [600, 600, 319.5, 239.5, 0.1, 0.2, 0, 0]),
    ("7 FULL_OPENCV 640 480 600 601 320 240 1 2 3 4 5 6 7 8", [600, 601, 319.5, 239.5, 1, 2, 3, 4]),
)
def test_models_of_colmap_become_cameras_in_our_convention(tmp_path, line, values):
    cameras = tr.load_cameras(colmap(tmp_path, line + "\n"))
    assert cameras.names == ("a.png", "b c.png")
    assert [*cameras[0].intrinsics.tolist(), *cameras[0].distortion[:4].tolist()] == values
    turned = cameras[0].world_to_camera @ torch.tensor([1.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    assert torch.allclose(turned, turned.new_tensor([0.1, 1.2, 0.3, 1.0]))


test_damaged_colmap = refusing(lambda folder, *texts: tr.load_cameras(colmap(folder, *texts)))(
    ("7 OPENCV 640 480 600 601 320 240 0.1\n", IMAGES, "line 1: OPENCV has 8 parameters, got 5: it is cut off"),
    ("7 OPENCV 640\n", IMAGES, "must be CAMERA_ID MODEL"),
    ("7 PINHOLE \u00b2 4 1 1 1 1\n", IMAGES, "must be CAMERA_ID"),
    (f"7 PINHOLE {'9' * 5000} 4 1 1 1 1\n", IMAGES, "must be CAMERA_ID"),
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
    (CAMERA, b"\x80\x81\x00\xff", "is no text"),
)


HEAD = "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n"


def matrix(name, rows, columns, data):
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {data} ]\n"


LENS = matrix("camera_matrix", 3, 3, "600., 0., 320.,\n       0., 601., 240., 0., 0., 1.")
BENT = matrix("distortion_coefficients", 5, 1, "-1.0e-01, 2.0e-02, 1e-3, 2e-3, 0.")
K = "600, 0, 320, 0, 600, 240, 0, 0, 1"
PAIR = matrix("M1", 3, 3, K) + matrix("M2", 3, 3, K) + matrix("R", 3, 3, "1, 0, 0, 0, 1, 0, 0, 0, 1")
ONE = "M: !!opencv-matrix\n  rows: 1\n  cols: 1\n  dt: d\n  data: [ 1 ]"


def test_cameras_as_opencv_writes_them(tmp_path):
    single = put(tmp_path, "c.yml", HEAD + 'calibration_time: "today"\nflags: 0\n' + LENS + BENT)
    (found,) = tr.load_cameras(single)
    assert found.intrinsics.tolist() == [600.0, 601.0, 320.0, 240.0]
    assert found.distortion.tolist() == [-0.1, 0.02, 1e-3, 2e-3, 0, 0, 0, 0]
    assert torch.equal(found.world_to_camera, torch.eye(4, dtype=torch.float64))
    text = "%YAML:1.0\n---\nimageSize: [ 640, 480 ]\n" + matrix("K", 3, 3, K) + matrix("R", 3, 1, "0.1, 0.2, 0.3")
    (found,) = tr.load_cameras(put(tmp_path, "v.yml", text + matrix("T", 1, 3, "1, 2, 3")))
    assert torch.allclose(found.world_to_camera, motion([0.1, 0.2, 0.3], [1.0, 2.0, 3.0]))
    assert (found.width, found.height) == (640, 480)
    step = PAIR + matrix("T", 3, 1, "-120, 0, 0")
    pair = tr.load_cameras(put(tmp_path, "p.yml", HEAD + step), scale=1e-3)
    assert pair.names == ("left", "right")
    assert pair.stereo().baseline == pytest.approx(0.12)
    assert pair.stereo().is_rectified
    path = put(tmp_path, "q.yml", "%YAML:1.0\n---\n" + step)
    refused((lambda: tr.load_cameras(path), "write them into the file, as in `image_width: 640`"))
    refused((lambda: tr.load_cameras(path, scale=0.0), "scale must be positive"), error=InputError)


def test_opencv_reads_what_we_write_and_we_what_it_writes(tmp_path):
    cv2 = pytest.importorskip("cv2")
    (camera,) = cameras = rig((0.1, 0.2, 0.3, 0.4, 0.5))
    save_opencv(tmp_path / "ours.yml", cameras)
    storage = cv2.FileStorage(str(tmp_path / "ours.yml"), cv2.FILE_STORAGE_READ)
    assert storage.getNode("camera_matrix").mat().tolist() == camera.matrix.tolist()
    assert int(storage.getNode("image_width").real()) == 640
    storage.release()
    storage = cv2.FileStorage(str(tmp_path / "theirs.yml"), cv2.FILE_STORAGE_WRITE)
    for name, value in (("image_width", 640), ("image_height", 480), ("K", camera.matrix.numpy())):
        storage.write(name, value)
    storage.write("D", camera.distortion.unsqueeze(0).numpy())
    storage.release()
    (found,) = tr.load_cameras(tmp_path / "theirs.yml")
    assert torch.allclose(found.intrinsics, camera.intrinsics, rtol=1e-15)
    assert torch.allclose(found.distortion, camera.distortion, rtol=1e-15)


test_damaged_opencv = refusing(lambda folder, text: tr.load_cameras(put(folder, "c.yml", text)), file="c.yml")(
    ("<opencv_storage>", "must begin with %YAML"),
    (HEAD, "holds neither camera_matrix nor M1"),
    (HEAD.replace("640", "64000").replace("480", "48000") + LENS, "at most 64 megapixels"),
    (HEAD + LENS[:-20], "is cut off or no YAML"),
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
    (HEAD + "a: &a [1, 2]\nb: [*a, *a]\n", "aliases are not supported"),
    (HEAD + "a: " + "[" * 5000, "is cut off or no YAML"),
    *(("%YAML:1.0\n---\n" + body, "") for body in (
        "", "no entries", "camera_matrix: !!opencv-matrix\nx", ONE.replace("rows: 1", "rows: \u0663"),
        ONE.replace("rows: 1", "rows: " + "9" * 5000), "image_width: \u00b2\nimage_height: 3",
        "image_width: " + "9" * 5000,
    )),
)  # fmt: skip
