"""The energy that the T-step minimizes by the motions of all bones: residuals of correspondences, and joints."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from torchreg.geometry.rigid import transform_points
from torchreg.geometry.rotation import skew
from torchreg.registration.blend import blend_dual_quaternion, blend_dual_quaternion_jacobian
from torchreg.registration.bones.correspondences import Correspondences
from torchreg.registration.bones.joint_moments import JointMoments
from torchreg.solvers.levenberg_marquardt import Linearization


@dataclass(frozen=True)
class Binding:
    """Skinning weights (N, B) as a list of E entries: most points follow one or two of many bones."""

    # A smaller weight moves a point by less than the noise of any scan.
    LEAST_WEIGHT: ClassVar[float] = 1e-4

    weights: Tensor
    point: Tensor  # (E,) int64, of each entry; ``bone`` and ``values`` likewise
    bone: Tensor
    values: Tensor
    first: Tensor  # (Q,) int64, first entry of every pair of entries of one point, an entry with itself included
    second: Tensor  # (Q,) int64, second entry of every pair, not before the first
    block: Tensor  # (Q,) int64, block of the Hessian that the pair adds to: first bone times B plus second bone

    @classmethod
    def from_weights(cls, weights: Tensor) -> Binding:
        """Return the list of weights (N, B) without those below `LEAST_WEIGHT`."""
        weights = weights.detach()
        point, bone = (weights > cls.LEAST_WEIGHT).nonzero().unbind(-1)
        entries = torch.arange(len(point), device=point.device)
        # Entries of a point follow each other: each pairs with itself and all later ones of its point.
        partners = torch.bincount(point, minlength=len(weights)).cumsum(0)[point] - entries
        first = entries.repeat_interleave(partners)
        begin = partners.cumsum(0) - partners
        second = first + torch.arange(len(first), device=point.device) - begin[first]
        return cls(
            weights=weights,
            point=point,
            bone=bone,
            values=weights[point, bone],
            first=first,
            second=second,
            block=bone[first] * weights.shape[1] + bone[second],
        )

    @property
    def num_bones(self) -> int:
        """B."""
        return self.weights.shape[1]


@dataclass(frozen=True)
class BoneBodies:
    """Weighted mean (B, 3) and covariance (B, 3, 3) of the points that each bone moves."""

    center: Tensor
    spread: Tensor

    @classmethod
    def from_weights(cls, points: Tensor, weights: Tensor) -> BoneBodies:
        """Return the bodies of bones with weights (N, B) at points (N, 3); a bone without weight moves all points."""
        mass = weights.sum(0)
        shares = torch.where(mass > 0, weights / mass.clamp_min(torch.finfo(mass.dtype).tiny), 1 / len(points))
        origin = points.mean(0)
        local = points - origin
        center = shares.mT @ local
        squares = (shares.mT @ (local.unsqueeze(-1) * local.unsqueeze(-2)).flatten(1)).unflatten(1, (3, 3))
        return cls(origin + center, squares - center.unsqueeze(-1) * center.unsqueeze(-2))


@dataclass(frozen=True)
class BoneProblem:
    """The energy of the bones' motions (eq. 5); problems of a batch share points, weights and bodies.

    ``E = E_dist + beta sum_{i<j} b_ij tau_ij int w_i w_j |T_i x - T_j x|^2 dx + sum_i a_i E_anchor,i``: the mean
    squared residual, see `ScanDistance`; the joint energy, see `JointEnergy`; and the mean squared distance of each
    bone's body from where its anchor takes it.
    """

    points: Tensor  # (N, 3) before they are moved
    binding: Binding
    correspondences: Correspondences
    bodies: BoneBodies  # of the bones, which turn about their centers
    moments: JointMoments = field(default_factory=JointMoments.none)
    joint_weight: float = 1.0  # beta
    pair_weights: Tensor | None = None  # (..., P) b, of the joints; ones by default
    anchors: Tensor | None = None  # (..., B, 4, 4) motions to stay near; none by default
    anchor_weights: float | Tensor = 0.0  # a, one for all bones or (..., B)
    blend: str = "linear"

    @classmethod
    def of_weights(cls, points: Tensor, weights: Tensor, correspondences: Correspondences, **terms: Any) -> BoneProblem:
        """Return the problem of bones that have weights (N, B) at the points; the other terms by name."""
        binding, bodies = Binding.from_weights(weights), BoneBodies.from_weights(points, weights)
        return cls(points=points, binding=binding, correspondences=correspondences, bodies=bodies, **terms)

    def energy(self, transforms: Tensor) -> Tensor:
        """Return E (...) at motions (..., B, 4, 4). Cost: that of `linearize`."""
        return 2 * self.linearize(transforms).cost

    def centers(self, transforms: Tensor) -> Tensor:
        """Return the centers (..., B, 3) of the moved bodies, about which twists turn the bones."""
        return transform_points(transforms, self.bodies.center.unsqueeze(-2)).squeeze(-2)

    def batched(self, transforms: Tensor) -> Tensor:
        """Return motions (..., B, 4, 4) with the batch dimensions of the problem too."""
        batch = self.correspondences.targets.shape[:-2]
        if transforms.shape[:-3] == batch:
            return transforms
        return transforms.expand(
            *np.broadcast_shapes(tuple(transforms.shape[:-3]), tuple(batch)), *transforms.shape[-3:]
        )

    def inertia(self, transforms: Tensor) -> Tensor:
        """Return the quadratic forms (..., B, 6, 6) of twists that give the bodies' mean squared displacement."""
        rotation = transforms[..., :3, :3]
        spread = rotation @ self.bodies.spread @ rotation.mT
        identity = torch.eye(3, dtype=spread.dtype, device=spread.device)
        turning = spread.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * identity - spread
        shifting = nn.functional.pad(identity, (0, 3, 0, 3))
        return shifting + nn.functional.pad(turning, (3, 0, 3, 0))

    def linearize(self, transforms: Tensor, joints: Tensor | None = None) -> Linearization:
        """Return half of E, its gradient and Gauss-Newton Hessian by the 6 B twists at motions (..., B, 4, 4)."""
        transforms = self.batched(transforms)
        equations = _NormalEquations(transforms, self.centers(transforms))
        self._add_correspondences(equations)
        if self._pairwise is not None:
            self._add_pairwise(equations, self._pairwise if joints is None else self._pairwise.at(joints))
        return equations.linearization()

    @cached_property
    def _residual_rows(self) -> tuple[Tensor, Tensor, Tensor]:
        """Targets, rows (..., N, m, 3) that make residuals of offsets, and the rows (..., E, m, 3) of the entries."""
        weights = self.correspondences.weights
        total = weights.sum(-1, keepdim=True).clamp_min(torch.finfo(weights.dtype).tiny)
        root = (weights / total).sqrt()[..., None, None]
        # Targets and normals of dropped matches may be anything.
        targets = torch.where(root[..., 0] > 0, self.correspondences.targets, 0.0)
        rows = root * torch.where(root > 0, self.correspondences.residual_rows(), 0.0)
        return targets, rows, self.binding.values[:, None, None] * rows.index_select(-3, self.binding.point)

    def _add_correspondences(self, equations: _NormalEquations) -> None:
        binding = self.binding
        targets, rows, entry_rows = self._residual_rows
        if self.blend == "linear":
            motions = equations.transforms[..., :3, :].index_select(-3, binding.bone)
            points = self.points.index_select(0, binding.point)
            images = (motions[..., :3] @ points.unsqueeze(-1)).squeeze(-1) + motions[..., 3]
            zeros = images.new_zeros(*images.shape[:-2], len(self.points), 3)
            moved = zeros.index_add_(-2, binding.point, binding.values.unsqueeze(-1) * images)
            arms = (images - equations.centers.index_select(-2, binding.bone)).unsqueeze(-2)
            entry_rows = entry_rows.expand(*arms.shape[:-2], *entry_rows.shape[-2:])
            jacobian = torch.cat([entry_rows, torch.linalg.cross(arms, entry_rows)], dim=-1)
        else:
            motions = equations.transforms
            moved = blend_dual_quaternion(self.points, binding.weights, motions)
            by_twists = blend_dual_quaternion_jacobian(self.points, binding.weights, motions, equations.centers)
            by_entries = by_twists.transpose(-2, -3)[..., binding.point, binding.bone, :, :]
            jacobian = rows.index_select(-3, binding.point) @ by_entries
        residual = (rows @ (moved - targets).unsqueeze(-1)).squeeze(-1)
        equations.cost = 0.5 * residual.square().sum((-1, -2))
        gradient = (jacobian * residual.index_select(-2, binding.point).unsqueeze(-1)).sum(-2)
        equations.add_gradient(gradient, binding.bone)
        first, second = jacobian.index_select(-3, binding.first), jacobian.index_select(-3, binding.second)
        # One row each: an outer product is faster than a batch of matrix products.
        equations.add_blocks(first.mT * second if rows.shape[-2] == 1 else first.mT @ second, binding.block)

    @cached_property
    def _pairwise(self) -> _PairwiseFactors | None:
        """Joints between bones, then anchors, which follow the B bones as numbers B to 2 B - 1."""
        size, device = self.binding.num_bones, self.points.device
        num_joints = len(self.moments.pairs) if self.joint_weight > 0 else 0
        factors: list[tuple[Tensor, Tensor, Tensor, float | Tensor]] = []
        if num_joints:
            moments, pair_weights = self.moments, 1.0 if self.pair_weights is None else self.pair_weights
            factors.append((moments.pairs, moments.center, moments.spread, self.joint_weight * pair_weights))
        if self.anchors is not None:
            bones = torch.arange(size, device=device)
            pairs = torch.stack([bones, bones + size], dim=-1)
            factors.append((pairs, self.bodies.center, self.bodies.spread, self.anchor_weights))
        if not factors:
            return None
        weights = [_per_factor(weight, len(pairs), self.points) for pairs, _, _, weight in factors]
        batch = np.broadcast_shapes(*(tuple(weight.shape[:-1]) for weight in weights))
        weight = torch.cat([weight.expand(*batch, weight.shape[-1]) for weight in weights], dim=-1)
        pairs, centers, spreads = (torch.cat(column) for column in list(zip(*factors, strict=True))[:3])
        first, second = pairs.unbind(-1)
        ends = torch.cat([first, second])
        free = ends[: len(first) + num_joints]
        blocks = torch.cat([free * (size + 1), first[:num_joints] * size + second[:num_joints]])
        frames = _factor_rows(centers, spreads)
        return _PairwiseFactors(ends, torch.cat([frames, frames]), weight.sqrt(), blocks, num_joints)

    def _add_pairwise(self, equations: _NormalEquations, factors: _PairwiseFactors) -> None:
        count, joints = len(factors.ends) // 2, factors.num_joints
        motions = equations.transforms
        if self.anchors is not None:
            motions = torch.cat([motions, self.anchors.expand(motions.shape)], dim=-3)
        root = factors.root[..., None, None]
        images = factors.frames @ motions.index_select(-3, factors.ends)[..., :3, :].mT
        residual = (root * (images[..., :count, :, :] - images[..., count:, :, :])).flatten(-2)
        equations.cost = equations.cost + 0.5 * residual.square().sum((-1, -2))
        # Anchors stay: of the second ends only those of the joints move.
        free, frames = factors.ends[: count + joints], factors.frames[: count + joints]
        roots = torch.cat([root, root[..., :joints, :, :]], dim=-3)
        shares = roots * frames[..., 3:]
        pivots = equations.centers.index_select(-2, free).unsqueeze(-2)
        arms = roots * images[..., : count + joints, :, :] - shares * pivots
        identity = torch.eye(3, dtype=arms.dtype, device=arms.device)
        by_translation = (shares.unsqueeze(-1) * identity).expand(*arms.shape, 3)
        jacobian = torch.cat([by_translation, -skew(arms)], dim=-1).flatten(-3, -2)
        residuals = torch.cat([residual, -residual[..., :joints, :]], dim=-2)
        equations.add_gradient((jacobian.mT @ residuals.unsqueeze(-1)).squeeze(-1), free)
        mixed = jacobian[..., :joints, :, :].mT @ jacobian[..., count:, :, :]
        equations.add_blocks(torch.cat([jacobian.mT @ jacobian, -mixed], dim=-3), factors.blocks)


