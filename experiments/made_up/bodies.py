"""Bodies with one bending skin: people and four-legged animals of any proportions."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import torch

from torchreg._checks import check_positive
from torchreg.datasets.figures import SIDES, Figure, Part, meshed_figure
from torchreg.datasets.solids import RoundCone, Vector, ball

# Angles of arms and legs from the trunk in the rest pose, so that they do not fuse with it; gaits undo them.
REST_ARM, REST_LEG = math.radians(40), math.radians(5)


@dataclass(frozen=True)
class Proportions:
    """Factors on the measures of a body, all 1 by default.

    Args:
        size: of everything.
        legs: length of the legs.
        arms: length of the arms, or of neck and head of an animal.
        trunk: length of the trunk.
        shoulders: width of the shoulders.
        hips: width of the hips.
        belly: girth of the trunk.
        limbs: girth of the limbs.
        head: size of the head.

    Raises:
        InputError: if one is not positive.
    """

    size: float = 1.0
    legs: float = 1.0
    arms: float = 1.0
    trunk: float = 1.0
    shoulders: float = 1.0
    hips: float = 1.0
    belly: float = 1.0
    limbs: float = 1.0
    head: float = 1.0

    def __post_init__(self) -> None:
        for field in fields(self):
            check_positive(getattr(self, field.name), field.name)

    @classmethod
    def random(cls, generator: torch.Generator | None = None, spread: float = 0.12) -> Proportions:
        """Return factors drawn evenly (in logarithms) between ``1 / (1 + spread)`` and ``1 + spread``.

        Args:
            generator: source of randomness; None draws from a fresh generator with seed 0.
            spread: largest relative deviation.
        """
        check_positive(spread, "spread", allow_zero=True)
        generator = torch.Generator().manual_seed(0) if generator is None else generator
        names = [field.name for field in fields(cls)]
        draws = 2 * torch.rand(len(names), generator=generator, dtype=torch.float64) - 1
        factors = torch.exp(math.log1p(spread) * draws).tolist()
        return replace(cls(), **dict(zip(names, factors, strict=True)))


def person(proportions: Proportions | None = None, *, spacing: float = 0.02) -> Figure:
    """Return a standing person of 13 parts and 1.75 m, arms and legs a little apart, looking along +z with y up.

    Parts: pelvis, torso, head, and on each side upper arm, forearm (with the hand), thigh, shin and foot. Bone lengths
    are those of an average adult.

    Args:
        proportions: factors on those; all 1 by default.
        spacing: of the mesh, metres (before ``size``).

    References: Drillis and Contini 1966, the shares of body height.

    Cost: 0.5 s.
    """
    shape = Proportions() if proportions is None else proportions
    hip, waist = 0.93 * shape.legs, 0.93 * shape.legs + 0.15 * shape.trunk
    parts = [*_trunk(shape, hip, waist)]
    for side, sign in SIDES.items():
        parts += [*_arm(shape, side, sign, waist + 0.33 * shape.trunk), *_leg(shape, side, sign, hip)]
    return _sized(parts, shape.size, spacing)


def _trunk(shape: Proportions, hip: float, waist: float) -> list[Part]:
    girth, hips, wide = shape.belly, 0.085 * shape.hips, 0.085 * shape.shoulders
    neck = waist + 0.38 * shape.trunk
    across = waist + 0.335 * shape.trunk
    pelvis = (
        RoundCone((-hips, hip + 0.03, -0.01), (hips, hip + 0.03, -0.01), 0.1 * girth, 0.1 * girth),
        RoundCone((0, hip + 0.03, 0), (0, waist, 0), 0.1 * girth, 0.105 * girth),
        *(ball((s * 0.8 * hips, hip, -0.05), 0.08 * girth) for s in (-1, 1)),
    )
    torso = (
        *(
            RoundCone((s * 0.05, waist + 0.03, 0), (s * wide, waist + 0.25 * shape.trunk, 0), 0.09 * girth, 0.1 * girth)
            for s in (-1, 1)
        ),
        RoundCone((0, waist + 0.03, 0.01), (0, waist + 0.28 * shape.trunk, 0.01), 0.09 * girth, 0.1 * girth),
        RoundCone((-2 * wide, across, -0.01), (2 * wide, across, -0.01), 0.055, 0.055),
    )
    size = shape.head
    face = (
        RoundCone((0, neck + 0.14 * size, 0), (0, neck + 0.19 * size, -0.005), 0.085 * size, 0.092 * size),
        ball((0, neck + 0.08 * size, 0.05 * size), 0.045 * size),
        RoundCone((0, neck + 0.13 * size, 0.09 * size), (0, neck + 0.16 * size, 0.085 * size), 0.02, 0.015),
        RoundCone((0, neck - 0.02, -0.01), (0, neck + 0.1 * size, 0), 0.055, 0.052),
    )
    return [
        Part("pelvis", None, (0, hip, 0), pelvis),
        Part("torso", "pelvis", (0, waist, 0), torso),
        Part("head", "torso", (0, neck + 0.02, 0), face),
    ]


def _arm(shape: Proportions, side: str, sign: float, height: float) -> list[Part]:
    outward, down, thick = sign * math.sin(REST_ARM), -math.cos(REST_ARM), shape.limbs

    def along(length: float, forward: float = 0.0) -> Vector:
        start = 0.19 * shape.shoulders
        return sign * start + length * shape.arms * outward, height + length * shape.arms * down, forward

    upper = (
        RoundCone(along(0), along(0.08), 0.058, 0.053 * thick),
        RoundCone(along(0.08), along(0.32), 0.053 * thick, 0.04 * thick),
    )
    forearm = (
        RoundCone(along(0.32), along(0.39), 0.041 * thick, 0.044 * thick),
        RoundCone(along(0.39), along(0.575), 0.044 * thick, 0.028 * thick),
        RoundCone(along(0.6, -0.018), along(0.74, -0.015), 0.026, 0.02),
        RoundCone(along(0.6, 0.018), along(0.74, 0.015), 0.026, 0.02),
        RoundCone(along(0.6, 0.03), along(0.68, 0.06), 0.02, 0.017),
    )
    return [
        Part(f"{side} upper arm", "torso", along(0), upper),
        Part(f"{side} forearm", f"{side} upper arm", along(0.32), forearm),
    ]


def _leg(shape: Proportions, side: str, sign: float, hip: float) -> list[Part]:
    thick, start = shape.limbs, 0.095 * shape.hips

    def along(length: float, forward: float = 0.0) -> Vector:
        reach = length * shape.legs
        return sign * (start + reach * math.sin(REST_LEG)), hip - reach * math.cos(REST_LEG), forward

    ankle = along(0.85)
    sole = (ankle[0] + sign * 0.02, 0.03, 0.12)
    thigh = (RoundCone(along(0.03), along(0.43), 0.088 * thick, 0.055 * thick),)
    shin = (
        RoundCone(along(0.43), along(0.85, -0.01), 0.055 * thick, 0.036 * thick),
        RoundCone(along(0.5, -0.02), along(0.6, -0.02), 0.045 * thick, 0.05 * thick),
    )
    foot = (
        ball((ankle[0], 0.042, -0.045), 0.042),
        RoundCone((ankle[0], 0.055, -0.01), sole, 0.04, 0.03),
        RoundCone(sole, (sole[0], 0.028, 0.17), 0.034, 0.025),
    )
    return [
        Part(f"{side} thigh", "pelvis", along(0), thigh),
        Part(f"{side} shin", f"{side} thigh", along(0.43), shin),
        Part(f"{side} foot", f"{side} shin", (ankle[0], ankle[1], -0.01), foot),
    ]


def quadruped(proportions: Proportions | None = None, *, spacing: float = 0.02) -> Figure:
    """Return a standing four-legged animal of 17 parts and 1.4 m length, looking along +z with y up.

    Parts: chest, rump, neck, head, tail, and three for each leg: "front left thigh", "... shin", "... foot" and so on.

    Args:
        proportions: factors on its measures; all 1 by default.
        spacing: of the mesh, metres (before ``size``).

    Cost: 0.5 s.
    """
    shape = Proportions() if proportions is None else proportions
    back, half = 0.75 * shape.legs, 0.36 * shape.trunk
    parts = _long_trunk(shape, back, half)
    for side, sign in SIDES.items():
        parts += _animal_leg(shape, f"front {side}", "chest", (sign * 0.085 * shape.shoulders, back - 0.09, half))
        parts += _animal_leg(shape, f"hind {side}", "rump", (sign * 0.085 * shape.hips, back - 0.07, -half))
    return _sized(parts, shape.size, spacing)


def _long_trunk(shape: Proportions, back: float, half: float) -> list[Part]:
    girth, reach, size = shape.belly, shape.arms, shape.head
    nape = (0.0, back + 0.26 * reach, half + 0.26 * reach)
    muzzle = (0.0, nape[1] - 0.11 * size, nape[2] + 0.21 * size)
    chest = (
        RoundCone((0, back - 0.03, 0.02), (0, back - 0.03, half), 0.145 * girth, 0.15 * girth),
        ball((0, back + 0.05, half - 0.05), 0.11 * girth),
    )
    rump = (
        RoundCone((0, back - 0.01, -0.02), (0, back, -half), 0.135 * girth, 0.14 * girth),
        *(ball((s * 0.05, back - 0.02, -half), 0.12 * girth) for s in (-1, 1)),
    )
    neck = (RoundCone((0, back + 0.05, half + 0.05), nape, 0.105 * girth, 0.065 * size),)
    crown = nape[1] + 0.06 * size
    ears = (
        RoundCone(
            (0.045 * s * size, crown, nape[2]), (0.06 * s * size, crown + 0.08 * size, nape[2] - 0.01), 0.024, 0.015
        )
        for s in (-1, 1)
    )
    head = (RoundCone((0, nape[1] + 0.02, nape[2] + 0.02), muzzle, 0.07 * size, 0.042 * size), *ears)
    tail = (RoundCone((0, back + 0.07, -half - 0.1), (0, back - 0.25, -half - 0.28), 0.035, 0.022),)
    return [
        Part("chest", None, (0, back, 0.5 * half), chest),
        Part("rump", "chest", (0, back, 0), rump),
        Part("neck", "chest", (0, back + 0.05, half + 0.05), neck),
        Part("head", "neck", nape, head),
        Part("tail", "rump", (0, back + 0.07, -half - 0.1), tail),
    ]


def _animal_leg(shape: Proportions, name: str, parent: str, top: Vector) -> list[Part]:
    """Return the three parts of a leg from ``top`` down to the ground."""
    x, height, z = top
    thick = shape.limbs
    knee: Vector = (1.12 * x, 0.58 * height, z + 0.02)
    ankle: Vector = (1.12 * x, 0.17 * height, z - 0.01)
    toe: Vector = (1.12 * x, 0.03, z + 0.05)
    return [
        Part(f"{name} thigh", parent, top, (RoundCone(top, knee, 0.085 * thick, 0.05 * thick),)),
        Part(f"{name} shin", f"{name} thigh", knee, (RoundCone(knee, ankle, 0.05 * thick, 0.032 * thick),)),
        Part(f"{name} foot", f"{name} shin", ankle, (RoundCone(ankle, toe, 0.033 * thick, 0.036 * thick),)),
    ]


def _sized(parts: list[Part], size: float, spacing: float) -> Figure:
    """Return the figure of the parts, larger by ``size``."""
    # Seams of 1.5 cm, and skin that bends over 8 cm.
    figure = meshed_figure(parts, spacing=spacing, blend=0.015, softness=0.02)
    mesh = replace(figure.mesh, vertices=size * figure.mesh.vertices)
    return replace(figure, mesh=mesh, joints=size * figure.joints)
