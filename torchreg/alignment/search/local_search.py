"""Searching around a start when plain descent leaves part of the data unexplained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchreg.alignment.evidence.clusters import clustered_data, leaves_clusters
from torchreg.alignment.evidence.confidence import explains
from torchreg.alignment.evidence.reliability import CALIBRATION
from torchreg.alignment.fit.problem import AlignProblem
from torchreg.alignment.search.multi_start import Candidates, align_rows
from torchreg.alignment.search.pose_search import PoseSearch
from torchreg.shapes.limbs import Limb, find_limbs
from torchreg.shapes.pose_algebra import BASE_DOFS, difference
from torchreg.shapes.surface import SkinSurface


@dataclass(frozen=True)
class _Trust:
    """Limits of a descent beyond which its minimum may be a wrong one."""

    motion: float = 0.2  # of the base or the joints, radians: beyond, limbs are placed anew from its end
    far_motion: float = 0.32  # the same: beyond, candidates all around its start are tried, too
    gain: float = 1.0  # in data explained by placing limbs anew: beyond, the same
    clusters: float = 0.06  # data in unexplained clusters after that, as a share of those on the surface: the same


@dataclass(frozen=True)
class _Scatter:
    """Scatter of candidates around a pose: standard deviations, and limbs that are drawn uniformly."""

    joints: float = 0.2  # as a share of their range
    max_joints: float = 0.4  # radians or metres
    turn: float = 0.17  # of the base, radians
    shift: float = 0.035  # of the base, as a share of the model's size
    redrawn_limbs: float = 0.25  # share of the limbs that are drawn uniformly
    reach: float = 3.0  # standard deviations of the joints of such a limb, at most: beyond lies 1 in 400


@dataclass(frozen=True)
class _Around:
    """Numbers of the search all around a start."""

    placed_share: float = 0.35  # of the candidates, the best, whose limbs are placed
    num_refined: int = 3  # candidates that are refined thoroughly, at most


_TRUST = _Trust()
_SCATTER = _Scatter()
_AROUND = _Around()


def needs_search(problem: AlignProblem, start: Tensor, pose: Tensor) -> Tensor:
    """Return a mask (B,) of problems with which a single descent cannot be trusted.

    Either it went far from its start, where other minima are as near; or it leaves an unexplained cluster of data. Of a
    skinned rig it is what data it leaves unexplained alone: a redundant bone of its spine may turn far.
    """
    if isinstance(problem.surface, SkinSurface):
        return explains(problem, pose, torch.full_like(pose[:, 0], torch.inf)) < CALIBRATION.doubtful
    return (_motion(start, pose) > _TRUST.motion) | leaves_clusters(problem, pose)


def _motion(start: Tensor, pose: Tensor) -> Tensor:
    """Return the motion (B,) between poses, radians: of the base, or the joints' RMS or half their largest."""
    step = difference(start, pose)
    joints = pad(step[:, BASE_DOFS:].abs(), (0, 1))
    moved = torch.maximum(joints.square().mean(-1).sqrt(), 0.5 * joints.amax(-1))
    return torch.maximum(moved, step[:, 3:BASE_DOFS].norm(dim=-1))


def explore(
    problem: AlignProblem, start: Tensor, descended: Tensor, *, candidates: int, rounds: int, generator: torch.Generator
) -> Tensor:
    """Return the best poses (B, num_dofs) found around starts; the problems of a batch are searched together.

    Limbs are placed anew from the poses ``descended`` from the starts. Where that shows that one was in a wrong
    minimum, ``candidates`` per problem are scattered around the start and the best pose so far, and go through
    `PoseSearch`, the last stage at most ``rounds`` times. Of a skinned rig half as many are scattered at once, and all
    of their joints aligned, see `align_rows`. The draws for a problem do not depend on the others.
    """
    if isinstance(problem.surface, SkinSurface):
        return _aligned_around(problem, start, descended, candidates, generator)
    search = PoseSearch(problem, generator)
    before = search.fitted_score(descended)
    poses, scores = search.refine(descended.unsqueeze(1), 1)
    best, score = poses[:, 0], scores[:, 0]
    clustered, near = clustered_data(search.problem, best)
    doubtful = (before - score > _TRUST.gain) | (clustered > _TRUST.clusters * near)
    rows = (doubtful | (_motion(start, best) > _TRUST.far_motion)).nonzero()[:, 0]
    if len(rows) == 0:
        return best
    found, value = _search_around(search.rows(rows), start[rows], best[rows], candidates, rounds, generator)
    better = (value < score[rows]).unsqueeze(-1)
    best[rows] = torch.where(better, found, best[rows])
    return best