class _PairwiseFactors(NamedTuple):
    """Squared distances between the images of a body under two motions, one factor each."""

    ends: Tensor  # (2 S,) first motions of the S factors, joints before anchors, then second motions
    # (2 S, 4, 4) of both ends: homogeneous rows whose squared images under a difference of motions add up to the mean
    # over the body
    frames: Tensor
    root: Tensor  # (..., S) of the factors' weights
    blocks: Tensor  # of the Hessian: those of every end that moves, then those of the joints' pairs
    num_joints: int

    def at(self, joints: Tensor) -> _PairwiseFactors:
        """Return the factors with the joints at other centers (P, 3)."""
        frames = self.frames.clone()
        frames.unflatten(0, (2, -1))[:, : self.num_joints, 0, :3] = joints
        return self._replace(frames=frames)


def _per_factor(weight: float | Tensor, count: int, like: Tensor) -> Tensor:
    """Return weights (..., count) of one for all or of one for each."""
    weight = torch.as_tensor(weight, dtype=like.dtype, device=like.device)
    return weight.expand(count) if weight.ndim == 0 else weight


def _factor_rows(center: Tensor, spread: Tensor) -> Tensor:
    """Return (S, 4, 4): the rows (c, 1) and (l_k, 0) with ``sum l_k l_k^T`` the spread."""
    squares, axes = torch.linalg.eigh(spread)
    arms = (axes * squares.clamp_min(0).sqrt().unsqueeze(-2)).mT
    homogeneous = torch.cat([center, torch.ones_like(center[:, :1])], dim=-1)
    return torch.cat([homogeneous.unsqueeze(-2), nn.functional.pad(arms, (0, 1))], dim=-2)


