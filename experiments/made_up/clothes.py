"""Clothes over the skin of a body: shirts and trousers of random cut and thickness, with folds."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

import torchreg as tr

# What the names of the parts of a body begin with, as anny names them.
TRUNK = ("pelvis", "spine", "clavicle", "shoulder", "breast")
ARM, LEG = ("upperarm", "lowerarm"), ("upperleg", "lowerleg")
# First joint of a limb, and the one after its last part.
ARM_ENDS, LEG_ENDS = ("upperarm01", "wrist"), ("upperleg01", "foot")


@dataclass(frozen=True)
class Cloth:
    """Numbers of clothes."""

    hem: float = 0.02  # width in which cloth ends, as a share of a limb
    fold: float = 0.08  # size of folds, metres
    depth: float = 0.35  # standard deviation of the logarithm of thickness among folds
    waves: int = 64  # of which folds are the sum
    arm: float = 0.7  # thickness about an arm, as a share of that about the trunk
    rounds: int = 3  # of smoothing over neighbors


CLOTH = Cloth()


@dataclass(frozen=True)
class Outfit:
    """A shirt and trousers.

    Args:
        shirt: distance of its cloth from the skin, metres.
        trousers: the same.
        sleeves: how far they reach along the arm, from 0 to 1.
        legs: how far trousers reach along the leg.
    """

    shirt: float
    trousers: float
    sleeves: float
    legs: float

    @classmethod
    def random(cls, generator: torch.Generator, thinnest: float = 0.005, thickest: float = 0.04) -> Outfit:
        """Return one drawn evenly, of cloth between two distances from the skin, metres."""
        shirt, trousers, sleeves, legs = torch.rand(4, generator=generator).tolist()
        span = thickest - thinnest
        return cls(thinnest + span * shirt, thinnest + span * trousers, 0.1 + 0.9 * sleeves, 0.2 + 0.8 * legs)

    def offset(self, body: tr.ArticulatedShape, generator: torch.Generator) -> Tensor:
        """Return the distance (V,) of cloth from the skin of a body at rest, metres: none at face, hands and feet.

        Args:
            body: whose parts are named as those of anny.
            generator: of the folds.
        """
        pose, surface = body.rest_pose(), body.file_surface()
        vertices, weights = body(pose).points.double(), surface.weights.double()
        joints = dict(zip(body.part_names, body.keypoints(pose).double(), strict=True))

        def on(names: tuple[str, ...], side: str = "") -> Tensor:
            chosen = [name.startswith(names) and name.endswith(side) for name in body.part_names]
            return weights[:, torch.tensor(chosen)].sum(-1)

        above_waist = torch.sigmoid((vertices[:, 2] - joints["spine05"][2]) / CLOTH.hem)
        offset = on(TRUNK) * (above_waist * self.shirt + (1 - above_waist) * max(self.shirt, self.trousers))
        for names, ends, length, thickness in (
            (ARM, ARM_ENDS, self.sleeves, CLOTH.arm * self.shirt),
            (LEG, LEG_ENDS, self.legs, self.trousers),
        ):
            for side in (".L", ".R"):
                first, last = (joints[end + side] for end in ends)
                along = (vertices - first) @ (last - first) / (last - first).square().sum()
                offset += on(names, side) * thickness * torch.sigmoid((length - along) / CLOTH.hem)
        return offset * (CLOTH.depth * _folds(vertices, generator)).exp()


def _folds(points: Tensor, generator: torch.Generator) -> Tensor:
    """Return a smooth random function (V,) of points, of variance one (Rahimi and Recht 2007)."""
    waves = torch.randn(CLOTH.waves, 3, generator=generator, dtype=torch.float64) / CLOTH.fold
    phases = 2 * math.pi * torch.rand(CLOTH.waves, generator=generator, dtype=torch.float64)
    return math.sqrt(2 / CLOTH.waves) * (points @ waves.mT + phases).cos().sum(-1)


def dressed(skin: tr.TriangleMesh, offset: Tensor) -> tr.TriangleMesh:
    """Return the surface of a posed skin moved outward by clothes (V,), metres, and smoothed where it is covered."""
    normals = torch.nn.functional.normalize(_smoothed(skin, skin.vertex_normals()), dim=-1)
    cloth = _smoothed(skin, offset.to(skin.vertices).unsqueeze(-1))
    return tr.TriangleMesh(skin.vertices + cloth * normals, skin.faces)


def _smoothed(mesh: tr.TriangleMesh, values: Tensor) -> Tensor:
    """Return values (V, C) averaged over the neighbors of each vertex, some times."""
    first, second = torch.cat([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]).unbind(-1)
    count = torch.bincount(first, minlength=len(values)).clamp_min(1).unsqueeze(-1)
    for _ in range(CLOTH.rounds):
        values = torch.zeros_like(values).index_add(0, first, values[second]) / count
    return values
