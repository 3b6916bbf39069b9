"""What of a posed shape's surface a camera on the side of the data would see, and on how much of it no data lie."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchreg.alignment.fit.free_space_term import FreeSpaceTerm
from torchreg.alignment.fit.problem import INLIER_SHARE, AlignProblem, independent_share, soft_inliers
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
    cosine, clearance = _exposure(problem, pose, toward)
    return (cosine > _RAYS.facing) & (clearance > 0)


def _exposure(problem: AlignProblem, pose: Tensor, toward: Tensor) -> tuple[Tensor, Tensor]:
    """Return the cosines (B, N) between normals and directions to a camera, and how clear the shape is of the rays."""
    posed = problem.skin(pose)
    steps = problem.size * _RAYS.nearest * 2.0 ** torch.arange(_RAYS.count).to(posed)
    rays = posed.unsqueeze(1) + steps[:, None, None] * toward.unsqueeze(1)
    clearance = problem.surface.distance(rays.flatten(1, 2), pose).unflatten(1, rays.shape[1:3]).amin(1)
    return (shape_normals(problem, pose, posed) * toward).sum(-1), clearance


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
    toward, apart = _side_and_gaps(problem, pose, distance, jacobian, toward)
    visible = visible_skin(problem, pose, toward)
    share = (visible & (apart > 1)).sum(-1) / visible.sum(-1).clamp_min(1)
    return torch.where(visible.any(-1) & apart.isfinite().all(-1), share, 1.0).to(pose)


def _side_and_gaps(
    problem: AlignProblem, pose: Tensor, distance: Tensor, jacobian: Tensor, toward: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return directions to a camera, and how far off the next datum on the surface is of each skin point (B, N).

    Distances are shares of that up to which there are data.
    """
    near = (distance.abs() < INLIER_SHARE * problem.size) & problem.valid
    if toward is None:
        toward = normalize((_normals(jacobian) * near.unsqueeze(-1)).sum(1, keepdim=True), dim=-1)
    stride = -(-problem.data.shape[1] // _RAYS.num_data)
    apart = _nearest(problem.skin(pose), problem.data[:, ::stride], near[:, ::stride])
    return toward, apart / (2 * INLIER_SHARE * problem.size)


def missing_data(problem: AlignProblem, pose: Tensor) -> Tensor:
    """Return how many more data (B,) there would surely be if all the surface that a camera sees had them as densely.

    What a pose explains beside other things, or of something else, it does not cover; a picture tells that better. The
    share without data is a lower bound (Wilson 1927), of which patches of the surface tell independently. Points count
    as visible and as bare by degrees, unlike in `unseen_share`, so that rounding changes little.
    """
    if problem.factor(FreeSpaceTerm) is not None:
        return torch.zeros_like(pose[:, 0])
    distance, jacobian = problem.surface.distance_jacobian(problem.data, pose)
    toward, apart = _side_and_gaps(problem, pose, distance, jacobian, None)
    cosine, clearance = _exposure(problem, pose, toward)
    visible = _degree(cosine / _RAYS.facing) * _degree(1 + clearance / (INLIER_SHARE * problem.size))
    count = soft_inliers(problem, distance).sum(-1)
    share = ((visible * _degree(apart)).sum(-1) / visible.sum(-1)).nan_to_num(1.0)
    # Of which a camera sees a half.
    patches = independent_share(problem.skin.points, problem.size) * len(problem.skin) / 2
    prior = _RAYS.sure**2 / patches
    spread = (prior * (share * (1 - share) + prior / 4)).sqrt()
    surely = ((share + prior / 2 - spread) / (1 + prior)).clamp(0, 1 - 1 / len(problem.skin))
    return count * surely / (1 - surely)


def _degree(ratio: Tensor) -> Tensor:
    """Return 0 up to a half of a limit, 1 from one and a half on."""
    return (ratio - 0.5).clamp(0, 1)


def _normals(jacobian: Tensor) -> Tensor:
    return -normalize(jacobian[..., :3], dim=-1)


def _nearest(points: Tensor, data: Tensor, valid: Tensor) -> Tensor:
    """Return the distances (B, N) from points (B, N, 3) to the nearest of valid data (B, M, 3), infinite without."""
    rows, apart = max(1, BUDGET.table_entries // (points.shape[1] * data.shape[1])), []
    for few, near, known in zip(points.split(rows), data.split(rows), valid.split(rows), strict=True):
        apart.append(torch.cdist(few, near).masked_fill(~known.unsqueeze(1), torch.inf).amin(-1))
    return torch.cat(apart)
