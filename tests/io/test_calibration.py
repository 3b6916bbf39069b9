import json

import pytest
import torch

from torchreg.errors import FormatError
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import CameraRig
from torchreg.geometry.rigid import se3_exp
from torchreg.io.calibration import load_cameras, load_depth_camera, save_cameras, save_depth_camera
from torchreg.io.colmap import save_colmap
from torchreg.io.limits import FileLimits
from torchreg.io.opencv_yaml import save_opencv

PLAIN = {"width": 640, "height": 480, "fx": 600.0, "fy": 601.0, "cx": 319.5, "cy": 239.5}
MOTION = se3_exp(torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], dtype=torch.float64))


def rig(*lenses):
    twists = [torch.full((6,), 0.1 * (k + 1), dtype=torch.float64) for k in range(len(lenses))]
    values = torch.tensor([600.1, 590.7, 320.3, 240.9], dtype=torch.float64)
    return CameraRig(
        tuple(Camera(640, 480, values + k, se3_exp(twists[k]), lens, f"cam{k}") for k, lens in enumerate(lenses))
    )


def written(folder, document, name="c.json"):
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
    path = written(tmp_path, PLAIN | {"camera_to_world": MOTION.tolist()})
    camera, scale = load_depth_camera(path)
    assert scale == 1e-3
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
        (PLAIN | {"focal": 1}, "holds focal, which no camera has"),
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
        load_cameras(written(tmp_path, text))
    assert "c.json" in str(caught.value)


def test_depth_cameras_are_one_with_a_scale(tmp_path):
    two = {"format": "torchreg-cameras", "version": 1, "cameras": [PLAIN, PLAIN]}
    with pytest.raises(FormatError, match="must hold the one camera"):
        load_depth_camera(written(tmp_path, two))
    with pytest.raises(FormatError, match="depth_scale must be positive, got 0"):
        load_depth_camera(written(tmp_path, PLAIN | {"depth_scale": 0}))


def test_load_cameras_tells_formats_apart(tmp_path):
    cameras = rig((0.1, 0.2, 0.3, 0.4))
    save_opencv(tmp_path / "c.yml", cameras)
    save_colmap(tmp_path, cameras)
    assert load_cameras(tmp_path / "c.yml")[0].intrinsics.tolist() == cameras[0].intrinsics.tolist()
    same(load_cameras(tmp_path), cameras, atol=1e-12)
    with pytest.raises(FormatError, match=r"are \.json"):
        load_cameras(written(tmp_path, "", "c.txt"))
    with pytest.raises(FormatError, match=r"must end in \.json"):
        save_cameras(tmp_path / "c.txt", cameras)
    with pytest.raises(FileNotFoundError):
        load_cameras(tmp_path / "none.json")
    with pytest.raises(FormatError, match="the limit is 4"):
        load_cameras(written(tmp_path, PLAIN), limits=FileLimits(max_bytes=4))
