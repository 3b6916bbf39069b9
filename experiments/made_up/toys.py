"""Further toys of rigid pieces that meet at joints: an excavator, and others made up at random."""

from __future__ import annotations

import math

import torch

from torchreg._checks import check_count
from torchreg.datasets.figures import Part
from torchreg.datasets.solids import RoundBox, RoundCone, Solid, Vector, ball
from torchreg.datasets.toys import Hinge, Toy, toy_of
from torchreg.errors import InputError

from ..made_up.creature_parts import Draw

# Directions of the limbs of random toys: both ways along each axis.
_AXES: tuple[Vector, ...] = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
_DIRECTIONS: tuple[Vector, ...] = tuple((s * x, s * y, s * z) for x, y, z in _AXES for s in (1, -1))


def excavator(*, spacing: float = 0.01) -> Toy:
    """Return an excavator of 6 parts and 70 cm: tracks, cab, boom, stick, bucket, blade.

    Args:
        spacing: of the mesh, metres.

    Cost: 0.5 s.
    """
    tracks, cab, blade = _excavator_base()
    parts = [tracks, cab, *_excavator_arm(), blade]
    hinges = [
        Hinge("cab", (0, 1, 0), -math.pi / 2, math.pi / 2),
        Hinge("boom", (1, 0, 0), -0.4, 0.5),
        Hinge("stick", (1, 0, 0), -0.9, 0.6),
        Hinge("bucket", (1, 0, 0), -0.9, 0.9),
        Hinge("blade", (1, 0, 0), -0.5, 0.15),
    ]
    return toy_of(parts, hinges, spacing)


def _excavator_base() -> tuple[Part, Part, Part]:
    """Return tracks, cab and blade."""
    tracks: tuple[Solid, ...] = (
        *(RoundBox((x, 0.04, 0), (0.03, 0.04, 0.13), 0.025) for x in (-0.08, 0.08)),
        RoundBox((0, 0.05, 0), (0.06, 0.03, 0.07), 0.01),
        RoundCone((0, 0.06, 0), (0, 0.085, 0), 0.04, 0.04),
    )
    cab = (
        RoundBox((0, 0.14, -0.03), (0.09, 0.035, 0.11), 0.015),
        RoundBox((-0.05, 0.21, 0.02), (0.038, 0.055, 0.055), 0.012),
        RoundBox((0.035, 0.19, -0.09), (0.04, 0.03, 0.035), 0.01),
        RoundCone((0.05, 0.2, -0.05), (0.05, 0.27, -0.05), 0.01, 0.01),
    )
    blade: tuple[Solid, ...] = (
        *(RoundCone((x, 0.035, 0.13), (x, 0.04, 0.19), 0.012, 0.012) for x in (-0.05, 0.05)),
        RoundBox((0, 0.045, 0.205), (0.11, 0.04, 0.012), 0.008),
    )
    return (
        Part("tracks", None, (0, 0.04, 0), tracks),
        Part("cab", "tracks", (0, 0.1, 0), cab),
        Part("blade", "tracks", (0, 0.035, 0.13), blade),
    )


def _excavator_arm() -> tuple[Part, Part, Part]:
    """Return boom, stick and bucket."""
    boom = (
        RoundCone((0.02, 0.15, 0.09), (0.06, 0.15, 0.09), 0.026, 0.026),
        RoundCone((0.04, 0.15, 0.09), (0.04, 0.32, 0.2), 0.024, 0.027),
        RoundCone((0.04, 0.32, 0.2), (0.04, 0.3, 0.36), 0.027, 0.02),
    )
    stick = (
        RoundCone((0.015, 0.3, 0.36), (0.065, 0.3, 0.36), 0.023, 0.023),
        RoundBox((0.04, 0.21, 0.36), (0.018, 0.1, 0.024), 0.008),
        RoundCone((0.04, 0.31, 0.37), (0.04, 0.34, 0.4), 0.018, 0.014),
    )
    bucket = (
        RoundCone((0.015, 0.11, 0.36), (0.065, 0.11, 0.36), 0.02, 0.02),
        RoundBox((0.04, 0.06, 0.34), (0.05, 0.03, 0.045), 0.012),
        RoundBox((0.04, 0.035, 0.31), (0.045, 0.012, 0.04), 0.006),
    )
    return (
        Part("boom", "cab", (0.04, 0.15, 0.09), boom),
        Part("stick", "boom", (0.04, 0.3, 0.36), stick),
        Part("bucket", "stick", (0.04, 0.11, 0.36), bucket),
    )


