"""Rough poses of an articulated shape from the skeleton of its data: limbs matched to kinematic chains."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchreg._checks import check_count
from torchreg.alignment.fit.problem import BROAD_PRIOR, AlignProblem
from torchreg.alignment.search.rough_poses import typical_poses
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rigid import fit_rigid, transform_points
from torchreg.geometry.rotation import so3_exp, so3_log
from torchreg.geometry.skeleton import Skeleton
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.limbs import find_limbs
from torchreg.shapes.pose_algebra import BASE_DOFS, shifted
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.solvers.levenberg_marquardt import Linearization, levenberg_marquardt
from torchreg.spines.curves import points_along
from torchreg.spines.names.tip_matching import TipReference, rank_mappings
from torchreg.spines.skeletonize import SkeletonizeConfig, skeletonize


@dataclass(frozen=True)
class _ChainFit:
    """Numbers of fitting the chains of a shape to limbs."""

    num_mappings: int = 6  # of limbs to chains whose poses are fitted, per typical pose
    missing: float = 10.0  # cost of a chain without a limb: so high that it is only where limbs are lacking
    steps: int = 15  # of the fit
    joint_std: float = 0.02  # distance of joints from the curves, as a share of the size of the shape
    num_vertices: int = 6000  # of a surface whose skeleton is taken: limbs need no more


_CHAIN_FIT = _ChainFit()


@dataclass(frozen=True, eq=False)
class SpineLimbs:
    """A `PoseSource`: the chains of a shape fitted to the limbs of a skeleton.

    The tips of the skeleton are matched to the ends of the chains by rigid fits in typical poses; limbs without a
    chain, as a forearm cut off, stay unmatched. Each joint of a chain then has its target on its limb, at the length of
    its bones from the tip, and the pose is fitted to all targets within the limits.

    Args:
        skeleton: of the cloud and in its coordinates, such as ``spine.model.skeleton(t)`` or the result of
            `skeletonize`.
        count: poses proposed.

    Raises:
        InputError: if the skeleton has no limb, or a number is out of range.
    """

    skeleton: Skeleton
    count: int = 2

    def __post_init__(self) -> None:
        if not isinstance(self.skeleton, Skeleton):
            raise InputTypeError(f"skeleton must be a Skeleton, got {type(self.skeleton).__name__}")
        if not self.skeleton.limbs:
            raise InputError("skeleton must have a limb, got a single node")
        check_count(self.count, "count", 1)

    @classmethod
    def of_surface(cls, mesh: TriangleMesh, count: int = 2) -> SpineLimbs:
        """Return the source of the skeleton of a surface, of which few vertices are taken: limbs need no more.

        Args:
            mesh: the surface of which the data of `find_pose` are points.
            count: poses proposed.

        Raises:
            InputError: as `skeletonize`.
        """
        skeleton = skeletonize(mesh, SkeletonizeConfig(max_vertices=_CHAIN_FIT.num_vertices))
        return cls(skeleton=skeleton, count=count)

    def __call__(self, problem: AlignProblem, generator: torch.Generator) -> Tensor:
        """Return (B, K, num_dofs) poses, see `PoseSource`; every cloud of a batch is taken for the skeleton's."""
        shape = problem.skin.shape
        chains = _Chains.from_skin(problem.skin)
        limbs = self._limb_points(chains.lengths, problem.origin[0]).to(problem.data)
        starts, targets = [], []
        for typical in typical_poses(shape):
            known = chains.positions(shape, typical.unsqueeze(0))[0]
            maps, _ = rank_mappings([TipReference(known)], limbs, missing_cost=_CHAIN_FIT.missing)
            for row in maps[: _CHAIN_FIT.num_mappings]:
                pose, target = _rigidly_mapped(typical, known, limbs, row)
                starts.append(pose)
                targets.append(target)
        poses, costs = _fit_chains(problem, chains, torch.stack(starts), torch.stack(targets))
        best = poses[costs.argsort()[: self.count]]
        every = best.expand(len(problem.data), *best.shape)
        return shifted(every, (problem.origin[0] - problem.origin).unsqueeze(1).expand(*every.shape[:2], 3))

    def _limb_points(self, lengths: Tensor, origin: Tensor) -> Tensor:
        """Return points (M, K, S, 3) of each limb, at the lengths (K, S) of each chain from the tip, from an origin."""
        skeleton = self.skeleton
        nodes = skeleton.nodes.detach().cpu().double() - origin.cpu().double()
        tips = skeleton.tips.tolist()
        # On beyond the junction, towards the farthest tip: the first joint of a finger may lie in the palm.
        paths = [max((skeleton.path(tip, end) for end in tips if end != tip), key=len) for tip in tips]
        return torch.stack([points_along(nodes[path.cpu()], lengths.cpu().double()) for path in paths])


