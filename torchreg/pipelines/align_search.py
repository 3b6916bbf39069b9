"""Searching around a start when plain descent leaves part of the data unexplained.

Candidates are scattered around the start, refined in one batch on few points, and recombined limb by limb: a finger
that one candidate found is kept even if that candidate lost the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import torch
from torch import Tensor

from torchreg.correspondence.sigma import SigmaSchedule
from torchreg.geometry.rotation import compose_rotation_vectors
from torchreg.geometry.sampling import farthest_points
from torchreg.models.articulated import ArticulatedShape
from torchreg.models.skin import LinearBlendSkin
from torchreg.pipelines.align_stages import AlignProblem, register, residual_noise, surface_steps

_T = TypeVar("_T")

# Per round, as shares of the model's size: sigmas of the candidates' EM, widths of their surface fit and score.
# Later rounds look at more data, more closely: what is left to tell apart differs in a few data only.
_EM_SIGMAS = ((0.075, 0.022), (0.055, 0.022))
_SURFACE_SIGMAS = ((0.05, 0.03, 0.018), (0.05, 0.03, 0.018), (0.03, 0.018, 0.014))
_SCORE_SIGMA = (0.022, 0.018, 0.014)
_NUM_DATA = (250, 350, 500)
_NOISE = 0.01
# Scatter of the candidates per round: joints as a share of their range, base in radians, base as a share of the size.
_JOINT_SCATTER = (0.2, 0.15, 0.1)
_TURN_SCATTER = (0.17, 0.1, 0.07)
_SHIFT_SCATTER = (0.035, 0.02, 0.015)
_MAX_JOINT_SCATTER = 0.4
# One limb in four of a candidate is placed anywhere within this many radians of the start and its limits.
_FRESH_LIMBS = 0.25
_FRESH_REACH = 1.2
_NUM_MODEL = 120
# Widths of the surface fit that follows a search, whose poses are near already.
FINAL_SIGMAS = (0.022,)
# How much the prior weighs in a score, in outliers per squared standard deviation.
PRIOR_SHARE = 0.3
# A round that explains no more than this many data more is the last.
_MIN_GAIN = 0.5
# Unexplained data count as a cluster with this many others within four nearest-neighbor distances.
_CLUSTER_NEIGHBORS = 5
_CLUSTER_RADIUS = 4.0
_FAR_NOISES = 3.0
# A descent that turns the base or the joints (root mean square), or any one joint, by more radians than this started
# too far away.
_TRUSTED_MOTION, _TRUSTED_JOINT = 0.2, 0.4
_CLUSTER_SHARE, _CLUSTER_MIN = 0.015, 5
_MAX_CLUSTERED = 2000
# Candidates times points times parts held at a time.
_CHUNK_ENTRIES = 4_000_000


def needs_search(problem: AlignProblem, start: Tensor, pose: Tensor) -> Tensor:
    """Return which problems (B,) a single descent cannot be trusted with.

    Either it went far from its start, where other minima are as near; or it leaves a dense cluster of data off the
    surface: outliers are thin in space, a limb that was missed is as dense as the rest.
    """
    joints = torch.nn.functional.pad((pose - start)[:, 6:].abs(), (0, 1))
    moved = torch.maximum(joints.square().mean(-1).sqrt(), joints.amax(-1) * (_TRUSTED_MOTION / _TRUSTED_JOINT))
    turned = compose_rotation_vectors(pose[:, 3:6], -start[:, 3:6]).norm(dim=-1)
    return (torch.maximum(moved, turned) > _TRUSTED_MOTION) | _unexplained(problem, pose)


def _unexplained(problem: AlignProblem, pose: Tensor) -> Tensor:
    if problem.data.shape[-2] > _MAX_CLUSTERED:
        problem = _thinned(problem, _MAX_CLUSTERED)
    distance = problem.surface.distance(problem.data, pose).abs()
    noise = residual_noise(problem, pose)
    far = (distance > _FAR_NOISES * noise.unsqueeze(-1)) & problem.valid
    squares = _squared_distances(problem.data)
    squares.diagonal(dim1=-2, dim2=-1).fill_(torch.inf)
    spacing = torch.where(~far & problem.valid, squares.amin(-1), torch.nan).nanmedian(-1).values.sqrt()
    radius = torch.nan_to_num(_CLUSTER_RADIUS * spacing, nan=0.0).clamp_max(0.1 * problem.size)
    close = (squares < radius.square()[:, None, None]) & far.unsqueeze(-2)
    clustered = far & (close.sum(-1) >= _CLUSTER_NEIGHBORS)
    near_count = (~far & problem.valid).sum(-1)
    return clustered.sum(-1) > (_CLUSTER_SHARE * near_count).clamp_min(_CLUSTER_MIN)


def _squared_distances(data: Tensor) -> Tensor:
    norms = data.square().sum(-1)
    return (norms.unsqueeze(-1) + norms.unsqueeze(-2) - 2 * data @ data.mT).clamp_min_(0)


def _thinned(problem: AlignProblem, count: int) -> AlignProblem:
    """Return the problem with every k-th datum, so that at most about ``count`` are left."""
    stride = -(-problem.data.shape[-2] // count)
    return replace(problem, data=problem.data[:, ::stride], valid=problem.valid[:, ::stride])


def coarse_skin(skin: LinearBlendSkin) -> LinearBlendSkin:
    """Return a skin of few points that cover the given one's."""
    index = farthest_points(skin.points, min(_NUM_MODEL, len(skin)))
    return LinearBlendSkin(skin.shape, skin.points[index], skin.weights[index], skin.reference_pose)


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

    Args:
        problem: the batch, with few model points and a surface that is cheap to evaluate.
        start: (B, num_dofs).
        descended: (B, num_dofs) what a single descent made of the starts.
        candidates: per problem and round.
        rounds: of scattering, refining and recombining, at most; a round without improvement is the last.
        generator: of the scatter.

    Returns:
        (B, num_dofs).
    """
    per_problem = candidates * max(_NUM_DATA) * problem.skin.shape.num_parts
    rows = torch.arange(len(start), device=start.device).split(max(1, _CHUNK_ENTRIES // per_problem))
    best = [_explore(problem.rows(row), start[row], descended[row], candidates, rounds, generator) for row in rows]
    return torch.cat(best)


def _explore(
    problem: AlignProblem,
    start: Tensor,
    descended: Tensor,
    candidates: int,
    rounds: int,
    generator: torch.Generator,
) -> Tensor:
    limbs = limb_dofs(problem.skin.shape)
    best, centers = descended, [start, descended]
    for number in range(rounds):
        subset = _subset(problem, _of(number, _NUM_DATA), generator)
        count = -(-candidates // len(centers))
        scattered = [_scatter(problem, center, limbs, count, number, generator) for center in centers]
        pool = torch.cat([_refine(subset, torch.cat(scattered, dim=1), number), best.unsqueeze(1)], dim=1)
        width = _of(number, _SCORE_SIGMA) * problem.size
        score = _score(subset, pool, width)
        value, index = score.min(1)
        before = score[:, -1]
        best, value = _recombine(subset, _pick(pool, index), value, pool, limbs, width)
        if not bool((value < before - _MIN_GAIN).any()):
            break
        centers = [best]
    return best


def _of(number: int, per_round: Sequence[_T]) -> _T:
    """Return a round's value; the last one serves all later rounds."""
    return per_round[min(number, len(per_round) - 1)]


