"""A batch of alignments as every stage sees it: data in centered coordinates, limits, prior, sizes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self, TypeVar

import torch
from torch import Tensor

from torchreg.alignment.fit.free_space_term import FreeSpaceTerm
from torchreg.alignment.fit.landmarks import MeasuredKeypoints, keypoint_skin
from torchreg.alignment.fit.objectives import Factor, GaussianPosePrior, Objective
from torchreg.capture.free_space import FreeSpace
from torchreg.geometry.kinematic_tree import stack_sizes
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.link_surface import LinkSurface, has_rigid_links
from torchreg.shapes.pose_algebra import BASE_DOFS
from torchreg.shapes.shaped import ShapedSkin
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.shapes.surface import FusedSurface, ShapeSurface, SkinSurface, dense_file_skin
from torchreg.solvers.levenberg_marquardt import Linearization, LMResult, SharedRows
from torchreg.solvers.robust import welsch_loss, welsch_weight

OneFactor = TypeVar("OneFactor", bound=Factor)
# Data nearer to the fitted surface than this share of the model's size are inliers.
INLIER_SHARE = 0.02
# Weight of the prior in a score, in outliers per half squared standard deviation.
PRIOR_SHARE = 0.3
# Revolute joints with one center make a ball joint from this number on.
BALL_AXES = 3


@dataclass(frozen=True)
class BroadPrior:
    """Standard deviations of a plausible pose of which nothing else is known."""

    turn: float = 1.0  # of hinges and of the base's rotation, radians: a third of a half turn
    typical: float = 0.4  # of joints about a typical pose, as to the middle of their limits, radians
    shift: float = 0.5  # of sliding joints and of the base's position, as a share of the model's size

    def precision(self, shape: Articulation, size: float) -> Tensor:
        """Return 1 / std^2 (num_dofs,) for a shape of some size in metres."""
        turns = torch.full_like(shape.rest, self.turn**-2)
        return torch.where(shape.is_sliding, (self.shift * size) ** -2, turns)


BROAD_PRIOR = BroadPrior()


@dataclass(frozen=True)
class AlignProblem:
    """A batch of alignments of one shape, the input of every stage.

    Data (B, M, 3) in metres from the origins (B, 3); `size`, the diagonal of the model at rest, is the unit of all
    thresholds; `debias` is the share of the kernel's shrinkage that is corrected in the targets of the EM; normals (B,
    M, 3) of the data count in the EM. Successive rows, `scans` each, share coefficients.
    """

    skin: LinearBlendSkin
    surface: ShapeSurface
    data: Tensor
    valid: Tensor
    origin: Tensor
    size: float
    lower: Tensor
    upper: Tensor
    prior: GaussianPosePrior
    pose_atol: float
    outlier: str | float = "limit"
    debias: float = 0.0
    correspondence: str = "em"
    factors: tuple[Factor, ...] = ()
    prior_precision: Tensor | None = None
    normals: Tensor | None = None
    scans: int = 1

    def rows(self, index: Tensor) -> Self:
        """Return the problems of some rows of the batch, which may repeat."""
        return replace(
            self,
            data=self.data[index],
            valid=self.valid[index],
            origin=self.origin[index],
            lower=_rows(self.lower, index),
            upper=_rows(self.upper, index),
            prior=replace(self.prior, mean=self.prior.mean[index], precision=_rows(self.prior.precision, index)),
            prior_precision=None if self.prior_precision is None else self.prior_precision[index],
            factors=tuple(factor.rows(index) for factor in self.factors),
            normals=None if self.normals is None else self.normals[index],
        )

    def repeated(self, count: int) -> Self:
        """Return the batch with every problem ``count`` times in a row."""
        return self.rows(torch.arange(len(self.data), device=self.data.device).repeat_interleave(count))

    def draw(self, count: int, generator: torch.Generator) -> Self:
        """Return the problem with at most ``count`` data, drawn from the valid ones, the same alone and in a batch."""
        draw = torch.rand(self.valid.shape[-1], generator=generator, dtype=torch.float32).to(self.data)
        keep = torch.where(self.valid, draw, -1.0).topk(min(count, draw.shape[-1]), dim=-1).indices
        return self.kept(keep)

    def kept(self, index: Tensor) -> Self:
        """Return the problem with the data (B, C) of an index, that stand for all."""
        wide = index.unsqueeze(-1).expand(*index.shape, 3)
        found = self.with_data(self.data.gather(1, wide), self.valid.gather(1, index))
        return found if self.normals is None else replace(found, normals=self.normals.gather(1, wide))

    def with_data(self, data: Tensor, valid: Tensor) -> Self:
        """Return the problem with a sample of its data (B, M, 3), valid or not (B, M), that stands for all."""
        thinning = self.valid.sum(-1) / valid.sum(-1).clamp_min(1)
        return replace(self, data=data, valid=valid, factors=tuple(each.thinned(thinning) for each in self.factors))

    def with_skin(self, skin: LinearBlendSkin) -> Self:
        """Return the problem with other model points that cover the shape as evenly."""
        return replace(self, skin=skin, factors=tuple(factor.for_skin(skin) for factor in self.factors))

    def factor(self, kind: type[OneFactor]) -> OneFactor | None:
        """Return the factor of a kind, None without one."""
        return next((factor for factor in self.factors if isinstance(factor, kind)), None)

    def informed(self, covariance: Tensor, pose: Tensor) -> Tensor:
        """Return the covariance (B, num_dofs, num_dofs) that data give poses, with what the factors add."""
        for factor in self.factors:
            covariance = factor.informed(covariance, pose)
        return covariance

    def factor_score(self, pose: Tensor, width: float) -> Tensor | float:
        """Return the score of all factors (B, ...) at poses (B, ..., num_dofs); ``width`` is a share of the size."""
        return sum((factor.score(pose, width * self.size) for factor in self.factors), 0.0)

    def plausible_limits(self, reach: float) -> tuple[Tensor, Tensor]:
        """Return limits (B, num_dofs) of the pose, narrowed to ``reach`` standard deviations about the prior's mean."""
        lower, upper = (limit.expand_as(self.prior.mean) for limit in (self.lower, self.upper))
        if self.prior_precision is None:
            return lower, upper
        width = reach * self.prior_precision.rsqrt()
        low, high = self.prior.mean - width, self.prior.mean + width
        return torch.minimum(torch.maximum(low, lower), upper), torch.maximum(torch.minimum(high, upper), lower)

    def cap_std_by_prior(self, std: Tensor) -> Tensor:
        """Return standard deviations (num_dofs,) as (B, num_dofs), none wider than what is known beforehand."""
        wide = std.expand_as(self.prior.mean)
        return wide if self.prior_precision is None else torch.minimum(wide, self.prior_precision.rsqrt())

    def solve(
        self, objective: Objective, pose: Tensor, max_steps: int, around: Linearization, damping: Tensor | None = None
    ) -> LMResult:
        """Return the result of Levenberg-Marquardt within the joint limits from a pose with a known linearization."""
        return self.shared.descend(
            objective, pose, lower=self.lower, upper=self.upper, damping=damping, max_steps=max_steps,
            atol=self.pose_atol * min(1.0, self.size), start=around, cost=objective.cost,
        )  # fmt: skip

    def step(self, around: Linearization, pose: Tensor, damping: float = 1e-3) -> LMResult:
        """Return the result of one damped step without a test: all that a generalized EM needs."""
        return self.shared.step(around, pose, lower=self.lower, upper=self.upper, damping=damping)

    @property
    def shared(self) -> SharedRows:
        """Which unknowns the rows share: none, one by one."""
        return SharedRows(self.skin.shape.retract)

    def unfinished(self, step: Tensor) -> Tensor:
        """Return the rows (R,) whose last step (B, num_dofs) was not final, or none, with those that share unknowns."""
        moves = ~((step != 0).any(-1) & (self.change(step) <= self.pose_atol))
        return moves.unflatten(0, (-1, self.scans)).any(-1).repeat_interleave(self.scans).nonzero()[:, 0]

    def change(self, step: Tensor) -> Tensor:
        """Return the largest change (B,) in a step, radians, or metres as a share of the size."""
        return torch.cat([step[:, :3] / self.size, step[:, 3:]], dim=-1).abs().amax(-1)

    def clamp(self, pose: Tensor) -> Tensor:
        """Return poses (..., B, num_dofs) moved inside the limits."""
        return torch.minimum(torch.maximum(pose, self.lower), self.upper)

    def clamp_candidates(self, poses: Tensor) -> Tensor:
        """Return candidates (B, K, num_dofs) moved inside the limits."""
        return self.clamp(poses.transpose(0, 1)).transpose(0, 1)


