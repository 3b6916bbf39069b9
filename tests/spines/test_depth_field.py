"""Depth inside a sphere against its closed form, and curves drawn into tubes."""

import pytest
import torch

from torchreg.datasets.creatures import CreatureForm, creature_sequence
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh, unit_sphere
from torchreg.spines.depth_field import DepthField, draw_inside


@pytest.fixture(scope="module")
def sphere():
    return DepthField(unit_sphere(4, dtype=torch.float64), 48)


def test_depth_in_a_sphere_is_the_distance_to_it(sphere):
    generator = torch.Generator().manual_seed(0)
    points = 0.75 * torch.randn(300, 3, generator=generator, dtype=torch.float64)
    points = points[points.norm(dim=-1) < 1.2]
    true = 1 - points.norm(dim=-1)
    assert float((sphere(points) - true).abs().max()) < 1.2 * sphere.spacing
    assert float((sphere(points) - true).abs().mean()) < 0.4 * sphere.spacing


def test_the_way_up_leads_to_the_middle(sphere):
    points = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    up = torch.nn.functional.normalize(sphere.upward(0.7 * points), dim=-1)
    assert float((up * -points).sum(-1).min()) > 0.9
    outside = torch.nn.functional.normalize(sphere.upward(1.1 * points), dim=-1)
    assert float((outside * -points).sum(-1).min()) > 0.8
    assert sphere.upward(points).dtype == torch.float32


def test_batches_equal_loops(sphere):
    points = torch.randn(2, 3, 5, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    torch.testing.assert_close(sphere(points)[1, 2], sphere(points[1, 2]))


def test_a_curve_is_drawn_into_its_arm_and_its_ends_stay():
    form = CreatureForm(3, 0.3, 0.15, 0.1, sway=0.8, curl=0.5)
    sequence = creature_sequence(form, 1, resolution=48, dtype=torch.float64, seed=1)
    field = DepthField(sequence.meshes[0], 64)
    axis, radii = sequence.curves[0, 0], sequence.radii[0]
    away = torch.zeros_like(axis)
    away[5:-1] = 0.12 * torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64), dim=0)
    free = torch.ones(len(axis), dtype=torch.bool)
    free[[0, -1]] = False
    drawn = draw_inside(field, axis + away, radii, free)
    assert torch.equal(drawn[[0, -1]], axis[[0, -1]])
    before, after = (torch.cdist(curve[5:-1], axis).amin(-1) for curve in (axis + away, drawn))
    assert float(after.max()) < 0.5 * float(before.max())
    assert float(field(drawn)[1:-1].min()) > 0.04


def test_points_outside_are_brought_inside(sphere):
    curve = torch.tensor([[1.15, 0.0, 0.0], [0.0, 1.1, 0.0], [0.0, 0.0, -1.05]], dtype=torch.float64)
    moved = draw_inside(sphere, curve, torch.zeros(3), torch.ones(3, dtype=torch.bool), stiffness=0.0)
    assert bool((moved.norm(dim=-1) < 1).all())


def test_bad_input_is_named(sphere):
    curve, free = torch.zeros(4, 3), torch.ones(4, dtype=torch.bool)
    with pytest.raises(InputError, match="radii must have shape"):
        draw_inside(sphere, curve, torch.zeros(3), free)
    with pytest.raises(InputError, match="curves must be finite"):
        draw_inside(sphere, curve * torch.nan, torch.zeros(4), free)
    with pytest.raises(InputError, match="mesh must have faces"):
        DepthField(TriangleMesh(torch.zeros(3, 3), torch.zeros(0, 3).long()))