def limb_dofs(shape: ArticulatedShape) -> list[Tensor]:
    """Return the degrees of freedom of every limb: a chain of parts that hangs on a part with several children."""
    moved = (shape.chain.moves[shape.part_index] @ shape.chain.couplings.abs()) > 0
    children = [[c for c, p in enumerate(shape.part_parents) if p == part] for part in range(shape.num_parts)]
    limbs = []
    for part, below in enumerate(children):
        for child in below if len(below) > 1 else ():
            chain = _descendants(children, child)
            dofs = 6 + (moved[chain].any(0) & ~moved[part]).nonzero()[:, 0]
            if len(dofs):
                limbs.append(dofs)
    return limbs


def _descendants(children: list[list[int]], part: int) -> list[int]:
    found = [part]
    for member in found:
        found.extend(children[member])
    return found


def _subset(problem: AlignProblem, count: int, generator: torch.Generator) -> AlignProblem:
    """Return the problem with few data, drawn from the valid ones."""
    draw = torch.rand(problem.valid.shape, generator=generator).to(problem.data)
    keep = torch.where(problem.valid, draw, -1.0).topk(min(count, draw.shape[-1]), dim=-1).indices
    data = problem.data.gather(1, keep.unsqueeze(-1).expand(*keep.shape, 3))
    return replace(problem, data=data, valid=problem.valid.gather(1, keep))


