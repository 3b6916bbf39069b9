"""Walks of made-up people and animals: rotations of their parts over the gait cycle, with random variations."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchreg._checks import check_choice
from torchreg.datasets.figures import SIDES, Figure
from torchreg.geometry.rotation import so3_exp

from ..made_up.bodies import REST_ARM, REST_LEG

# Phases of an animal's feet behind its left hind foot, as shares of the cycle.
GAITS = {
    "walk": {"hind left": 0.0, "front left": 0.25, "hind right": 0.5, "front right": 0.75},
    "trot": {"hind left": 0.0, "front left": 0.5, "hind right": 0.5, "front right": 0.0},
    "gallop": {"hind left": 0.0, "front left": 0.6, "hind right": 0.1, "front right": 0.5},
}
# Angle between hanging arms and the trunk.
_HANGING_ARM = math.radians(14)


def person_walk(figure: Figure, phase: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
    """Return the rotations of the parts of a walking person, and the heights of the person.

    Joint angles of hips, knees and ankles follow those measured of people; arms swing against the legs, elbows bend as
    the arms come forward, trunk and pelvis turn against each other. Over the cycles strides get longer and shorter,
    and the person looks about and leans a little, at random.

    Args:
        figure: a `person`.
        phase: (T,) cycles; the left heel strikes at whole numbers.
        generator: of the variations; None draws from a fresh generator with seed 0.

    Returns:
        Rotations (T, P, 3, 3) for `Figure.transforms`, and heights (T,), metres.

    Raises:
        InputError: if the figure is no person.

    References: Winter 2009, the angles of natural cadence.
    """
    phase, wander, turns = _begun(figure, phase, generator)
    stride, swing = wander(0.15, 1.0), wander(0.3, 1.0)
    beat = torch.cos(2 * math.pi * phase)
    turns.add("pelvis", y=-6 * stride * beat, z=3 * torch.sin(2 * math.pi * phase))
    turns.add("torso", x=wander(5.0, 5.0), y=12 * stride * beat + wander(8.0), z=wander(4.0))
    turns.add("head", x=wander(12.0), y=wander(30.0) - 6 * stride * beat, z=wander(5.0))
    for side, sign in SIDES.items():
        cycle = phase if side == "left" else phase + 0.5
        outward = sign * math.degrees(REST_LEG)
        turns.add(f"{side} thigh", x=-stride * (10 + 24 * torch.cos(2 * math.pi * cycle)), z=-outward - sign * 0.5)
        knee = 4 + 14 * _bump(cycle, 0.14, 0.07) + 56 * _bump(cycle, 0.72, 0.095)
        turns.bend(f"{side} shin", stride * knee, outward)
        turns.bend(
            f"{side} foot",
            stride * (6 * _bump(cycle, 0.07, 0.05) - 9 * _bump(cycle, 0.42, 0.12) + 18 * _bump(cycle, 0.62, 0.07)),
            outward,
        )
        forward = swing * (3 - 24 * torch.cos(2 * math.pi * cycle))
        hanging = sign * math.degrees(REST_ARM - _HANGING_ARM)
        turns.add(f"{side} upper arm", x=-forward, z=-hanging + sign * wander(3.0, 2.0))
        turns.bend(f"{side} forearm", -(12 + swing * (18 - 16 * torch.cos(2 * math.pi * (cycle - 0.05)))), hanging)
    return turns.rotations, -0.02 * torch.cos(4 * math.pi * phase)


def person_tucks(figure: Figure, phase: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
    """Return the rotations of the parts of a person who tucks limbs in, and the heights of the person.

    In the first half of a cycle the left knee comes up to the chest and the right forearm folds before it; in the
    second half the same happens in the mirror. How far they come differs from cycle to cycle, at random.

    Args:
        figure: a `person`.
        phase: (T,) cycles; nothing is tucked in at multiples of a half.
        generator: of the variations; None draws from a fresh generator with seed 0.

    Returns:
        Rotations (T, P, 3, 3) for `Figure.transforms`, and heights (T,), metres.

    Raises:
        InputError: if the figure is no person.
    """
    phase, wander, turns = _begun(figure, phase, generator)
    turns.add("torso", x=wander(6.0, 4.0), y=wander(8.0), z=wander(4.0))
    turns.add("head", x=wander(12.0), y=wander(20.0), z=wander(5.0))
    for side, sign in SIDES.items():
        cycle = phase if side == "left" else phase + 0.5
        leg, arm = (wander(0.1, 0.9) * _raised(rows) for rows in (cycle, cycle + 0.5))
        outward = sign * math.degrees(REST_LEG)
        turns.add(f"{side} thigh", x=-125 * leg, z=-outward)
        turns.bend(f"{side} shin", 145 * leg, outward)
        turns.bend(f"{side} foot", wander(10.0), outward)
        hanging = sign * math.degrees(REST_ARM - _HANGING_ARM)
        turns.add(
            f"{side} upper arm",
            x=-10 * arm + wander(6.0),
            y=-60 * sign * arm,
            z=-hanging + sign * wander(8.0, 8.0) * (1 - arm),
        )
        turns.bend(f"{side} forearm", -15 - 125 * arm, hanging)
    return turns.rotations, torch.zeros_like(phase)


def _raised(cycle: Tensor) -> Tensor:
    """Return how far (T,) a limb is tucked in, from 0 to 1: in the first half of a cycle, and held in its middle."""
    return (1.4 * torch.sin(2 * math.pi * cycle)).clamp(0, 1)


def animal_walk(
    figure: Figure, phase: Tensor, gait: str = "walk", generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Return the rotations of the parts of a moving four-legged animal, and the heights of the animal.

    Args:
        figure: a `quadruped`.
        phase: (T,) cycles; the left hind foot is foremost at whole numbers.
        gait: "walk", "trot" or "gallop".
        generator: of variations from cycle to cycle; None draws from a fresh generator with seed 0.

    Returns:
        Rotations (T, P, 3, 3) for `Figure.transforms`, and heights (T,), metres.

    Raises:
        InputError: if the gait is unknown or the figure no quadruped.
    """
    check_choice(gait, "gait", tuple(GAITS))
    phase, wander, turns = _begun(figure, phase, generator)
    stride, beat, twice = wander(0.15, 1.0), torch.sin(2 * math.pi * phase), torch.cos(4 * math.pi * phase)
    rocking = 8.0 if gait == "gallop" else 1.0
    turns.add("chest", x=rocking * beat, y=wander(4.0) + 3 * beat)
    turns.add("rump", x=-1.5 * rocking * beat, y=-6 * beat + wander(6.0))
    turns.add("neck", x=10 + 8 * twice + wander(12.0), y=wander(18.0))
    turns.add("head", x=wander(12.0) - 8 * twice, y=wander(15.0))
    turns.add("tail", x=wander(10.0), y=20 * beat)
    for leg, lag in GAITS[gait].items():
        cycle = phase - lag
        turns.add(f"{leg} thigh", x=-stride * (24 * torch.cos(2 * math.pi * cycle) + 8 * _bump(cycle, 0.8, 0.1)))
        turns.add(f"{leg} shin", x=stride * (4 + 45 * _bump(cycle, 0.72, 0.1)))
        turns.add(f"{leg} foot", x=stride * (15 * _bump(cycle, 0.6, 0.07) + 20 * _bump(cycle, 0.75, 0.08)))
    return turns.rotations, -0.015 * twice


