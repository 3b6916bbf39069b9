"""Placing the limbs of a shape on data, given where its trunk lies.

The joints of each limb are tried body by body over their whole range; the configurations that explain most data are
kept, diverse ones, and moved onto the data; then the limbs are combined so that no two explain the same data.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.alignment.fit.problem import BALL_AXES, PRIOR_SHARE, AlignProblem
from torchreg.alignment.search.multi_start import SEARCH_BUDGET, distinct_first, rows_in_memory, take_rows
from torchreg.geometry.rigid import invert_rigid, rigid_matrix
from torchreg.geometry.rotation import so3_exp, so3_log
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.limbs import Body, Limb, find_limbs
from torchreg.shapes.pose_algebra import BASE_DOFS
from torchreg.solvers.cover import best_covers
from torchreg.solvers.robust import welsch_loss, welsch_weight


@dataclass(frozen=True)
class Effort:
    """Thoroughness of placing limbs. Widths are shares of the model's size."""

    num_data: int
    width: float
    beam: int
    configurations: int
    refine_widths: tuple[float, ...]
    score_width: float
    combinations: int
    exchanged: int


@dataclass(frozen=True)
class _Sampling:
    """Sampling of the joints between a body and its parent."""

    angle: float = math.radians(16)  # between neighboring samples of a hinge
    free_range: float = 2 * math.pi  # of a hinge without limits: all around
    ball_range: float = 2.4  # of each axis of a ball joint without limits, radians: more would repeat rotations
    max_count: int = 64  # samples of all joints between two bodies
    slide_count: int = 8  # samples of a joint that slides


@dataclass(frozen=True)
class _Placement:
    """Numbers of the beam search over a limb's bodies and of the steps that refine its configurations."""

    max_tried: int = 1500  # configurations of a body, per problem
    near_shares: float = 3.0  # data near its root that a limb is tried on, as multiples of its share among all limbs
    min_loss: float = 0.02  # of a datum, so that those which the trunk explains count as far from the root
    same: float = 0.25  # configurations of a limb whose joints all differ by less are duplicates, radians
    max_step: float = 0.3  # of a joint, radians or metres


_SAMPLING = _Sampling()
_PLACEMENT = _Placement()


@dataclass(frozen=True)
class _Beam:
    """Configurations (B, K, num_dofs) of a limb, losses (B, K, M) from 0 (explained) to 1, frames of the next body."""

    poses: Tensor
    losses: Tensor
    frames: Tensor

    def take(self, index: Tensor) -> _Beam:
        return _Beam(take_rows(self.poses, index), take_rows(self.losses, index), take_rows(self.frames, index))


def joint_samples(shape: Articulation, body: Body) -> Tensor:
    """Return samples (G, dofs) of the joints between a body and its parent; none if those only follow others."""
    dofs = list(body.dofs)
    if not dofs:
        return shape.rest.new_zeros(0, 0)
    free = _SAMPLING.free_range if len(dofs) < BALL_AXES else _SAMPLING.ball_range
    lower, upper = shape.lower[dofs], shape.upper[dofs]
    lower = torch.where(lower.isfinite(), lower, torch.where(upper.isfinite(), upper - free, -free / 2))
    upper = torch.where(upper.isfinite(), upper, lower + free)
    counts = [
        _SAMPLING.slide_count if shape.is_sliding[dof] else max(2, math.ceil(width / _SAMPLING.angle))
        for dof, width in zip(dofs, (upper - lower).tolist(), strict=True)
    ]
    if math.prod(counts) > _SAMPLING.max_count:
        shares = torch.quasirandom.SobolEngine(len(dofs), scramble=True, seed=0).draw(
            _SAMPLING.max_count, dtype=torch.float32
        )
    else:
        grids = torch.meshgrid(
            *[(torch.arange(count, dtype=torch.float32) + 0.5) / count for count in counts], indexing="ij"
        )
        shares = torch.stack(grids, dim=-1).reshape(-1, len(dofs))
    return lower + (upper - lower) * shares.to(lower)


