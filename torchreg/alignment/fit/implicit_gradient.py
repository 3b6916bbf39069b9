"""The pose of a surface fit as a fixed point: its energy, exact Newton steps, gradients by the implicit function."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchreg.geometry.rotation import left_jacobian, so3_exp
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.pose_algebra import BASE_DOFS, difference, retract
from torchreg.shapes.shaped import ShapedTree
from torchreg.shapes.surface import ShapeSurface
from torchreg.solvers.levenberg_marquardt import held_at_limits
from torchreg.solvers.robust import welsch_loss

# Curvatures below this share of the largest, once every variable is scaled to a unit diagonal, are rounding.
_FLAT = {torch.float32: 1e-6, torch.float64: 1e-12}


@dataclass(frozen=True)
class FixedPoint:
    """The energy (21, 22) that the surface fit of a batch of clouds minimizes at its last width, about a start.

    ``E(pose) = sum_j s^2 (1 - exp(-d(Y_j, pose)^2 / s^2)) / (2 noise^2) + sum_k p_k (pose - start)_k^2 / 2``, with the
    difference of base rotations by composition; s is sigma (B,), p precision (num_dofs,). Dewaele et al. 2006.
    """

    shape: ArticulatedShape | ShapedTree
    surface: ShapeSurface
    valid: Tensor
    sigma: Tensor
    noise: Tensor
    precision: Tensor
    lower: Tensor
    upper: Tensor

    @property
    def parameters(self) -> list[Tensor]:
        """The parameters of the shape that take gradients."""
        return [value for value in self.shape.parameters() if value.requires_grad]

    def energy(self, step: Tensor, pose: Tensor, data: Tensor, start: Tensor) -> Tensor:
        """Return the energy (B,) at poses moved by tangent steps (B, num_dofs), see `ArticulatedShape.retract`."""
        turn = step[:, 3:BASE_DOFS]
        joints = pose[:, BASE_DOFS:] + step[:, BASE_DOFS:]
        # The step of the base is taken by the data, backwards: then no rotation of the pose is special.
        local_data = (data - (pose[:, :3] + step[:, :3]).unsqueeze(1)) @ so3_exp(turn)
        local_pose = torch.cat([torch.zeros_like(turn), pose[:, 3:BASE_DOFS], joints], dim=-1)
        distance = self.surface.distance(local_data, local_pose)
        losses = welsch_loss((distance / self.sigma.unsqueeze(-1)).square())
        cost = 0.5 * (losses * self.valid).sum(-1) * (self.sigma / self.noise).square()
        offset = retract(difference(start, pose), step)
        return cost + 0.5 * (self.precision * offset.square()).sum(-1)

    def derivatives(self, pose: Tensor, data: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gradient (B, num_dofs), still differentiable, and the exact Hessian, without a graph."""
        with torch.enable_grad():
            step = torch.zeros_like(pose, requires_grad=True)
            energy = self.energy(step, pose.detach(), data, start)
            (gradient,) = torch.autograd.grad(energy.sum(), step, create_graph=True)
            rows = [
                torch.autograd.grad(gradient[:, k].sum(), step, retain_graph=True)[0] for k in range(pose.shape[-1])
            ]
        hessian = torch.stack(rows, dim=-2)
        return gradient, 0.5 * (hessian + hessian.mT)

    def free(self, pose: Tensor, gradient: Tensor) -> Tensor:
        """Return a mask (B, num_dofs) of the variables that are not at a limit which holds them."""
        return ~held_at_limits(gradient, pose, self.lower, self.upper)

    def newton_steps(self, pose: Tensor, data: Tensor, start: Tensor, steps: int) -> Tensor:
        """Return the pose (B, num_dofs) after Newton steps, each kept where it lowers the norm of the gradient."""
        pose, data, start = pose.detach(), data.detach(), start.detach()
        best = torch.full_like(pose[:, 0], torch.inf)
        kept, trial = pose, pose
        for number in range(steps + 1):
            gradient, hessian = self.derivatives(trial, data, start)
            gradient = gradient.detach()
            free = self.free(trial, gradient)
            scale = hessian.diagonal(dim1=-2, dim2=-1).abs().clamp_min(torch.finfo(pose.dtype).tiny).rsqrt()
            norm = (gradient * scale * free).norm(dim=-1)
            better = (norm < best).unsqueeze(-1)
            kept, best = torch.where(better, trial, kept), torch.minimum(norm, best)
            if number == steps:
                break
            step = -solve_symmetric(hessian, gradient, free)
            moved = self.shape.retract(kept, torch.where(better, step, 0.0))
            trial = torch.minimum(torch.maximum(moved, self.lower), self.upper).detach()
        return kept