@dataclass(frozen=True, eq=False)
class _Chains:
    """S points along the K chains of a shape, from the tips inwards; repeats of the last point have weight 0."""

    parts: Tensor
    offsets: Tensor
    lengths: Tensor
    weights: Tensor

    @classmethod
    def from_skin(cls, skin: LinearBlendSkin) -> _Chains:
        """Return the chains of a skin's shape, those of limbs that carry no other limb."""
        shape = skin.shape
        limbs, _ = find_limbs(shape)
        inner = {body.parent for limb in limbs for body in limb.bodies[:1]}
        rows = [_chain_points(skin, limb.parts) for limb in limbs if not inner & set(limb.parts)]
        size = max(len(parts) for parts, _ in rows)
        parts = torch.tensor([[*row, *[row[-1]] * (size - len(row))] for row, _ in rows])
        offsets = torch.stack([torch.cat((row, row[-1:].expand(size - len(row), 3))) for _, row in rows])
        weights = torch.tensor([[1.0] * len(row) + [0.0] * (size - len(row)) for row, _ in rows]).to(offsets)
        positions = _chain_positions(shape, shape.rest.unsqueeze(0), parts, offsets)[0]
        steps = (positions[:, 1:] - positions[:, :-1]).norm(dim=-1)
        return cls(parts=parts, offsets=offsets, lengths=pad(steps.cumsum(-1), (1, 0)), weights=weights)

    def positions(self, shape: Articulation, poses: Tensor) -> Tensor:
        """Return the points (B, K, S, 3) in poses (B, num_dofs)."""
        return _chain_positions(shape, poses, self.parts, self.offsets)


def _chain_positions(shape: Articulation, poses: Tensor, parts: Tensor, offsets: Tensor) -> Tensor:
    return _moved(shape.part_transforms(poses)[:, parts], offsets)


def _moved(transforms: Tensor, offsets: Tensor) -> Tensor:
    return (transforms[..., :3, :3] @ offsets.unsqueeze(-1)).squeeze(-1) + transforms[..., :3, 3]


def _chain_points(skin: LinearBlendSkin, parts: list[int]) -> tuple[list[int], Tensor]:
    """Return the parts and offsets of a chain's points: its end, then the origins of its parts inwards."""
    transforms = skin.shape.part_transforms(skin.reference_pose)
    last = transforms[parts[-1]]
    local = (skin.points - last[:3, 3]) @ last[:3, :3]
    on_last = skin.weights[:, parts[-1]] > 0.5
    reach = torch.where(on_last, local.norm(dim=-1), -1.0)
    end = local[reach.argmax()] if bool(on_last.any()) else torch.zeros_like(local[0])
    return [parts[-1], *reversed(parts)], torch.cat((end[None], end.new_zeros(len(parts), 3)))


def _rigidly_mapped(typical: Tensor, known: Tensor, limbs: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
    """Return a typical pose moved rigidly to the limbs of a mapping (K,), and targets (K, S, 3), NaN without a limb."""
    has_limb = row >= 0
    target = limbs[row.clamp_min(0), torch.arange(len(row))].to(known)
    weights = has_limb.to(known)[:, None].expand(known.shape[:2]).flatten()
    motion = fit_rigid(known.flatten(0, 1), target.flatten(0, 1), weights)
    pose = typical.clone()
    pose[:3] = transform_points(motion, typical[None, :3])[0]
    pose[3:BASE_DOFS] = so3_log(motion[None, :3, :3] @ so3_exp(typical[None, 3:BASE_DOFS]))[0]
    return pose, torch.where(has_limb[:, None, None], target, torch.nan)


def _fit_chains(problem: AlignProblem, chains: _Chains, poses: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
    """Return poses (N, num_dofs) whose chains lie on targets (N, K, S, 3) as far as limits allow, and the costs."""
    shape, mean = problem.skin.shape, poses.clone()
    variance = (_CHAIN_FIT.joint_std * problem.size) ** 2
    weights = torch.where(targets.isnan().any(-1), 0.0, chains.weights) / variance
    targets = targets.nan_to_num()
    precision = torch.zeros_like(poses[0])
    precision[BASE_DOFS:] = 1 / BROAD_PRIOR.turn**2

    def linearize(state: Tensor) -> Linearization:
        transforms, twists = shape.part_twists(state, chart="tangent")
        twist = twists[:, chains.parts]
        positions = _moved(transforms[:, chains.parts], chains.offsets)
        moves = twist[..., :3] + torch.linalg.cross(twist[..., 3:], positions.unsqueeze(-2).expand_as(twist[..., 3:]))
        residual = positions - targets
        bend = (state - mean) * precision
        cost = 0.5 * (weights * residual.square().sum(-1)).sum((-2, -1)) + 0.5 * (bend * (state - mean)).sum(-1)
        gradient = torch.einsum("nks,nksdi,nksi->nd", weights, moves, residual) + bend
        hessian = torch.einsum("nks,nksdi,nksei->nde", weights, moves, moves) + torch.diag(precision)
        return Linearization(cost, gradient, hessian)

    fitted = levenberg_marquardt(
        linearize, poses, retract=shape.retract, lower=problem.lower, upper=problem.upper, max_steps=_CHAIN_FIT.steps
    )
    return fitted.state, fitted.cost
