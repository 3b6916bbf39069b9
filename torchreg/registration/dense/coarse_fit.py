"""A coarse fit of the deformation graph to a learnt matcher's matches, by an EM that keeps them as prior."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.geometry.rigid import fit_rigid, transform_points
from torchreg.registration.annealing import geometric_at
from torchreg.registration.dense.graph_fit import fit_graph
from torchreg.registration.dense.match_prior import MatchPrior
from torchreg.registration.dense.problem import ScanAlignProblem
from torchreg.registration.dense.stages import Reporter, match_tokens
from torchreg.solvers.robust import geman_mcclure_weight

# Rounds in which matches that do not fit a rigid motion count less and less.
_ROUNDS = 5


def fit_coarsely(problem: ScanAlignProblem, reporter: Reporter) -> Tensor:
    """Return motions (J, 4, 4) of the nodes, however far the source moved or was turned.

    A sample i matches a target j with ``q_ij = p_ij N_ij / (sum_k p_ik N_ik + h_i / A)``, N_ij a Gaussian of their
    distance: the matcher's posterior p stays the prior of every match to the end, and what it calls hidden, h, is the
    outlier class, spread over the squared size A. Targets choose among samples alike. While sigma shrinks, normals
    count ever more, and the graph softens.

    References: Myronenko and Song 2010, for the EM with an outlier class.
    """
    plan = problem.config.coarse
    transforms = rigid_start(problem.prior, problem.source.points, problem.target.points, plan.sigma[0])
    transforms = transforms.repeat(problem.graph.num_nodes, 1, 1)
    for step in range(plan.num_steps):
        share = step / max(plan.num_steps - 1, 1)
        sigma, stiffness = geometric_at(plan.sigma, share), geometric_at(plan.stiffness, share)
        matches = match_tokens(problem, transforms, sigma, share)
        fit = fit_graph(problem.graph, transforms, matches, stiffness, edge_scale=problem.config.edge_scale)
        transforms = fit.transforms
        reporter.report("match", step, plan.num_steps, sigma, fit, stiffness, float(matches.weights.mean()))
    return transforms


def rigid_start(prior: MatchPrior, source: Tensor, target: Tensor, width: float) -> Tensor:
    """Return the motion (4, 4) of all of a source that suits most of the matches of the matcher."""
    mass = prior.by_source.sum(1)
    targets = prior.by_source @ target[: prior.by_source.shape[1]]
    targets = targets / mass.clamp_min(torch.finfo(mass.dtype).tiny).unsqueeze(1)
    tokens, weights = source[: len(mass)], mass
    for _ in range(_ROUNDS):
        motion = fit_rigid(tokens, targets, weights)
        apart = (transform_points(motion, tokens) - targets).square().sum(-1)
        weights = mass * geman_mcclure_weight(apart / width**2)
    return motion