def _begun(figure: Figure, phase: Tensor, generator: torch.Generator | None) -> tuple[Tensor, _Wander, _Turns]:
    """Return the phases (T,) in float64, the source of variations, and the turns of a figure that stands still."""
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    phase = phase.double()
    return phase, _Wander(phase, generator), _Turns(figure, len(phase))


class _Turns:
    """Rotations of all parts of a figure over time, at first the identity; angles in degrees."""

    def __init__(self, figure: Figure, frames: int) -> None:
        self._figure = figure
        self._frames = frames
        eye = torch.eye(3, dtype=torch.float64)
        self.rotations = eye.expand(frames, figure.num_parts, 3, 3).clone()

    def add(self, part: str, x: Tensor | float = 0.0, y: Tensor | float = 0.0, z: Tensor | float = 0.0) -> None:
        """Turn a part about z, then x, then y of its parent."""
        self.rotations[:, self._figure.index(part)] = self._about(1, y) @ self._about(0, x) @ self._about(2, z)

    def bend(self, part: str, angle: Tensor, rest_angle: float) -> None:
        """Turn a part about the x axis of its parent, which in the rest pose is turned about z by ``rest_angle``."""
        back = self._about(2, -rest_angle)
        self.rotations[:, self._figure.index(part)] = back.mT @ self._about(0, angle) @ back

    def _about(self, axis: int, degrees: Tensor | float) -> Tensor:
        vector = torch.zeros(self._frames, 3, dtype=torch.float64)
        vector[:, axis] = torch.as_tensor(degrees, dtype=torch.float64).deg2rad()
        return so3_exp(vector)


class _Wander:
    """Slow random variations: sums of three sines of incommensurable periods of 2 to 9 cycles, at most 1."""

    def __init__(self, phase: Tensor, generator: torch.Generator) -> None:
        self._phase = phase
        self._generator = generator

    def __call__(self, amplitude: float, middle: float = 0.0) -> Tensor:
        starts, periods = torch.rand(2, 3, 1, generator=self._generator, dtype=torch.float64)
        waves = torch.sin(2 * math.pi * (self._phase / (2 + 7 * periods) + starts))
        return middle + amplitude * waves.mean(0)


def _bump(phase: Tensor, center: float, width: float) -> Tensor:
    """Return a bell (T,) of height 1 around ``center`` in every cycle."""
    return torch.exp(-0.5 * ((((phase - center) + 0.5) % 1.0 - 0.5) / width) ** 2)
