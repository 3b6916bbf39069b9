import struct
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from torchreg.errors import FormatError, MissingExtraError
from torchreg.geometry.camera import Camera
from torchreg.io.images import list_frames, list_pictures, load_depth, load_image, load_mask, save_depth, save_image
from torchreg.io.limits import FileLimits

STEPS = np.arange(12, dtype=np.uint16).reshape(3, 4) * 1000


@pytest.mark.parametrize(
    ("name", "values", "scale"),
    [
        ("d.png", STEPS, 1e-3),
        ("d.tif", STEPS, 1e-3),
        ("d.tiff", STEPS.astype(np.float32), 1e-3),
        ("d.png", STEPS, 2e-4),
    ],
)
def test_depth_pictures(tmp_path, name, values, scale):
    Image.fromarray(values).save(tmp_path / name)
    depth = load_depth(tmp_path / name, scale)
    assert depth.dtype == torch.float32
    assert torch.allclose(depth, torch.from_numpy(STEPS.astype(np.float32)) * scale)


@pytest.mark.parametrize("dtype", [np.uint16, np.float16, np.float32, np.float64])
def test_depth_arrays(tmp_path, dtype):
    np.save(tmp_path / "d.npy", STEPS.astype(dtype))
    assert torch.allclose(load_depth(tmp_path / "d.npy", 5e-4), torch.from_numpy(STEPS.astype(np.float32)) * 5e-4)


def test_depth_exr(tmp_path):
    exr = pytest.importorskip("OpenEXR")
    values = STEPS.astype(np.float32) / 1000
    for name in ("Z", "Y"):
        header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
        with exr.File(header, {name: values}) as file:
            file.write(str(tmp_path / "d.exr"))
        assert torch.equal(load_depth(tmp_path / "d.exr", 1.0), torch.from_numpy(values))
    whole = (tmp_path / "d.exr").read_bytes()
    (tmp_path / "d.exr").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FormatError, match="cut off or damaged"):
        load_depth(tmp_path / "d.exr")


def test_exr_without_its_extra_names_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    (tmp_path / "d.exr").write_bytes(b"v/1\x01")
    with pytest.raises(MissingExtraError, match=r"torchreg-articulated\[exr\]"):
        load_depth(tmp_path / "d.exr")


def test_what_was_not_measured_is_zero(tmp_path):
    np.save(tmp_path / "d.npy", np.array([[1.0, np.nan], [np.inf, -1.0]]))
    assert load_depth(tmp_path / "d.npy", 1.0).tolist() == [[1.0, 0.0], [0.0, 0.0]]
    np.save(tmp_path / "d.npy", np.full((2, 2), np.nan))
    with pytest.raises(FormatError, match="holds no depth, all of 4 pixels"):
        load_depth(tmp_path / "d.npy")


def test_depth_round_trip(tmp_path):
    depth = torch.tensor([[0.5, 1.2344], [0.0, 70.0]])
    save_depth(tmp_path / "d.png", depth)
    assert torch.allclose(load_depth(tmp_path / "d.png"), torch.tensor([[0.5, 1.234], [0.0, 0.0]]), atol=6e-4)
    with pytest.raises(FormatError, match=r"must end in \.png"):
        save_depth(tmp_path / "d.jpg", depth)


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
    np.save(tmp_path / "m.npy", mask.numpy())
    assert torch.equal(load_mask(tmp_path / "m.npy"), mask)


def test_sizes_and_bit_depths_are_checked(tmp_path):
    camera = Camera(5, 3, (1.0, 1.0, 1.0, 1.0))
    Image.fromarray(STEPS).save(tmp_path / "d.png")
    with pytest.raises(FormatError, match="is 4 x 3 pixels, the camera's pictures are 5 x 3"):
        load_depth(tmp_path / "d.png", camera=camera)
    with pytest.raises(FormatError, match="8 bits per channel, gray or color; got PIL mode I;16"):
        load_image(tmp_path / "d.png")
    Image.fromarray(STEPS.astype(np.uint8)).save(tmp_path / "b.png")
    with pytest.raises(FormatError, match="PIL mode L of 8 bits"):
        load_depth(tmp_path / "b.png")
    np.save(tmp_path / "b.npy", STEPS.astype(np.uint8))
    with pytest.raises(FormatError, match="got uint8"):
        load_depth(tmp_path / "b.npy")
    np.save(tmp_path / "c.npy", STEPS[None])
    with pytest.raises(FormatError, match=r"got shape \(1, 3, 4\)"):
        load_depth(tmp_path / "c.npy")


def test_pictures_over_64_megapixels_are_not_decoded(tmp_path):
    for name, size in (("a.png", (8000, 8001)), ("b.png", (20_000, 20_000))):
        Image.new("1", size).save(tmp_path / name)
        with pytest.raises(FormatError, match="64 m"):
            load_depth(tmp_path / name)
    header = np.lib.format.header_data_from_array_1_0(STEPS) | {"shape": (8000, 8001)}
    with (tmp_path / "d.npy").open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, header)
    with pytest.raises(FormatError, match="1 to 64 million pixels"):
        load_depth(tmp_path / "d.npy")


