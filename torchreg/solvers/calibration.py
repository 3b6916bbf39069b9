"""Logistic models of probabilities that are calibrated on labeled cases."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Logistic:
    """The log-odds ``bias - sum_k weight_k e_k`` of evidence ``e`` (..., E), of which more speaks against."""

    bias: float
    weights: tuple[float, ...]

    def log_odds(self, evidence: Tensor) -> Tensor:
        """Return the logarithms of the odds (...)."""
        return self.bias - evidence @ evidence.new_tensor(self.weights)

    def probability(self, evidence: Tensor) -> Tensor:
        """Return the probabilities (...)."""
        return self.log_odds(evidence).sigmoid()


@dataclass(frozen=True)
class _Fit:
    """How a logistic model is fitted."""

    ridge: float = 0.0015  # of squared weights, relative to the mean log-likelihood
    steps: int = 200  # of the optimizer, at most
    start: float = 0.5  # of all weights
    moved: float = 2.0  # standard deviation of bias and weights about those of a model that is known before, log-odds


_FIT = _Fit()


def fit_logistic(
    evidence: Tensor,
    right: Tensor,
    weights: Tensor | None = None,
    before: Logistic | None = None,
    held: Sequence[int] = (),
) -> Logistic:
    """Return the logistic model of highest likelihood with weights of at least zero, and a ridge or a prior.

    Args:
        evidence: (N, E).
        right: (N,) bool.
        weights: (N,) of the cases; all alike by default.
        before: the model fitted to other cases, the mean of the prior; few cases move it little.
        held: numbers of the evidence whose weights stay those of the model before.

    References: Platt 1999.
    """
    table = torch.cat([torch.ones(len(evidence), 1, dtype=torch.float64), -evidence.double()], dim=1)
    shares = torch.ones_like(table[:, 0]) if weights is None else weights.double()
    shares = shares / shares.sum()
    free = torch.full((table.shape[1],), _FIT.start, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([free], max_iter=_FIT.steps, line_search_fn="strong_wolfe")

    known, is_held = torch.zeros_like(free), torch.zeros_like(free, dtype=torch.bool)
    if before is not None:
        known, is_held[[1 + number for number in held]] = known.new_tensor([before.bias, *before.weights]), True

    def model() -> Tensor:
        return torch.where(is_held, known, torch.cat([free[:1], torch.nn.functional.softplus(free[1:])]))

    def loss() -> Tensor:
        optimizer.zero_grad()
        kept = model()
        losses = torch.nn.functional.binary_cross_entropy_with_logits(table @ kept, right.double(), reduction="none")
        penalty = _FIT.ridge * kept[1:].square().mean()
        if before is not None:
            penalty = 0.5 * ((kept - known) / _FIT.moved).square().sum() / len(evidence)
        value = losses @ shares + penalty
        value.backward()
        return value

    optimizer.step(loss)
    bias, *kept = model().detach().tolist()
    return Logistic(round(bias, 2), tuple(round(weight, 2) for weight in kept))