class _NormalEquations:
    """Cost, gradient and Hessian under construction."""

    def __init__(self, transforms: Tensor, centers: Tensor) -> None:
        self.transforms, self.centers = transforms, centers
        batch, self.size = transforms.shape[:-3], transforms.shape[-3]
        self.cost = transforms.new_zeros(())
        self.gradient = transforms.new_zeros(*batch, self.size, 6)
        self.blocks = transforms.new_zeros(*batch, self.size * self.size, 36)

    def add_gradient(self, values: Tensor, bone: Tensor) -> None:
        self.gradient.index_add_(-2, bone, values)

    def add_blocks(self, values: Tensor, block: Tensor) -> None:
        """Add blocks (..., Q, 6, 6) of the upper triangle, numbered first bone times B plus second."""
        self.blocks.index_add_(-2, block, values.flatten(-2))

    def linearization(self) -> Linearization:
        size = 6 * self.size
        blocks = self.blocks.unflatten(-1, (6, 6)).unflatten(-3, (self.size, self.size))
        # The blocks on the diagonal are whole already, and would count twice.
        blocks.diagonal(dim1=-4, dim2=-3).mul_(0.5)
        upper = blocks.transpose(-2, -3).reshape(*self.blocks.shape[:-2], size, size)
        return Linearization(self.cost, self.gradient.flatten(-2), upper + upper.mT)