@pytest.mark.parametrize("load", [load_image, load_mask])
def test_pictures_and_masks_have_the_same_limits(tmp_path, load):
    Image.new("1", (8000, 8001)).save(tmp_path / "a.png")
    with pytest.raises(FormatError, match=r"a.png: .*64 million pixels"):
        load(tmp_path / "a.png")
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 256, (40, 40, 3)).astype(np.uint8)).save(tmp_path / "b.png")
    for name in ("b.png", "b.jpg", "b.tif", "b.bmp"):
        Image.fromarray(rng.integers(0, 256, (40, 40, 3)).astype(np.uint8)).save(tmp_path / name)
        assert load(tmp_path / name).shape[:2] == (40, 40)
        whole = (tmp_path / name).read_bytes()
        for length in (0, 5, len(whole) // 2):
            (tmp_path / name).write_bytes(whole[:length])
            with pytest.raises(FormatError, match=name):
                load(tmp_path / name)
    Image.fromarray(STEPS).save(tmp_path / "c.png")
    if load is load_mask:
        assert torch.equal(load(tmp_path / "c.png"), torch.from_numpy(STEPS >= 5500))
        return
    with pytest.raises(FormatError, match="8 bits per channel"):
        load(tmp_path / "c.png")
    Image.fromarray(STEPS.astype(np.float32) * np.float32("nan")).save(tmp_path / "n.tif")
    with pytest.raises(FormatError, match="got PIL mode F"):
        load(tmp_path / "n.tif")


def test_mask_arrays_are_checked(tmp_path):
    np.save(tmp_path / "m.npy", np.ones((2, 3, 1), dtype=bool))
    with pytest.raises(FormatError, match=r"must be \(H, W\)"):
        load_mask(tmp_path / "m.npy")
    np.save(tmp_path / "m.npy", np.ones((20, 30), dtype=bool))
    whole = (tmp_path / "m.npy").read_bytes()
    (tmp_path / "m.npy").write_bytes(whole[:-7])
    with pytest.raises(FormatError, match="cut off"):
        load_mask(tmp_path / "m.npy")


def test_exr_of_another_size_kind_or_too_many_pixels(tmp_path):
    exr = pytest.importorskip("OpenEXR")

    def written(name, channels):
        header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
        with exr.File(header, channels) as file:
            file.write(str(tmp_path / name))
        return tmp_path / name

    path = written("d.exr", {"Z": STEPS.astype(np.float32)})
    with pytest.raises(FormatError, match="is 4 x 3 pixels, the camera's pictures are 5 x 3"):
        load_depth(path, camera=Camera(5, 3, (1.0, 1.0, 1.0, 1.0)))
    nothing = written("n.exr", {"Z": np.full((2, 2), np.nan, dtype=np.float32)})
    with pytest.raises(FormatError, match="holds no depth"):
        load_depth(nothing)
    with pytest.raises(FormatError, match="has none of the channels"):
        load_depth(written("o.exr", {"other": STEPS.astype(np.float32)}))
    whole = path.read_bytes()
    place = whole.index(b"dataWindow\x00box2i\x00") + len(b"dataWindow\x00box2i\x00") + 4
    path.write_bytes(whole[:place] + struct.pack("<4i", 0, 0, 7999, 8000) + whole[place + 16 :])
    with pytest.raises(FormatError, match=r"64 million pixels|cut off or damaged"):
        load_depth(path)


@pytest.mark.parametrize("name", ["d.png", "d.tif", "d.npy"])
def test_truncated_files_are_refused(tmp_path, name):
    values = np.random.default_rng(0).integers(0, 60_000, (40, 40)).astype(np.uint16)
    np.save(tmp_path / name, values) if name.endswith("npy") else Image.fromarray(values).save(tmp_path / name)
    whole = (tmp_path / name).read_bytes()
    for length in (0, 5, 60, len(whole) // 2):
        (tmp_path / name).write_bytes(whole[:length])
        with pytest.raises(FormatError, match=name):
            load_depth(tmp_path / name)
    with pytest.raises(FormatError, match="the limit is 4"):
        load_depth(tmp_path / name, limits=FileLimits(max_bytes=4))


def test_pictures_of_a_folder_in_the_order_of_their_numbers(tmp_path):
    for name in ("f10.png", "f9.png", ".hidden.png", "notes.txt", "F2.JPG"):
        (tmp_path / name).touch()
    assert [file.name for file in list_pictures(tmp_path)] == ["F2.JPG", "f9.png", "f10.png"]
    with pytest.raises(FormatError, match="must be a folder of pictures"):
        list_pictures(tmp_path / "f9.png")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        list_pictures(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FormatError, match="holds no pictures"):
        list_pictures(tmp_path / "empty")


def test_frames_of_several_folders_go_together(tmp_path):
    def folder(name, *files):
        (tmp_path / name).mkdir()
        for file in files:
            (tmp_path / name / file).touch()
        return tmp_path / name

    left, right = folder("l", "cam0_1.png", "cam0_12.png"), folder("r", "cam1_1.png", "cam1_12.png")
    frames = list_frames((left, right))
    assert [[file.name for file in frame] for frame in frames] == [
        ["cam0_1.png", "cam1_1.png"], ["cam0_12.png", "cam1_12.png"],
    ]  # fmt: skip
    stamps = folder("s", "1700.png", "1733.png")
    assert len(list_frames((left, stamps))) == 2
    with pytest.raises(FormatError, match=r"a frame is missing: .*cam0_12.png and .*2.png have different numbers"):
        list_frames((left, folder("m", "1.png", "2.png")))
    with pytest.raises(FormatError, match=r"equally many pictures, one per frame; got .*l 2, .*n 1"):
        list_frames((left, folder("n", "1.png")))
