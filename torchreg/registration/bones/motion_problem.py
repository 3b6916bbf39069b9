"""What the T-step of scan registration minimizes: distances of matches and joints, by the motions of all bones."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchreg._checks import check_choice, check_positive, check_same_kind, check_shape
from torchreg.errors import InputError
from torchreg.geometry.rigid import transform_points
from torchreg.geometry.rotation import skew
from torchreg.registration.blend import blend_dual_quaternion, blend_dual_quaternion_jacobian
from torchreg.registration.bones.distance_loss import check_share
from torchreg.registration.bones.grid_lbs import BLENDS
from torchreg.registration.bones.joint_moments import JointMoments
from torchreg.solvers.levenberg_marquardt import Linearization

# A share of a point smaller than this moves it by less than the noise of any scan.
_MIN_WEIGHT = 1e-4


@dataclass(frozen=True)
class Binding:
    """Which bones move which points, as a list: most points have one or two of many bones.

    Args:
        weights: (N, B) of the points.
        point: (E,) int64, of each entry of the list.
        bone: (E,) int64.
        share: (E,) the weight of the bone at the point.
        first: (Q,) int64 entries of one point, in all pairs, an entry with itself included, and
        second: (Q,) int64 the other entry of the pair, not before the first.
        slot: (Q,) int64, bone of the first times B plus bone of the second.
    """

    weights: Tensor
    point: Tensor
    bone: Tensor
    share: Tensor
    first: Tensor
    second: Tensor
    slot: Tensor

    @property
    def num_bones(self) -> int:
        """B."""
        return self.weights.shape[1]


@dataclass(frozen=True)
class BoneBodies:
    """What each bone carries, as a mass with center and spread.

    Args:
        mass: (B,).
        middle: (B, 3).
        spread: (B, 3, 3) mean of ``(x - middle) (x - middle)^T``, squared units.
    """

    mass: Tensor
    middle: Tensor
    spread: Tensor


def bind(weights: Tensor) -> Binding:
    """Return the list of bones that move points, of weights (N, B); those below 1e-4 are left out.

    Raises:
        InputError: if the shape does not fit.
    """
    check_shape(weights, "weights", ("N", "B"))
    weights = weights.detach()
    point, bone = (weights > _MIN_WEIGHT).nonzero().unbind(-1)
    count = torch.bincount(point, minlength=len(weights))
    # Entries of a point follow each other: entry e pairs with itself and all later ones of its point.
    left = count.cumsum(0)[point] - torch.arange(len(point), device=point.device)
    first = torch.arange(len(point), device=point.device).repeat_interleave(left)
    begin = left.cumsum(0) - left
    second = first + torch.arange(len(first), device=point.device) - begin[first]
    slot = bone[first] * weights.shape[1] + bone[second]
    return Binding(weights, point, bone, weights[point, bone], first, second, slot)


def bone_bodies(points: Tensor, weights: Tensor) -> BoneBodies:
    """Return what bones carry of points (N, 3) with weights (N, B); a bone without points has all of them as its body.

    Differentiable: in both.
    """
    check_shape(points, "points", ("N", 3))
    check_shape(weights, "weights", (len(points), "B"))
    mass = weights.sum(0)
    share = torch.where(mass > 0, weights / mass.clamp_min(torch.finfo(mass.dtype).tiny), 1 / len(points))
    origin = points.mean(0)
    local = points - origin
    middle = share.mT @ local
    squares = (share.mT @ (local.unsqueeze(-1) * local.unsqueeze(-2)).flatten(1)).unflatten(1, (3, 3))
    return BoneBodies(mass, origin + middle, squares - middle.unsqueeze(-1) * middle.unsqueeze(-2))


@dataclass(frozen=True)
class BoneProblem:
    """What the bones' motions shall achieve; problems of a batch share points and weights.

    ``E = E_dist + beta sum_{i<j} b_ij tau_ij int w_i w_j |T_i x - T_j x|^2 dx + sum_i a_i E_stay,i``: the mean squared
    distance of matched points, see `ScanDistance`; the joints, see `JointEnergy`; and the mean squared distance of what
    each bone carries from where given motions would take it.

    Args:
        points: (N, 3) before they are moved.
        binding: of the points to B bones, see `bind`.
        targets: (..., N, 3) what each moved point is matched with.
        normals: (..., N, 3) unit normals at the targets; None only where ``point_to_point`` is one.
        match_weights: (..., N) not negative, zero for dropped matches; ones by default.
        point_to_point: share of the point-to-point distance, 0 to 1.
        moments: what the bones share, None for no joints.
        joint_weight: beta.
        pair_weights: (..., P) b, how much each joint counts; ones by default.
        bodies: what each bone carries; by default what ``points`` say. Bones turn about its middle.
        anchors: (..., B, 4, 4) the motions to stay near; none by default.
        anchor_weights: a, one for all bones, or (..., B).
        blend: how bones share points, see `GridLBS`.

    Raises:
        InputError: if a shape does not fit, normals are missing or a weight is negative.
        InputTypeError: if dtypes or devices differ.

    References: Chang and Zwicker 2009, eq. 5.
    """

    points: Tensor
    binding: Binding
    targets: Tensor
    normals: Tensor | None = None
    match_weights: Tensor | None = None
    point_to_point: float = 0.0
    moments: JointMoments | None = None
    joint_weight: float = 1.0
    pair_weights: Tensor | None = None
    bodies: BoneBodies = field(default=None)  # type: ignore[assignment]
    anchors: Tensor | None = None
    anchor_weights: float | Tensor = 0.0
    blend: str = "linear"

    def __post_init__(self) -> None:
        check_share(self.point_to_point, "point_to_point")
        check_positive(self.joint_weight, "joint_weight", allow_zero=True)
        check_choice(self.blend, "blend", BLENDS)
        count, size = self.binding.weights.shape
        check_shape(self.points, "points", (count, 3))
        check_shape(self.targets, "targets", (count, 3), batch=True)
        check_same_kind(self.targets, "targets", self.points, "points")
        check_same_kind(self.binding.weights, "weights", self.points, "points")
        if self.normals is not None:
            check_shape(self.normals, "normals", (count, 3), batch=True)
        elif self.point_to_point < 1:
            raise InputError("normals are needed for point to plane; pass them, or set point_to_point=1")
        if self.match_weights is not None:
            check_shape(self.match_weights, "match_weights", (count,), batch=True)
        if self.pair_weights is not None:
            pairs = 0 if self.moments is None else len(self.moments.pairs)
            check_shape(self.pair_weights, "pair_weights", (pairs,), batch=True)
        if self.anchors is not None:
            check_shape(self.anchors, "anchors", (size, 4, 4), batch=True)
        for name in ("match_weights", "pair_weights", "anchor_weights"):
            value = getattr(self, name)
            if value is not None and bool((torch.as_tensor(value) < 0).any()):
                raise InputError(f"{name} must not be negative, got {float(torch.as_tensor(value).min()):g}")
        if self.bodies is None:
            object.__setattr__(self, "bodies", bone_bodies(self.points, self.binding.weights))

    def energy(self, transforms: Tensor) -> Tensor:
        """Return E (...) at motions (..., B, 4, 4). Cost: that of `linearize`."""
        return 2 * self.linearize(transforms).cost

    def centers(self, transforms: Tensor) -> Tensor:
        """Return where the bones' middles are (..., B, 3), about which twists turn them."""
        return transform_points(transforms, self.bodies.middle.unsqueeze(-2)).squeeze(-2)

    def batched(self, transforms: Tensor) -> Tensor:
        """Return motions (..., B, 4, 4) with the batch dimensions of the problem too.

        Raises:
            InputError: if a shape does not fit.
            InputTypeError: if dtypes or devices differ.
        """
        check_shape(transforms, "transforms", (self.binding.num_bones, 4, 4), batch=True)
        check_same_kind(transforms, "transforms", self.points, "points")
        batch = self.targets.shape[:-2]
        if transforms.shape[:-3] == batch:
            return transforms
        return transforms.expand(*torch.broadcast_shapes(transforms.shape[:-3], batch), *transforms.shape[-3:])

    def inertia(self, transforms: Tensor) -> Tensor:
        """Return the matrices (..., B, 6, 6) that make of a bone's twist the mean squared shift of what it carries."""
        rotation = transforms[..., :3, :3]
        spread = rotation @ self.bodies.spread @ rotation.mT
        identity = torch.eye(3, dtype=spread.dtype, device=spread.device)
        turning = spread.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * identity - spread
        shifting = nn.functional.pad(identity, (0, 3, 0, 3))
        return shifting + nn.functional.pad(turning, (3, 0, 3, 0))

    def linearize(self, transforms: Tensor, joints: Tensor | None = None) -> Linearization:
        """Return half of E, its gradient and Gauss-Newton Hessian by the 6 B twists at motions (..., B, 4, 4).

        With ``joints`` (P, 3), these are the centers of the moments.
        """
        transforms = self.batched(transforms)
        system = _System(transforms, self.centers(transforms))
        self._add_matches(system)
        if self._springs is not None:
            self._add_springs(system, self._springs if joints is None else self._springs.at(joints))
        return system.linearization()

    @cached_property
    def _matches(self) -> tuple[Tensor, Tensor, Tensor]:
        """Targets, rows (..., N, m, 3) whose products with offsets are residuals, and rows (..., E, m, 3) by entry."""
        weights = torch.ones_like(self.targets[..., 0]) if self.match_weights is None else self.match_weights
        total = weights.sum(-1, keepdim=True).clamp_min(torch.finfo(weights.dtype).tiny)
        root = (weights / total).sqrt()[..., None, None]
        # Targets and normals of dropped matches may be anything.
        targets = torch.where(root[..., 0] > 0, self.targets, 0.0)
        rows = root * torch.where(root > 0, self._metric_rows(), 0.0)
        return targets, rows, self.binding.share[:, None, None] * rows.index_select(-3, self.binding.point)

    def _metric_rows(self) -> Tensor:
        """Return the root of ``(1 - s) n n^T + s I``, (..., N, 3, 3), or of ``n n^T``, (..., N, 1, 3)."""
        identity = torch.eye(3, dtype=self.points.dtype, device=self.points.device)
        if self.normals is None or self.point_to_point == 1:
            return identity.expand(len(self.points), 3, 3)
        if self.point_to_point == 0:
            return self.normals.unsqueeze(-2)
        root = self.point_to_point**0.5
        return (1 - root) * self.normals.unsqueeze(-1) * self.normals.unsqueeze(-2) + root * identity

    def _add_matches(self, system: _System) -> None:
        bound = self.binding
        targets, rows, entry_rows = self._matches
        if self.blend == "linear":
            table = system.transforms[..., :3, :].index_select(-3, bound.bone)
            places = self.points.index_select(0, bound.point)
            image = (table[..., :3] @ places.unsqueeze(-1)).squeeze(-1) + table[..., 3]
            blank = image.new_zeros(*image.shape[:-2], len(self.points), 3)
            moved = blank.index_add_(-2, bound.point, bound.share.unsqueeze(-1) * image)
            arms = (image - system.centers.index_select(-2, bound.bone)).unsqueeze(-2)
            entry_rows = entry_rows.expand(*arms.shape[:-2], *entry_rows.shape[-2:])
            slopes = torch.cat([entry_rows, torch.linalg.cross(arms, entry_rows)], dim=-1)
        else:
            moved = blend_dual_quaternion(self.points, bound.weights, system.transforms)
            jacobian = blend_dual_quaternion_jacobian(self.points, bound.weights, system.transforms, system.centers)
            chosen = jacobian.transpose(-2, -3)[..., bound.point, bound.bone, :, :]
            slopes = rows.index_select(-3, bound.point) @ chosen
        residual = (rows @ (moved - targets).unsqueeze(-1)).squeeze(-1)
        system.cost = 0.5 * residual.square().sum((-1, -2))
        system.add_gradient((slopes * residual.index_select(-2, bound.point).unsqueeze(-1)).sum(-2), bound.bone)
        left, right = slopes.index_select(-3, bound.first), slopes.index_select(-3, bound.second)
        # One row each: an outer product is faster than a batch of matrix products.
        system.add_blocks(left.mT * right if rows.shape[-2] == 1 else left.mT @ right, bound.slot)

    @cached_property
    def _springs(self) -> _Springs | None:
        """What holds bones to each other, and to anchors, which follow the B bones as numbers B to 2 B - 1."""
        size, like = self.binding.num_bones, self.points
        pairs, centers, spreads, weights = [], [], [], []
        num_joints = 0
        if self.moments is not None and len(self.moments.pairs) and self.joint_weight > 0:
            num_joints = len(self.moments.pairs)
            pairs.append(self.moments.pairs)
            centers.append(self.moments.center)
            spreads.append(self.moments.spread)
            scale = self.joint_weight * (1.0 if self.pair_weights is None else self.pair_weights)
            weights.append(_per_spring(scale, num_joints, like))
        if self.anchors is not None:
            bones = torch.arange(size, device=like.device)
            pairs.append(torch.stack([bones, bones + size], dim=-1))
            centers.append(self.bodies.middle)
            spreads.append(self.bodies.spread)
            weights.append(_per_spring(self.anchor_weights, size, like))
        if not pairs:
            return None
        lead = torch.broadcast_shapes(*(weight.shape[:-1] for weight in weights))
        weight = torch.cat([weight.expand(*lead, weight.shape[-1]) for weight in weights], dim=-1)
        first, second = torch.cat(pairs).unbind(-1)
        ends = torch.cat([first, second])
        moving = ends[: len(first) + num_joints]
        slots = torch.cat([moving * (size + 1), first[:num_joints] * size + second[:num_joints]])
        frames = _frames(torch.cat(centers), torch.cat(spreads))
        return _Springs(ends, torch.cat([frames, frames]), weight.sqrt(), slots, num_joints)

    def _add_springs(self, system: _System, springs: _Springs) -> None:
        count, joints = len(springs.ends) // 2, springs.num_joints
        table = system.transforms
        if self.anchors is not None:
            table = torch.cat([table, self.anchors.expand(table.shape)], dim=-3)
        root = springs.root[..., None, None]
        image = springs.frames @ table.index_select(-3, springs.ends)[..., :3, :].mT
        residual = (root * (image[..., :count, :, :] - image[..., count:, :, :])).flatten(-2)
        system.cost = system.cost + 0.5 * residual.square().sum((-1, -2))
        # Anchors stay: of the second ends only those of the joints move.
        moving, frames = springs.ends[: count + joints], springs.frames[: count + joints]
        scaled = torch.cat([root, root[..., :joints, :, :]], dim=-3)
        share = scaled * frames[..., 3:]
        pivots = system.centers.index_select(-2, moving).unsqueeze(-2)
        arms = scaled * image[..., : count + joints, :, :] - share * pivots
        identity = torch.eye(3, dtype=arms.dtype, device=arms.device)
        pushes = (share.unsqueeze(-1) * identity).expand(*arms.shape, 3)
        slopes = torch.cat([pushes, -skew(arms)], dim=-1).flatten(-3, -2)
        forces = torch.cat([residual, -residual[..., :joints, :]], dim=-2)
        system.add_gradient((slopes.mT @ forces.unsqueeze(-1)).squeeze(-1), moving)
        mixed = slopes[..., :joints, :, :].mT @ slopes[..., count:, :, :]
        system.add_blocks(torch.cat([slopes.mT @ slopes, -mixed], dim=-3), springs.slots)


