"""Searching around a start when plain descent leaves part of the data unexplained."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchreg.alignment.annealed_em import residual_noise
from torchreg.alignment.pose_search import PoseSearch
from torchreg.alignment.problem import AlignProblem
from torchreg.shapes.pose_algebra import difference

_FIT_STEPS = 2
# Scatter of the candidates: joints as a share of their range, base in radians, base as a share of the size.
_JOINT_SCATTER, _MAX_JOINT_SCATTER = 0.2, 0.4
_TURN_SCATTER, _SHIFT_SCATTER = 0.17, 0.035
# One limb in four of a candidate is placed anywhere within this many radians of the start and its limits.
_FRESH_LIMBS, _FRESH_REACH = 0.25, 1.2
# Share of the candidates whose limbs are placed, and how many are searched thoroughly.
_PLACED_SHARE, _NUM_SEARCHED = 0.35, 3
# Data on which a candidate is measured with its limbs in several places; entries of a table held at a time.
_DATA_PER_CANDIDATE = 500
_CHUNK_ENTRIES = 4_000_000
# A thorough search from where the descent ended shows that it was lost if it gains more than this many data, or still
# leaves more than this share of them in clusters.
_DOUBTFUL_GAIN, _DOUBTFUL_CLUSTERS = 1.0, 0.06
# Widths of the surface fit that follows a search, whose poses are near already.
FINAL_SIGMAS = (0.022,)
# Unexplained data count as a cluster with this many others within four nearest-neighbor distances.
_CLUSTER_NEIGHBORS = 5
_CLUSTER_RADIUS = 4.0
# Data are off the surface beyond this many deviations of the noise, and this share of the size: skins are not exact.
_FAR_NOISES, _FAR_SHARE = 3.0, 0.012
# A descent that went farther than this, in radians, is looked at; one that went farther than the second is not trusted.
_TRUSTED_MOTION, _LOST_MOTION = 0.2, 0.32
_CLUSTER_SHARE, _CLUSTER_MIN = 0.015, 5
_MAX_CLUSTERED = 2000


def needs_search(problem: AlignProblem, start: Tensor, pose: Tensor) -> Tensor:
    """Return which problems (B,) a single descent cannot be trusted with.

    Either it went far from its start, where other minima are as near; or it leaves a dense cluster of data off the
    surface: outliers are thin in space, a limb that was missed is as dense as the rest.
    """
    return (_motion(start, pose) > _TRUSTED_MOTION) | leaves_clusters(problem, pose)


def _motion(start: Tensor, pose: Tensor) -> Tensor:
    """Return how far (B,) poses lie apart, radians: of the base, of the joints (root mean square), of one at half."""
    step = difference(start, pose)
    joints = torch.nn.functional.pad(step[:, 6:].abs(), (0, 1))
    moved = torch.maximum(joints.square().mean(-1).sqrt(), 0.5 * joints.amax(-1))
    return torch.maximum(moved, step[:, 3:6].norm(dim=-1))


def leaves_clusters(problem: AlignProblem, pose: Tensor) -> Tensor:
    """Return which poses (B,) leave clusters of data off the surface that are worth a search."""
    clustered, near = clustered_data(problem, pose)
    return clustered > (_CLUSTER_SHARE * near).clamp_min(_CLUSTER_MIN)


def clustered_data(problem: AlignProblem, pose: Tensor) -> tuple[Tensor, Tensor]:
    """Return how many data (B,) lie off the surface as densely as others lie on it, and how many lie on it."""
    if problem.data.shape[-2] > _MAX_CLUSTERED:
        problem = _thinned(problem, _MAX_CLUSTERED)
    distance = problem.surface.distance(problem.data, pose).abs()
    noise = residual_noise(problem, pose)
    beyond = (_FAR_NOISES * noise).clamp_min(_FAR_SHARE * problem.size)
    far = (distance > beyond.unsqueeze(-1)) & problem.valid
    squares = _squared_distances(problem.data)
    squares.diagonal(dim1=-2, dim2=-1).fill_(torch.inf)
    spacing = torch.where(~far & problem.valid, squares.amin(-1), torch.nan).nanmedian(-1).values.sqrt()
    radius = torch.nan_to_num(_CLUSTER_RADIUS * spacing, nan=0.0).clamp_max(0.1 * problem.size)
    close = (squares < radius.square()[:, None, None]) & far.unsqueeze(-2)
    clustered = far & (close.sum(-1) >= _CLUSTER_NEIGHBORS)
    return clustered.sum(-1), (~far & problem.valid).sum(-1)


def _squared_distances(data: Tensor) -> Tensor:
    norms = data.square().sum(-1)
    return (norms.unsqueeze(-1) + norms.unsqueeze(-2) - 2 * data @ data.mT).clamp_min_(0)


def _thinned(problem: AlignProblem, count: int) -> AlignProblem:
    """Return the problem with every k-th datum, so that at most about ``count`` are left."""
    stride = -(-problem.data.shape[-2] // count)
    return replace(problem, data=problem.data[:, ::stride], valid=problem.valid[:, ::stride])


def explore(
    problem: AlignProblem,
    start: Tensor,
    descended: Tensor,
    *,
    candidates: int,
    rounds: int,
    generator: torch.Generator,
) -> Tensor:
    """Return the best poses found around the starts; the problems of a batch are searched together.

    Limbs are placed anew where the descent ended. Where that shows that it was lost, candidates are scattered around
    the start and what became of it, and fitted in one batch; the funnel of `PoseSearch` does the rest.

    Args:
        problem: the batch.
        start: (B, num_dofs).
        descended: (B, num_dofs) what a single descent made of the starts.
        candidates: per problem.
        rounds: of the thorough search, at most.
        generator: of the scatter and of the data looked at.

    Returns:
        (B, num_dofs).
    """
    per_problem = candidates * _DATA_PER_CANDIDATE * problem.skin.shape.num_parts
    rows = torch.arange(len(start), device=start.device).split(max(1, _CHUNK_ENTRIES // per_problem))
    state, found = generator.get_state(), []
    for row in rows:
        # What is drawn for a problem does not depend on the others.
        generator.set_state(state)
        found.append(_explore(problem.rows(row), start[row], descended[row], candidates, rounds, generator))
    return torch.cat(found)


def _explore(
    problem: AlignProblem, start: Tensor, descended: Tensor, candidates: int, rounds: int, generator: torch.Generator
) -> Tensor:
    """Search thoroughly from where the descent ended; where that changes or leaves much, from all around."""
    search = PoseSearch(problem, generator)
    before = search.fitted_score(descended)
    poses, scores = search.settle(descended.unsqueeze(1), 1)
    best, score = poses[:, 0], scores[:, 0]
    clustered, near = clustered_data(search.problem, best)
    doubtful = (before - score > _DOUBTFUL_GAIN) | (clustered > _DOUBTFUL_CLUSTERS * near)
    rows = (doubtful | (_motion(start, best) > _LOST_MOTION)).nonzero()[:, 0]
    if len(rows) == 0:
        return best
    found, value = _search_around(search.rows(rows), start[rows], best[rows], candidates, rounds, generator)
    better = (value < score[rows]).unsqueeze(-1)
    best[rows] = torch.where(better, found, best[rows])
    return best


def _search_around(
    search: PoseSearch, start: Tensor, best: Tensor, candidates: int, rounds: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Return what the funnel makes of candidates around starts and the best poses so far, and the scores (B,)."""
    scattered = [_scatter(search, center, max(1, candidates // 2), generator) for center in (start, best)]
    pool = search.attract(torch.cat([*scattered, best.unsqueeze(1)], dim=1), _FIT_STEPS)
    narrowed = search.narrow(pool[:, : max(1, round(_PLACED_SHARE * pool.shape[1]))], _NUM_SEARCHED)
    poses, scores = search.settle(narrowed[:, :1], rounds)
    found, value = poses[:, 0], scores[:, 0]
    rows = leaves_clusters(search.problem, found).nonzero()[:, 0]
    if len(rows) and narrowed.shape[1] > 1:
        poses, scores = search.rows(rows).settle(narrowed[rows, 1:], rounds)
        better = scores[:, 0] < value[rows]
        found[rows] = torch.where(better.unsqueeze(-1), poses[:, 0], found[rows])
        value[rows] = torch.minimum(scores[:, 0], value[rows])
    return found, value


def _scatter(search: PoseSearch, center: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return (B, count, num_dofs) candidates; the first is the center itself."""
    problem = search.problem
    shape = problem.skin.shape
    scale = (_JOINT_SCATTER * (shape.upper - shape.lower)).clamp_max(_MAX_JOINT_SCATTER)
    scale[:3], scale[3:6] = _SHIFT_SCATTER * problem.size, _TURN_SCATTER
    noise = torch.randn(count, shape.num_dofs, generator=generator).to(center) * scale
    noise[0] = 0
    wide = center.unsqueeze(1).expand(-1, count, -1)
    around = shape.retract(wide, noise.expand_as(wide))
    reach = (shape.upper - shape.lower).clamp_max(2 * _FRESH_REACH)
    low = torch.maximum(center - _FRESH_REACH, shape.lower).clamp_max(shape.upper - reach)
    fresh = low.unsqueeze(1) + reach * torch.rand(noise.shape, generator=generator).to(center)
    for limb in search.limbs.limbs:
        redraw = torch.rand(count, 1, generator=generator).to(center) < _FRESH_LIMBS
        redraw[0] = False
        around[..., limb.dofs] = torch.where(redraw, fresh[..., limb.dofs], around[..., limb.dofs])
    return problem.clamp(around.transpose(0, 1)).transpose(0, 1)
