import pytest
import torch

from torchreg.capture.disparity_refinement import refine_disparity
from torchreg.errors import InputError


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
    with pytest.raises(InputError, match="dense must have shape"):
        refine_disparity(left, right, truth[1:], PIXELS)
    assert len(refine_disparity(left, right, truth, PIXELS[:0]).std) == 0
