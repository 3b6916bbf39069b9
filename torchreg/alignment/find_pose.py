"""Finding the pose of an articulated shape without a start: sources of rough poses, then the funnel of the search."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from torchreg._checks import check_choice, check_count, check_positive
from torchreg._threads import one_thread
from torchreg.alignment.annealed_em import fit_surface
from torchreg.alignment.confidence import is_misfit, pose_confidence
from torchreg.alignment.limb_search import distinct_first, take_rows
from torchreg.alignment.pose_search import PoseSearch, mean_distances
from torchreg.alignment.problem import (
    AlignProblem,
    alignment_cost,
    centered_problem,
    check_data,
    masked_mean,
    shifted,
    warn_about_units,
)
from torchreg.alignment.results import PoseStarts
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.rigid import fit_rigid, rigid_matrix, transform_points
from torchreg.geometry.rotation import so3_exp, so3_log
from torchreg.geometry.sampling import farthest_points
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.skin import LinearBlendSkin, sample_skin
from torchreg.solvers.e_step import OUTLIER_CONSTANT, expectation

# Typical poses lie at these shares of the way from the rest pose to the middle of the joint limits.
_BENT_SHARES, _TYPICAL_SHARE = (0.2, 0.8), 0.5
# Widths of the rigid registration of rough poses, as shares of the size, and how many points it sees.
_RIGID_SIGMAS = (0.14, 0.14, 0.1, 0.1, 0.07, 0.07, 0.07, 0.05, 0.05, 0.05)
_RIGID_POINTS, _RIGID_DATA = 60, 120
# Rough poses are ranked by the data and by the model points that they leave alone.
_RIGID_SCORE, _MODEL_SHARE = 0.05, 0.5
# The best so many are compared; two whose points differ by less than this share of the size are one.
_MAX_COMPARED, _SAME_ROUGH, _SAME_POSE = 300, 0.045, 0.05
_FIT_STEPS, _FINAL_SIGMAS, _FINAL_STEPS = 3, (0.022,), 4
# Few model points share a datum here, so the outlier class is taken smaller.
_OUTLIERS = 0.3 * OUTLIER_CONSTANT
# Square root of two, and the positive root of x^4 = x + 4.
_SPIRAL_STEPS = (math.sqrt(2), 1.533751168755204288118041)


class PoseSource(Protocol):
    """Something that proposes rough poses: the base near, the joints of any plausible pose."""

    def __call__(self, problem: AlignProblem, generator: torch.Generator) -> Tensor:
        """Return (B, K, num_dofs) poses in the coordinates of the problem's data; they are registered rigidly next."""


@dataclass(frozen=True)
class UniformRotations:
    """A `PoseSource`: evenly spread rotations of typical poses, at the middle of the data.

    Args:
        count: of rotations, per typical pose.

    References: Alexa 2022, super-Fibonacci spirals.
    """

    count: int = 200

    def __call__(self, problem: AlignProblem, generator: torch.Generator) -> Tensor:
        """Return (B, K, num_dofs) poses, see `PoseSource`."""
        joints = typical_poses(problem.skin.shape)
        poses = joints.repeat_interleave(self.count, 0)
        poses[:, 3:6] = so3_log(spread_rotations(self.count).to(poses)).repeat(len(joints), 1)
        return _at_the_middle(problem, poses)


@dataclass(frozen=True)
class PrincipalAxes:
    """A `PoseSource`: the principal axes of typical poses turned onto those of the data, in all four ways."""

    def __call__(self, problem: AlignProblem, generator: torch.Generator) -> Tensor:
        """Return (B, K, num_dofs) poses, see `PoseSource`."""
        joints = typical_poses(problem.skin.shape)
        model = _axes(problem.skin(joints), torch.ones_like(problem.skin(joints)[..., 0]))
        data = _axes(problem.data, problem.valid.to(problem.data))
        ways = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]).to(joints).diag_embed()
        turns = data[:, None, None] @ ways @ model[:, None].mT
        own = so3_exp(joints[:, 3:6]).unsqueeze(1)
        poses = joints[:, None].expand(len(data), len(joints), len(ways), -1).clone()
        poses[..., 3:6] = so3_log((turns @ own).flatten(0, 2)).reshape(*poses.shape[:-1], 3)
        return _at_the_middle(problem, poses.flatten(1, 2))


