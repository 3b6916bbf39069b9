"""What of a posed shape's surface a camera on the side of the data would see, and on how much of it no data lie."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchreg.alignment.fit.free_space_term import FreeSpaceTerm
from torchreg.alignment.fit.problem import INLIER_SHARE, AlignProblem, errors_per_patch, soft_inliers
from torchreg.geometry.budget import BUDGET


@dataclass(frozen=True)
class _Rays:
    """What a surface looks like from a camera; lengths are shares of the shape's size."""

    facing: float = 0.3  # cosine between a normal and the direction to the camera of a visible surface, at least
    nearest: float = 0.04  # first step towards the camera in which the shape may hide itself; each is twice as long
    count: int = 5
    sure: float = 2.0  # standard deviations to the bound of the share of the surface without data
    num_data: int = 1000  # per cloud, that tell how much of the surface has data: more tell the same


_RAYS = _Rays()


def visible_skin(problem: AlignProblem, pose: Tensor, toward: Tensor) -> Tensor:
    """Return which points (B, N) of the skin in poses (B, num_dofs) a camera in directions (B, N or 1, 3) would see."""
    posed = problem.skin(pose)
    steps = problem.size * _RAYS.nearest * 2.0 ** torch.arange(_RAYS.count).to(posed)
    rays = posed.unsqueeze(1) + steps[:, None, None] * toward.unsqueeze(1)
    clear = problem.surface.distance(rays.flatten(1, 2), pose).unflatten(1, rays.shape[1:3]) > 0
    return ((shape_normals(problem, pose, posed) * toward).sum(-1) > _RAYS.facing) & clear.all(1)


def shape_normals(problem: AlignProblem, pose: Tensor, points: Tensor) -> Tensor:
    """Return unit normals (B, N, 3) of the surface next to points (B, N, 3): the base's translation moves it so."""
    return _normals(problem.surface.distance_jacobian(points, pose)[1])


def unseen_share(
    problem: AlignProblem, pose: Tensor, distance: Tensor, jacobian: Tensor, toward: Tensor | None = None
) -> Tensor:
    """Return the share (B,) that no data lie near of the surface that a camera sees from the side of the data.

    Distances (B, M) of the data and their Jacobian are those of `SkinSurface.distance_jacobian`. Without directions
    ``toward`` a camera (B, N or 1, 3), that side is where the surface faces on which the data lie.
    """
    near = (distance.abs() < INLIER_SHARE * problem.size) & problem.valid
    if toward is None:
        toward = normalize((_normals(jacobian) * near.unsqueeze(-1)).sum(1, keepdim=True), dim=-1)
    visible = visible_skin(problem, pose, toward)
    stride = -(-problem.data.shape[1] // _RAYS.num_data)
    apart = _nearest(problem.skin(pose), problem.data[:, ::stride], near[:, ::stride])
    bare = visible & (apart > 2 * INLIER_SHARE * problem.size)
    share = bare.sum(-1) / visible.sum(-1).clamp_min(1)
    return torch.where(visible.any(-1) & near.any(-1), share, 1.0).to(pose)


def missing_data(problem: AlignProblem, pose: Tensor) -> Tensor:
    """Return how many more data (B,) there would surely be if all the surface that a camera sees had them as densely.

    What a pose explains beside other things, or of something else, it does not cover; a picture tells that better. The
    share without data is a lower bound (Wilson 1927), of which patches of the surface tell independently.
    """
    if problem.factor(FreeSpaceTerm) is not None:
        return torch.zeros_like(pose[:, 0])
    distance, jacobian = problem.surface.distance_jacobian(problem.data, pose)
    near = soft_inliers(problem, distance)
    count, share = near.sum(-1), unseen_share(problem, pose, distance, jacobian)
    patches = count / errors_per_patch(problem.data, near > 0.5, problem.size)
    prior = _RAYS.sure**2 / patches.clamp_min(1)
    spread = (prior * (share * (1 - share) + prior / 4)).sqrt()
    surely = ((share + prior / 2 - spread) / (1 + prior)).clamp(0, 1 - 1 / len(problem.skin))
    return count * surely / (1 - surely)


def _normals(jacobian: Tensor) -> Tensor:
    return -normalize(jacobian[..., :3], dim=-1)


def _nearest(points: Tensor, data: Tensor, valid: Tensor) -> Tensor:
    """Return the distances (B, N) from points (B, N, 3) to the nearest of valid data (B, M, 3), infinite without."""
    rows, apart = max(1, BUDGET.table_entries // (points.shape[1] * data.shape[1])), []
    for few, near, known in zip(points.split(rows), data.split(rows), valid.split(rows), strict=True):
        apart.append(torch.cdist(few, near).masked_fill(~known.unsqueeze(1), torch.inf).amin(-1))
    return torch.cat(apart)
