"""Depth images, pictures and masks: units, marks of no depth, which pixels are set, and what is refused."""

import io
import json
import struct

import numpy as np
import pytest
import torch
from PIL import Image

import torchreg as tr
from tests.io.helpers import put
from tests.tables import each, each_row, refused, refusing
from torchreg.io.calibration import load_depth_camera
from torchreg.io.images import list_frames, list_pictures, load_depth, load_image, load_mask, save_depth, save_image
from torchreg.io.limits import FileLimits

FileWarning, FormatError = tr.errors.FileWarning, tr.errors.FormatError
STEPS = np.arange(12, dtype=np.uint16).reshape(3, 4) * 1000
ROW, COLUMN = np.mgrid[:48, :64]
DOME = 1.2 - 0.25 * np.clip(1 - ((ROW - 24) ** 2 + (COLUMN - 32) ** 2) / 19.2**2, 0, 1)
PLAIN = {"width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "cx": 31.5, "cy": 23.5}


def picture(path, values):
    """Write an array as an .npy or a picture."""
    np.save(path, values) if path.suffix == ".npy" else Image.fromarray(values).save(path)
    return path


@each_row(
    ("d.png", "u2", 1e-3), ("d.tif", "u2", 1e-3), ("d.tiff", "f4", 1e-3), ("d.png", "u2", 2e-4),
    *(("d.npy", kind, 5e-4) for kind in ("u2", "f2", "f4", "f8")),
)  # fmt: skip
def test_depth_of_every_kind(tmp_path, name, kind, scale):
    depth = load_depth(picture(tmp_path / name, STEPS.astype(kind)), scale)
    assert depth.dtype == torch.float32
    assert torch.allclose(depth, torch.from_numpy(STEPS.astype(np.float32)) * scale)
    turned = picture(tmp_path / "turned.npy", np.asfortranarray(STEPS.astype("f4")))
    for path in (turned, turned.with_suffix(".png")):  # the content decides
        assert torch.allclose(load_depth(turned.rename(path), 1e-3), torch.from_numpy(STEPS.astype(np.float32)) * 1e-3)
        turned = path


def test_depth_exr(tmp_path):
    exr = pytest.importorskip("OpenEXR")

    def written(values, channel="Z"):
        header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
        with exr.File(header, {channel: values.astype(np.float32)}) as file:
            file.write(str(tmp_path / "d.exr"))
        return tmp_path / "d.exr"

    for channel in ("Z", "Y"):
        values = STEPS.astype(np.float32) / 1000
        assert torch.equal(load_depth(written(values, channel), 1.0), torch.from_numpy(values))
    path = written(STEPS)
    words = "is 4 x 3 pixels, the camera's pictures are 5 x 3"
    refused((lambda: load_depth(path, camera=tr.Camera(5, 3, (1.0, 1.0, 1.0, 1.0))), words))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    refused((lambda: load_depth(path), "cut off or damaged"))
    place = whole.index(b"dataWindow\x00box2i\x00") + len(b"dataWindow\x00box2i\x00") + 4
    path.write_bytes(whole[:place] + struct.pack("<4i", 0, 0, 7999, 8000) + whole[place + 16 :])
    refused((lambda: load_depth(path), r"64 million pixels|cut off or damaged"))
    refused(
        (lambda: load_depth(written(np.full((2, 2), np.nan))), "holds no depth"),
        (lambda: load_depth(written(STEPS, "other")), "has none of the channels"),
    )


def test_exr_without_its_extra_names_it(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "OpenEXR", None)
    path = put(tmp_path, "d.exr", b"v/1\x01")
    refused((lambda: load_depth(path), r"torchreg-articulated\[exr\]"), error=tr.errors.MissingExtraError)


def test_depth_round_trip_and_what_was_not_measured(tmp_path):
    depth = torch.tensor([[0.5, 1.2344], [0.0, 70.0]])
    save_depth(tmp_path / "d.png", depth)
    assert torch.allclose(load_depth(tmp_path / "d.png"), torch.tensor([[0.5, 1.234], [0.0, 0.0]]), atol=6e-4)
    holes = picture(tmp_path / "d.npy", np.array([[1.0, np.nan], [np.inf, -1.0]]))
    assert load_depth(holes, 1.0).tolist() == [[1.0, 0.0], [0.0, 0.0]]
    nothing, lfs = (
        picture(tmp_path / "n.npy", np.full((2, 2), np.nan)),
        b"version https://git-lfs.github.com/spec/v1\noid",
    )
    pointer = put(tmp_path, "p.png", lfs + b" sha256:0f\nsize 48213\n")
    refused(
        (lambda: save_depth(tmp_path / "d.jpg", depth), r"must end in \.png"),
        (lambda: load_depth(nothing), "holds no depth, all of 4 pixels"),
        (lambda: load_depth(pointer), r"p\.png: is a Git LFS pointer"),
    )


def test_images_and_masks(tmp_path):
    image = torch.arange(24).reshape(2, 4, 3) / 255.0
    save_image(tmp_path / "i.png", image)
    assert torch.equal(load_image(tmp_path / "i.png"), image)
    mask = torch.tensor([[True, False], [False, True]])
    save_image(tmp_path / "m.png", mask)
    assert load_image(tmp_path / "m.png").shape == (2, 2)
    assert torch.equal(load_mask(tmp_path / "m.png"), mask)
    save_image(tmp_path / "c.png", mask.float().unsqueeze(-1) * torch.tensor([0.0, 1.0, 0.0]))
    assert torch.equal(load_mask(tmp_path / "c.png"), mask)
    deep = picture(tmp_path / "d.png", STEPS)
    assert torch.equal(load_mask(deep), torch.from_numpy(STEPS >= 5500))


test_wrong_pictures = refusing(lambda folder, load, name, values: load(picture(folder / name, values)))(
    (load_depth, "b.png", STEPS.astype("u1"), "PIL mode L of 8 bits"),
    (load_depth, "b.npy", STEPS.astype("u1"), "got uint8"),
    (load_depth, "c.npy", STEPS[None], r"got shape \(1, 3, 4\)"),
    (load_image, "d.png", STEPS, "8 bits per channel, gray or color; got PIL mode I;16"),
    (load_image, "n.tif", STEPS.astype("f4") * np.float32("nan"), "got PIL mode F"),
    (load_mask, "m.npy", np.ones((2, 3, 1), bool), r"must be \(H, W\)"),
    *((load_mask, "m.npy", np.full((2, 3), value, kind), r"masks? .*are|must hold")
      for value, kind in (("x", "U1"), (0, "M8[s]"), (0, complex))),
    *((load, f"a{side}.png", np.zeros((8000, side), bool), r"a\d+\.png: .*64 m")
      for load in (load_depth, load_image, load_mask) for side in (8001,)),
)  # fmt: skip


def test_sizes_are_those_of_the_camera_and_no_more_than_64_megapixels(tmp_path):
    path, camera = picture(tmp_path / "d.png", STEPS), tr.Camera(5, 3, (1.0, 1.0, 1.0, 1.0))
    header = np.lib.format.header_data_from_array_1_0(STEPS) | {"shape": (8000, 8001)}
    with (tmp_path / "d.npy").open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, header)
    refused(
        (lambda: load_depth(path, camera=camera), "is 4 x 3 pixels, the camera's pictures are 5 x 3"),
        (lambda: load_depth(tmp_path / "d.npy"), "1 to 64 million pixels"),
    )