def trunk_turns(problem: AlignProblem, poses: Tensor) -> Tensor:
    """Return poses (B, G, num_dofs) of which the trunk alone differs, by samples of the joints that it hangs on.

    All else stays where poses (B, num_dofs) have it. None where several limbs hold the trunk, or it is known.
    """
    shape, (limbs, trunk) = problem.skin.shape, find_limbs(problem.skin.shape)
    first = [limb.bodies[0] for limb in limbs if limb.level == 0]
    samples = joint_samples(shape, first[0]) if len(first) == 1 and trunk else shape.rest.new_zeros(0, 0)
    dofs = [*range(BASE_DOFS), *(first[0].dofs if len(first) == 1 else ())]
    told = problem.lower == problem.upper
    if problem.prior_precision is not None:
        told = told | (problem.prior_precision > 0)
    if len(samples) == 0 or bool(told[..., dofs].any()):
        return poses.new_zeros(len(poses), 0, poses.shape[-1])
    turned = poses.unsqueeze(1).repeat(1, len(samples), 1)
    turned[..., dofs[BASE_DOFS:]] = samples
    limb, moved = (shape.part_transforms(each)[..., first[0].parts[0], :, :] for each in (poses.unsqueeze(1), turned))
    base = limb @ invert_rigid(moved) @ rigid_matrix(so3_exp(poses[:, 3:BASE_DOFS]), poses[:, :3]).unsqueeze(1)
    turned[..., :3] = base[..., :3, 3]
    turned[..., 3:BASE_DOFS] = so3_log(base[..., :3, :3].flatten(0, 1)).unflatten(0, base.shape[:2])
    return turned


class LimbSearch:
    """The samples of a shape's joints, and the search over them."""

    def __init__(self, shape: Articulation) -> None:
        self.shape = shape
        limbs, self.trunk = find_limbs(shape)
        self.limbs = [limb for limb in limbs if limb.dofs]
        self.parts = {limb: limb.parts for limb in self.limbs}
        for follower in limbs:
            if not follower.dofs:
                # A limb whose joints are all mimics, as the second jaw of a gripper, goes with the limb they follow.
                leader = self._leader(follower)
                self.parts[leader] = self.parts[leader] + follower.parts
        bodies = [body for limb in self.limbs for body in limb.bodies]
        self.samples = {body: joint_samples(shape, body) for body in bodies}
        # Mimic joints of a body follow joints elsewhere, so its samples do not determine its transforms.
        self.relative = {} if shape.kinematics.has_mimics else {body: self._sampled_transforms(body) for body in bodies}

    def __call__(self, problem: AlignProblem, poses: Tensor, effort: Effort, generator: torch.Generator) -> Tensor:
        """Return the best limb configurations (B, C, num_dofs) on the trunks of poses (B, num_dofs), tried as well."""
        if not self.limbs:
            return poses.unsqueeze(1)
        rows = rows_in_memory(len(poses), effort.num_data * _PLACEMENT.max_tried, poses.device)
        subset = problem.draw(effort.num_data, generator)
        found = [_Search(self, problem.rows(row), subset.rows(row), effort).run(poses[row]) for row in rows]
        return torch.cat(found)

    def knows(self, problem: AlignProblem, limb: Limb) -> bool:
        """Return whether the joints of a limb are known beforehand as well as samples would tell them."""
        if problem.prior_precision is None:
            return False
        slides = (self.shape.upper - self.shape.lower) / _SAMPLING.slide_count
        spacing = torch.where(self.shape.is_sliding, slides, _SAMPLING.angle)[limb.dofs]
        return bool((problem.prior_precision[:, limb.dofs].rsqrt() <= spacing).all())

    def _leader(self, follower: Limb) -> Limb:
        """Return the limb whose degrees of freedom move the first body of one that has none."""
        kinematics, first = self.shape.kinematics, follower.bodies[0]
        moves = kinematics.moves[self.shape.part_index]
        joints = moves[first.parts[0]] - moves[first.parent] if first.parent >= 0 else moves[first.parts[0]]
        driven = joints.to(kinematics.couplings) @ kinematics.couplings.abs() > 0
        return max(self.limbs, key=lambda limb: int(driven[[dof - BASE_DOFS for dof in limb.dofs]].sum()))

    def _sampled_transforms(self, body: Body) -> Tensor:
        poses = self.shape.rest.repeat(len(self.samples[body]), 1)
        poses[:, list(body.dofs)] = self.samples[body]
        return self.transforms_on_parent(body, poses, self.shape.part_transforms(poses))

    def transforms_on_parent(self, body: Body, poses: Tensor, transforms: Tensor) -> Tensor:
        """Return the transforms (..., P, 4, 4) of a body's parts in the frame of the part it hangs on."""
        parent = self.parent_frame(body, poses, transforms)
        return invert_rigid(parent).unsqueeze(-3) @ transforms[..., list(body.parts), :, :]

    def parent_frame(self, body: Body, poses: Tensor, transforms: Tensor) -> Tensor:
        """Return the frame (..., 4, 4) that a body hangs on, given all part transforms."""
        if body.parent < 0:
            return rigid_matrix(so3_exp(poses[..., 3:6]), poses[..., :3])
        return transforms[..., body.parent, :, :]


