import pytest
import torch

from torchreg.errors import FormatError, InputError
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import CameraRig
from torchreg.geometry.rigid import rigid_matrix, se3_exp
from torchreg.geometry.rotation import so3_exp
from torchreg.io.opencv_yaml import load_opencv, save_opencv

HEAD = "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n"


def matrix(name, rows, columns, data):
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {data} ]\n"


LENS = matrix("camera_matrix", 3, 3, "600., 0., 320.,\n       0., 601., 240., 0., 0., 1.")
BENT = matrix("distortion_coefficients", 5, 1, "-1.0e-01, 2.0e-02, 1e-3, 2e-3, 0.")
EYE, K = "1, 0, 0, 0, 1, 0, 0, 0, 1", "600, 0, 320, 0, 600, 240, 0, 0, 1"
PAIR = matrix("M1", 3, 3, K) + matrix("M2", 3, 3, K) + matrix("R", 3, 3, EYE)


def written(folder, text):
    path = folder / "c.yml"
    path.write_text(text, encoding="utf-8")
    return path


def camera(twist, lens, name=""):
    values = torch.tensor([600.1, 590.7, 320.3, 240.9], dtype=torch.float64)
    return Camera(640, 480, values, se3_exp(torch.tensor(twist, dtype=torch.float64)), lens, name)


def test_single_camera_as_the_calibration_sample_writes_it(tmp_path):
    found = load_opencv(written(tmp_path, HEAD + 'calibration_time: "today"\nflags: 0\n' + LENS + BENT))
    assert len(found) == 1
    assert found[0].intrinsics.tolist() == [600.0, 601.0, 320.0, 240.0]
    assert found[0].distortion.tolist() == [-0.1, 0.02, 1e-3, 2e-3, 0, 0, 0, 0]
    assert torch.equal(found[0].world_to_camera, torch.eye(4, dtype=torch.float64))


def test_pair_in_millimeters_with_its_size_from_the_caller(tmp_path):
    path = written(tmp_path, "%YAML:1.0\n---\n" + PAIR + matrix("T", 3, 1, "-120, 0, 0"))
    rig = load_opencv(path, size=(640, 480), unit=1e-3)
    assert rig.names == ("left", "right")
    assert rig.stereo().baseline == pytest.approx(0.12)
    assert rig.stereo().is_rectified
    with pytest.raises(FormatError, match=r"pass size=\(width, height\)"):
        load_opencv(path)
    with pytest.raises(InputError, match="unit must be positive"):
        load_opencv(path, unit=0.0)


def test_rotation_vectors_and_size_lists(tmp_path):
    text = "%YAML:1.0\n---\nimageSize: [ 640, 480 ]\n" + matrix("K", 3, 3, K) + matrix("R", 3, 1, "0.1, 0.2, 0.3")
    found = load_opencv(written(tmp_path, text + matrix("T", 1, 3, "1, 2, 3")))[0]
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
        load_opencv(written(tmp_path, text))
    assert "c.yml" in str(caught.value)


def test_binary_files_are_refused(tmp_path):
    (tmp_path / "c.yml").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(FormatError, match="is no text"):
        load_opencv(tmp_path / "c.yml")
