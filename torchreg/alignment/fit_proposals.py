"""Proposed poses on the data: a coarse fit of several per cloud in one batch, and the choice of the best."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.alignment.limb_search import distinct_first, take_rows
from torchreg.alignment.objectives import GaussianPosePrior, RegistrationObjective
from torchreg.alignment.pose_proposer import Proposals
from torchreg.alignment.pose_search import PoseSearch, fit_candidates, mean_distances, score_candidates
from torchreg.alignment.problem import AlignProblem, joint_precision
from torchreg.solvers.e_step import EStep


@dataclass(frozen=True)
class _Fit:
    """Numbers of the fit; widths are shares of the model's size."""

    kept: int = 2  # most probable proposals, beside that fitted to matches
    surface_std: float = 0.015  # of where the network says that a datum lies on the shape
    sigma: float = 0.02  # of a datum about the model point
    reach: tuple[float, ...] = (0.15, 0.08)  # by which a datum may be off in the rounds after the first
    joint_std: float = 0.35  # of the network's joints that no datum shows, radians
    matched_steps: int = 2  # in each round
    widths: tuple[float, ...] = (0.05, 0.03, 0.02)  # of the kernel, from what a proposal errs by to a searched pose's
    steps: int = 2  # at each width
    score_width: float = 0.022  # as in the search
    same: float = 0.05  # fitted poses whose points differ by less are duplicates


_FIT = _Fit()


@torch.no_grad()
def best_proposal(problem: AlignProblem, proposals: Proposals) -> tuple[Tensor, Tensor]:
    """Return the pose (B, num_dofs) that explains most data after a coarse fit, and its lead (B,) over other ones.

    Args:
        problem: the batch.
        proposals: for its data.
    """
    coarse = PoseSearch(problem, torch.Generator().manual_seed(0)).coarse_problem
    first = problem.clamp_candidates(proposals.poses[:, : _FIT.kept])
    matched = matched_pose(problem, proposals, first[:, 0]).unsqueeze(1)
    fitted, scores = _coarsely_fitted(coarse, torch.cat([matched, first], dim=1))
    apart = mean_distances(coarse, fitted)[:, 0] > _FIT.same * problem.size
    share = problem.valid.sum(-1) / coarse.valid.sum(-1).clamp_min(1)
    lead = torch.where(apart, scores, torch.inf).amin(1) - scores[:, 0]
    return fitted[:, 0], lead * share


@torch.no_grad()
def best_proposals(problem: AlignProblem, proposals: Proposals, count: int) -> Tensor:
    """Return the ``count`` poses (B, count, num_dofs) that explain most data after a coarse fit, different ones first.

    All that are proposed are fitted, each also to the matches; without as many the last one repeats.

    Args:
        problem: the batch.
        proposals: for its data.
        count: of poses.
    """
    coarse = PoseSearch(problem, torch.Generator().manual_seed(0)).coarse_problem
    poses = problem.clamp_candidates(proposals.poses)
    number = poses.shape[1]
    matched = matched_pose(problem.repeated(number), proposals.repeated(number), poses.flatten(0, 1))
    fitted, _ = _coarsely_fitted(coarse, torch.cat([poses, matched.reshape(poses.shape)], dim=1))
    close = mean_distances(coarse, fitted) < _FIT.same * problem.size
    order = distinct_first(close)[:, :count]
    return take_rows(fitted, torch.cat([order, order[:, -1:].expand(-1, count - order.shape[1])], dim=1))


def _coarsely_fitted(coarse: AlignProblem, poses: Tensor) -> tuple[Tensor, Tensor]:
    """Return poses (B, K, num_dofs) after a coarse fit, best first, and their scores (B, K)."""
    fitted = fit_candidates(coarse, poses, _FIT.widths, _FIT.steps)
    scores, order = score_candidates(coarse, fitted, _FIT.score_width).sort(dim=1, stable=True)
    return take_rows(fitted, order), scores


def matched_pose(problem: AlignProblem, proposals: Proposals, pose: Tensor) -> Tensor:
    """Return poses (B, num_dofs) in which a shape's points lie where a network says that the data are on it.

    An EM from proposed poses (B, num_dofs), which are the prior of joints that no datum shows: to a model point belong
    the data near to it on the shape at rest, as far as the pose takes it near to them.
    """
    skin, sigma = problem.skin, _FIT.sigma * problem.size
    near = torch.cdist(proposals.surface, skin.points).square()
    told = (near / (-2 * (_FIT.surface_std * problem.size) ** 2)).softmax(-1) * proposals.inlier.unsqueeze(-1)
    prior = GaussianPosePrior(pose, joint_precision(skin.shape, problem.size, _FIT.joint_std))
    for width in (None, *_FIT.reach):
        weight = told
        if width is not None:
            far = torch.cdist(proposals.points, skin(pose)) / (width * problem.size)
            weight = told * (-0.5 * far.square()).exp()
        total = weight.sum(1)
        targets = weight.mT @ proposals.points / total.clamp_min(1e-9).unsqueeze(-1)
        matches = EStep(total, targets, weight.sum(2), torch.zeros_like(total[:, 0]))
        objective = RegistrationObjective(skin, matches, torch.full_like(pose[:, 0], sigma), prior)
        for _ in range(_FIT.matched_steps):
            pose = problem.step(objective(pose), pose).state
    return pose