@each_row(
    *((load_depth, name) for name in ("d.png", "d.tif", "d.npy")),
    *((load, name) for load in (load_image, load_mask) for name in ("b.png", "b.jpg", "b.tif", "b.bmp")),
    (load_mask, "m.npy"),
)
def test_files_that_are_cut_off_are_refused(tmp_path, load, name):
    rng = np.random.default_rng(0)
    values = rng.integers(0, 60_000, (40, 40)).astype("u2") if load is load_depth else rng.integers(0, 256, (40, 40, 3))
    values = values if load is load_depth else values.astype("u1")[..., 0] if name == "m.npy" else values.astype("u1")
    path = picture(tmp_path / name, values)
    assert load(path).shape[:2] == (40, 40)
    refused((lambda: load(path, limits=FileLimits(max_bytes=4)), "the limit is 4"))
    whole = path.read_bytes()
    for length in (0, 5, 60, len(whole) // 2):
        put(tmp_path, name, whole[:length])
        refused((lambda: load(path), name))


def touched(folder, *files):
    folder.mkdir(exist_ok=True)
    for file in files:
        (folder / file).touch()
    return folder


def test_pictures_of_a_folder_in_the_order_of_their_numbers(tmp_path):
    touched(tmp_path, "f10.png", "f9.png", ".hidden.png", "notes.txt", "F2.JPG")
    assert [file.name for file in list_pictures(tmp_path)] == ["F2.JPG", "f9.png", "f10.png"]
    empty = touched(tmp_path / "empty")
    refused(
        (lambda: list_pictures(tmp_path / "f9.png"), "must be a folder of pictures"),
        (lambda: list_pictures(empty), "holds no pictures"),
    )
    refused((lambda: list_pictures(tmp_path / "none"), "does not exist"), error=FileNotFoundError)


def test_frames_of_several_folders_go_together(tmp_path):
    left = touched(tmp_path / "l", "cam0_1.png", "cam0_12.png")
    right = touched(tmp_path / "r", "cam1_1.png", "cam1_12.png")
    names = [[file.name for file in frame] for frame in list_frames((left, right))]
    assert names == [["cam0_1.png", "cam1_1.png"], ["cam0_12.png", "cam1_12.png"]]
    assert len(list_frames((left, touched(tmp_path / "s", "1700.png", "1733.png")))) == 2
    other, few = touched(tmp_path / "m", "1.png", "2.png"), touched(tmp_path / "n", "1.png")
    missing = r"a frame is missing: .*cam0_12.png and .*2.png have different numbers"
    refused(
        (lambda: list_frames((left, other)), missing),
        (lambda: list_frames((left, few)), r"equally many pictures, one per frame; got .*l 2, .*n 1"),
    )


def depths(tmp_path, values, **camera):
    path = picture(tmp_path / ("d.npy" if values.dtype.kind == "f" else "d.png"), values)
    found = tr.load_depth_scan(path, put(tmp_path, "k.json", PLAIN | camera)).points[:, 2]
    return float(found.min()), float(found.max())


MILLIMETERS, FIFTHS = np.round(1000 * DOME).astype("u2"), np.round(5000 * DOME).astype("u2")


@each_row(
    *((DOME.astype(kind), {}, None) for kind in ("f2", "f4", "f8")),
    (1000 * DOME, {}, r"d\.npy: numbers around 12.. are taken for millimeters"),
    (FIFTHS, {"depth_scale": 1 / 5000}, None),
    (MILLIMETERS, {"depth_scale": 1}, r"depths around 1\.2e\+03 m are unlikely: with depth_scale 1"),
    (DOME, {"depth_scale": 0.001}, r"depths around 0\.0012 m are unlikely"),
    (MILLIMETERS, {"depth_units": 1000}, r"k\.json: depth_units 1000 is taken for units per metre"),
    (MILLIMETERS, {"depth_factor": 0.001}, r"k\.json: depth_factor 0.001 is taken for metres per unit"),
)
def test_units_of_depth(tmp_path, values, camera, words):
    if words is None:
        found = depths(tmp_path, values, **camera)
    else:
        with pytest.warns(FileWarning, match=words):
            found = depths(tmp_path, values, **camera)
    if "unlikely" not in (words or ""):
        np.testing.assert_allclose(found, (0.95, 1.2), atol=2e-3)


test_wrong_units = refusing(lambda folder, values, camera: depths(folder, values, **camera))(
    (MILLIMETERS, {"depth_scale": 1000.0}, "depth_scale is metres per unit, got 1000; .* write 0.001"),
    (FIFTHS, {"depth_scale": 5000.0}, "depth_scale is metres per unit, got 5000; .* write 0.0002"),
    (MILLIMETERS, {"depth_units": 0.001, "depth_factor": 5000}, "not the same unit of depth; keep one"),
    (MILLIMETERS, {"depth_units": "furlongs"}, "depth_units must hold numbers"),
    (MILLIMETERS, {"depth_factor": 0}, "depth_factor must be positive"),
    (MILLIMETERS, {"depth_factor": [1]}, "depth_factor must be a number"),
)


@each_row(("u2", 65535, 1000), ("f4", 1e10, 1), ("f2", 65504, 1), ("f4", -1, 1))
def test_marks_of_no_depth_are_none(tmp_path, kind, mark, unit):
    values = (unit * DOME).astype(kind)
    values[:, :12] = mark
    low, high = depths(tmp_path, values)
    assert 0.9 < low < high < 1.3


@each_row(
    ({"fx": 600.0, "fy": 600.0, "cx": 319.5, "cy": 239.5}, r"319\.5, 239\.5 lies outside .* 64 x 48.*640 x 480"),
    ({"width": 640, "height": 480}, "is far from the middle of a picture of 640 x 480"),
)
def test_the_principal_point_of_another_picture_warns(tmp_path, camera, words):
    with pytest.warns(FileWarning, match=words):
        load_depth_camera(put(tmp_path, "k.json", PLAIN | camera))


OPEN3D = {"intrinsic_matrix": [60.0, 0, 0, 0, 61.0, 0, 31.5, 23.5, 1], "depth_scale": 1000.0}
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
@pytest.mark.parametrize("nested", [None, "cam", "depth"])
def test_units_of_depth_under_the_names_of_other_programs(tmp_path, entry, unit, nested):
    document = PLAIN | entry if nested is None else {"note": "x", nested: PLAIN | entry}
    lines = "".join(f"  {name}: {value}\n" for name, value in (PLAIN | entry).items())
    text = lines.replace("  ", "") if nested is None else f"note: x\n{nested}:\n{lines}"
    for name, content in (("k.json", json.dumps(document)), ("k.yaml", text)):
        camera, found = load_depth_camera(put(tmp_path, name, content))
        assert found == (unit if unit is None else pytest.approx(unit))
        assert (camera.width, camera.intrinsics.tolist()) == (64, [60.0, 61.0, 31.5, 23.5])
    recorder = put(tmp_path, "o.json", {"width": 64, "height": 48} | OPEN3D)
    assert load_depth_camera(recorder)[1] == pytest.approx(0.001)  # Open3D writes units per metre


DISK = (ROW - 24) ** 2 + (COLUMN - 32) ** 2 < 15**2
SOFT = np.clip(15.5 - np.hypot(ROW - 24, COLUMN - 32), 0, 1)
LABELS = "labels: all but 0 are set"


def masked(tmp_path, values, **options):
    stream, image = io.BytesIO(), values if isinstance(values, Image.Image) else Image.fromarray(values)
    image.save(stream, "PNG", **options)
    return load_mask(put(tmp_path, "m.png", stream.getvalue())).numpy()


def in_palette(values, colors):
    image, flat = Image.fromarray(values.astype("u1")), [0] * 768
    for index, color in colors.items():
        flat[3 * index : 3 * index + 3] = color
    image.putpalette(flat)
    return image


def gray_alpha(gray, alpha):
    return np.concatenate([np.full((48, 64, 3), gray, "u1"), alpha[..., None].astype("u1")], -1)


BLACK_ON_WHITE = np.concatenate(
    [np.repeat(255 * DISK[..., None].astype("u1"), 3, 2), np.full((48, 64, 1), 255, "u1")], 2
)


@each(
    *(np.where(DISK, high, low).astype(kind) for kind in ("u1", "u2")
      for low, high in ((0, 1), (0, 100), (0, 255), (50, 200), (1, 2), (254, 255))),
    *(kind for color in ((64, 0, 0), (0, 0, 255), (255, 255, 255), (1, 1, 1))
      for kind in (DISK[..., None] * np.array(color, "u1"), in_palette(8 * DISK, {8: color}))),
    gray_alpha(255, 255 * DISK), gray_alpha(90, 255 * DISK)[..., 2:], BLACK_ON_WHITE,
    (65535 * DISK.astype("u4")).astype("u2"), Image.fromarray(DISK),
)  # fmt: skip
def test_the_brighter_the_colored_or_the_opaque_is_set(tmp_path, values):
    assert (masked(tmp_path, values) == DISK).all()
    clear = in_palette(DISK, {0: (9, 9, 9), 1: (9, 9, 9)})
    assert (masked(tmp_path, clear, transparency=0) == DISK).all()


@pytest.mark.parametrize("white", [120, 255, 30])
def test_soft_edges_are_cut_at_half_of_their_own_white(tmp_path, white):
    assert (masked(tmp_path, np.round(white * SOFT).astype("u1")) == (SOFT >= 0.5)).mean() > 0.995
    slope = np.round(np.clip((COLUMN - 10) / 40, 0, 1) * 200).astype("u1")
    assert (masked(tmp_path, slope) == (slope >= 100)).all()


@pytest.mark.parametrize("value", [1, 20, 100, 127])
@pytest.mark.parametrize("kind", ["gray", "rgb", "alpha", "u2", "soft"])
def test_halos_of_one_value_are_beside_the_mask(tmp_path, value, kind):
    distance = np.hypot(ROW - 24, COLUMN - 32)
    gray = np.where(DISK, 255, np.where(distance < 20, value, 0)).astype("u1")
    if kind == "soft":  # pixels between the halo and what is around it
        gray[(distance >= 20) & (distance < 20.7)] = value // 2
    pictures = {"rgb": np.repeat(gray[..., None], 3, 2), "u2": gray.astype("u2") * 257, "alpha": gray_alpha(90, gray)}
    with pytest.warns(FileWarning, match=r"m\.png: what is (255|65535) has a halo"):
        assert (masked(tmp_path, pictures.get(kind, gray)) == DISK).all()


INNER, ANGLE = np.hypot(ROW - 24, COLUMN - 32) < 7, np.arctan2(ROW - 24, COLUMN - 32)


@each(
    DISK + 2 * (ROW < 8),
    np.select([INNER, DISK], [2, 1], 0),
    np.select([INNER, DISK], [255, 127], 0),
    np.select([DISK & (COLUMN < 32), DISK], [255, 128], 0),
    np.where(DISK, 20 * (1 + (ANGLE + np.pi) // 0.6), 0),
)
def test_labels_that_nest_or_touch_are_no_halos(tmp_path, labels):
    with pytest.warns(FileWarning, match=rf"holds \d+ {LABELS}"):
        assert (masked(tmp_path, labels.astype("u1")) == (labels > 0)).all()


def test_arrays_of_two_values_of_probabilities_and_of_scores(tmp_path):
    for kind in (bool, "u1", "i8", "f4"):
        path = picture(tmp_path / "m.npy", DISK.astype(kind))
        assert (load_mask(path).numpy() == DISK).all()
        assert (load_mask(path.rename(tmp_path / "m.png")).numpy() == DISK).all()  # the content decides
    path = picture(tmp_path / "m.npy", (0.9 * SOFT + 0.01).astype("f4"))
    assert (load_mask(path).numpy() == (SOFT >= 0.5)).mean() > 0.995
    scores = np.where(DISK, 3.0, -2.0) + np.linspace(0, 1, 64)
    scores[0, 0] = np.nan
    assert (load_mask(picture(tmp_path / "s.npy", scores)).numpy() == DISK).all()


@each_row((0, "keeps none of its 3072 pixels"), (255, "keeps all"), (7, "keeps all"))
def test_a_mask_of_one_value_warns(tmp_path, value, words):
    with pytest.warns(FileWarning, match=rf"m\.png: the mask {words}"):
        assert (masked(tmp_path, np.full((48, 64), value, "u1")) == bool(value)).all()