DEFAULT_SOURCES: tuple[PoseSource, ...] = (UniformRotations(), PrincipalAxes())


@dataclass(frozen=True)
class FindPoseConfig:
    """How poses are found.

    Args:
        num_candidates: rough poses, after rigid registration, that are fitted to the surface.
        num_placed: of those, the best, whose limbs are placed coarsely.
        num_searched: of those, the best, whose limbs are placed thoroughly.
        search_rounds: of the thorough search, at most.
        num_retries: searches with other draws, at most, where the best pose leaves many data beside the surface.
        prior_std: standard deviation of a weak prior that draws joints to a typical pose, radians; None for none.
        num_model_points: points sampled on the shape.
        nan_policy: "raise", or "omit" to leave out non-finite data.
        seed: of everything that is drawn.
    """

    num_candidates: int = 64
    num_placed: int = 16
    num_searched: int = 4
    search_rounds: int = 2
    num_retries: int = 0
    prior_std: float | None = 0.4
    num_model_points: int = 500
    nan_policy: str = "raise"
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("num_candidates", "num_placed", "num_searched", "search_rounds", "num_model_points"):
            check_count(getattr(self, name), name, 1)
        check_count(self.num_retries, "num_retries", 0)
        if self.prior_std is not None:
            check_positive(self.prior_std, "prior_std")
        check_choice(self.nan_policy, "nan_policy", ("raise", "omit"))


def find_pose(
    shape: ArticulatedShape,
    data: Tensor,
    *,
    num_starts: int = 4,
    mask: Tensor | None = None,
    sources: Sequence[PoseSource] = DEFAULT_SOURCES,
    model_points: LinearBlendSkin | None = None,
    config: FindPoseConfig | None = None,
) -> PoseStarts:
    """Return the poses in which an articulated shape may lie on 3-D data, best first, and how sure the first is.

    Rough poses from all sources are registered rigidly in one batch; the best are fitted to the surface, their limbs
    placed on the data by beam search, first coarsely, then thoroughly, and ranked by the data that they leave
    unexplained.

    Args:
        shape: the articulated shape, in metres; where its base is bolted down, only its joints are sought.
        data: (M, 3), metres, or (B, M, 3) for a batch of clouds.
        num_starts: poses returned, at most `FindPoseConfig.num_searched`; fewer where they fall together.
        mask: (M,) or (B, M), False where data are padding.
        sources: of rough poses, see `PoseSource`.
        model_points: a skin of the shape to reuse; sampled on the surface by default.
        config: see `FindPoseConfig`.

    Returns:
        a `PoseStarts`; with a batch of clouds its tensors have a leading dimension B. The confidence falls with every
        limb of which no data tell where it ends.

    Raises:
        InputError: if the data are empty or not finite, or there is no source.
        InputTypeError: if an argument has the wrong type.

    Warns:
        UnitsWarning: if the data are more than thirty times larger or smaller than the shape.

    Differentiable: no.

    Cost: 1 to 2 s for a hand on one CPU core, whatever the number of data.
    """
    config = config or FindPoseConfig()
    check_count(num_starts, "num_starts", 1)
    if not sources:
        raise InputError("sources must hold at least one source of rough poses, got none")
    _check_skin(shape, model_points)
    with torch.no_grad():
        checked, valid = check_data(shape, data, mask, config.nan_policy)
        batch_data, batch_valid = (checked, valid) if checked.ndim == 3 else (checked[None], valid[None])
        origin = masked_mean(batch_data, batch_valid)
        typical = _towards_middle(shape, _TYPICAL_SHARE).expand(len(batch_data), -1)
        skin = sample_skin(shape, config.num_model_points) if model_points is None else model_points
        problem = centered_problem(
            skin, batch_data, batch_valid, shifted(typical, origin), origin, prior_std=config.prior_std, pose_atol=0.0
        )
        warn_about_units(problem)
        with one_thread():
            poses, costs = _found(problem, sources, config)
        starts = _ranked(problem, poses, costs, num_starts)
        starts = replace(starts, poses=shifted(starts.poses, origin.unsqueeze(1)))
    return starts if checked.ndim == 3 else starts.row(0)


