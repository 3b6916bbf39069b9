"""Distances to tubes against closed forms, gradients, and a spine that a loss draws back to the surface."""

import math

import pytest
import torch

from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.errors import InputError
from torchreg.spines.spine import Spine
from torchreg.spines.tube_loss import TubeLoss

LINE = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [3, 0, 0]]], dtype=torch.float64)


def test_distances_to_a_straight_tube_are_those_of_a_capsule():
    radii = torch.full((1, 3), 0.5, dtype=torch.float64)
    points = torch.tensor([[2.0, 2, 0], [-3, 4, 0], [0.5, 0, 0.1], [1, 0, 0]], dtype=torch.float64)
    found = TubeLoss(1.0).distances(LINE, radii, points)
    torch.testing.assert_close(found, torch.tensor([1.5, 4.5, -0.4, -0.5], dtype=torch.float64))


def test_radii_are_linear_and_the_nearest_tube_counts():
    radii = torch.tensor([[0.1, 0.3, 0.3]], dtype=torch.float64)
    other = LINE + torch.tensor([0.0, 5.0, 0.0], dtype=torch.float64)
    curves, both = torch.cat((LINE, other)), torch.cat((radii, radii))
    points = torch.tensor([[0.5, 1.0, 0.0], [2.0, 4.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(TubeLoss(1.0).distances(curves, both, points), torch.tensor([0.8, 0.7]).double())


def test_far_points_count_no_more_than_the_scale():
    radii = torch.full((1, 3), 0.5, dtype=torch.float64)
    loss = TubeLoss(0.2)
    far = loss(LINE, radii, torch.tensor([[0.0, 1000.0, 0.0]], dtype=torch.float64))
    assert float(far) == pytest.approx(0.04, rel=1e-3)
    near = loss(LINE, radii, torch.tensor([[1.0, 0.51, 0.0]], dtype=torch.float64))
    assert float(near) == pytest.approx(1e-4, rel=0.01)


def test_gradients_are_right_and_finite_on_the_axis():
    generator = torch.Generator().manual_seed(0)
    curves = torch.randn(2, 4, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    radii = torch.rand(2, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    points = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda c, r: TubeLoss(0.7)(c, r, points), (curves, radii))
    TubeLoss(0.7)(curves, radii, curves.detach()[0]).backward()
    assert bool(curves.grad.isfinite().all())
    TubeLoss(0.7)(torch.zeros(1, 3, 3), torch.zeros(1, 3), torch.zeros(2, 3)).isfinite()


def test_a_spine_off_the_surface_is_drawn_back():
    sequence = creature_sequence(STARFISH, 1, resolution=40, dtype=torch.float64)
    true = sequence.curves[:, :, ::4].flip(2)
    graph = torch.tensor([[arm, 5] for arm in range(5)])
    off = 0.05 * torch.randn(true.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    off[:, :, -1] = 0.0
    spine = Spine(true + off, graph, torch.full(true.shape[:3], 0.12, dtype=torch.float64))
    points = sequence.meshes[0].vertices[::7]
    loss, optimizer = TubeLoss(0.1), torch.optim.Adam(spine.parameters(), lr=0.01)

    def away():  # across the axes: along them the surface says little
        return float(torch.cdist(spine(0.0).detach(), sequence.curves[0]).amin(-1).mean())

    start, first = away(), None
    for _ in range(60):
        optimizer.zero_grad()
        value = loss(spine(0.0), spine.radii(0.0), points) + 0.002 * spine.bend_angles(0.0).square().mean()
        first = float(value.detach()) if first is None else first
        value.backward()
        optimizer.step()
    assert float(value.detach()) < 0.3 * first
    assert away() < 0.75 * start


def test_bad_input_is_named():
    with pytest.raises(InputError, match="scale must be positive"):
        TubeLoss(0.0)
    for curves, radii, points, message in (
        (LINE[0], torch.ones(3), torch.zeros(1, 3), "curves must have shape"),
        (LINE, torch.ones(1, 2), torch.zeros(1, 3), "radii must have shape"),
        (LINE, torch.ones(1, 3), torch.zeros(0, 3), "points must hold at least 1"),
        (LINE, torch.ones(1, 3), torch.full((1, 3), math.nan), "points must be finite"),
    ):
        with pytest.raises(InputError, match=message):
            TubeLoss(1.0)(curves, radii, points)
