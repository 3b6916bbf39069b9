"""Fitting the motions of all bones at once to matched points while joints hold: the T-step of scan registration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from torchreg._checks import check_choice, check_count, check_positive, check_same_kind, check_shape
from torchreg.errors import InputError
from torchreg.geometry.blend import blend_dual_quaternion, blend_dual_quaternion_jacobian, turn_about
from torchreg.geometry.joint_moments import JointMoments
from torchreg.geometry.rigid import transform_points
from torchreg.geometry.rotation import skew
from torchreg.losses.scan import check_share
from torchreg.models.grid_lbs import BLENDS
from torchreg.solvers.levenberg_marquardt import Linearization, damped_step

# A share of a point smaller than this moves it by less than the noise of any scan.
_MIN_WEIGHT = 1e-4
_DAMPING_DOWN, _DAMPING_UP = 0.2, 6.0
_LARGEST_DAMPING = 1e7
_ROUNDING = 10.0


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
        if self.bodies is None:
            object.__setattr__(self, "bodies", bone_bodies(self.points, self.binding.weights))

    def energy(self, transforms: Tensor) -> Tensor:
        """Return E (...) at motions (..., B, 4, 4). Cost: that of `linearize`."""
        return 2 * self.linearize(transforms).cost

    def centers(self, transforms: Tensor) -> Tensor:
        """Return where the bones' middles are (..., B, 3), about which twists turn them."""
        return transform_points(transforms, self.bodies.middle.unsqueeze(-2)).squeeze(-2)

    def linearize(self, transforms: Tensor) -> Linearization:
        """Return half of E, its gradient and Gauss-Newton Hessian by the 6 B twists at motions (..., B, 4, 4)."""
        system = _System(transforms, self.centers(transforms))
        self._add_matches(system)
        if self.moments is not None and len(self.moments.pairs) and self.joint_weight > 0:
            self._add_joints(system, self.moments)
        if self.anchors is not None:
            self._add_anchors(system, self.anchors)
        return system.linearization()

    def _add_matches(self, system: _System) -> None:
        bound = self.binding
        moved, sloped = self._moved(system)
        off = moved - self.targets
        weights = torch.ones_like(off[..., 0]) if self.match_weights is None else self.match_weights
        total = weights.sum(-1, keepdim=True).clamp_min(torch.finfo(off.dtype).tiny)
        root = (weights / total).sqrt()[..., None, None]
        # Targets of dropped matches may be anything.
        off = torch.where(root[..., 0] > 0, off, 0.0)
        rows = torch.where(root > 0, self._metric_rows(off), 0.0) * root
        residual = (rows @ off.unsqueeze(-1)).squeeze(-1)
        slopes = sloped(rows.index_select(-3, bound.point))
        system.cost = system.cost + 0.5 * residual.square().sum((-1, -2))
        system.add_gradient((slopes * residual.index_select(-2, bound.point).unsqueeze(-1)).sum(-2), bound.bone)
        left, right = slopes.index_select(-3, bound.first), slopes.index_select(-3, bound.second)
        # One row each: an outer product is faster than a batch of matrix products.
        system.add_blocks(left.mT * right if rows.shape[-2] == 1 else left.mT @ right, bound.slot)

    def _moved(self, system: _System) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Return moved points (..., N, 3), and what takes rows (..., E, m, 3) to their slopes (..., E, m, 6)."""
        bound, transforms = self.binding, system.transforms
        if self.blend != "linear":
            jacobian = blend_dual_quaternion_jacobian(self.points, bound.weights, transforms, system.centers)
            chosen = jacobian.transpose(-2, -3)[..., bound.point, bound.bone, :, :]
            return blend_dual_quaternion(self.points, bound.weights, transforms), lambda rows: rows @ chosen
        table = transforms[..., :3, :].index_select(-3, bound.bone)
        image = (table[..., :3] @ self.points.index_select(0, bound.point).unsqueeze(-1)).squeeze(-1) + table[..., 3]
        blank = image.new_zeros(*image.shape[:-2], len(self.points), 3)
        moved = blank.index_add_(-2, bound.point, bound.share.unsqueeze(-1) * image)
        arms = (image - system.centers.index_select(-2, bound.bone)).unsqueeze(-2)

        def slopes(rows: Tensor) -> Tensor:
            shared = bound.share[:, None, None] * rows
            return torch.cat([shared, torch.linalg.cross(arms, shared)], dim=-1)

        return moved, slopes

    def _metric_rows(self, off: Tensor) -> Tensor:
        """Return the root of ``(1 - s) n n^T + s I``, (..., N, 3, 3), or of ``n n^T``, (..., N, 1, 3)."""
        identity = torch.eye(3, dtype=off.dtype, device=off.device)
        if self.normals is None or self.point_to_point == 1:
            return identity.expand(*off.shape, 3)
        if self.point_to_point == 0:
            return self.normals.unsqueeze(-2)
        root = self.point_to_point**0.5
        return (1 - root) * self.normals.unsqueeze(-1) * self.normals.unsqueeze(-2) + root * identity

    def _add_joints(self, system: _System, moments: JointMoments) -> None:
        weight = self.joint_weight * (1.0 if self.pair_weights is None else self.pair_weights)
        weight = torch.as_tensor(weight, dtype=self.points.dtype, device=self.points.device)
        weight = weight.expand(len(moments.pairs)) if weight.ndim == 0 else weight
        first, second = moments.pairs.unbind(-1)
        # Both bones of every pair in one go: a solver's step spends its time on calls, not on numbers.
        ends = _Carried(moments.center, moments.spread, system, torch.cat([first, second]))
        place, other_place = ends.place.chunk(2, -2)
        slopes, other_slopes = ends.slopes.chunk(2, -3)
        gap, cross = place - other_place, ends.spread.chunk(2, -3)[0] @ ends.rotation.chunk(2, -3)[1].mT
        system.cost = system.cost + (weight * _misfit(gap, cross, moments.spread)).sum(-1)
        force = weight.unsqueeze(-1) * torch.cat([gap, _twice_axis(cross)], dim=-1)
        system.add_gradient(ends.twisted(torch.cat([force, -force], dim=-2)), ends.bones)
        weight = weight[..., None, None]
        system.add_blocks(torch.cat([weight, weight], dim=-3) * ends.blocks(), ends.bones * (system.size + 1))
        mixed = slopes.mT @ other_slopes + _turning(cross.mT)
        system.add_blocks(-weight * mixed, first * system.size + second)

    def _add_anchors(self, system: _System, anchors: Tensor) -> None:
        bodies, size = self.bodies, self.binding.num_bones
        weight = torch.as_tensor(self.anchor_weights, dtype=self.points.dtype, device=self.points.device)
        weight = weight.expand(size) if weight.ndim == 0 else weight
        bones = torch.arange(size, device=anchors.device)
        ends = _Carried(bodies.middle, bodies.spread, system, bones)
        gap = ends.place - transform_points(anchors, bodies.middle.unsqueeze(-2)).squeeze(-2)
        cross = ends.spread @ anchors[..., :3, :3].mT
        system.cost = system.cost + (weight * _misfit(gap, cross, bodies.spread)).sum(-1)
        system.add_gradient(ends.twisted(weight.unsqueeze(-1) * torch.cat([gap, _twice_axis(cross)], dim=-1)), bones)
        system.add_blocks(weight[..., None, None] * ends.blocks(), bones * (size + 1))


class _Carried:
    """Masses with center and spread S as bones carry them.

    Half the mean of ``|T_i x - T_j x|^2`` over such a mass is half the squared gap of its centers and, with
    K = R_i S R_j^T, ``tr S - tr K``: neither it nor its derivatives need a root of S.
    """

    def __init__(self, center: Tensor, spread: Tensor, system: _System, bones: Tensor) -> None:
        repeat = len(bones) // len(center)
        transforms = system.transforms.index_select(-3, bones)
        self.bones, self.rotation = bones, transforms[..., :3, :3]
        self.place = (self.rotation @ center.repeat(repeat, 1).unsqueeze(-1)).squeeze(-1) + transforms[..., :3, 3]
        self.spread = self.rotation @ spread.repeat(repeat, 1, 1)
        self.arm = self.place - system.centers.index_select(-2, bones)
        self.slopes = _place_slopes(self.arm)

    def twisted(self, force: Tensor) -> Tensor:
        """Return gradients (..., P, 6) by twists of forces at the center and moments, (..., P, 6) in one."""
        pull, turn = force[..., :3], force[..., 3:]
        return torch.cat([pull, torch.linalg.cross(self.arm, pull) + turn], dim=-1)

    def blocks(self) -> Tensor:
        """Return the Hessians (..., P, 6, 6) by twists of the bone itself."""
        return self.slopes.mT @ self.slopes + _turning(self.spread @ self.rotation.mT)


def _misfit(gap: Tensor, cross: Tensor, spread: Tensor) -> Tensor:
    """Return half the mean squared distance (...) of masses whose centers are ``gap`` apart, with K ``cross``."""
    return 0.5 * gap.square().sum(-1) + _trace(spread) - _trace(cross)


def _twice_axis(k: Tensor) -> Tensor:
    """Return the vector of ``K - K^T``: the gradient of ``-tr K`` by a turn of the first rotation."""
    return torch.stack([k[..., 2, 1] - k[..., 1, 2], k[..., 0, 2] - k[..., 2, 0], k[..., 1, 0] - k[..., 0, 1]], dim=-1)


def _turning(product: Tensor) -> Tensor:
    """Return ``tr(P) I - P`` (..., 3, 3) as the turning part of blocks (..., 6, 6)."""
    identity = torch.eye(3, dtype=product.dtype, device=product.device)
    return nn.functional.pad(_trace(product)[..., None, None] * identity - product, (3, 0, 3, 0))


class _System:
    """Cost, gradient and Hessian under construction."""

    def __init__(self, transforms: Tensor, centers: Tensor) -> None:
        self.transforms, self.centers = transforms, centers
        batch, self.size = transforms.shape[:-3], transforms.shape[-3]
        self.cost = transforms.new_zeros(batch)
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


@dataclass(frozen=True)
class BoneFit:
    """Motions that fit matches.

    Args:
        transforms: (..., B, 4, 4).
        energy: (...) at them.
        damping: (...) to continue with.
        num_steps: linear systems solved.
        converged: (...) whether the last step was within the tolerance.
    """

    transforms: Tensor
    energy: Tensor
    damping: Tensor
    num_steps: int
    converged: Tensor


@torch.no_grad()
def bone_step(
    problem: BoneProblem, transforms: Tensor, *, damping: float = 1e-6, fixed: Tensor | None = None
) -> Tensor:
    """Return the motions after one Gauss-Newton step, ``R <- exp(w) R`` about the bones' middles, untested.

    Args:
        problem: the problem.
        transforms: (..., B, 4, 4) to start from.
        damping: of the diagonal of the normal equations, relative.
        fixed: (B,) bool, bones to hold.

    Returns:
        (..., B, 4, 4).

    Differentiable: no.

    Cost: 4 ms for 2,000 points and 40 bones on one core.

    References: Chang and Zwicker 2009, section 4.1.
    """
    check_positive(damping, "damping")
    start = transforms
    transforms = _batched(problem, transforms)
    flat = _flat(problem.linearize(transforms))
    twists = damped_step(flat, flat.cost.new_full(flat.cost.shape, damping), frozen=_frozen(fixed, flat))
    return _turned(problem, transforms, twists).to(start)


@torch.no_grad()
def fit_bones(
    problem: BoneProblem,
    transforms: Tensor,
    *,
    fixed: Tensor | None = None,
    max_steps: int = 5,
    rtol: float = 1e-4,
    damping: Tensor | None = None,
) -> BoneFit:
    """Return the motions of least energy that damped Gauss-Newton steps find, each problem of a batch by itself.

    Args:
        problem: the problem.
        transforms: (..., B, 4, 4) to start from.
        fixed: (B,) bool, bones to hold.
        max_steps: most linear systems.
        rtol: a problem is done when a step changes its energy by less than this share.
        damping: (...) to start with, as an earlier fit of the same kind returned; 1e-6 by default.

    Returns:
        a `BoneFit`.

    Raises:
        InputError: if a shape does not fit.

    Differentiable: no.

    References: Chang and Zwicker 2009, eq. 5; Marquardt 1963.
    """
    check_count(max_steps, "max_steps", 1)
    check_positive(rtol, "rtol", allow_zero=True)
    transforms = _batched(problem, transforms)
    current = problem.linearize(transforms)
    least = 4 * transforms.shape[-3] * 6 * torch.finfo(transforms.dtype).eps
    level = torch.full_like(current.cost, 1e-6) if damping is None else damping.expand(current.cost.shape)
    # An energy of nothing but rounding falls no further.
    floor = (_ROUNDING * torch.finfo(transforms.dtype).eps) ** 2 * float(_trace(problem.bodies.spread).mean())
    done = torch.zeros_like(current.cost, dtype=torch.bool)
    steps = 0
    while steps < max_steps and not bool(done.all()):
        steps += 1
        flat = _flat(current)
        twists = damped_step(flat, level.reshape(-1).clamp_min(least), frozen=_frozen(fixed, flat))
        trial_transforms = _turned(problem, transforms, twists)
        trial = problem.linearize(trial_transforms)
        better = (trial.cost <= current.cost) & ~done
        small = (current.cost - trial.cost).abs() <= rtol * current.cost + floor
        transforms = torch.where(better[..., None, None, None], trial_transforms, transforms)
        level = torch.where(better, level * _DAMPING_DOWN, level * _DAMPING_UP).clamp(least, _LARGEST_DAMPING)
        current = Linearization(
            torch.where(better, trial.cost, current.cost),
            torch.where(better[..., None], trial.gradient, current.gradient),
            torch.where(better[..., None, None], trial.hessian, current.hessian),
        )
        done = done | small
    return BoneFit(transforms, 2 * current.cost, level, steps, done)


def _batched(problem: BoneProblem, transforms: Tensor) -> Tensor:
    """Return the motions with the batch dimensions of the problem."""
    check_shape(transforms, "transforms", (problem.binding.num_bones, 4, 4), batch=True)
    check_same_kind(transforms, "transforms", problem.points, "points")
    batch = problem.targets.shape[:-2]
    if transforms.shape[:-3] == batch:
        return transforms
    return transforms.expand(*torch.broadcast_shapes(transforms.shape[:-3], batch), *transforms.shape[-3:])


def _flat(problem: Linearization) -> Linearization:
    size = problem.gradient.shape[-1]
    return Linearization(
        problem.cost.reshape(-1), problem.gradient.reshape(-1, size), problem.hessian.reshape(-1, size, size)
    )


def _frozen(fixed: Tensor | None, like: Linearization) -> Tensor | None:
    if fixed is None:
        return None
    check_shape(fixed, "fixed", (like.gradient.shape[-1] // 6,))
    return fixed.to(like.gradient.device).repeat_interleave(6).expand(like.gradient.shape)


def _turned(problem: BoneProblem, transforms: Tensor, twists: Tensor) -> Tensor:
    """Return motions moved on by flat twists, their rotations made orthogonal to rounding."""
    moved = turn_about(transforms, twists.reshape(*transforms.shape[:-2], 6), problem.centers(transforms))
    rotation = moved[..., :3, :3]
    # One Newton step to the nearest rotation: products of many would drift.
    moved[..., :3, :3] = 1.5 * rotation - 0.5 * rotation @ rotation.mT @ rotation
    return moved


def _place_slopes(arms: Tensor) -> Tensor:
    """Return the derivatives (..., 3, 6) of places by twists about a point that is ``arms`` (..., 3) away."""
    identity = torch.eye(3, dtype=arms.dtype, device=arms.device).expand(*arms.shape, 3)
    return torch.cat([identity, -skew(arms)], dim=-1)


def _trace(matrix: Tensor) -> Tensor:
    return matrix.diagonal(dim1=-2, dim2=-1).sum(-1)