class _Springs(NamedTuple):
    """Pairs of motions that are to take masses to the same place.

    Args:
        ends: (2 S,) the first motions of S springs, joints before anchors, then the second ones.
        frames: (2 S, 4, 4) of both ends: rows in homogeneous coordinates whose squared images, under the difference of
            two motions, add up to the mean over the mass.
        root: (..., S) of the springs' weights.
        slots: of the Hessian's blocks: those of every end that moves, then those of the joints' pairs.
        num_joints: how many of the springs hold two bones.
    """

    ends: Tensor
    frames: Tensor
    root: Tensor
    slots: Tensor
    num_joints: int

    def at(self, joints: Tensor) -> _Springs:
        """Return the springs with the joints at other centers (P, 3)."""
        frames = self.frames.clone()
        frames.unflatten(0, (2, -1))[:, : self.num_joints, 0, :3] = joints
        return self._replace(frames=frames)


def _per_spring(weight: float | Tensor, count: int, like: Tensor) -> Tensor:
    """Return weights (..., count) of one for all or of one for each."""
    weight = torch.as_tensor(weight, dtype=like.dtype, device=like.device)
    return weight.expand(count) if weight.ndim == 0 else weight


def _frames(center: Tensor, spread: Tensor) -> Tensor:
    """Return (S, 4, 4): the rows (c, 1) and (l_k, 0) with ``sum l_k l_k^T`` the spread."""
    squares, axes = torch.linalg.eigh(spread)
    arms = (axes * squares.clamp_min(0).sqrt().unsqueeze(-2)).mT
    place = torch.cat([center, torch.ones_like(center[:, :1])], dim=-1)
    return torch.cat([place.unsqueeze(-2), nn.functional.pad(arms, (0, 1))], dim=-2)


