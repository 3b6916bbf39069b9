import sys

import pytest
import torch

import torchreg as tr
from torchreg.capture.disparity import census, match_disparity
from torchreg.capture.disparity_refinement import refine_disparity


def textured(height, width, seed=0):
    noise = torch.rand(1, 1, height, width, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.nn.functional.avg_pool2d(noise, 3, stride=1, padding=1)[0, 0]


def scene(shift=8, front=14, noise=0.002):
    """Two pictures of a wall with a square before it, and the disparities of the left one."""
    wall, square = textured(50, 120), textured(50, 120, 1)
    disparity = torch.full((50, 100), float(shift), dtype=torch.float64)
    disparity[15:35, 40:70] = front
    left = wall[:, :100].clone()
    left[15:35, 40:70] = square[15:35, 40:70]
    right = wall[:, shift : 100 + shift].clone()
    right[15:35, 40 - front : 70 - front] = square[15:35, 40:70]
    grain = noise * torch.randn(2, 50, 100, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    return left + grain[0], right + grain[1], disparity


@pytest.mark.parametrize("method", ["semi-global", "block", "opencv"])
def test_disparity_of_two_layers(method):
    if method == "opencv":
        pytest.importorskip("cv2")
    left, right, truth = scene()
    found = match_disparity(left, right, 20, method=method)
    known = found.isfinite()
    known[:, :25] = False
    assert known[:, 25:].double().mean() > 0.7
    # OpenCV's blocks fatten the square by two or three pixels.
    assert ((found - truth)[known].abs() < 1).double().mean() > (0.92 if method == "opencv" else 0.95)
    if method != "opencv":
        # The strip left of the square is hidden from the right camera.
        assert known[17:33, 35:39].double().mean() < 0.6


def test_subpixel_shift_is_found():
    wide = textured(30, 600, 3)
    smooth = torch.nn.functional.avg_pool1d(wide[:, None], 9, stride=1)[:, 0]
    left, right = smooth[:, 0:480:4], smooth[:, 27 : 27 + 480 : 4]
    found = match_disparity(left, right, 14)
    assert float(found[:, 20:].nanmedian()) == pytest.approx(6.75, abs=0.2)


def test_census_ignores_brightness_and_counts_darker_neighbors():
    image = textured(12, 15)
    assert torch.equal(census(image), census(3 * image + 1))
    bright = torch.zeros(9, 11)
    bright[4, 5] = 1.0
    assert int(census(bright)[4, 5]) == 2**62 - 1
    assert int(census(bright)[0, 0]) == 0


def test_a_missing_opencv_is_told_with_its_extra(monkeypatch):
    left, right, _ = scene()
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(tr.errors.MissingExtraError, match=r"torchreg-articulated\[stereo\]"):
        match_disparity(left, right, 20, method="opencv")


def test_opencv_matches_up_to_the_left_border():
    pytest.importorskip("cv2")
    left, right, truth = scene()
    found = match_disparity(left, right, 30, method="opencv")
    column = torch.arange(100).expand(50, 100)
    both = (column - truth >= 2) & (column < 30)
    assert found[both].isfinite().double().mean() > 0.7
    assert not found[column < found].isfinite().any()


def picture(column, row):
    """A smooth texture anywhere in the plane: waves of six to twenty pixels."""
    waves = torch.tensor([[0.9, 0.2], [0.5, -0.7], [-0.3, 0.6], [0.7, 0.5]], dtype=torch.float64)
    return sum(torch.sin(a * column + b * row + 3 * a * b) for a, b in waves.tolist()) / 8 + 0.5


def pair(disparity, slope=0.0, noise=0.0, seed=0):
    """A plane of known disparity ``disparity + slope (x - 40)``, in the left picture's pixels."""
    row, column = torch.meshgrid(*(torch.arange(size, dtype=torch.float64) for size in (40, 80)), indexing="ij")
    truth = disparity + slope * (column - 40)
    # A point at column x on the left lies at x - d(x) on the right.
    back = (column + disparity - 40 * slope) / (1 - slope)
    grain = noise * torch.randn(2, 40, 80, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return picture(column, row) + grain[0], 0.8 * picture(back, row) + 0.1 + grain[1], truth


PIXELS = torch.cartesian_prod(torch.arange(25, 65, 4), torch.arange(10, 30, 4))


@pytest.mark.parametrize("slope", [0.0, 0.1, -0.1])
def test_close_on_slanted_planes_of_other_brightness(slope):
    left, right, truth = pair(6.37, slope)
    fit = refine_disparity(left, right, truth + 0.4, PIXELS)
    assert fit.good.all()
    # The least uncertainty that is ever stated.
    assert (fit.disparity - truth[PIXELS[:, 1], PIXELS[:, 0]]).abs().max() < 0.05


def test_errors_are_as_large_as_stated():
    ratios = []
    for seed in range(4):
        left, right, truth = pair(6.37, 0.05, noise=0.05, seed=seed)
        fit = refine_disparity(left, right, truth + 0.3, PIXELS)
        ratios.append(((fit.disparity - truth[PIXELS[:, 1], PIXELS[:, 0]]) / fit.std)[fit.good])
    ratio = torch.cat(ratios)
    assert len(ratio) > 100
    assert 0.6 < ratio.std() < 1.3
    assert (ratio.abs() < 3).double().mean() > 0.97


def test_other_surfaces_in_the_window_do_not_disturb():
    left, right, truth = pair(6.37)
    other, seen, _ = pair(12.0, seed=1)
    left[:, 40:], right[:, 34:] = other[:, 40:].flip(0), seen[:, 34:].flip(0)
    dense = truth.clone()
    dense[:, 40:] = torch.nan
    pixels = torch.tensor([[36, 20], [37, 15]])
    fit = refine_disparity(left, right, dense, pixels)
    assert (fit.disparity - 6.37).abs().max() < 0.1


def test_windows_that_do_not_match_are_not_good():
    left, right, truth = pair(6.37)
    fit = refine_disparity(left, right.flip(0), truth, PIXELS)
    assert fit.good.double().mean() < 0.3
    flat = refine_disparity(torch.zeros_like(left), torch.zeros_like(left), truth, PIXELS)
    assert not flat.good.any()
    assert len(refine_disparity(left, right, truth, PIXELS[:0]).std) == 0