def solve_symmetric(matrix: Tensor, right: Tensor, free: Tensor) -> Tensor:
    """Return x (B, D) with ``matrix x = right`` over the ``free`` variables; zero in others and without curvature."""
    matrix, free_right = matrix.double(), right.double() * free
    diagonal = matrix.diagonal(dim1=-2, dim2=-1).abs()
    idle = ~free | (diagonal <= torch.finfo(torch.float64).tiny)
    scale = diagonal.masked_fill(idle, 1.0).rsqrt().masked_fill(idle, 0.0)
    values, vectors = torch.linalg.eigh(matrix * scale.unsqueeze(-1) * scale.unsqueeze(-2))
    largest = values.abs().amax(-1, keepdim=True).clamp_min(torch.finfo(torch.float64).tiny)
    curved = values.abs() > _FLAT[right.dtype] * largest
    inverse = torch.where(curved, 1 / values.masked_fill(~curved, 1.0), 0.0)
    inner = (vectors.mT @ (free_right * scale).unsqueeze(-1)) * inverse.unsqueeze(-1)
    return ((vectors @ inner).squeeze(-1) * scale).to(right.dtype)


def attach_gradients(problem: FixedPoint, pose: Tensor, data: Tensor, start: Tensor) -> Tensor:
    """Return a stationary pose (B, num_dofs) with its gradients in data, start and the shape's parameters.

    By the implicit function theorem ``d pose / d p = -H^-1 dg / dp`` over the variables within their limits, with
    correspondences and widths fixed (Krantz and Parks 2003; Gould et al. 2016).
    """
    return _Implicit.apply(problem, pose.detach(), data, start, *problem.parameters)


class _Implicit(torch.autograd.Function):
    """The identity on a stationary pose, with the implicit function's gradients."""

    @staticmethod
    def forward(
        ctx: Any, problem: FixedPoint, pose: Tensor, data: Tensor, start: Tensor, *parameters: Tensor
    ) -> Tensor:
        ctx.problem = problem
        # Also the parameters, so that autograd notices if they are changed before the backward pass.
        ctx.save_for_backward(pose, data, start, *parameters)
        return pose.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        problem: FixedPoint = ctx.problem
        pose, data, start = ctx.saved_tensors[:3]
        data, start = data.detach().requires_grad_(), start.detach().requires_grad_()
        gradient, hessian = problem.derivatives(pose, data, start)
        free = problem.free(pose, gradient.detach())
        adjoint = solve_symmetric(hessian, _to_tangent(upstream, pose), free)
        inputs = [data, start, *problem.parameters]
        grads = torch.autograd.grad(gradient, inputs, -adjoint, allow_unused=True)
        needs = ctx.needs_input_grad[2:]
        return (None, None, *(grad if needed else None for grad, needed in zip(grads, needs, strict=True)))


def _to_tangent(upstream: Tensor, pose: Tensor) -> Tensor:
    """Return gradients in pose vectors as gradients in tangent steps: the base's rotation vector moves by J^-1 step."""
    jacobian = left_jacobian(pose[:, 3:BASE_DOFS])
    turn = torch.linalg.solve(jacobian.mT, upstream[:, 3:BASE_DOFS].unsqueeze(-1)).squeeze(-1)
    return torch.cat([upstream[:, :3], turn, upstream[:, BASE_DOFS:]], dim=-1)