class _System:
    """Cost, gradient and Hessian under construction."""

    def __init__(self, transforms: Tensor, centers: Tensor) -> None:
        self.transforms, self.centers = transforms, centers
        batch, self.size = transforms.shape[:-3], transforms.shape[-3]
        self.cost = transforms.new_zeros(())
        self.gradient = transforms.new_zeros(*batch, self.size, 6)
        self.blocks = transforms.new_zeros(*batch, self.size * self.size, 36)

    def add_gradient(self, values: Tensor, bone: Tensor) -> None:
        self.gradient.index_add_(-2, bone, values)

    def add_blocks(self, values: Tensor, slot: Tensor) -> None:
        """Add blocks (..., Q, 6, 6) of the upper triangle at slots first * B + second."""
        self.blocks.index_add_(-2, slot, values.flatten(-2))

    def linearization(self) -> Linearization:
        size = 6 * self.size
        blocks = self.blocks.unflatten(-1, (6, 6)).unflatten(-3, (self.size, self.size))
        # The blocks on the diagonal are whole already, and would count twice.
        blocks.diagonal(dim1=-4, dim2=-3).mul_(0.5)
        upper = blocks.transpose(-2, -3).reshape(*self.blocks.shape[:-2], size, size)
        return Linearization(self.cost, self.gradient.flatten(-2), upper + upper.mT)
