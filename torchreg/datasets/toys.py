"""Toys of rigid pieces that meet at joints, such as a robot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_count, check_positive, check_shape
from torchreg.datasets.figures import SIDES, Figure, Part, meshed_figure
from torchreg.datasets.solids import RoundBox, RoundCone, Solid, Vector, union_distance
from torchreg.errors import InputError
from torchreg.geometry.rigid import invert_rigid, transform_points
from torchreg.geometry.rotation import so3_exp


@dataclass(frozen=True)
class _CollisionTest:
    """Test for parts that run into each other."""

    max_overlap: float = 0.002  # of parts that do not meet, metres
    num_vertices: int = 4000  # that are tested, evenly chosen
    max_trials: int = 200  # poses drawn per frame


_COLLISIONS = _CollisionTest()


@dataclass(frozen=True)
class Hinge:
    """An axis about which a part turns in its parent, radians; of several hinges the last one comes first."""

    part: str
    axis: Vector
    lower: float
    upper: float


@dataclass(frozen=True, eq=False)
class Toy:
    """Rigid pieces, the same as solids to test for collisions, and the hinges between them."""

    figure: Figure
    parts: tuple[Part, ...]
    hinges: tuple[Hinge, ...]

    def rotations(self, angles: Tensor) -> Tensor:
        """Return rotations (..., P, 3, 3) for `Figure.transforms` from angles (..., H), radians."""
        check_shape(angles, "angles", (len(self.hinges),), batch=True)
        eye = torch.eye(3, dtype=angles.dtype)
        turns = [eye.expand(*angles.shape[:-1], 3, 3)] * self.figure.num_parts
        for hinge, angle in zip(self.hinges, angles.unbind(-1), strict=True):
            index = self.figure.index(hinge.part)
            turns[index] = turns[index] @ so3_exp(angle.unsqueeze(-1) * angle.new_tensor(hinge.axis))
        return torch.stack(turns, dim=-3)

    def overlap(self, angles: Tensor) -> float:
        """Return the largest penetration of parts that do not meet, metres; zero if none collide."""
        transforms = self.figure.transforms(self.rotations(angles.double()))
        sample = slice(None, None, max(1, self.figure.mesh.num_vertices // _COLLISIONS.num_vertices))
        vertices, owner = self.figure.vertices(transforms)[sample], self.figure.weights[sample].argmax(-1)
        deepest = 0.0
        for index, part in enumerate(self.parts):
            apart = torch.tensor([not self._meet(index, second) for second in range(len(self.parts))])[owner]
            local = transform_points(invert_rigid(transforms[index]), vertices[apart])
            if len(local):
                deepest = max(deepest, -float(union_distance(part.solids, local, 0.0).min()))
        return deepest

    def random_motion(
        self, frames: int, step: float = math.radians(30), generator: torch.Generator | None = None
    ) -> Tensor:
        """Return angles (frames, H) of poses in which all hinges turn by up to ``step`` from one to the next.

        Poses in which parts run into each other are drawn again.
        """
        check_count(frames, "frames", 1)
        check_positive(step, "step", allow_zero=True)
        generator = torch.Generator().manual_seed(0) if generator is None else generator
        lower = torch.tensor([hinge.lower for hinge in self.hinges], dtype=torch.float64)
        upper = torch.tensor([hinge.upper for hinge in self.hinges], dtype=torch.float64)
        poses: list[Tensor] = []
        for _ in range(frames):
            for _ in range(_COLLISIONS.max_trials):
                draw = torch.rand(len(lower), generator=generator, dtype=torch.float64)
                angles = poses[-1] + step * (2 * draw - 1) if poses else lower + (upper - lower) * draw
                angles = _reflected(angles, lower, upper)
                if self.overlap(angles) <= _COLLISIONS.max_overlap:
                    break
            else:
                trials = _COLLISIONS.max_trials
                raise InputError(f"hinges must leave room: in {trials} random poses parts ran into each other")
            poses.append(angles)
        return torch.stack(poses)

    def _meet(self, first: int, second: int) -> bool:
        """Return whether two parts are one, or a part and its parent."""
        return first in (self.figure.parents[second], second) or self.figure.parents[first] == second


def robot(*, spacing: float = 0.008) -> Toy:
    """Return a robot of 8 parts and 53 cm: body, head, and on each side upper arm, forearm and leg."""
    body = (
        RoundBox((0, 0.3, 0), (0.07, 0.09, 0.045), 0.012),
        RoundBox((0.02, 0.325, 0.045), (0.03, 0.03, 0.012), 0.006),
        RoundBox((0, 0.31, -0.055), (0.045, 0.05, 0.025), 0.01),
    )
    head = (
        RoundCone((0, 0.385, 0), (0, 0.42, 0), 0.02, 0.02),
        RoundBox((0, 0.45, 0), (0.042, 0.034, 0.036), 0.01),
        RoundCone((0.025, 0.48, -0.01), (0.03, 0.53, -0.015), 0.008, 0.008),
        RoundCone((0, 0.445, 0.035), (0, 0.44, 0.055), 0.013, 0.01),
    )
    parts = [Part("body", None, (0, 0.3, 0), body), Part("head", "body", (0, 0.395, 0), head)]
    hinges = [Hinge("head", (0, 1, 0), -1.0, 1.0), Hinge("head", (1, 0, 0), -0.3, 0.3)]
    for side, sign in SIDES.items():
        parts += _robot_limbs(side, sign)
        hinges += [
            Hinge(f"{side} upper arm", (1, 0, 0), -2.0, 0.8),
            Hinge(f"{side} upper arm", (0, 0, sign), 0.0, 1.0),
            Hinge(f"{side} forearm", (1, 0, 0), -1.8, 0.0),
            Hinge(f"{side} leg", (1, 0, 0), -1.0, 0.6),
        ]
    return toy_of(parts, hinges, spacing)


def _robot_limbs(side: str, sign: float) -> list[Part]:
    upper = (
        RoundCone((sign * 0.085, 0.36, 0), (sign * 0.105, 0.36, 0), 0.026, 0.028),
        RoundBox((sign * 0.105, 0.3, 0), (0.019, 0.05, 0.022), 0.007),
    )
    forearm: tuple[Solid, ...] = (
        RoundCone((sign * 0.098, 0.232, 0), (sign * 0.122, 0.232, 0), 0.023, 0.023),
        RoundBox((sign * 0.105, 0.175, 0), (0.022, 0.045, 0.026), 0.008),
        *(RoundBox((sign * 0.105, 0.115, z), (0.012, 0.026, 0.007), 0.004) for z in (-0.015, 0.015)),
    )
    leg = (
        RoundCone((sign * 0.03, 0.2, 0), (sign * 0.055, 0.2, 0), 0.028, 0.028),
        RoundBox((sign * 0.042, 0.13, 0), (0.029, 0.06, 0.03), 0.01),
        RoundBox((sign * 0.042, 0.055, 0), (0.02, 0.04, 0.02), 0.006),
        RoundBox((sign * 0.042, 0.018, 0.015), (0.034, 0.018, 0.055), 0.008),
    )
    return [
        Part(f"{side} upper arm", "body", (sign * 0.085, 0.36, 0), upper),
        Part(f"{side} forearm", f"{side} upper arm", (sign * 0.105, 0.232, 0), forearm),
        Part(f"{side} leg", "body", (sign * 0.042, 0.2, 0), leg),
    ]


def toy_of(parts: Sequence[Part], hinges: Sequence[Hinge], spacing: float) -> Toy:
    """Return the toy of parts and hinges, with a mesh of some spacing, metres."""
    return Toy(meshed_figure(parts, spacing=spacing), tuple(parts), tuple(hinges))


def _reflected(angles: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return angles (H,), those beyond a limit reflected at it."""
    angles = torch.where(angles > upper, 2 * upper - angles, angles)
    angles = torch.where(angles < lower, 2 * lower - angles, angles)
    return torch.minimum(torch.maximum(angles, lower), upper)
