"""Masks as programs write them: which pixels are set."""

import numpy as np
import pytest
from PIL import Image

from torchreg.errors import FileWarning
from torchreg.io.images import load_mask

ROW, COLUMN = np.mgrid[:48, :64]
DISK = (ROW - 24) ** 2 + (COLUMN - 32) ** 2 < 15**2
SOFT = np.clip(15.5 - np.hypot(ROW - 24, COLUMN - 32), 0, 1)


def saved(tmp_path, values, mode=None, **options):
    image = values if isinstance(values, Image.Image) else Image.fromarray(values, mode)
    image.save(tmp_path / "m.png", "PNG", **options)
    return load_mask(tmp_path / "m.png").numpy()


def in_palette(values, colors):
    image = Image.fromarray(values.astype("u1"), "P")
    flat = [0] * 768
    for index, color in colors.items():
        flat[3 * index : 3 * index + 3] = color
    image.putpalette(flat)
    return image


@pytest.mark.parametrize("pair", [(0, 1), (0, 100), (0, 255), (50, 200), (1, 2), (254, 255)])
@pytest.mark.parametrize("kind", ["u1", "u2"])
def test_the_brighter_of_two_values_is_set(tmp_path, pair, kind):
    assert (saved(tmp_path, np.where(DISK, pair[1], pair[0]).astype(kind)) == DISK).all()


@pytest.mark.parametrize("color", [(64, 0, 0), (0, 0, 255), (255, 255, 255), (1, 1, 1)])
def test_colors_on_black_are_set(tmp_path, color):
    assert (saved(tmp_path, DISK[..., None] * np.array(color, "u1")) == DISK).all()
    assert (saved(tmp_path, in_palette(8 * DISK, {8: color})) == DISK).all()


def test_transparency_that_varies_is_the_mask(tmp_path):
    white = np.full((48, 64, 4), 255, "u1")
    white[..., 3] = 255 * DISK
    assert (saved(tmp_path, white) == DISK).all()
    gray = np.stack([np.full_like(white[..., 0], 90), 255 * DISK.astype("u1")], -1)
    assert (saved(tmp_path, gray) == DISK).all()
    assert (saved(tmp_path, in_palette(DISK, {0: (9, 9, 9), 1: (9, 9, 9)}), transparency=0) == DISK).all()
    opaque = np.concatenate([np.repeat(255 * DISK[..., None].astype("u1"), 3, 2), np.full((48, 64, 1), 255, "u1")], 2)
    assert (saved(tmp_path, opaque) == DISK).all()


def test_16_bits_and_one(tmp_path):
    assert (saved(tmp_path, (65535 * DISK.astype("u4")).astype("u2")) == DISK).all()
    assert (saved(tmp_path, Image.fromarray(DISK)) == DISK).all()


@pytest.mark.parametrize("white", [120, 255, 30])
def test_soft_edges_are_cut_at_half_of_their_own_white(tmp_path, white):
    assert (saved(tmp_path, np.round(white * SOFT).astype("u1")) == (SOFT >= 0.5)).mean() > 0.995


def test_a_wide_blur_is_soft_and_labels_are_not(tmp_path):
    slope = np.round(np.clip((COLUMN - 10) / 40, 0, 1) * 200).astype("u1")
    assert (saved(tmp_path, slope) == (slope >= 100)).all()
    labels = (DISK + 2 * (ROW < 8)).astype("u1")
    with pytest.warns(FileWarning, match="holds 2 labels: all but 0 are set"):
        assert (saved(tmp_path, labels) == (labels > 0)).all()


@pytest.mark.parametrize("value", [1, 20, 100, 127])
@pytest.mark.parametrize("kind", ["gray", "rgb", "alpha", "u2", "soft"])
def test_halos_of_one_value_are_beside_the_mask(tmp_path, value, kind):
    distance = np.hypot(ROW - 24, COLUMN - 32)
    gray = np.where(DISK, 255, np.where(distance < 20, value, 0)).astype("u1")
    if kind == "soft":  # pixels between the halo and what is around it
        gray[(distance >= 20) & (distance < 20.7)] = value // 2
    pictures = {"rgb": np.repeat(gray[..., None], 3, 2), "u2": gray.astype("u2") * 257}
    pictures["alpha"] = np.concatenate([np.full((48, 64, 3), 90, "u1"), gray[..., None]], -1)
    with pytest.warns(FileWarning, match=r"m\.png: what is (255|65535) has a halo"):
        assert (saved(tmp_path, pictures.get(kind, gray)) == DISK).all()


def test_labels_that_nest_or_touch_are_no_halos(tmp_path):
    inner, angle = np.hypot(ROW - 24, COLUMN - 32) < 7, np.arctan2(ROW - 24, COLUMN - 32)
    for labels in (
        np.select([inner, DISK], [2, 1], 0),
        np.select([inner, DISK], [255, 127], 0),
        np.select([DISK & (COLUMN < 32), DISK], [255, 128], 0),
        np.where(DISK, 20 * (1 + (angle + np.pi) // 0.6), 0),
    ):
        with pytest.warns(FileWarning, match=r"holds \d+ labels: all but 0 are set"):
            assert (saved(tmp_path, labels.astype("u1")) == DISK).all()


@pytest.mark.parametrize("kind", [bool, "u1", "i8", "f4"])
def test_arrays_of_two_values(tmp_path, kind):
    np.save(tmp_path / "m.npy", DISK.astype(kind))
    assert (load_mask(tmp_path / "m.npy").numpy() == DISK).all()


def test_arrays_of_probabilities_and_scores(tmp_path):
    np.save(tmp_path / "m.npy", (0.9 * SOFT + 0.01).astype("f4"))
    assert (load_mask(tmp_path / "m.npy").numpy() == (SOFT >= 0.5)).mean() > 0.995
    scores = np.where(DISK, 3.0, -2.0) + np.linspace(0, 1, 64)
    scores[0, 0] = np.nan
    np.save(tmp_path / "s.npy", scores)
    assert (load_mask(tmp_path / "s.npy").numpy() == DISK).all()


@pytest.mark.parametrize(
    ("value", "words"), [(0, "keeps none of its 3072 pixels"), (255, "keeps all"), (7, "keeps all")]
)
def test_a_mask_of_one_value_warns(tmp_path, value, words):
    with pytest.warns(FileWarning, match=rf"m\.png: the mask {words}"):
        assert (saved(tmp_path, np.full((48, 64), value, "u1")) == bool(value)).all()
