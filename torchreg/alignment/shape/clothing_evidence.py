"""Whether a fitted body wears clothes: the evidence for a body with clothes and for one without."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.alignment.evidence.curvature import correlated_count, neighbor_correlation
from torchreg.alignment.fit.surface_fit import surface_noise
from torchreg.alignment.shape.clothing import CLOTH
from torchreg.alignment.shape.person_covariance import noise_covariance
from torchreg.alignment.shape.shape_problem import ShapeProblem

Fit = Callable[[ShapeProblem, Tensor], Tensor]


@dataclass(frozen=True)
class _Mixture:
    """Numbers of the mixture of data on the surface, normally distributed, and of others, evenly distributed."""

    reach: float = 0.1  # of the others, to both sides, as a share of the size
    steps: int = 20  # of EM, which hardly changes the likelihood further
    bare_std: float = 0.2  # of the modes of clothes on bare skin: errors of a body's model, 2 to 3 mm


_MIXTURE = _Mixture()


def are_clothes_likelier(problem: ShapeProblem, state: Tensor, fit: Fit) -> bool:
    """Return whether the data are likelier with clothes, whose coefficients are the last of states (T, D + K).

    Both hypotheses are fitted from the states, those of a bare person in mean clothes: the skin of a bare person is off
    the model by as much as bodies are. Evidence by Laplace's approximation (MacKay 1992): data that err together under
    either count once, and a hypothesis pays for the volume of its prior that the data exclude.
    """
    bare, naked = _bare(problem), state.clone()
    naked[:, -CLOTH.num_modes :] = 0
    naked, state = fit(bare, naked), fit(problem, state)
    likelihoods, shared = zip(*(_likelihood(problem, each) for each in (naked, state)), strict=True)
    gained = float(likelihoods[1] - likelihoods[0]) / max(shared)
    return gained + _prior_evidence(problem, state) - _prior_evidence(bare, naked) > 0


def _bare(problem: ShapeProblem) -> ShapeProblem:
    """Return the problem of a bare person."""
    prior = problem.prior
    worn = torch.arange(prior.precision.shape[-1]) >= prior.precision.shape[-1] - CLOTH.num_modes
    skin = replace(
        prior, mean=torch.where(worn, 0.0, prior.mean),
        precision=torch.where(worn, _MIXTURE.bare_std**-2, prior.precision),
    )  # fmt: skip
    return replace(problem, prior=skin)


def _prior_evidence(problem: ShapeProblem, state: Tensor) -> float:
    """Return the prior's density at states (T, D + K) times the posterior's volume of clothes, as a logarithm."""
    posterior = noise_covariance(problem, state)[0, -CLOTH.num_modes :, -CLOTH.num_modes :].double()
    precision = problem.prior.precision[..., -CLOTH.num_modes :].double()
    volume = torch.linalg.slogdet(posterior).logabsdet + precision.log().sum()
    return 0.5 * float(volume) - float(problem.prior.cost(state).sum())


def _likelihood(problem: ShapeProblem, state: Tensor) -> tuple[Tensor, float]:
    """Return the log-likelihood () of data about the surface in states, and how many of them err as one."""
    distance = problem.surface.distance(problem.data, state)
    noise = surface_noise(distance, problem.valid, problem.size).unsqueeze(-1)
    share, elsewhere = torch.full_like(noise, 0.5), 1 / (2 * _MIXTURE.reach * problem.size)
    squares = distance.square()
    for _ in range(_MIXTURE.steps):
        on = share * (-0.5 * squares / noise.square()).exp() / (math.sqrt(2 * math.pi) * noise)
        total = on + (1 - share) * elsewhere
        posterior = on / total * problem.valid
        count = posterior.sum(-1, keepdim=True).clamp_min(1)
        share = count / problem.valid.sum(-1, keepdim=True)
        noise = ((posterior * torch.where(posterior > 0, squares, 0.0)).sum(-1, keepdim=True) / count).sqrt()
    shared = correlated_count(neighbor_correlation(problem.data, distance, posterior))
    return (total.log() * problem.valid).sum(), float(shared.mean())
