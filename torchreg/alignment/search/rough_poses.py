"""Rough poses of a shape without a start: where they come from, and their rigid registration to the data."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchreg._checks import check_count, check_direction
from torchreg.alignment.fit.annealed_em import narrowing
from torchreg.alignment.fit.problem import AlignProblem
from torchreg.geometry.rigid import fit_rigid, rigid_matrix, transform_points
from torchreg.geometry.rotation import rotation_between, so3_exp, so3_log, spread_rotations
from torchreg.geometry.sampling import farthest_points
from torchreg.geometry.upright import Direction
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.pose_algebra import BASE_DOFS, shifted
from torchreg.solvers.e_step import OUTLIER_CONSTANT, expectation


@dataclass(frozen=True)
class _RigidEM:
    """Numbers of the rigid registration of rough poses; widths are shares of the model's size."""

    start: float = 0.13  # first sigma
    stop: float = 0.05  # last sigma, and that of the kernel in the cost
    steps: int = 3  # at each sigma
    num_points: int = 60  # model points
    num_data: int = 120  # drawn per cloud
    outlier: float = 0.3  # as a share of the usual outlier constant, since few model points share a datum
    model_weight: float = 0.5  # in the cost, of model points far from the data, beside that of data far from the model


_RIGID_EM = _RigidEM()
# Typical poses lie at these shares of the way from the rest pose to the middle of the joint limits.
_BENT_SHARES = (0.2, 0.8)


class PoseSource(Protocol):
    """Something that proposes rough poses: the base near the data, the joints of any plausible pose."""

    def __call__(self, problem: AlignProblem, generator: torch.Generator) -> Tensor:
        """Return (B, K, num_dofs) poses in the coordinates of the problem's data; they are registered rigidly next."""


@dataclass(frozen=True)
class UniformRotations:
    """A `PoseSource`: evenly spread rotations of typical poses, at the median of the data."""

    count: int = 200

    def __call__(self, problem: AlignProblem, generator: torch.Generator) -> Tensor:
        """Return (B, K, num_dofs) poses, see `PoseSource`."""
        joints = typical_poses(problem.skin.shape)
        poses = joints.repeat_interleave(self.count, 0)
        poses[:, 3:BASE_DOFS] = so3_log(spread_rotations(self.count).to(poses)).repeat(len(joints), 1)
        return _at_data_median(problem, poses)


@dataclass(frozen=True)
class PrincipalAxes:
    """A `PoseSource`: the principal axes of typical poses turned onto those of the data, by all four rotations."""

    def __call__(self, problem: AlignProblem, generator: torch.Generator) -> Tensor:
        """Return (B, K, num_dofs) poses, see `PoseSource`."""
        joints = typical_poses(problem.skin.shape)
        model = _principal_axes(problem.skin(joints), torch.ones_like(problem.skin(joints)[..., 0]))
        data = _principal_axes(problem.data, problem.valid.to(problem.data))
        # Axes have no sign: half turns about each of them.
        signs = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]).to(joints)
        turns = data[:, None, None] @ signs.diag_embed() @ model[:, None].mT
        base = so3_exp(joints[:, 3:BASE_DOFS]).unsqueeze(1)
        poses = joints[:, None].expand(len(data), len(joints), len(signs), -1).clone()
        poses[..., 3:BASE_DOFS] = so3_log((turns @ base).flatten(0, 2)).reshape(*poses.shape[:-1], 3)
        return _at_data_median(problem, poses.flatten(1, 2))


@dataclass(frozen=True)
class UprightRotations:
    """A `PoseSource`: typical poses turned about the vertical ``up`` of the data, at their median."""

    up: Direction
    count: int = 12

    def __post_init__(self) -> None:
        check_direction(self.up, "up")
        check_count(self.count, "count", 1)

    def __call__(self, problem: AlignProblem, generator: torch.Generator) -> Tensor:
        """Return (B, K, num_dofs) poses, see `PoseSource`."""
        joints = typical_poses(problem.skin.shape)
        poses = joints.repeat_interleave(self.count, 0)
        rotations = so3_log(self.rotations(problem.skin.shape.up)).to(poses)
        poses[:, 3:BASE_DOFS] = rotations.repeat(len(joints), 1)
        return _at_data_median(problem, poses)

    def rotations(self, own_up: Direction) -> Tensor:
        """Return rotations (count, 3, 3), float64, that take what is upright in a shape (3,) to what is in the data."""
        up, own = (normalize(torch.tensor(axis, dtype=torch.float64), dim=0) for axis in (self.up, own_up))
        angles = torch.arange(self.count, dtype=torch.float64) * (math.tau / self.count)
        return so3_exp(angles.unsqueeze(-1) * up) @ rotation_between(own, up)