def _rows(limits: Tensor, index: Tensor) -> Tensor:
    return limits if limits.ndim == 1 else limits[index]


def masked_mean(data: Tensor, valid: Tensor) -> Tensor:
    """Return the mean (B, 3) of the valid data of each cloud."""
    return (data * valid.unsqueeze(-1)).sum(-2) / valid.sum(-1, keepdim=True).clamp_min(1)


def model_size(skin: LinearBlendSkin | ShapedSkin) -> float:
    """Return the diagonal of the bounding box of model points in their reference pose, metres."""
    return float((skin.points.amax(0) - skin.points.amin(0)).norm())


def centered_problem(
    skin: LinearBlendSkin,
    data: Tensor,
    valid: Tensor,
    pose: Tensor,
    origin: Tensor,
    *,
    prior_std: float | None,
    pose_atol: float,
    outlier: str | float = "limit",
    debias: float = 0.0,
    correspondence: str = "em",
    free_space: FreeSpace | None = None,
    keypoints: MeasuredKeypoints | None = None,
) -> AlignProblem:
    """Return a batch of alignments with each cloud's origin (B, 3) at zero, where float32 is precise.

    Data (B, M, 3), free space, keypoints and the prior's mean ``pose`` (B, num_dofs) are given in the world.
    """
    shape, size = skin.shape, model_size(skin)
    shift = torch.nn.functional.pad(origin, (0, shape.num_dofs - 3))
    lower, upper = shape.lower, shape.upper
    factors: list[Factor] = []
    if free_space is not None:
        factors.append(FreeSpaceTerm.of_skin(free_space.to(data).moved(origin), skin, size))
    if keypoints is not None:
        factors.append(keypoints.of_problems(keypoint_skin(shape), origin))
    if not bool(torch.isinf(shape.lower[:3]).all()):
        lower, upper = shape.lower - shift, shape.upper - shift
    return AlignProblem(
        skin=skin,
        surface=fitted_surface(shape),
        data=torch.where(valid.unsqueeze(-1), data - origin.unsqueeze(1), 0.0),
        valid=valid,
        origin=origin,
        size=size,
        lower=lower,
        upper=upper,
        prior=GaussianPosePrior(pose - shift, joint_precision(shape, size, prior_std)),
        pose_atol=pose_atol,
        outlier=outlier,
        debias=debias,
        correspondence=correspondence,
        factors=tuple(factors),
    )