def _aligned_around(
    problem: AlignProblem, start: Tensor, descended: Tensor, candidates: int, generator: torch.Generator
) -> Tensor:
    """Return the best poses of rigs whose candidates around the starts and the descents are aligned whole."""
    limbs, count = find_limbs(problem.skin.shape)[0], max(1, candidates // 4)
    pool = [_scatter(problem, limbs, center, count, generator) for center in (start, descended)]
    aligned = align_rows(problem, torch.cat(pool, dim=1), _AROUND.num_refined, generator)
    return Candidates.fitted(problem, aligned).poses[:, 0]


def _search_around(
    search: PoseSearch, start: Tensor, best: Tensor, candidates: int, rounds: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Return the poses found from candidates around the starts and the best poses so far, and scores (B,)."""
    scattered = [
        _scatter(search.problem, search.limbs.limbs, center, max(1, candidates // 2), generator)
        for center in (start, best)
    ]
    pool = search.fit_coarsely(torch.cat([*scattered, best.unsqueeze(1)], dim=1))
    placed = search.prune(pool[:, : max(1, round(_AROUND.placed_share * pool.shape[1]))], _AROUND.num_refined)
    poses, scores = search.refine(placed[:, :1], rounds)
    found, value = poses[:, 0], scores[:, 0]
    rows = leaves_clusters(search.problem, found).nonzero()[:, 0]
    if len(rows) and placed.shape[1] > 1:
        poses, scores = search.rows(rows).refine(placed[rows, 1:], rounds)
        better = scores[:, 0] < value[rows]
        found[rows] = torch.where(better.unsqueeze(-1), poses[:, 0], found[rows])
        value[rows] = torch.minimum(scores[:, 0], value[rows])
    return found, value


def _scatter(
    problem: AlignProblem, limbs: Sequence[Limb], center: Tensor, count: int, generator: torch.Generator
) -> Tensor:
    """Return (B, count, num_dofs) candidates; the first is the center itself."""
    shape = problem.skin.shape
    scale = (_SCATTER.joints * (shape.upper - shape.lower)).clamp_max(_SCATTER.max_joints)
    scale[:3], scale[3:BASE_DOFS] = _SCATTER.shift * problem.size, _SCATTER.turn
    scale = problem.cap_std_by_prior(scale).unsqueeze(1)
    noise = torch.randn(count, shape.num_dofs, generator=generator, dtype=torch.float32).to(center)
    noise[0] = 0
    around = shape.retract(center.unsqueeze(1).expand(-1, count, -1), noise * scale)
    lower, upper = problem.plausible_limits(_SCATTER.reach)
    reach = _SCATTER.reach * _SCATTER.max_joints
    span = (upper - lower).clamp_max(2 * reach)
    low = torch.minimum(torch.maximum(center - reach, lower), upper - span)
    redrawn = low.unsqueeze(1) + span.unsqueeze(1) * torch.rand(
        noise.shape, generator=generator, dtype=torch.float32
    ).to(center)
    for limb in limbs:
        is_redrawn = torch.rand(count, 1, generator=generator, dtype=torch.float32).to(center) < _SCATTER.redrawn_limbs
        is_redrawn[0] = False
        around[..., limb.dofs] = torch.where(is_redrawn, redrawn[..., limb.dofs], around[..., limb.dofs])
    return problem.clamp_candidates(around)
