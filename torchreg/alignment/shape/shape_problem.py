"""Alignments of poses together with shape coefficients, which the scans of one person share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from torchreg.alignment.fit.problem import AlignProblem, alignment_cost
from torchreg.shapes.shaped import ShapedSkin
from torchreg.shapes.shaped_surface import ShapedSurface
from torchreg.solvers.arrow import SharedRows


@dataclass(frozen=True)
class ShapeProblem(AlignProblem):
    """Alignments whose degrees of freedom end with shape coefficients, shared by successive rows, ``scans`` each."""

    skin: ShapedSkin  # type: ignore[assignment]
    surface: ShapedSurface

    def rows(self, index: Tensor) -> Self:
        """Return the problems of some rows of the batch."""
        chosen = super().rows(index)
        return replace(chosen, surface=self.surface.with_normals(chosen.data_normals()))

    def people(self, index: Tensor) -> Tensor:
        """Return the rows (S T,) of some people (S,)."""
        return (index.unsqueeze(-1) * self.scans + torch.arange(self.scans)).flatten()

    def data_normals(self) -> Tensor:
        """Return the normals (B, M, 3) of the data."""
        return torch.zeros_like(self.data) if self.normals is None else self.normals

    def kept(self, index: Tensor) -> Self:
        """Return the problem with the data (B, C) of an index, that stand for all."""
        chosen = super().kept(index)
        return replace(chosen, surface=self.surface.with_normals(chosen.data_normals()))

    def cost_of_people(self, state: Tensor) -> Tensor:
        """Return the cost (S,) by which people are ranked."""
        return alignment_cost(self, state).unflatten(0, (-1, self.scans)).sum(-1)

    @property
    def shared(self) -> SharedRows:
        """The scans of a person share coefficients."""
        return SharedRows(self.skin.shape.retract, self.scans, self.skin.shape.rig.num_dofs)
