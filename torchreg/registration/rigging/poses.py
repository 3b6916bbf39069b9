"""Poses of a rig: from the motions of its bones, and by surfaces that correspond to nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.neighbors import NeighborTree, nearest_neighbor
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rotation import so3_log
from torchreg.registration.rigging.config import RigConfig
from torchreg.registration.rigging.distances import surface_distances
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.pose_algebra import BASE_DOFS, difference, retract
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.solvers.levenberg_marquardt import Linearization, damped_step
from torchreg.solvers.robust import welsch_weight


@dataclass(frozen=True)
class _Matching:
    """Numbers of matches between surfaces."""

    normal_reach: float = 0.05  # diagonals that normals a unit apart count as: surfaces back to back must not match
    damping: float = 1e-3  # relative, of a Gauss-Newton step: bones that no match holds must not turn far


_MATCHING = _Matching()


def poses_of_motions(shape: ArticulatedShape, motions: Tensor) -> Tensor:
    """Return poses (T, D) in which bones turn as motions (T, B, 4, 4) from rest do; only the root's shifts are kept."""
    turns = motions[..., :3, :3]
    pose = shape.rest_pose().double().repeat(len(motions), 1)
    pose[:, :3], pose[:, 3:BASE_DOFS] = motions[:, 0, :3, 3], so3_log(turns[:, 0].contiguous())
    place = {name: number for number, name in enumerate(shape.dof_names)}
    for bone, parent in enumerate(shape.part_parents):
        if parent < 0:
            continue
        local = turns[:, parent].mT @ turns[:, bone]
        angles = (
            torch.atan2(-local[:, 1, 2], local[:, 2, 2]),
            torch.asin(local[:, 0, 2].clamp(-1, 1)),
            torch.atan2(-local[:, 0, 1], local[:, 0, 0]),
        )
        for axis, angle in zip("xyz", angles, strict=True):
            pose[:, place[f"{shape.part_names[bone]}_{axis}"]] = angle
    return pose.to(shape.rest)


@dataclass(frozen=True)
class FittedPose:
    """A pose (D,) and the mean distance of the two surfaces in it, in diagonals."""

    pose: Tensor
    error: float


class SurfaceFitter:
    """Fits poses of a rig to coarse scans by matches both ways, ever narrower."""

    def __init__(self, shape: ArticulatedShape, scan: RangeScan, config: RigConfig) -> None:
        """Take a rig, and a coarse scan of its surface whose points are vertices of it."""
        full = shape.file_skin()
        self.index, _ = nearest_neighbor(scan.points, full.points)
        self.skin = LinearBlendSkin(
            shape, full.points[self.index], full.weights[self.index], full.reference_pose, normals=scan.normals
        )
        self.shape, self.size, self.config = shape, float(scan.diagonal), config

    def fit(self, scan: RangeScan, starts: Sequence[Tensor]) -> FittedPose:
        """Return the best pose found from several starts (D,), the last of which is that of the neighbor in time."""
        target = _Target.of(scan, self.size)
        return min((self._descend(target, start, starts[-1]) for start in starts), key=lambda found: found.error)

    def _descend(self, target: _Target, start: Tensor, neighbor: Tensor) -> FittedPose:
        pose, config = start.double(), self.config
        first, last = config.width
        for number in range(config.rounds):
            width = first * (last / first) ** (number / max(1, config.rounds - 1))
            problem = self._linearized(target, pose, neighbor.double(), width * self.size)
            step, _ = damped_step(problem, pose.new_full((1,), _MATCHING.damping))
            pose = retract(pose, step[0])
        return FittedPose(pose, self.error(target, pose))

    def error(self, target: _Target, pose: Tensor) -> float:
        """Return the mean two-way distance of the surfaces, in diagonals."""
        points, normals = self.skin(pose), self.skin.posed_normals(pose)
        index, back = target.match(points, normals)
        forward = surface_distances(points - target.points[index], target.normals[index], target.spacing)
        forward = forward[target.inside[index]]
        backward = surface_distances(target.points - points[back], normals[back], target.spacing)
        # A scan of nothing but borders shows how far it is from the rig, not the rig from it.
        parts = [part.mean() for part in (forward, backward) if len(part)]
        return float(sum(parts)) / len(parts) / self.size

    def _linearized(self, target: _Target, pose: Tensor, neighbor: Tensor, width: float) -> Linearization:
        """Return matches both ways at a pose (D,) as one least-squares problem, with a prior about the neighbor."""
        points, jacobian = self.skin.jacobian(pose, chart="tangent")
        index, back = target.match(points, self.skin.posed_normals(pose))
        model = torch.cat((torch.arange(len(points)), back))
        data = torch.cat((index, torch.arange(len(target.points))))
        residual = (points[model] - target.points[data]) / self.size
        weight = welsch_weight(residual.square().sum(-1) * (self.size / width) ** 2)
        sizes = torch.tensor([len(index), len(back)]).repeat_interleave(torch.tensor([len(index), len(back)]))
        # Beyond the border of a scan the surface goes on unseen.
        seen = torch.cat((target.inside[index], target.inside.new_ones(len(back))))
        direction = target.normals[data]
        metric = (weight * seen / sizes)[:, None, None] * (
            direction[:, :, None] * direction[:, None, :] + self.config.along * torch.eye(3, dtype=points.dtype)
        )
        weighted = (metric @ residual[:, :, None])[..., 0]
        # Sums over the matches of each model point make the product with the Jacobian small.
        count = len(points)
        metrics = metric.new_zeros(count, 3, 3).index_add(0, model, metric)
        forces = weighted.new_zeros(count, 3).index_add(0, model, weighted)
        scaled = jacobian / self.size
        flat = scaled.reshape(-1, scaled.shape[-1])
        joints = torch.zeros_like(pose)
        joints[BASE_DOFS:] = self.config.stay**2
        gradient = flat.mT @ forces.reshape(-1) + joints * difference(neighbor, pose)
        hessian = flat.mT @ (metrics @ scaled).reshape(flat.shape) + torch.diag(joints)
        return Linearization(gradient.new_zeros(1), gradient[None], hessian[None])


@dataclass(frozen=True)
class _Target:
    """A scan's points and normals (M, 3), whether they are inside its border (M,), and a tree of points and normals."""

    points: Tensor
    normals: Tensor
    inside: Tensor
    spacing: float
    reach: float
    tree: NeighborTree

    @classmethod
    def of(cls, scan: RangeScan, size: float) -> _Target:
        reach = _MATCHING.normal_reach * size
        tree = NeighborTree(torch.cat((scan.points, reach * scan.normals), 1))
        return cls(scan.points, scan.normals, ~scan.boundary, scan.spacing, reach, tree)

    def match(self, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        """Return the target's nearest point (N,) of each model point, and the model's (M,) of each of the target."""
        both = torch.cat((points, self.reach * normals), 1)
        own = torch.cat((self.points, self.reach * self.normals), 1)
        return self.tree.nearest(both)[0], NeighborTree(both).nearest(own)[0]
