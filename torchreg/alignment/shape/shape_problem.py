"""Alignments of poses together with shape coefficients, which the scans of one person share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.alignment.fit.objectives import Objective
from torchreg.alignment.fit.problem import AlignProblem, alignment_cost
from torchreg.shapes.shaped import ShapedSkin
from torchreg.shapes.shaped_surface import ShapedSurface
from torchreg.solvers.arrow import join_shared
from torchreg.solvers.levenberg_marquardt import (
    Linearization,
    LMResult,
    damped_step,
    held_at_limits,
    levenberg_marquardt,
)


@dataclass(frozen=True)
class ShapeProblem(AlignProblem):
    """Alignments whose degrees of freedom end with shape coefficients, shared by successive rows, ``scans`` each."""

    skin: ShapedSkin  # type: ignore[assignment]
    surface: ShapedSurface
    scans: int = 1

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

    def solve(
        self, objective: Objective, pose: Tensor, max_steps: int, around: Linearization, damping: Tensor | None = None
    ) -> LMResult:
        """Return the result of Levenberg-Marquardt, see `AlignProblem.solve`, with coefficients shared."""
        if self.scans == 1:
            return super().solve(objective, pose, max_steps, around, damping)
        low, high = self._joined_limits()
        found = levenberg_marquardt(
            lambda state: self._joined(objective(self._split(state))), self._together(pose), retract=self._retract,
            lower=low, upper=high, damping=damping, max_steps=max_steps, atol=self.pose_atol * min(1.0, self.size),
            start=self._joined(around),
        )  # fmt: skip
        return self._spread(found)

    def step(self, around: Linearization, pose: Tensor, damping: float = 1e-3) -> LMResult:
        """Return the result of one damped step, see `AlignProblem.step`, with coefficients shared."""
        if self.scans == 1:
            return super().step(around, pose, damping)
        joined, state = self._joined(around), self._together(pose)
        low, high = self._joined_limits()
        shares = torch.full_like(state[:, 0], damping)
        step, _ = damped_step(joined, shares, frozen=held_at_limits(joined.gradient, state, low, high))
        moved = torch.minimum(torch.maximum(self._retract(state, step), low), high)
        return self._spread(LMResult(moved, joined.cost, shares, step, 1))

    @property
    def _dofs(self) -> int:
        return self.skin.shape.rig.num_dofs

    def _together(self, rows: Tensor) -> Tensor:
        """Return rows (S T, D + K) as one state a person, (S, T D + K)."""
        grouped = rows.unflatten(0, (-1, self.scans))
        return torch.cat([grouped[..., : self._dofs].flatten(1), grouped[:, 0, self._dofs :]], dim=-1)

    def _split(self, state: Tensor) -> Tensor:
        """Return states (S, T D + K) as rows (S T, D + K)."""
        poses, coefficients = state.tensor_split([self.scans * self._dofs], dim=-1)
        shared = coefficients.unsqueeze(1).expand(-1, self.scans, -1)
        return torch.cat([poses.unflatten(1, (self.scans, -1)), shared], dim=-1).flatten(0, 1)

    def _retract(self, state: Tensor, step: Tensor) -> Tensor:
        return self._together(self.skin.shape.retract(self._split(state), self._split(step)))

    def _joined_limits(self) -> tuple[Tensor, Tensor]:
        low, high = (limit.expand(self.scans, -1) for limit in (self.lower, self.upper))
        return self._together(low)[0], self._together(high)[0]

    def _joined(self, rows: Linearization) -> Linearization:
        """Return the least-squares problem (S, T D + K) of people from that of their scans (S T, D + K)."""
        return join_shared(Linearization(*(value.unflatten(0, (-1, self.scans)) for value in rows)), self._dofs)

    def _spread(self, found: LMResult) -> LMResult:
        """Return a result over people as one over their scans."""
        cost, damping = (value.repeat_interleave(self.scans) for value in (found.cost, found.damping))
        return LMResult(self._split(found.state), cost, damping, self._split(found.last_step), found.num_steps)
