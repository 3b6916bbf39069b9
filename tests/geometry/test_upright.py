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


def quadruped(upright, forward):
    """A body as long as it is high, on four legs that are set apart, of which one is lifted."""
    parts = []
    for side in (-0.1, 0.1):
        for end in (-0.5, 0.5):
            leg = box(0.08, 0.6, 0.08, seed=len(parts))
            lift = 0.2 if side > 0 and end > 0 else 0.0
            parts.append(leg + torch.tensor([side, 0.3 + lift, end]))
    trunk = box(0.3, 0.3, 1.6, seed=9) + torch.tensor([0.0, 0.8, 0.0])
    points = torch.cat([*parts, trunk, trunk + 0.001])
    points = points - points.mean(0)
    return points if (upright, forward) == (1, 2) else points[:, [0, 2, 1]] * torch.tensor([1.0, -1.0, 1.0])


@pytest.mark.parametrize(("upright", "forward"), [(1, 2), (2, 1)])
@pytest.mark.parametrize("height", [0.0, 3.0])
def test_what_is_longer_than_high_stands_on_its_feet(upright, forward, height):
    points = quadruped(upright, forward)
    points[:, upright] += height * (points[:, upright].amax() - points[:, upright].amin()) / 6
    assert guess_up([points]) == (0, float(upright == 1), float(upright == 2))


@pytest.mark.parametrize(("upright", "forward"), [(1, 2), (2, 1)])
def test_what_ends_at_zero_stands_on_the_ground(upright, forward):
    points = box(0.4, 1.0, 1.0)
    points[:, upright] += 0.5
    assert guess_up([points]) == (0, float(upright == 1), float(upright == 2))


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
