"""Rough poses of an articulated shape from the skeleton of what was measured: limbs matched to kinematic chains."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_count, check_finite, check_points, check_shape
from torchreg.alignment.find_pose import typical_poses
from torchreg.alignment.problem import AlignProblem
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rigid import fit_rigid, transform_points
from torchreg.geometry.rotation import so3_exp, so3_log
from torchreg.geometry.skeleton import Skeleton
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.limbs import find_limbs
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.solvers.levenberg_marquardt import Linearization, levenberg_marquardt
from torchreg.spines.curves import points_along
from torchreg.spines.skeletonize import SkeletonizeConfig, skeletonize
from torchreg.spines.tip_matching import TipReference, rank_mappings

# Mappings of limbs to chains whose poses are fitted, per typical pose, and steps of the fit.
_MAPPINGS, _FIT_STEPS = 6, 15
_FEW_VERTICES = 6000
# Joints lie this near to the curves, as a share of the size of the shape; joints bend freely by so much, radians.
_JOINT_STD, _BEND_STD = 0.02, 1.0


@dataclass(frozen=True, eq=False)
class SpineLimbs:
    """A `PoseSource`: the chains of a shape laid along the limbs of a skeleton.

    The tips of the skeleton are matched to the ends of the chains by rigid fits in typical poses; limbs that are no
    chain's, as a forearm cut off, are left over. Each joint of a chain then lies on its limb at the length of its bones
    from the tip, and the pose is fitted to all joints within the limits.

    Args:
        skeleton: of the cloud, such as one frame of a spine or what `skeletonize` returns.
        middle: (3,) mean of the data that are given to `find_pose`, in the coordinates of the skeleton.
        count: poses proposed.

    Raises:
        InputError: if the skeleton has no limb, or a number is out of range.
    """

    skeleton: Skeleton
    middle: Tensor
    count: int = 2

    def __post_init__(self) -> None:
        if not isinstance(self.skeleton, Skeleton):
            raise InputTypeError(f"skeleton must be a Skeleton, got {type(self.skeleton).__name__}")
        if not self.skeleton.limbs:
            raise InputError("skeleton must have a limb, got a single node")
        middle = as_float_tensor(self.middle, "middle")
        check_shape(middle, "middle", (3,))
        check_finite(middle, "middle")
        check_count(self.count, "count", 1)

    @classmethod
    def of_surface(cls, mesh: TriangleMesh, data: Tensor, count: int = 2) -> SpineLimbs:
        """Return the source of the skeleton of a surface, which is made of few vertices: limbs need no more.

        Args:
            mesh: the surface of the shape.
            data: (M, 3) what is given to `find_pose`, such as points of that surface.
            count: poses proposed.

        Raises:
            InputError: as `skeletonize`, or if the data are empty or not finite.
        """
        data = as_float_tensor(data, "data")
        check_points(data, "data", batch=False)
        return cls(skeletonize(mesh, SkeletonizeConfig(max_vertices=_FEW_VERTICES)), data.mean(0), count)

    def __call__(self, problem: AlignProblem, generator: torch.Generator) -> Tensor:
        """Return (B, K, num_dofs) poses, see `PoseSource`; every cloud of a batch is taken for the skeleton's."""
        shape = problem.skin.shape
        chains = _Chains.of(problem.skin)
        limbs = self._limbs(chains.lengths).to(problem.data)
        starts, targets = [], []
        for typical in typical_poses(shape):
            known = chains.places(shape, typical.unsqueeze(0))[0]
            maps, _ = rank_mappings([TipReference(known)], limbs, missing_cost=10.0)
            for row in maps[:_MAPPINGS]:
                pose, target = _laid(typical, known, limbs, row)
                starts.append(pose)
                targets.append(target)
        poses, costs = _fitted(problem, chains, torch.stack(starts), torch.stack(targets))
        best = poses[costs.argsort()[: self.count]]
        return best.expand(len(problem.data), *best.shape)

    def _limbs(self, lengths: Tensor) -> Tensor:
        """Return points (M, K, S, 3) of each limb at the lengths (K, S) of each chain from the tip, centered."""
        skeleton = self.skeleton
        nodes = skeleton.nodes.detach().cpu().double() - self.middle.detach().cpu().double()
        tips = skeleton.tips.tolist()
        # On beyond the junction, towards the farthest tip: the first joint of a finger may lie in the palm.
        ways = [max((skeleton.path(tip, other) for other in tips if other != tip), key=len) for tip in tips]
        return torch.stack([points_along(nodes[way.cpu()], lengths.cpu().double()) for way in ways])