def _check_skin(shape: ArticulatedShape, skin: LinearBlendSkin | None) -> None:
    if skin is not None and not isinstance(skin, LinearBlendSkin):
        raise InputTypeError(
            f"model_points must be a skin of the shape, as from sample_skin, got {type(skin).__name__}"
        )
    if skin is not None and skin.shape is not shape:
        raise InputError("model_points is a skin of another shape; build it from the shape whose pose is sought")


def _found(problem: AlignProblem, sources: Sequence[PoseSource], config: FindPoseConfig) -> tuple[Tensor, Tensor]:
    """Return candidates (B, H, num_dofs), best first, and their costs, after as many searches as each cloud needs."""
    poses, costs = _find(problem, sources, config)
    active = is_misfit(problem, poses[:, 0]).nonzero()[:, 0]
    for number in range(1, config.num_retries + 1):
        if len(active) == 0:
            break
        again = problem.rows(active)
        other, other_costs = _find(again, sources, replace(config, seed=config.seed + number))
        merged, merged_costs = torch.cat([poses[active], other], 1), torch.cat([costs[active], other_costs], 1)
        order = merged_costs.argsort(dim=1, stable=True)[:, : poses.shape[1]]
        poses[active], costs[active] = take_rows(merged, order), merged_costs.gather(1, order)
        active = active[is_misfit(again, poses[active, 0])]
    return poses, costs


def _find(problem: AlignProblem, sources: Sequence[PoseSource], config: FindPoseConfig) -> tuple[Tensor, Tensor]:
    """Return candidates (B, H, num_dofs) after one search, best first, and their costs."""
    generator = torch.Generator().manual_seed(config.seed)
    search = PoseSearch(problem, generator)
    rough = torch.cat([source(search.problem, generator) for source in sources], dim=1)
    rough = problem.clamp(rough.transpose(0, 1)).transpose(0, 1)
    rough, rough_costs = _register_rigidly(search, rough, search.problem.draw(_RIGID_DATA, generator))
    rough = _best_distinct(search.problem, rough, rough_costs, config.num_candidates)
    pool = search.attract(rough, _FIT_STEPS)[:, : config.num_placed]
    poses, _ = search.settle(search.narrow(pool, config.num_searched), config.search_rounds)
    count = poses.shape[1]
    wide = problem.rows(torch.arange(len(poses), device=poses.device).repeat_interleave(count))
    fitted = fit_surface(wide, poses.flatten(0, 1), steps=_FINAL_STEPS, sigmas=_FINAL_SIGMAS).pose
    costs = alignment_cost(wide, fitted).reshape(len(poses), count)
    order = costs.argsort(dim=1, stable=True)
    return take_rows(fitted.reshape(poses.shape), order), costs.gather(1, order)


def typical_poses(shape: Articulation) -> Tensor:
    """Return (K, num_dofs) different poses between the rest pose and the middle of the joint limits."""
    return torch.stack([_towards_middle(shape, share) for share in _BENT_SHARES]).unique(dim=0)


def _towards_middle(shape: Articulation, share: float) -> Tensor:
    middle = 0.5 * (shape.lower + shape.upper)
    return shape.rest + share * torch.where(middle.isfinite(), middle - shape.rest, 0.0)


def spread_rotations(count: int) -> Tensor:
    """Return ``count`` rotation matrices (count, 3, 3), float64, spread evenly over all rotations.

    References: Alexa 2022, super-Fibonacci spirals.
    """
    index = torch.arange(count, dtype=torch.float64) + 0.5
    inner, outer = (index / count).sqrt(), (1 - index / count).sqrt()
    first, second = (2 * math.pi * index / step for step in _SPIRAL_STEPS)
    x, y, z, w = inner * first.sin(), inner * first.cos(), outer * second.sin(), outer * second.cos()
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def _axes(points: Tensor, weights: Tensor) -> Tensor:
    """Return the principal axes (..., 3, 3) of points as columns, a right-handed rotation."""
    weights = (weights / weights.sum(-1, keepdim=True).clamp_min(1)).unsqueeze(-1)
    centered = points - (weights * points).sum(-2, keepdim=True)
    axes = torch.linalg.eigh((weights * centered).mT @ centered).eigenvectors
    return torch.cat([axes[..., :1] * torch.det(axes).sign()[..., None, None], axes[..., 1:]], dim=-1)


