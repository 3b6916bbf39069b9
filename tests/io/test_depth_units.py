"""Depth images in the units that programs write: what is metres, what is no depth, what no camera sees."""

import json

import numpy as np
import pytest
from PIL import Image

from torchreg.capture.depth import load_depth_scan
from torchreg.errors import FileWarning, FormatError
from torchreg.io.calibration import load_depth_camera
from torchreg.io.images import load_depth

ROW, COLUMN = np.mgrid[:48, :64]
DOME = 1.2 - 0.25 * np.clip(1 - ((ROW - 24) ** 2 + (COLUMN - 32) ** 2) / 19.2**2, 0, 1)
PLAIN = {"width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "cx": 31.5, "cy": 23.5}


def depths(tmp_path, values, **camera):
    if values.dtype.kind == "f":
        path = tmp_path / "d.npy"
        np.save(path, values)
    else:
        path = tmp_path / "d.png"
        Image.fromarray(values).save(path)
    (tmp_path / "k.json").write_text(json.dumps(PLAIN | camera))
    found = load_depth_scan(path, tmp_path / "k.json").points[:, 2]
    return float(found.min()), float(found.max())


@pytest.mark.parametrize("kind", ["f2", "f4", "f8"])
def test_floating_point_depth_is_in_metres(tmp_path, kind):
    np.testing.assert_allclose(depths(tmp_path, DOME.astype(kind)), (0.95, 1.2), atol=2e-3)


def test_floating_point_depth_that_no_camera_sees_is_in_millimeters(tmp_path):
    with pytest.warns(FileWarning, match=r"d\.npy: numbers around 12.. are taken for millimeters"):
        np.testing.assert_allclose(depths(tmp_path, 1000 * DOME), (0.95, 1.2), atol=2e-3)


def test_the_file_of_the_camera_decides(tmp_path):
    np.testing.assert_allclose(depths(tmp_path, 1000 * DOME, depth_scale=0.001), (0.95, 1.2), atol=2e-3)
    np.testing.assert_allclose(
        depths(tmp_path, np.round(5000 * DOME).astype("u2"), depth_scale=1 / 5000), (0.95, 1.2), atol=2e-3
    )


@pytest.mark.parametrize("scale", [1000.0, 5000.0])
def test_units_per_metre_are_refused(tmp_path, scale):
    with pytest.raises(FormatError, match=rf"depth_scale is metres per unit, got {scale:g}; .* write {1 / scale:g}"):
        depths(tmp_path, np.round(scale * DOME).astype("u2"), depth_scale=scale)


def test_depths_of_a_kilometre_and_of_a_millimeter_are_told(tmp_path):
    values = np.round(1000 * DOME).astype("u2")
    with pytest.warns(FileWarning, match=r"depths around 1\.2e\+03 m are unlikely: with depth_scale 1"):
        depths(tmp_path, values, depth_scale=1)
    with pytest.warns(FileWarning, match=r"depths around 0\.0012 m are unlikely"):
        depths(tmp_path, DOME, depth_scale=0.001)


@pytest.mark.parametrize(
    ("kind", "mark", "unit"), [("u2", 65535, 1000), ("f4", 1e10, 1), ("f2", 65504, 1), ("f4", -1, 1)]
)
def test_marks_of_no_depth_are_none(tmp_path, kind, mark, unit):
    values = (unit * DOME).astype(kind)
    values[:, :12] = mark
    low, high = depths(tmp_path, values)
    assert 0.9 < low < high < 1.3


def test_the_principal_point_of_another_picture_is_told(tmp_path):
    camera = PLAIN | {"fx": 600.0, "fy": 600.0, "cx": 319.5, "cy": 239.5}
    (tmp_path / "k.json").write_text(json.dumps(camera))
    with pytest.warns(FileWarning, match=r"319\.5, 239\.5 lies outside a picture of 64 x 48.*about 640 x 480"):
        load_depth_camera(tmp_path / "k.json")
    (tmp_path / "k.json").write_text(json.dumps(PLAIN | {"width": 640, "height": 480}))
    with pytest.warns(FileWarning, match="is far from the middle of a picture of 640 x 480"):
        load_depth_camera(tmp_path / "k.json")


def test_units_of_open3ds_recorder_are_per_metre(tmp_path):
    camera = {
        "width": 64,
        "height": 48,
        "intrinsic_matrix": [60.0, 0, 0, 0, 61.0, 0, 31.5, 23.5, 1],
        "depth_scale": 1000.0,
    }
    (tmp_path / "k.json").write_text(json.dumps(camera))
    assert load_depth_camera(tmp_path / "k.json")[1] == pytest.approx(0.001)
    (tmp_path / "k.json").write_text(json.dumps(PLAIN))
    assert load_depth_camera(tmp_path / "k.json")[1] is None


UNITS = [
    ({"depth_scale": 0.001}, 0.001),
    ({"depth_units": 0.0001}, 0.0001),
    ({"depth_unit": 0.00025}, 0.00025),
    ({"depthScale": 0.001}, 0.001),
    ({"depth_unit": "mm"}, 0.001),
    ({"depth_units": "Millimeters"}, 0.001),
    ({"depth_factor": 5000.0}, 0.0002),
    ({"depth_factor": 1000}, 0.001),
    ({"DepthMapFactor": 5000}, 0.0002),
    ({"RGBD.DepthMapFactor": 5000}, 0.0002),
    ({"png_depth_scale": 6553.5}, 1 / 6553.5),
    ({"scale": 6553.5}, 1 / 6553.5),
    ({"depth_scale": 0.001, "depth_factor": 1000}, 0.001),
    ({"scale": 0.5}, None),  # of the picture
    ({"scale": 2.0}, None),
    ({}, None),
]


@pytest.mark.parametrize(("entry", "unit"), UNITS)
@pytest.mark.parametrize("nested", [None, "camera", "cam", "intrinsics", "depth"])
def test_units_of_depth_under_the_names_of_other_programs(tmp_path, entry, unit, nested):
    document = PLAIN | entry if nested is None else {"note": "x", nested: PLAIN | entry}
    (tmp_path / "k.json").write_text(json.dumps(document))
    camera, found = load_depth_camera(tmp_path / "k.json")
    assert found == (unit if unit is None else pytest.approx(unit))
    assert camera.intrinsics.tolist() == [60.0, 61.0, 31.5, 23.5]
    lines = "".join(f"  {name}: {value}\n" for name, value in (PLAIN | entry).items())
    text = lines.replace("  ", "") if nested is None else f"note: x\n{nested}:\n{lines}"
    (tmp_path / "k.yaml").write_text(text)
    camera, found = load_depth_camera(tmp_path / "k.yaml")
    assert found == (unit if unit is None else pytest.approx(unit))
    assert (camera.width, camera.intrinsics.tolist()) == (64, [60.0, 61.0, 31.5, 23.5])


def test_a_unit_that_its_name_contradicts_is_told(tmp_path):
    for entry, words in (
        ({"depth_units": 1000}, "depth_units 1000 is taken for units per metre"),
        ({"depth_factor": 0.001}, "depth_factor 0.001 is taken for metres per unit"),
    ):
        with pytest.warns(FileWarning, match=rf"k\.json: {words}"):
            found = depths(tmp_path, np.round(1000 * DOME).astype("u2"), **entry)
        np.testing.assert_allclose(found, (0.95, 1.2), atol=2e-3)
    for entry, words in (
        ({"depth_units": 0.001, "depth_factor": 5000}, "not the same unit of depth; keep one"),
        ({"depth_units": "furlongs"}, "depth_units must hold numbers"),
        ({"depth_factor": 0}, "depth_factor must be positive"),
        ({"depth_factor": [1]}, "depth_factor must be a number"),
    ):
        with pytest.raises(FormatError, match=rf"k\.json: .*{words}"):
            depths(tmp_path, np.round(1000 * DOME).astype("u2"), **entry)


def test_a_pointer_in_place_of_a_picture_is_told(tmp_path):
    (tmp_path / "d.png").write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:0f\nsize 48213\n")
    with pytest.raises(FormatError, match=r"d\.png: is a Git LFS pointer"):
        load_depth(tmp_path / "d.png")