def joint_precision(shape: Articulation, size: float, std: float | None) -> Tensor:
    """Return the precision (num_dofs,) of a prior that leaves the base free, from the joints' deviation."""
    precision = torch.zeros_like(shape.rest)
    if std is not None:
        joints = torch.where(shape.is_sliding[BASE_DOFS:], std * size, std)
        precision[BASE_DOFS:] = joints.square().reciprocal()
        # The three axes of a ball joint share the deviation of its one rotation.
        balls = [BASE_DOFS + dof for dof, axes in enumerate(stack_sizes(shape.kinematics.tree)) if axes >= BALL_AXES]
        precision[balls] *= BALL_AXES
    return precision


def fitted_surface(shape: Articulation) -> ShapeSurface:
    """Return the surface to fit: that of the shape's file where there is one, else the fused solids."""
    if shape.surface is None:
        return FusedSurface(shape)
    return LinkSurface(shape) if has_rigid_links(shape) else SkinSurface(dense_file_skin(shape))


def soft_inliers(problem: AlignProblem, distances: Tensor) -> Tensor:
    """Return the degree (..., M), from 0 to 1, to which data at distances (..., M) from a surface are inliers."""
    return welsch_weight((distances / (INLIER_SHARE * problem.size)).square()) * problem.valid


def alignment_cost(problem: AlignProblem, pose: Tensor, distances: Tensor | None = None) -> Tensor:
    """Return the cost (B,) that ranks alignments: soft counts of outliers and of points in free space, and a prior."""
    distances = problem.surface.distance(problem.data, pose) if distances is None else distances
    outliers = welsch_loss((distances / (INLIER_SHARE * problem.size)).square())
    cost = (outliers * problem.valid).sum(-1) + PRIOR_SHARE * problem.prior.cost(pose)
    return cost + problem.factor_score(pose, INLIER_SHARE)


def free_space_loss(problem: AlignProblem, pose: Tensor) -> Tensor:
    """Return the data (B,), softly counted, that model points in free space stand for; zero without a picture."""
    term = problem.factor(FreeSpaceTerm)
    return torch.zeros_like(pose[:, 0]) if term is None else term.score(pose, INLIER_SHARE * problem.size)


# Edge of the patches within which data err together, as a share of the size: about a link of an arm.
_PATCH = 0.15


def independent_share(points: Tensor, size: float) -> float:
    """Return the share of points (M, 3) on a thing of some size, metres, that are independent: one for each patch."""
    return max(1, len((points / (_PATCH * size)).floor().unique(dim=0))) / max(1, len(points))


def errors_per_patch(data: Tensor, valid: Tensor, size: float) -> Tensor:
    """Return the mean number (B,) of data in a patch, which err as one, of a model of some size."""
    shares = [independent_share(points[chosen], size) for points, chosen in zip(data, valid, strict=True)]
    return torch.tensor([1 / share for share in shares]).to(data)