def _at_the_middle(problem: AlignProblem, poses: Tensor) -> Tensor:
    """Return poses ((B,) K, num_dofs) moved so that the model's center is the median of the data, (B, K, num_dofs)."""
    middle = torch.where(problem.valid.unsqueeze(-1), problem.data, torch.nan).nanmedian(-2).values.nan_to_num()
    poses = poses.expand(len(middle), *poses.shape[-2:])
    center = problem.skin(poses).mean(-2)
    return shifted(poses, middle.unsqueeze(1) - center)


def _is_bolted(shape: Articulation) -> bool:
    return bool((shape.lower[:6] == shape.upper[:6]).all())


def _register_rigidly(search: PoseSearch, poses: Tensor, data: AlignProblem) -> tuple[Tensor, Tensor]:
    """Return poses (B, K, num_dofs) after a rigid EM of a few model points, and their costs (B, K), both ways.

    Wide kernels first; the joints stay. A batch of closed-form M-steps costs less than one step of the joints.
    """
    skin, size = search.problem.skin, search.problem.size
    points = skin(poses)[..., farthest_points(skin.points, min(_RIGID_POINTS, len(skin))), :]
    moved, motion = points, torch.eye(4).to(points).expand(*poses.shape[:2], 4, 4)
    valid, cloud = data.valid.to(points)[:, None, None], data.data.unsqueeze(1)
    for share in () if _is_bolted(skin.shape) else _RIGID_SIGMAS:
        held = expectation(moved, cloud, moved.new_tensor(share * size), _OUTLIERS, mask=data.valid.unsqueeze(1))
        motion = fit_rigid(points, held.targets, held.weights)
        moved = transform_points(motion, points)
    kernel = _kernel(moved, cloud, _RIGID_SCORE * size / math.sqrt(2)) * valid
    count = data.valid.sum(-1, keepdim=True).clamp_min(1)
    cost = -kernel.amax(-2).sum(-1) / count - _MODEL_SHARE * kernel.amax(-1).mean(-1)
    base = motion @ rigid_matrix(so3_exp(poses[..., 3:6]), poses[..., :3])
    turned = so3_log(base[..., :3, :3].flatten(0, 1)).reshape(*poses.shape[:2], 3)
    return torch.cat([base[..., :3, 3], turned, poses[..., 6:]], dim=-1), cost


def _kernel(points: Tensor, data: Tensor, sigma: float) -> Tensor:
    """Return ``exp(-r^2 / 2 sigma^2)`` (B, K, N, M)."""
    squares = points.square().sum(-1, keepdim=True) + data.square().sum(-1).unsqueeze(-2) - 2 * points @ data.mT
    return (squares.clamp_min_(0) * (-0.5 / sigma**2)).exp_()


def _best_distinct(problem: AlignProblem, poses: Tensor, costs: Tensor, count: int) -> Tensor:
    """Return the best ``count`` of poses (B, K, num_dofs) whose points differ; then others of them."""
    poses = take_rows(poses, costs.argsort(1)[:, :_MAX_COMPARED])
    order = distinct_first(mean_distances(problem, poses) < _SAME_ROUGH * problem.size)
    return take_rows(poses, order[:, :count])


def _ranked(problem: AlignProblem, poses: Tensor, costs: Tensor, count: int) -> PoseStarts:
    """Return the candidates, best first; those that fell together with a better one come last."""
    apart = mean_distances(problem, poses) > _SAME_POSE * problem.size
    rival = torch.where(apart[:, 0], costs, torch.inf).amin(1)
    confidence = pose_confidence(problem, poses[:, 0], rival - costs[:, 0])
    order = distinct_first(~apart)[:, :count]
    return PoseStarts(take_rows(poses, order), costs.gather(1, order), confidence)