@dataclass(frozen=True, eq=False)
class _Chains:
    """Points along the K chains of a shape, from the tips inwards; shorter chains repeat their last point.

    Args:
        parts: (K, S) part that each point is fixed to.
        offsets: (K, S, 3) of the points in the coordinates of their parts.
        lengths: (K, S) of the bones from the tip.
        weights: (K, S) zero for repeated points.
    """

    parts: Tensor
    offsets: Tensor
    lengths: Tensor
    weights: Tensor

    @classmethod
    def of(cls, skin: LinearBlendSkin) -> _Chains:
        shape = skin.shape
        limbs, _ = find_limbs(shape)
        inner = {body.parent for limb in limbs for body in limb.bodies[:1]}
        ends = [limb for limb in limbs if not inner & set(limb.parts)]
        rows = [_chain_points(skin, limb.parts) for limb in ends]
        size = max(len(parts) for parts, _ in rows)
        parts = torch.tensor([[*some, *[some[-1]] * (size - len(some))] for some, _ in rows])
        offsets = torch.stack([torch.cat((some, some[-1:].expand(size - len(some), 3))) for _, some in rows])
        weights = torch.tensor([[1.0] * len(some) + [0.0] * (size - len(some)) for some, _ in rows]).to(offsets)
        chains = cls(parts, offsets, weights, weights)
        places = chains.places(shape, shape.rest.unsqueeze(0))[0]
        steps = (places[:, 1:] - places[:, :-1]).norm(dim=-1)
        return cls(parts, offsets, torch.nn.functional.pad(steps.cumsum(-1), (1, 0)), weights)

    def places(self, shape: Articulation, poses: Tensor) -> Tensor:
        """Return the points (B, K, S, 3) in poses (B, num_dofs)."""
        transforms = shape.part_transforms(poses)[:, self.parts]
        return (transforms[..., :3, :3] @ self.offsets.unsqueeze(-1)).squeeze(-1) + transforms[..., :3, 3]


def _chain_points(skin: LinearBlendSkin, parts: list[int]) -> tuple[list[int], Tensor]:
    """Return the parts and offsets of a chain's points: its end, then the origins of its parts inwards."""
    transforms = skin.shape.part_transforms(skin.reference_pose)
    last = transforms[parts[-1]]
    local = (skin.points - last[:3, 3]) @ last[:3, :3]
    own = skin.weights[:, parts[-1]] > 0.5
    reach = torch.where(own, local.norm(dim=-1), -1.0)
    end = local[reach.argmax()] if bool(own.any()) else torch.zeros_like(local[0])
    return [parts[-1], *reversed(parts)], torch.cat((end[None], end.new_zeros(len(parts), 3)))


def _laid(typical: Tensor, known: Tensor, limbs: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
    """Return a typical pose laid on the limbs that a mapping (K,) names, and the targets (K, S, 3); NaN for none."""
    found = row >= 0
    target = limbs[row.clamp_min(0), torch.arange(len(row))].to(known)
    weights = found.to(known)[:, None].expand(known.shape[:2]).flatten()
    motion = fit_rigid(known.flatten(0, 1), target.flatten(0, 1), weights)
    pose = typical.clone()
    pose[:3] = transform_points(motion, typical[None, :3])[0]
    pose[3:6] = so3_log(motion[None, :3, :3] @ so3_exp(typical[None, 3:6]))[0]
    return pose, torch.where(found[:, None, None], target, torch.nan)


def _fitted(problem: AlignProblem, chains: _Chains, poses: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
    """Return poses (N, num_dofs) whose chains lie on targets (N, K, S, 3) as far as limits allow, and the costs."""
    shape = problem.skin.shape
    weights = torch.where(targets.isnan().any(-1), 0.0, chains.weights) / (_JOINT_STD * problem.size) ** 2
    targets = targets.nan_to_num()
    middle = poses.clone()
    precision = torch.zeros_like(poses[0])
    precision[6:] = 1 / _BEND_STD**2

    def linearize(state: Tensor) -> Linearization:
        transforms, twists = shape.part_twists(state, chart="tangent")
        own, twist = transforms[:, chains.parts], twists[:, chains.parts]
        places = (own[..., :3, :3] @ chains.offsets.unsqueeze(-1)).squeeze(-1) + own[..., :3, 3]
        moves = twist[..., :3] + torch.linalg.cross(twist[..., 3:], places.unsqueeze(-2).expand_as(twist[..., 3:]))
        error = places - targets
        bent = (state - middle) * precision
        cost = 0.5 * (weights * error.square().sum(-1)).sum((-2, -1)) + 0.5 * (bent * (state - middle)).sum(-1)
        gradient = torch.einsum("nks,nksdi,nksi->nd", weights, moves, error) + bent
        hessian = torch.einsum("nks,nksdi,nksei->nde", weights, moves, moves) + torch.diag(precision)
        return Linearization(cost, gradient, hessian)

    fitted = levenberg_marquardt(
        linearize, poses, retract=shape.retract, lower=problem.lower, upper=problem.upper, max_steps=_FIT_STEPS
    )
    return fitted.state, fitted.cost