DEFAULT_SOURCES: tuple[PoseSource, ...] = (UniformRotations(), PrincipalAxes())


def typical_poses(shape: Articulation) -> Tensor:
    """Return (K, num_dofs) different poses between the rest pose and the middle of the joint limits."""
    middle = 0.5 * (shape.lower + shape.upper)
    way = torch.where(middle.isfinite(), middle - shape.rest, 0.0)
    return torch.stack([shape.rest + share * way for share in _BENT_SHARES]).unique(dim=0)


def _principal_axes(points: Tensor, weights: Tensor) -> Tensor:
    """Return the principal axes (..., 3, 3) of points as columns, a right-handed rotation."""
    weights = (weights / weights.sum(-1, keepdim=True).clamp_min(1)).unsqueeze(-1)
    centered = points - (weights * points).sum(-2, keepdim=True)
    axes = torch.linalg.eigh((weights * centered).mT @ centered).eigenvectors
    return torch.cat([axes[..., :1] * torch.det(axes).sign()[..., None, None], axes[..., 1:]], dim=-1)


def _at_data_median(problem: AlignProblem, poses: Tensor) -> Tensor:
    """Return poses ((B,) K, num_dofs) moved so that the model's center is the median of the data, (B, K, num_dofs)."""
    median = torch.where(problem.valid.unsqueeze(-1), problem.data, torch.nan).nanmedian(-2).values.nan_to_num()
    poses = poses.expand(len(median), *poses.shape[-2:])
    center = problem.skin(poses).mean(-2)
    return shifted(poses, median.unsqueeze(1) - center)


def register_rigidly(problem: AlignProblem, poses: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return poses (B, K, num_dofs) after a rigid EM of a few model points to drawn data, and their costs (B, K)."""
    skin, size = problem.skin, problem.size
    drawn = problem.draw(_RIGID_EM.num_data, generator)
    points = skin(poses)[..., farthest_points(skin.points, min(_RIGID_EM.num_points, len(skin))), :]
    moved, motion = points, torch.eye(4).to(points).expand(*poses.shape[:2], 4, 4)
    data, mask = drawn.data.unsqueeze(1), drawn.valid.unsqueeze(1)
    widths = () if _has_fixed_base(problem) else narrowing(_RIGID_EM.start, _RIGID_EM.stop)
    for width in (width for width in widths for _ in range(_RIGID_EM.steps)):
        outlier = _RIGID_EM.outlier * OUTLIER_CONSTANT
        matches = expectation(moved, data, moved.new_tensor(width * size), outlier, mask=mask)
        motion = fit_rigid(points, matches.targets, matches.weights)
        moved = transform_points(motion, points)
    base = motion @ rigid_matrix(so3_exp(poses[..., 3:BASE_DOFS]), poses[..., :3])
    rotation = so3_log(base[..., :3, :3].flatten(0, 1)).reshape(*poses.shape[:2], 3)
    registered = torch.cat([base[..., :3, 3], rotation, poses[..., BASE_DOFS:]], dim=-1)
    return registered, two_sided_cost(*closeness(moved, drawn, size), drawn)


def _has_fixed_base(problem: AlignProblem) -> bool:
    return bool((problem.lower[..., :BASE_DOFS] == problem.upper[..., :BASE_DOFS]).all())


def closeness(points: Tensor, problem: AlignProblem, size: float) -> tuple[Tensor, Tensor]:
    """Return how near data are to points (B, K, N, 3), and points to data, (B, K, M) and (B, K, N), from 0 to 1."""
    data, valid = problem.data.unsqueeze(1), problem.valid.to(points)[:, None, None]
    kernel = _kernel(points, data, _RIGID_EM.stop * size / math.sqrt(2)) * valid
    return kernel.amax(-2), kernel.amax(-1)


def two_sided_cost(data: Tensor, points: Tensor, problem: AlignProblem) -> Tensor:
    """Return the cost (B, K) of data far from points, and points far from data, by their `closeness`."""
    count = problem.valid.sum(-1, keepdim=True).clamp_min(1)
    return -data.sum(-1) / count - _RIGID_EM.model_weight * points.mean(-1)


def _kernel(points: Tensor, data: Tensor, sigma: float) -> Tensor:
    """Return ``exp(-r^2 / 2 sigma^2)`` (B, K, N, M)."""
    squares = points.square().sum(-1, keepdim=True) + data.square().sum(-1).unsqueeze(-2) - 2 * points @ data.mT
    return (squares.clamp_min_(0) * (-0.5 / sigma**2)).exp_()
