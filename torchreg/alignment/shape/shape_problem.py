"""Alignments of poses together with shape coefficients, which the scans of one person share."""

from __future__ import annotations

from dataclasses import dataclass, replace

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

    def rows(self, index: Tensor) -> ShapeProblem:
        """Return the problems of some rows of the batch."""
        chosen: ShapeProblem = super().rows(index)  # type: ignore[assignment]
        return replace(chosen, surface=self.surface.with_normals(chosen.data_normals()))

    def people(self, index: Tensor) -> Tensor:
        """Return the rows (S T,) of some people (S,)."""
        return (index.unsqueeze(-1) * self.scans + torch.arange(self.scans)).flatten()

    def data_normals(self) -> Tensor:
        """Return the normals (B, M, 3) of the data."""
        return torch.zeros_like(self.data) if self.normals is None else self.normals

    def sample(self, count: int, generator: torch.Generator) -> ShapeProblem:
        """Return the problem with at most so many data of every scan, the same for all people."""
        draw = torch.rand(self.scans, self.valid.shape[1], generator=generator).to(self.data)
        draw = draw.repeat(len(self.data) // self.scans, 1)
        keep = torch.where(self.valid, draw, -1.0).topk(min(count, draw.shape[-1]), dim=-1).indices
        index = keep.unsqueeze(-1).expand(*keep.shape, 3)
        normals = self.data_normals().gather(1, index)
        return replace(
            self, data=self.data.gather(1, index), valid=self.valid.gather(1, keep), normals=normals,
            surface=self.surface.with_normals(normals),
        )  # fmt: skip

    def cost_of_people(self, state: Tensor) -> Tensor:
        """Return the cost (S,) by which people are ranked."""
        return alignment_cost(self, state).unflatten(0, (-1, self.scans)).sum(-1)

    @property
    def shared(self) -> SharedRows:
        """The scans of a person share coefficients."""
        return SharedRows(self.skin.shape.retract, self.scans, self.skin.shape.rig.num_dofs)