def random_toy(generator: torch.Generator | None = None, num_parts: int = 7, *, spacing: float = 0.008) -> Toy:
    """Return a random toy: a box, and limbs of boxes and cones in random directions, up to two in a row.

    Args:
        generator: source of randomness; None draws from a fresh generator with seed 0, the same toy at every call.
        num_parts: 2 to 9, the box included.
        spacing: of the mesh, metres.

    Raises:
        InputError: if ``num_parts`` is out of range.

    Cost: 0.3 s.
    """
    check_count(num_parts, "num_parts", 2)
    if num_parts > 2 * len(_DIRECTIONS) - 3:
        raise InputError(f"num_parts must be at most {2 * len(_DIRECTIONS) - 3}, got {num_parts}")
    draw = Draw(torch.Generator().manual_seed(0) if generator is None else generator)
    u = draw.uniform
    half = (u(0.05, 0.08), u(0.06, 0.1), u(0.045, 0.07))
    knob = RoundBox((u(-0.02, 0.02), u(-0.02, 0.02), half[2]), (0.02, u(0.015, 0.03), 0.02), 0.006)
    parts, hinges = [Part("body", None, (0, 0, 0), (RoundBox((0, 0, 0), half, 0.012), knob))], []
    directions = [_DIRECTIONS[number] for number in draw.order(len(_DIRECTIONS))]
    for number in range(num_parts - 1):
        # First limbs in different directions, then second ones at their ends.
        limb = number % ((num_parts + 1) // 2 if num_parts > 2 else 1)
        direction, first = directions[limb], number == limb
        parent = parts[0] if first else next(part for part in parts if part.name == f"limb {limb}")
        reach = [side * abs(along) for side, along in zip(half, direction, strict=True)]
        start = sum(reach) + 0.012 if first else _tip(parent, direction)
        name = f"limb {limb}" if first else f"end {limb}"
        parts.append(_random_limb(name, parent.name, direction, start, draw))
        across = [axis for axis, along in zip(_AXES, direction, strict=True) if not along]
        hinges += [Hinge(name, axis, -0.9, 0.9) for axis in (across if first else across[:1])]
    return toy_of(parts, hinges, spacing)


def _random_limb(name: str, parent: str, direction: Vector, start: float, draw: Draw) -> Part:
    """Return a limb with a ball at its joint, ``start`` away from the origin, and a box or cone along ``direction``."""

    def point(distance: float) -> Vector:
        x, y, z = (distance * along for along in direction)
        return x, y, z

    u = draw.uniform
    knob, length = u(0.022, 0.028), u(0.09, 0.14)
    thick, wide = u(0.016, 0.024), u(0.016, 0.03)
    solids: tuple[Solid, ...] = (ball(point(start), knob),)
    if draw.chance(0.5):
        solids += (RoundCone(point(start), point(start + length), thick, u(0.014, 0.03)),)
    else:
        sides = [length / 2 if along else side for along, side in zip(direction, (thick, wide, thick), strict=True)]
        solids += (RoundBox(point(start + length / 2), (sides[0], sides[1], sides[2]), 0.006),)
    return Part(name, parent, point(start), solids)


def _tip(part: Part, direction: Vector) -> float:
    """Return the largest distance from the origin of a limb along its direction."""
    corners = [corner for solid in part.solids for corner in solid.bounds()]
    return max(sum(map(math.prod, zip(corner, direction, strict=True))) for corner in corners)
