"""Building blocks of made-up creatures: random numbers, and parts that are added one after the other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from torchreg.datasets.figures import Part
from torchreg.datasets.solids import RoundCone, Solid, Vector, ball

# Left (+x) and right, with y up and z forward.
LEFT_RIGHT = (1.0, -1.0)


class Draw:
    """Random numbers of a seeded generator, as plain floats.

    Args:
        generator: their source.
    """

    def __init__(self, generator: torch.Generator) -> None:
        self.generator = generator

    def uniform(self, low: float, high: float) -> float:
        """Return a number drawn evenly between two."""
        return low + (high - low) * float(torch.rand((), generator=self.generator, dtype=torch.float64))

    def chance(self, probability: float) -> bool:
        """Return True with a probability."""
        return self.uniform(0, 1) < probability

    def count(self, low: int, high: int) -> int:
        """Return an integer from ``low`` to ``high``, both included."""
        return int(torch.randint(low, high + 1, (), generator=self.generator))

    def order(self, count: int) -> list[int]:
        """Return the numbers below a count in random order."""
        return torch.randperm(count, generator=self.generator).tolist()

    def log_uniform(self, low: float, high: float) -> float:
        """Return a number whose logarithm is drawn evenly."""
        return math.exp(self.uniform(math.log(low), math.log(high)))

    def normal(self, *shape: int) -> Tensor:
        """Return standard normal numbers, float64."""
        return torch.randn(*shape, generator=self.generator, dtype=torch.float64)

    def direction(self) -> Tensor:
        """Return a unit vector (3,) drawn evenly."""
        return torch.nn.functional.normalize(self.normal(3), dim=0)


@dataclass(frozen=True)
class Creature:
    """The parts of one creature in its rest pose, and how far their joints turn.

    Args:
        parts: P parts, parents before children; y up, z forward, about a metre long.
        limits: P largest angles of the joints, radians.
        rigid: whether its parts are rigid pieces rather than one bending skin.
    """

    parts: tuple[Part, ...]
    limits: tuple[float, ...]
    rigid: bool = False


@dataclass(frozen=True)
class FlatCone:
    """A round cone flattened across its axis: an ear, a wing, a foot.

    Args:
        cone: before it is flattened.
        normal: unit vector at right angles to its axis, along which it is flattened.
        flatness: thickness over width, in (0, 1].
    """

    cone: RoundCone
    normal: Vector
    flatness: float

    def distance(self, points: Tensor) -> Tensor:
        """Return lower bounds (N,) of the signed distances of points (N, 3), exact across the axis."""
        normal = points.new_tensor(self.normal)
        height = (points - points.new_tensor(self.cone.start)) @ normal
        stretched = points + ((1 / self.flatness - 1) * height).unsqueeze(-1) * normal
        return self.flatness * self.cone.distance(stretched)

    def bounds(self) -> tuple[Vector, Vector]:
        """Return the lower and upper corner of a box that holds the solid."""
        return self.cone.bounds()


def towards(elevation: float, azimuth: float = 0.0) -> Tensor:
    """Return the unit vector (3,) at an elevation and an azimuth from forward to the left, degrees."""
    rise, turn = math.radians(elevation), math.radians(azimuth)
    return torch.tensor(
        [math.cos(rise) * math.sin(turn), math.sin(rise), math.cos(rise) * math.cos(turn)], dtype=torch.float64
    )


@dataclass
class Builder:
    """Collects the parts of a creature.

    Args:
        draw: source of randomness.
        rigid: see `Creature`.
    """

    draw: Draw
    rigid: bool = False
    _parts: list[Part] = field(default_factory=list)
    _limits: list[float] = field(default_factory=list)

    def add(
        self,
        parent: int,
        start: Tensor,
        direction: Tensor,
        length: float,
        radii: tuple[float, float],
        *,
        flat: float = 1.0,
        normal: Tensor | None = None,
        limit: float = 80.0,
    ) -> tuple[int, Tensor]:
        """Add a part that is a cone from its joint on; return its number and where it ends (3,).

        Args:
            parent: number of the part that it hangs on, -1 for the first.
            start: (3,) its joint.
            direction: (3,) of any length.
            length: of the cone, metres.
            radii: at both ends, metres.
            flat: see `FlatCone`.
            normal: (3,) along which it is flat.
            limit: of its joint, degrees.
        """
        axis = torch.nn.functional.normalize(direction.double(), dim=0)
        end = start + length * axis
        number, hangs_on = len(self._parts), None if parent < 0 else f"part {parent}"
        solid = cone_of(start, end, radii, flat, normal)
        self._parts.append(Part(f"part {number}", hangs_on, as_tuple(start), (solid,)))
        self._limits.append(math.radians(limit))
        return number, end

    def chain(
        self,
        parent: int,
        start: Tensor,
        directions: Sequence[Tensor],
        lengths: Sequence[float],
        radii: Sequence[float],
        **form: Any,
    ) -> tuple[list[int], Tensor]:
        """Add parts one after the other, radii (K + 1) at their ends; return their numbers and the last end."""
        numbers = []
        for direction, length, ends in zip(directions, lengths, pairwise(radii), strict=True):
            parent, start = self.add(parent, start, direction, length, ends, **form)
            numbers.append(parent)
        return numbers, start

    def attach(self, part: int, solid: Solid) -> None:
        """Add a solid to a part."""
        self._parts[part] = replace(self._parts[part], solids=(*self._parts[part].solids, solid))

    def blob(self, part: int, center: Tensor, radius: float) -> None:
        """Add a ball to a part."""
        self.attach(part, ball(as_tuple(center), radius))

    def finish(self) -> Creature:
        """Return the creature."""
        return Creature(tuple(self._parts), tuple(self._limits), self.rigid)


def cone_of(start: Tensor, end: Tensor, radii: tuple[float, float], flat: float, normal: Tensor | None) -> Solid:
    """Return a round cone between two centers (3,), flattened along a normal (3,) if it is less than 1 flat."""
    cone = RoundCone(as_tuple(start), as_tuple(end), *radii)
    if flat >= 1 or normal is None:
        return cone
    axis = torch.nn.functional.normalize(end - start, dim=0)
    across = normal.double() - (normal.double() @ axis) * axis
    if float(across.norm()) < 1e-3:
        return cone
    return FlatCone(cone, as_tuple(torch.nn.functional.normalize(across, dim=0)), flat)


def as_tuple(vector: Tensor) -> Vector:
    """Return a vector (3,) as numbers."""
    x, y, z = vector.tolist()
    return x, y, z


def at(x: float, y: float, z: float) -> Tensor:
    """Return a position (3,) float64."""
    return torch.tensor([x, y, z], dtype=torch.float64)
