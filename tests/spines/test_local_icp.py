"""Nodes carried with a surface: rigid motions, bending tubes, and arms beside a body that they only touch."""

import math

import pytest
import torch

from torchreg.errors import InputError
from torchreg.geometry.rotation import so3_exp
from torchreg.spines.local_icp import carry_nodes

COUNT = 21


def tube(bend, *, turn=0.0, radius=0.12, length=2.0, samples=60, start=0.0):
    """Axis (COUNT, 3), surface points and normals of a tube that is bent into an arc."""

    def at(along):
        angle = bend * along / length
        if bend:
            place = torch.stack((angle.sin(), 1 - angle.cos(), 0 * angle), -1) * length / bend
        else:
            place = torch.stack((along, 0 * along, 0 * along), -1)
        return place, torch.stack((-angle.sin(), angle.cos(), 0 * angle), -1)

    axis, _ = at(torch.linspace(0, length, COUNT, dtype=torch.float64))
    along = torch.linspace(0, length, samples, dtype=torch.float64) + start
    place, across = at(along.repeat_interleave(16))
    around = (2 * math.pi * torch.arange(16, dtype=torch.float64) / 16 + turn).repeat(samples)[:, None]
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    normals = around.cos() * across + around.sin() * up
    return axis, place + radius * normals, normals


def apart(axis):
    steps = torch.cat((torch.zeros(1).double(), (axis[1:] - axis[:-1]).norm(dim=-1).cumsum(0)))
    return (steps[:, None] - steps).abs()


def test_a_rigid_motion_of_the_surface_carries_the_nodes():
    axis, source, normals = tube(0.6)
    turn = so3_exp(torch.tensor([0.1, 0.15, -0.1], dtype=torch.float64))
    shift = torch.tensor([0.05, -0.04, 0.08], dtype=torch.float64)
    moved = carry_nodes(
        axis, torch.full((COUNT,), 0.12), apart(axis), source, normals, source @ turn.mT + shift, normals @ turn.mT,
        [1.0, 0.3], num_rounds=20,
    )  # fmt: skip
    torch.testing.assert_close(moved, axis @ turn.mT + shift, atol=0.04, rtol=0)


def test_nodes_follow_a_tube_that_bends_and_is_meshed_anew():
    axis, source, normals = tube(0.3)
    goal, target, target_normals = tube(0.8, turn=0.1, samples=71, start=0.01)
    known = torch.zeros(COUNT, dtype=torch.bool)
    known[[0, -1]] = True
    moved = carry_nodes(
        axis, torch.full((COUNT,), 0.12), apart(axis), source, normals, target, target_normals, [1.0, 0.5, 0.25],
        known=known, places=goal, num_rounds=8,
    )  # fmt: skip
    assert float((moved - goal).norm(dim=-1).max()) < 0.04
    assert float((axis - goal).norm(dim=-1).max()) > 0.4


def test_scale_and_common_motion_change_nothing():
    axis, source, normals = tube(0.3)
    _, target, target_normals = tube(0.5)
    radii = torch.full((COUNT,), 0.12)
    plain = carry_nodes(axis, radii, apart(axis), source, normals, target, target_normals, [0.5])
    turn = so3_exp(torch.tensor([1.0, -0.4, 2.0], dtype=torch.float64))

    def place(points):
        return 30 * points @ turn.mT + 7

    moved = carry_nodes(
        place(axis), 30 * radii, 30 * apart(axis), place(source), normals @ turn.mT, place(target),
        target_normals @ turn.mT, [15.0],
    )  # fmt: skip
    torch.testing.assert_close(moved, place(plain), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"widths": []}, "widths must hold"),
        ({"widths": [0.0]}, "widths must be positive"),
        ({"apart": torch.zeros(2, 2)}, "apart must have shape"),
        ({"radii": torch.zeros(2)}, "radii must have shape"),
        ({"source": torch.zeros(4, 3)}, "source_normals must have shape"),
        ({"num_rounds": 0}, "num_rounds must be at least 1"),
        ({"known": torch.zeros(2, dtype=torch.bool)}, "known must have shape"),
        ({"nodes": torch.full((COUNT, 3), torch.nan)}, "nodes must be finite"),
    ],
)
def test_bad_input_is_named(change, message):
    axis, source, normals = tube(0.3)
    given = {
        "nodes": axis, "radii": torch.ones(COUNT), "apart": apart(axis), "source": source, "source_normals": normals,
        "target": source, "target_normals": normals, "widths": [0.5],
    }  # fmt: skip
    with pytest.raises(InputError, match=message):
        carry_nodes(**{**given, **change})