def _scatter(
    problem: AlignProblem, center: Tensor, limbs: list[Tensor], count: int, number: int, generator: torch.Generator
) -> Tensor:
    """Return (B, count, num_dofs) candidates; the first is the center itself."""
    shape = problem.skin.shape
    scale = (_of(number, _JOINT_SCATTER) * (shape.upper - shape.lower)).clamp_max(_MAX_JOINT_SCATTER)
    scale[:3], scale[3:6] = _of(number, _SHIFT_SCATTER) * problem.size, _of(number, _TURN_SCATTER)
    noise = torch.randn(len(center), count, shape.num_dofs, generator=generator).to(center) * scale
    noise[:, 0] = 0
    around = shape.retract(center.unsqueeze(1).expand_as(noise), noise)
    reach = (shape.upper - shape.lower).clamp_max(2 * _FRESH_REACH)
    low = torch.maximum(center - _FRESH_REACH, shape.lower).clamp_max(shape.upper - reach)
    fresh = low.unsqueeze(1) + reach * torch.rand(noise.shape, generator=generator).to(center)
    for dofs in limbs:
        redraw = torch.rand(*noise.shape[:2], 1, generator=generator).to(center) < _FRESH_LIMBS
        redraw[:, 0] = False
        around[..., dofs] = torch.where(redraw, fresh[..., dofs], around[..., dofs])
    return problem.clamp(around.transpose(0, 1)).transpose(0, 1)


def _refine(problem: AlignProblem, poses: Tensor, number: int) -> Tensor:
    """Return candidates (B, K, num_dofs) after a short EM and surface fit, all in one batch."""
    batch, count = poses.shape[:2]
    wide = problem.rows(torch.arange(batch, device=poses.device).repeat_interleave(count))
    first, last = _of(number, _EM_SIGMAS)
    schedule = SigmaSchedule.geometric(first * problem.size, last * problem.size, 3)
    pose = register(wide, poses.flatten(0, 1), schedule, em_steps=2, m_steps=1, tempered=False).pose
    noise = torch.full_like(pose[:, 0], _NOISE * problem.size)
    for share in _of(number, _SURFACE_SIGMAS):
        pose = surface_steps(wide, pose, torch.full_like(noise, share * problem.size), noise, 2).state
    return pose.reshape(poses.shape)


def _score(problem: AlignProblem, poses: Tensor, width: float) -> Tensor:
    """Return the score (B, K) of poses (B, K, num_dofs): outliers, softly counted, and the prior; lower is better."""
    distance = problem.surface.distance(problem.data.unsqueeze(1), poses)
    lost = 1 - (-(distance / width).square()).exp()
    return (lost * problem.valid.unsqueeze(1)).sum(-1) + PRIOR_SHARE * problem.prior.cost(poses)


def _recombine(
    problem: AlignProblem, best: Tensor, value: Tensor, pool: Tensor, limbs: list[Tensor], width: float
) -> tuple[Tensor, Tensor]:
    """Return the best poses, each limb taken from whichever candidate explains most with it, and their scores."""
    for dofs in limbs:
        mixed = best.unsqueeze(1).repeat(1, pool.shape[1], 1)
        mixed[..., dofs] = pool[..., dofs]
        score, index = _score(problem, mixed, width).min(1)
        better = score < value
        best = torch.where(better.unsqueeze(-1), _pick(mixed, index), best)
        value = torch.where(better, score, value)
    return best, value


def _pick(poses: Tensor, index: Tensor) -> Tensor:
    return poses.gather(1, index[:, None, None].expand(-1, 1, poses.shape[-1])).squeeze(1)
