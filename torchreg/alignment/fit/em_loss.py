"""The EM objective of soft correspondences as a differentiable loss, in bounded memory."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import Function

from torchreg._checks import check_choice, check_positive, check_same_kind, check_shape
from torchreg.errors import InputError, InputTypeError
from torchreg.solvers.e_step import (
    OUTLIER_CONSTANT,
    chunks,
    expectation,
    gaussian_kernel,
    outlier_constant,
    posterior,
    working_volume,
)


class EMLoss(nn.Module):
    """Negative log-likelihood of data under a Gaussian on every posed point and an outlier class.

    ``E = -sum_j log(sum_i exp(-|Y_j - T_i|^2 / 2 sigma^2) + c)``. Its gradient in a posed point is that of the expected
    squared error (eq. 19) at the posterior of that point, ``lambda_i (T_i - G_i) / sigma^2``.

    Args:
        sigma: kernel width, metres; a tensor (...) gives every problem of a batch its own and moves with the module.
        outlier: c, or "volume" for eq. 18 with the bounding box of data and posed points, grown by 3 sigma. Either is a
            constant to the gradient.
        reduction: "sum" over the data, or "mean" over those that are not masked.

    Raises:
        InputError: if ``sigma`` or ``outlier`` is not positive and finite, or ``reduction`` is unknown.
        InputTypeError: if ``sigma`` or ``outlier`` is not a number.

    References: Dewaele et al. 2006, eqs. 17-20.
    """

    sigma: Tensor | float

    def __init__(
        self, sigma: float | Tensor, *, outlier: float | str = OUTLIER_CONSTANT, reduction: str = "sum"
    ) -> None:
        super().__init__()
        check_choice(reduction, "reduction", ("sum", "mean"))
        if isinstance(outlier, str):
            check_choice(outlier, "outlier", ("volume",))
        else:
            check_positive(outlier, "outlier")
        if isinstance(sigma, Tensor):
            if not sigma.is_floating_point():
                raise InputTypeError(f"sigma must hold floating-point numbers, got dtype {sigma.dtype}")
            if not bool(((sigma > 0) & torch.isfinite(sigma)).all()):
                raise InputError("sigma must be positive and finite in every entry; use a small one for exact matches")
            self.register_buffer("sigma", sigma)
        else:
            check_positive(sigma, "sigma")
            self.sigma = float(sigma)
        self.outlier = outlier
        self.reduction = reduction

    def extra_repr(self) -> str:
        """Return the settings for the module's printed form."""
        sigma = f"{self.sigma:g}" if isinstance(self.sigma, float) else tuple(self.sigma.shape)
        return f"sigma={sigma}, outlier={self.outlier}, reduction={self.reduction!r}"

    def forward(self, posed_points: Tensor, data: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return the loss of every problem of the batch.

        Args:
            posed_points: (..., N, 3), metres.
            data: (..., M, 3), metres, of the same dtype, with batch dimensions that broadcast.
            mask: (..., M) bool, False where a datum is padding, whose coordinates are never looked at.

        Returns:
            (...).

        Raises:
            InputError: if a shape does not fit, or there are no points.
            InputTypeError: if the dtypes or devices differ, or the mask is not boolean.

        Differentiable: in ``posed_points``, ``data`` and a tensor ``sigma``, in reverse and forward mode, under
        ``torch.func``, and twice.

        Cost: O(N M) time. Memory is bounded in the forward and the backward pass, except when differentiating twice.
        """
        batch = _check(posed_points, data, mask)
        sigma = self._sigma(posed_points)
        outlier = self._constant(posed_points, data, sigma, mask)
        batch = torch.broadcast_shapes(batch, sigma.shape)
        flat, num_points, num_data = math.prod(batch), posed_points.shape[-2], data.shape[-2]
        origin = posed_points.detach().mean(-2, keepdim=True)
        scale = (2**-0.5 / sigma)[..., None, None]
        data_offset = data - origin
        if mask is not None:
            data_offset = torch.where(mask.unsqueeze(-1), data_offset, 0.0)
        model = ((posed_points - origin) * scale).expand(*batch, num_points, 3).reshape(flat, num_points, 3)
        target = (data_offset * scale).expand(*batch, num_data, 3).reshape(flat, num_data, 3)
        levels = _LogLikelihood.apply(model, target, outlier.expand(batch).reshape(flat)).reshape(*batch, num_data)
        if mask is None:
            return -(levels.sum(-1) if self.reduction == "sum" else levels.mean(-1))
        total = torch.where(mask, levels, 0.0).sum(-1)
        return -total if self.reduction == "sum" else -total / mask.sum(-1).clamp_min(1)

    def posterior(self, posed_points: Tensor, data: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return the full posterior alpha (..., N, M), eq. 17.

        Args:
            posed_points: (..., N, 3), metres.
            data: (..., M, 3), metres.
            mask: (..., M) bool, False where a datum is padding; its column is zero.

        Returns:
            (..., N, M); columns sum to the probability that the datum is an inlier.

        Raises:
            InputError: if a shape does not fit, or there are no points.
            InputTypeError: if the dtypes or devices differ, or the mask is not boolean.

        Differentiable: in ``posed_points``, ``data`` and a tensor ``sigma``.

        Cost: O(N M) memory.
        """
        _check(posed_points, data, mask)
        sigma = self._sigma(posed_points)
        return posterior(posed_points, data, sigma, self._constant(posed_points, data, sigma, mask), mask=mask)

    def virtual_observations(
        self, posed_points: Tensor, data: Tensor, mask: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return lambda_i and G_i, the mass and the mean of the data matched to every posed point, eq. 20.

        Args:
            posed_points: (..., N, 3), metres.
            data: (..., M, 3), metres.
            mask: (..., M) bool, False where a datum is padding.

        Returns:
            weights (..., N), and targets (..., N, 3) in metres: the posed point itself where no datum matches it.

        Raises:
            InputError: if a shape does not fit, or there are no points.
            InputTypeError: if the dtypes or devices differ, or the mask is not boolean.

        Differentiable: no; the M-step holds them fixed.

        Cost: O(N M) time, bounded memory.
        """
        batch = _check(posed_points, data, mask)
        sigma = self._sigma(posed_points)
        batch = torch.broadcast_shapes(batch, sigma.shape)
        constant = self._constant(posed_points, data, sigma, mask)
        posed_points = posed_points.expand(*batch, *posed_points.shape[-2:])
        matches = expectation(posed_points, data, sigma, constant, mask=mask)
        return matches.weights, matches.targets

    def _sigma(self, like: Tensor) -> Tensor:
        return torch.as_tensor(self.sigma, dtype=like.dtype, device=like.device)

    def _constant(self, posed_points: Tensor, data: Tensor, sigma: Tensor, mask: Tensor | None) -> Tensor:
        if not isinstance(self.outlier, str):
            return torch.as_tensor(self.outlier, dtype=posed_points.dtype, device=posed_points.device)
        with torch.no_grad():
            fixed = sigma.detach()
            volume = working_volume(posed_points.detach(), data.detach(), fixed, mask)
            return outlier_constant(posed_points.shape[-2], fixed, volume)


def _check(posed_points: Tensor, data: Tensor, mask: Tensor | None) -> torch.Size:
    """Raise unless the arguments fit together; return the batch shape."""
    check_shape(posed_points, "posed_points", ("N", 3), batch=True)
    check_shape(data, "data", ("M", 3), batch=True)
    check_same_kind(posed_points, "posed_points", data, "data")
    for points, name in ((posed_points, "posed_points"), (data, "data")):
        if points.shape[-2] == 0:
            raise InputError(f"{name} must hold at least 1 point(s), got 0")
    if mask is not None:
        if mask.dtype != torch.bool:
            raise InputTypeError(f"mask must be boolean, got dtype {mask.dtype}; compare it with zero")
        check_shape(mask, "mask", (data.shape[-2],), batch=True)
    shapes = [posed_points.shape[:-2], data.shape[:-2], *([] if mask is None else [mask.shape[:-1]])]
    try:
        return torch.broadcast_shapes(*shapes)
    except RuntimeError as error:
        raise InputError(f"batch dimensions of points, data and mask must broadcast, got {shapes}") from error


class _LogLikelihood(Function):
    """``log(sum_i exp(-|x_i - y_j|^2) + c)`` of points x (B, N, 3), data y (B, M, 3) and c (B,): (B, M).

    Nothing of size N M is kept: each pass computes the kernel again in chunks, into one buffer for all of a batch.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(model: Tensor, data: Tensor, outlier: Tensor) -> Tensor:
        levels = torch.zeros_like(data[..., 0] + model[:, :1, 0] + outlier.unsqueeze(-1))
        for part in _parts(model, data):
            levels[:, part] = (_kernel(model, data[:, part]).sum(-2) + outlier.unsqueeze(-1)).log()
        return levels

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        model, data, outlier = ctx.saved_tensors
        mixed = grad[:, :1, None] + model[:, :1] + data[:, :1] + outlier[:, None, None]
        model_grad, data_grad = torch.zeros_like(model + mixed), torch.zeros_like(data + mixed)
        sources = _with_one(model)
        for part in _parts(model, data):
            targets = _with_one(data[:, part])
            kernel = _kernel(model, data[:, part])
            model_sums = kernel.mT @ sources
            share = (2 * grad[:, part] / (model_sums[..., 3] + outlier.unsqueeze(-1))).unsqueeze(-1)
            data_sums = kernel @ (share * targets)
            # With a_ij the shares of the kernel: sum_j a_ij (y_j - x_i), and sum_i a_ij (x_i - y_j).
            model_grad += data_sums[..., :3] - data_sums[..., 3:] * model
            data_grad[:, part] = share * (model_sums[..., :3] - model_sums[..., 3:] * targets[..., :3])
        return model_grad, data_grad, None

    @staticmethod
    def jvp(ctx: Any, model_t: Tensor | None, data_t: Tensor | None, outlier_t: Tensor | None) -> Tensor:
        model, data, outlier = ctx.saved_tensors
        model_t = torch.zeros_like(model) if model_t is None else model_t
        data_t = torch.zeros_like(data) if data_t is None else data_t
        mixed = (model + model_t)[:, :1, 0] + outlier.unsqueeze(-1)
        levels_t = torch.zeros_like((data + data_t)[..., 0] + mixed)
        sources = torch.cat([_with_one(model), model_t, (model * model_t).sum(-1, keepdim=True)], dim=-1)
        for part in _parts(model, data):
            target, target_t = data[:, part], data_t[:, part]
            sums = _kernel(model, target).mT @ sources
            # d(-|x - y|^2) = -2 (x - y) . (dx - dy), its four products summed over i.
            total = sums[..., 3]
            crossed = (sums[..., 4:7] * target + (sums[..., :3] - total.unsqueeze(-1) * target) * target_t).sum(-1)
            levels_t[:, part] = 2 * (crossed - sums[..., 7]) / (total + outlier.unsqueeze(-1))
        return levels_t


def _with_one(points: Tensor) -> Tensor:
    return torch.cat([points, torch.ones_like(points[..., :1])], dim=-1)


def _parts(model: Tensor, data: Tensor) -> Iterator[slice]:
    """Return slices of the data for each of which the kernel of all problems fits into memory."""
    return (columns for _, columns in chunks(1, model.shape[0] * model.shape[1], data.shape[1]))


def _kernel(model: Tensor, data: Tensor) -> Tensor:
    """Return ``exp(-|x - y|^2)`` (B, N, m), by differences: exact however far the points are from each other."""
    if not torch.is_grad_enabled():
        return gaussian_kernel(model, data)
    squares = (model.unsqueeze(-2) - data.unsqueeze(-3)).square().sum(-1)
    return squares.neg().exp()
