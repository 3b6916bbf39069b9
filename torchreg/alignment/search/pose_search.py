"""From many rough candidates to a few good poses: fitted coarsely, pruned with limbs placed anew, and refined."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchreg.alignment.evidence.confidence import clustered_data, leaves_clusters
from torchreg.alignment.fit.annealed_em import narrowing
from torchreg.alignment.fit.problem import AlignProblem
from torchreg.alignment.search.limb_search import Effort, LimbSearch
from torchreg.alignment.search.multi_start import SEARCH_BUDGET, Candidates, Plan, descend, take_rows
from torchreg.alignment.search.rough_poses import register_rigidly
from torchreg.geometry.sampling import farthest_points
from torchreg.shapes.limbs import Limb
from torchreg.shapes.pose_algebra import BASE_DOFS, difference
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.shapes.surface import FusedSurface, SkinSurface


@dataclass(frozen=True)
class _Stage:
    """Settings of a stage: placing limbs, then fits to the surface and scores."""

    effort: Effort
    plan: Plan


@dataclass(frozen=True)
class _Search:
    """Numbers of the search; lengths are shares of the model's size."""

    min_gain: float = 0.5  # in data explained: a round that gains less is the last


_PRUNE = _Stage(
    effort=Effort(
        num_data=150, width=0.05, beam=82, configurations=41, refine_widths=(), score_width=0.05, combinations=2,
        exchanged=0,
    ),
    plan=Plan(start=0.04, stop=0.022, steps=1),
)  # fmt: skip
_REFINE = _Stage(
    effort=Effort(
        num_data=250, width=0.05, beam=123, configurations=40, refine_widths=narrowing(0.04, 0.022), score_width=0.02,
        combinations=8, exchanged=3,
    ),
    plan=Plan(start=0.03, stop=0.018, steps=2),
)  # fmt: skip
_COARSE = Plan(start=0.12, stop=0.018, steps=3)
_SEARCH = _Search()


class PoseSearch:
    """A search, with few data and model points, for the poses that explain most data of a batch of problems."""

    def __init__(self, problem: AlignProblem, generator: torch.Generator) -> None:
        shape = problem.skin.shape
        reduced = replace(problem.with_skin(_coarse_skin(problem.skin)), surface=FusedSurface(shape))
        self.problem = reduced.draw(SEARCH_BUDGET.num_data, generator)
        self.coarse_problem = self.problem.draw(SEARCH_BUDGET.num_coarse_data, generator)
        self.seed = int(torch.randint(2**31, (), generator=generator))

    @cached_property
    def limbs(self) -> LimbSearch:
        """The search over the limbs, whose samples of the joints are placed when first needed."""
        return LimbSearch(self.problem.skin.shape)

    def rows(self, index: Tensor) -> PoseSearch:
        """Return the search for some rows of the batch."""
        part = copy(self)
        part.problem, part.coarse_problem = self.problem.rows(index), self.coarse_problem.rows(index)
        return part

    def fitted_score(self, poses: Tensor) -> Tensor:
        """Return the scores (B,) of poses (B, num_dofs) after a fit without any search, comparable to `refine`'s."""
        return descend(self.problem, poses.unsqueeze(1), _REFINE.plan)[1][:, 0]

    def registered(self, rough: Tensor, generator: torch.Generator) -> Candidates:
        """Return rough poses (B, K, num_dofs) after a rigid registration, best first."""
        return Candidates.ranked(self.problem, *register_rigidly(self.problem, rough, generator))

    def fit_coarsely(self, pool: Tensor) -> Tensor:
        """Return candidates (B, N, num_dofs) after surface fits of narrowing kernels, best and different ones first."""
        fitted = Candidates.descended(self.coarse_problem, pool, _COARSE)
        return fitted.distinct(SEARCH_BUDGET.duplicate).poses

    def prune(self, pool: Tensor, count: int) -> Tensor:
        """Return the best, different ``count`` of candidates (B, N, num_dofs), limbs placed anew or as given."""
        return self._best_options(self.coarse_problem, pool, _PRUNE, 0).distinct(SEARCH_BUDGET.duplicate, count).poses

    def refine(self, candidates: Tensor, rounds: int) -> tuple[Tensor, Tensor]:
        """Return candidates (B, H, num_dofs) after a thorough search, best first, and their scores (B, H)."""
        first = self._best_options(self.problem, candidates, _REFINE, 1)
        poses, scores = first.poses, first.costs
        active = torch.arange(len(poses), device=poses.device)
        for number in range(2, rounds + 1):
            part = self.problem.rows(active)
            best = self._best_options(part, poses[active, :1], _REFINE, number)
            gain = scores[active, 0] - best.costs[:, 0]
            better = (gain > 0).unsqueeze(-1)
            poses[active, 0] = torch.where(better, best.poses[:, 0], poses[active, 0])
            scores[active, 0] = torch.minimum(best.costs[:, 0], scores[active, 0])
            active = active[gain > _SEARCH.min_gain]
            if len(active) == 0:
                break
        return poses, scores

    def _best_options(self, problem: AlignProblem, candidates: Tensor, stage: _Stage, number: int) -> Candidates:
        """Return candidates (B, N, num_dofs) fitted with their limbs placed anew or as given, whichever is better."""
        generator = torch.Generator().manual_seed(self.seed + number)
        wide = problem.repeated(candidates.shape[1])
        placed = self.limbs(wide, candidates.flatten(0, 1), stage.effort, generator).unflatten(0, candidates.shape[:2])
        options = torch.cat([placed, candidates.unsqueeze(2)], dim=2)
        fitted, scores = descend(problem, options.flatten(1, 2), stage.plan)
        best, choice = scores.unflatten(1, options.shape[1:3]).min(-1)
        first = torch.arange(choice.shape[1], device=choice.device) * options.shape[2]
        return Candidates.ranked(problem, take_rows(fitted, first + choice), best)


def _coarse_skin(skin: LinearBlendSkin) -> LinearBlendSkin:
    """Return a skin of few points that cover the given one's."""
    index = farthest_points(skin.points, min(SEARCH_BUDGET.num_model_points, len(skin)))
    return LinearBlendSkin(skin.shape, skin.points[index], skin.weights[index], skin.reference_pose)


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


def needs_search(problem: AlignProblem, start: Tensor, pose: Tensor, *, always: bool = False) -> Tensor:
    """Return a mask (B,) of problems with which a single descent cannot be trusted, or is ``always`` mistrusted.

    Either it went far from its start, where other minima are as near; or it leaves an unexplained cluster of data. The
    limbs of a skinned rig, without a solid trunk, are not placed one by one: it is sought everywhere or not at all.
    """
    if isinstance(problem.surface, SkinSurface):
        return torch.zeros_like(pose[:, 0], dtype=torch.bool)
    return (_motion(start, pose) > (-1 if always else _TRUST.motion)) | leaves_clusters(problem, pose)


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
    `PoseSearch`, the last stage at most ``rounds`` times. The draws for a problem do not depend on the others.
    """
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
