"""What is upright: what stands, what walks, what a camera sees."""

import pytest
import torch

from torchreg.geometry.upright import guess_up


def box(*sizes, seed=0):
    return (torch.rand(400, 3, generator=torch.Generator().manual_seed(seed)) - 0.5) * torch.tensor(sizes)


@pytest.mark.parametrize(
    ("points", "up"),
    [
        (box(0.5, 1.8, 0.3), (0, 1, 0)),  # tall
        (box(0.5, 0.3, 1.8), (0, 0, 1)),
        (box(1.8, 0.3, 0.5), (0, 0, 1)),
        (box(0.2, 0.2, 0.2) + torch.tensor([0.0, 0.0, 0.6]), (0, -1, 0)),  # before a camera
        (box(40, 30, 25) + torch.tensor([-50.0, -745.0, 15.0]), (0, 0, 1)),  # beside what it would see
        (torch.cat([box(0.5, 1.8, 0.3), torch.full((5, 3), torch.nan)]), (0, 1, 0)),
        (torch.zeros(0, 3), (0, 0, 1)),
    ],
)
def test_what_stands_alone(points, up):
    assert guess_up([points]) == up


def quadruped(upright):
    """A body as long as it is high, on four legs that are set apart, of which one is lifted."""
    parts = []
    for side in (-0.1, 0.1):
        for end in (-0.5, 0.5):
            leg = box(0.08, 0.6, 0.08, seed=len(parts))
            parts.append(leg + torch.tensor([side, 0.5 if side > 0 and end > 0 else 0.3, end]))
    trunk = box(0.3, 0.3, 1.6, seed=9) + torch.tensor([0.0, 0.8, 0.0])
    points = torch.cat([*parts, trunk, trunk + 0.001])
    points = points - points.mean(0)
    return points if upright == 1 else points[:, [0, 2, 1]] * torch.tensor([1.0, -1.0, 1.0])


@pytest.mark.parametrize("upright", [1, 2])
@pytest.mark.parametrize("height", [0.0, 3.0])
def test_what_is_longer_than_high_stands_on_its_feet(upright, height):
    points = quadruped(upright)
    points[:, upright] += height * (points[:, upright].amax() - points[:, upright].amin()) / 6
    assert guess_up([points]) == (0, float(upright == 1), float(upright == 2))


@pytest.mark.parametrize("upright", [1, 2])
def test_what_ends_at_zero_stands_on_the_ground_and_feet_stay_there(upright):
    expected, step = (0, float(upright == 1), float(upright == 2)), torch.zeros(3)
    points = box(0.4, 1.0, 1.0)
    points[:, upright] += 0.5
    assert guess_up([points]) == expected
    body = box(0.3, 1.0, 1.0)
    body[:, upright] -= body[:, upright].min()
    step[3 - upright], step[upright] = 0.03, 0.0
    lift = 0.002 * torch.eye(3)[upright]
    assert guess_up([body + number * step + number % 2 * lift for number in range(8)]) == expected
