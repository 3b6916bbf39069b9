"""Building blocks of made-up creatures: random numbers, and parts that are added one after the other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchreg.datasets.figures import Part
from torchreg.datasets.solids import FlatCone, RoundCone, Solid

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
    _solids: list[list[Solid]] = field(default_factory=list)
    _rows: list[tuple[int, Tensor, float]] = field(default_factory=list)

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
        self._rows.append((parent, start, limit))
        self._solids.append([cone_of(start, end, radii, flat, normal)])
        return len(self._rows) - 1, end

    def chain(
        self,
        parent: int,
        start: Tensor,
        directions: Sequence[Tensor],
        lengths: Sequence[float],
        radii: Sequence[float],
        *,
        limit: float = 80.0,
        flat: float = 1.0,
        normal: Tensor | None = None,
    ) -> tuple[list[int], Tensor]:
        """Add parts one after the other, radii (K + 1) at their ends; return their numbers and the last end."""
        numbers = []
        for index, (direction, length) in enumerate(zip(directions, lengths, strict=True)):
            parent, start = self.add(
                parent,
                start,
                direction,
                length,
                (radii[index], radii[index + 1]),
                limit=limit,
                flat=flat,
                normal=normal,
            )
            numbers.append(parent)
        return numbers, start

    def attach(self, part: int, solid: Solid) -> None:
        """Add a solid to a part."""
        self._solids[part].append(solid)

    def blob(self, part: int, center: Tensor, radius: float) -> None:
        """Add a ball to a part."""
        self.attach(part, RoundCone(as_tuple(center), as_tuple(center), radius, radius))

    def finish(self) -> Creature:
        """Return the creature."""
        parts = tuple(
            Part(f"part {number}", None if parent < 0 else f"part {parent}", as_tuple(joint), tuple(solids))
            for number, ((parent, joint, _), solids) in enumerate(zip(self._rows, self._solids, strict=True))
        )
        return Creature(parts, tuple(math.radians(limit) for _, _, limit in self._rows), self.rigid)


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


def as_tuple(vector: Tensor) -> tuple[float, float, float]:
    """Return a vector (3,) as numbers."""
    x, y, z = vector.tolist()
    return x, y, z


def at(x: float, y: float, z: float) -> Tensor:
    """Return a position (3,) float64."""
    return torch.tensor([x, y, z], dtype=torch.float64)
