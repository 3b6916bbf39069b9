"""What is upright: what stands, what walks, what a camera sees."""

import pytest
import torch

from torchreg.geometry.upright import guess_up


def box(*sizes, seed=0):
    return (torch.rand(400, 3, generator=torch.Generator().manual_seed(seed)) - 0.5) * torch.tensor(sizes)


def test_what_stands_on_y_is_tall():
    assert guess_up([box(0.5, 1.8, 0.3)]) == (0, 1, 0)
    assert guess_up([box(0.5, 0.3, 1.8)]) == (0, 0, 1)
    assert guess_up([box(1.8, 0.3, 0.5)]) == (0, 0, 1)


def test_what_a_camera_measures_hangs_from_minus_y():
    assert guess_up([box(0.2, 0.2, 0.2) + torch.tensor([0.0, 0.0, 0.6])]) == (0, -1, 0)


@pytest.mark.parametrize(("upright", "forward"), [(1, 2), (2, 1)])
def test_feet_stay_on_the_ground(upright, forward):
    body = box(0.3, 1.0, 1.0)
    body[:, upright] -= body[:, upright].min()
    frames = []
    for step in range(8):
        moved = body.clone()
        moved[:, forward] += 0.03 * step
        moved[:, upright] += 0.002 * (step % 2)
        frames.append(moved)
    assert guess_up(frames) == (0, float(upright == 1), float(upright == 2))


def test_points_that_are_not_finite_do_not_count():
    points = box(0.5, 1.8, 0.3)
    points[::7] = torch.nan
    assert guess_up([points, torch.full((5, 3), torch.nan)]) == (0, 1, 0)
    assert guess_up([torch.zeros(0, 3)]) == (0, 0, 1)