class _Search:
    """One search over a batch: samples are tried on a subset of the data, combinations on ``problem``."""

    def __init__(self, limbs: LimbSearch, problem: AlignProblem, subset: AlignProblem, effort: Effort) -> None:
        self.limbs, self.shape, self.effort, self.subset = limbs, limbs.shape, effort, subset
        self.problem = problem if effort.refine_widths else subset
        self.width = effort.width * problem.size
        self.score_width = effort.score_width * problem.size
        self.known = [limb for limb in limbs.limbs if limbs.knows(problem, limb)]

    def run(self, poses: Tensor) -> Tensor:
        """Return the best poses (B, C, num_dofs) with the trunk where ``poses`` have it."""
        transforms = self.shape.part_transforms(poses).unsqueeze(1)[:, :, self.limbs.trunk]
        score_losses = self._part_losses(self.problem, transforms, self.limbs.trunk, self.score_width)[:, 0]
        losses = self._part_losses(self.subset, transforms, self.limbs.trunk, self.width)
        found = poses.unsqueeze(1)
        for limb in self.known:
            losses = torch.minimum(losses, self._limb_losses(self.subset, found, limb, self.width))
            known = self._limb_losses(self.problem, found, limb, self.score_width)[:, 0]
            score_losses = torch.minimum(score_losses, known)
        sought = [limb for limb in self.limbs.limbs if limb not in self.known]
        for level in sorted({limb.level for limb in sought}):
            # Limbs that hang on limbs are placed on the best combination of those.
            pose = found[:, 0]
            members = [limb for limb in sought if limb.level == level]
            placed = [self._place(pose, losses, score_losses, limb) for limb in members]
            index = self._combine(pose, score_losses, placed)
            found = pose.unsqueeze(1).repeat(1, index.shape[1], 1)
            for number, (limb, (options, tables)) in enumerate(zip(members, placed, strict=True)):
                chosen = index[..., number]
                found[..., limb.dofs] = take_rows(options, chosen)[..., limb.dofs]
                score_losses = torch.minimum(score_losses, take_rows(tables, chosen[:, :1])[:, 0])
                losses = torch.minimum(losses, self._limb_losses(self.subset, found[:, :1], limb, self.width))
        return found

    def _combine(self, pose: Tensor, score_losses: Tensor, placed: list[tuple[Tensor, Tensor]]) -> Tensor:
        """Return the best choices (B, C, L) of one configuration per limb."""
        cost = PRIOR_SHARE * self.problem.prior.cost(pose.unsqueeze(1))
        index, _ = best_covers(
            score_losses,
            [tables for _, tables in placed],
            [PRIOR_SHARE * self.problem.prior.cost(options) - cost for options, _ in placed],
            count=self.effort.combinations,
            num_exchanged=self.effort.exchanged,
        )
        return index

    def _place(self, pose: Tensor, losses: Tensor, score_losses: Tensor, limb: Limb) -> tuple[Tensor, Tensor]:
        """Return configurations (B, K, num_dofs) of a limb and the losses (B, K, M) of the data with each of them."""
        transforms = self.shape.part_transforms(pose)
        frame = self.limbs.parent_frame(limb.bodies[0], pose, transforms)
        near, losses = self._near_data(losses, frame[..., :3, 3])
        beam = _Beam(pose.unsqueeze(1), losses, frame.unsqueeze(1))
        strata = 1
        for body in limb.bodies:
            beam = self._extended(near, beam, body, pose, transforms)
            strata = beam.poses.shape[1] if strata == 1 else strata
            beam = self._pruned(beam, strata, self.effort.beam)
        if self.effort.refine_widths:
            poses = self._refined(near, beam.poses, losses, limb)
        else:
            poses = self._pruned(beam, strata, self.effort.configurations).poses
        limb_losses = self._limb_losses(self.problem, poses, limb, self.score_width)
        tables = torch.minimum(limb_losses, score_losses.unsqueeze(1))
        cost = tables.sum(-1) + PRIOR_SHARE * self.problem.prior.cost(poses)
        index = _diverse(poses[..., limb.dofs], cost, self.effort.configurations)
        return take_rows(poses, index), take_rows(tables, index)

    def _near_data(self, losses: Tensor, root: Tensor) -> tuple[AlignProblem, Tensor]:
        """Return the data of the subset nearest to a limb's root (B, 3) that the trunk leaves, and losses (B, 1, M)."""
        distance = (self.subset.data - root.unsqueeze(1)).norm(dim=-1)
        count = math.ceil(min(1.0, _PLACEMENT.near_shares / len(self.limbs.limbs)) * distance.shape[1])
        index = (distance / (losses[:, 0] + _PLACEMENT.min_loss)).topk(count, dim=1, largest=False).indices
        near = replace(self.subset, data=take_rows(self.subset.data, index), valid=self.subset.valid.gather(1, index))
        return near, losses.gather(2, index.unsqueeze(1))

    def _extended(self, near: AlignProblem, beam: _Beam, body: Body, pose: Tensor, transforms: Tensor) -> _Beam:
        """Return the beam with one more body, at samples of its joints and as in ``pose``."""
        batch, count = beam.poses.shape[:2]
        dofs, samples = list(body.dofs), self.limbs.samples[body]
        num_kept = min(len(samples), max(1, _PLACEMENT.max_tried // count - 1))
        kept = torch.linspace(0, len(samples) - 1, num_kept, dtype=torch.float32).round().long()
        samples = samples[kept]
        values = torch.cat([samples.expand(batch, *samples.shape), pose[:, None, dofs]], dim=1)
        lower, upper = (limit.expand_as(pose)[:, None, dofs] for limit in (near.lower, near.upper))
        # Samples know the shape's limits alone, not what is held.
        held = bool((lower == upper).any())
        values = torch.minimum(torch.maximum(values, lower), upper) if held else values
        poses = beam.poses.unsqueeze(2).repeat(1, 1, values.shape[1], 1)
        poses[..., dofs] = values.unsqueeze(1)
        if body in self.limbs.relative and not held:
            sampled = self.limbs.relative[body][kept]
            given = self.limbs.transforms_on_parent(body, pose, transforms).unsqueeze(1)
            relative = torch.cat([sampled.expand(batch, *sampled.shape), given], dim=1).unsqueeze(1)
        else:
            relative = self.limbs.transforms_on_parent(body, poses, self.shape.part_transforms(poses))
        placed = (beam.frames[:, :, None, None] @ relative).flatten(1, 2)
        losses = self._part_losses(near, placed, list(body.parts), self.width).unflatten(1, (count, -1))
        losses = torch.minimum(losses, beam.losses.unsqueeze(2)).flatten(1, 2)
        return _Beam(poses.flatten(1, 2), losses, placed[:, :, 0])

    def _pruned(self, beam: _Beam, strata: int, keep: int) -> _Beam:
        """Return the best configurations; of each sample of the limb's first body equally many, so that all survive."""
        cost = beam.losses.sum(-1) + PRIOR_SHARE * self.subset.prior.cost(beam.poses)
        if keep < strata:
            return beam.take(cost.topk(min(keep, cost.shape[1]), largest=False).indices)
        cost = cost.unflatten(1, (strata, -1))
        best = cost.topk(min(keep // strata, cost.shape[-1]), dim=-1, largest=False).indices
        first = torch.arange(strata, device=cost.device).unsqueeze(-1) * cost.shape[-1]
        return beam.take((best + first).flatten(1))

    def _refined(self, problem: AlignProblem, poses: Tensor, losses: Tensor, limb: Limb) -> Tensor:
        """Return configurations after Gauss-Newton steps of the limb's joints, on data that the trunk leaves."""
        dofs = limb.dofs
        prior = problem.prior
        precision, mean = prior.precision[..., dofs], prior.mean[..., None, dofs]
        precision = precision.reshape(-1, 1, len(dofs))
        # The data of the subset count for all.
        share = self.problem.valid.sum(-1).to(losses) / self.subset.valid.sum(-1).clamp_min(1)
        noise = SEARCH_BUDGET.noise * problem.size
        weights = (losses * problem.valid.unsqueeze(1)) * (share / noise**2)[:, None, None]
        lower, upper = (limit.expand_as(poses[:, 0])[:, None, dofs] for limit in (problem.lower, problem.upper))
        for width in self.effort.refine_widths:
            distance, jacobian = self.shape.distance_jacobian(
                problem.data.unsqueeze(1), poses, chart="tangent", parts=self.limbs.parts[limb], dofs=dofs
            )
            near = welsch_weight((distance / (width * problem.size)).square())
            weighted = jacobian * (weights * near).unsqueeze(-1)
            values = poses[..., dofs]
            gradient = (weighted.mT @ distance.unsqueeze(-1)).squeeze(-1) + precision * (values - mean)
            # A unit of precision holds joints that no datum reaches.
            hessian = weighted.mT @ jacobian + torch.diag_embed(precision + 1)
            step = torch.linalg.solve(hessian, gradient).clamp(-_PLACEMENT.max_step, _PLACEMENT.max_step)
            poses = poses.clone()
            poses[..., dofs] = torch.minimum(torch.maximum(values - step, lower), upper)
        return poses

    def _part_losses(self, problem: AlignProblem, transforms: Tensor, parts: list[int], width: float) -> Tensor:
        """Return the losses (B, K, M) of data on parts at transforms (B, K, P, 4, 4)."""
        if not parts:
            return problem.valid.to(problem.data).unsqueeze(1)
        distance = self.shape.placed_distances(problem.data.unsqueeze(1), transforms, parts).amin(-2)
        return _losses(problem, distance, width)

    def _limb_losses(self, problem: AlignProblem, poses: Tensor, limb: Limb, width: float) -> Tensor:
        """Return the losses (B, K, M) of data on a limb in poses (B, K, num_dofs)."""
        distance = self.shape.distance(problem.data.unsqueeze(1), poses, parts=self.limbs.parts[limb])
        return _losses(problem, distance, width)


def _losses(problem: AlignProblem, distance: Tensor, width: float) -> Tensor:
    return welsch_loss((distance / width).square()) * problem.valid.unsqueeze(1)


def _diverse(joints: Tensor, cost: Tensor, count: int) -> Tensor:
    """Return the indices (B, C) of the best of K configurations (B, K, d), those that differ before the others."""
    order = cost.argsort(1)
    joints = take_rows(joints, order)
    close = (joints.unsqueeze(2) - joints.unsqueeze(1)).abs().amax(-1) < _PLACEMENT.same
    return order.gather(1, distinct_first(close)[:, :count])
