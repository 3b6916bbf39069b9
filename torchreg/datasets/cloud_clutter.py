"""What lies around a shape in made-up clouds: a table or a wall, things near it, a thing that it holds; in batches."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchreg.geometry.rotation_representations import rotation_from_quaternion


@dataclass(frozen=True)
class _Clutter:
    """Things around a shape; lengths are shares of its size."""

    samples: int = 600  # oriented points of each thing
    least: float = 0.03  # half a side of a thing, the shortest
    largest: float = 0.35
    near: tuple[float, float] = (0.3, 1.0)  # distance of a thing that stands near
    plane: float = 0.9  # radius of what is drawn of a plane
    behind: tuple[float, float] = (0.05, 0.8)  # distance of the plane from the middle of the shape


_CLUTTER = _Clutter()
Oriented = tuple[Tensor, Tensor]


@dataclass(frozen=True, eq=False)
class Clutter:
    """Draws oriented points (B, P, 3) and their normals about shapes of a size in metres, as of a tensor like."""

    generator: torch.Generator
    like: Tensor
    size: float

    def held(self, surface: Tensor, normals: Tensor) -> Oriented:
        """Return things that touch surfaces (B, N, 3) with normals at one of their points."""
        rows = torch.arange(len(surface), device=surface.device)
        pick = (surface.shape[1] * self._uniform(len(surface))).long().clamp_max(surface.shape[1] - 1)
        half = self._sides(len(surface))
        middle = surface[rows, pick] + half.amin(-1, keepdim=True) * normals[rows, pick]
        return self._things(half, middle)

    def near(self, middle: Tensor) -> Oriented:
        """Return things that stand near middles (B, 3)."""
        low, high = _CLUTTER.near
        away = self.size * (low + (high - low) * self._uniform(len(middle), 1))
        return self._things(self._sides(len(middle)), middle + away * normalize(self._normal(len(middle), 3), dim=-1))

    def plane(self, middle: Tensor) -> Oriented:
        """Return a table or a wall that a camera far along -z sees behind middles (B, 3)."""
        batch, count = len(middle), _CLUTTER.samples
        normal = normalize(self._normal(batch, 3), dim=-1)
        normal = normal * torch.where(normal[:, 2:] > 0, -1.0, 1.0)
        low, high = _CLUTTER.behind
        foot = middle - self.size * (low + (high - low) * self._uniform(batch, 1)) * normal
        spread = self._normal(batch, count, 3)
        along = normalize(spread - (spread * normal.unsqueeze(1)).sum(-1, keepdim=True) * normal.unsqueeze(1), dim=-1)
        radius = _CLUTTER.plane * self.size * self._uniform(batch, count, 1).sqrt()
        return foot.unsqueeze(1) + radius * along, normal.unsqueeze(1).expand(-1, count, -1)

    def _sides(self, batch: int) -> Tensor:
        """Return half the sides (B, 3) of things, metres."""
        low, high = math.log(_CLUTTER.least), math.log(_CLUTTER.largest)
        return self.size * (low + (high - low) * self._uniform(batch, 3)).exp()

    def _things(self, half: Tensor, middle: Tensor) -> Oriented:
        """Return boxes, cans and balls about middles (B, 3) with half their sides (B, 3), turned at random."""
        kinds = [self._boxes(half), self._cans(half), self._balls(half)]
        kind = (len(kinds) * self._uniform(len(half))).long().clamp_max(len(kinds) - 1)
        rows = torch.arange(len(half), device=half.device)
        points, normals = (torch.stack(each)[kind, rows] for each in zip(*kinds, strict=True))
        turn = rotation_from_quaternion(self._normal(len(half), 4)).mT
        return points @ turn + middle.unsqueeze(1), normals @ turn

    def _boxes(self, half: Tensor) -> Oriented:
        area = half.prod(-1, keepdim=True) / half
        axis = torch.multinomial(area.cpu(), _CLUTTER.samples, replacement=True, generator=self._host())
        facing = torch.nn.functional.one_hot(axis.to(half.device), 3).to(half)
        side = torch.where(self._uniform(*axis.shape, 1) < 0.5, -1.0, 1.0)
        inside = 2 * self._uniform(*axis.shape, 3) - 1
        normals = side * facing
        return half.unsqueeze(1) * torch.where(facing > 0, normals, inside), normals

    def _cans(self, half: Tensor) -> Oriented:
        radius, long = half[:, None, :1], half[:, None, 2:]
        batch, count = len(half), _CLUTTER.samples
        around = normalize(self._normal(batch, count, 2), dim=-1)
        on_cap = self._uniform(batch, count, 1) < radius / (radius + 2 * long)
        height = 2 * self._uniform(batch, count, 1) - 1
        inward = self._uniform(batch, count, 1).sqrt()
        up = torch.where(on_cap, height.sign(), 0.0)
        points = torch.cat(
            [radius * torch.where(on_cap, inward, 1.0) * around, long * torch.where(on_cap, up, height)], dim=-1
        )
        return points, torch.cat([torch.where(on_cap, 0.0, around), up], dim=-1)

    def _balls(self, half: Tensor) -> Oriented:
        normals = normalize(self._normal(len(half), _CLUTTER.samples, 3), dim=-1)
        return half[:, None, :1] * normals, normals

    def _host(self) -> torch.Generator:
        """Return a generator on the CPU, where rows are drawn by weight."""
        seed = torch.randint(2**31, (), generator=self.generator, device=self.generator.device)
        return torch.Generator().manual_seed(int(seed))

    def _uniform(self, *size: int) -> Tensor:
        return torch.rand(size, generator=self.generator, device=self.generator.device).to(self.like)

    def _normal(self, *size: int) -> Tensor:
        return torch.randn(size, generator=self.generator, device=self.generator.device).to(self.like)
