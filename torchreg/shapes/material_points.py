"""Points of a shape's surface that its parts carry along: what the forward pass of a shape gives back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchreg.geometry.mesh import TriangleMesh, interpolate, sample_surface
from torchreg.geometry.rigid import invert_rigid, transform_points
from torchreg.geometry.sampling import even_order
from torchreg.shapes.primitives import BALL_FACTOR, PrimitiveSet, fuse_given
from torchreg.shapes.spec import RigSurface


@dataclass(frozen=True)
class _Sampling:
    """Numbers of the samples of a surface."""

    # Points of a shape that has no vertices of its own: as many as the paper's hand model has.
    num_points: int = 500
    # Candidates per point; more cover the surface more evenly.
    oversampling: int = 4
    # Newton steps that bring points onto a surface: the first is exact for most solids, each next one squares the rest.
    newton_steps: int = 4
    # Least squared slope of a distance in a Newton step: it is one at a surface, and small only on a medial axis.
    least_slope: float = 0.25


_SAMPLING = _Sampling()


class ShapeOutput(NamedTuple):
    """What the forward pass of a shape returns.

    Args:
        points: (..., N, 3) of its surface, metres, always the same ones in the same order.
        keypoints: (..., K, 3), metres, as `ArticulatedShape.keypoints`.
        transforms: (..., P, 4, 4) ``T_world_part``.
    """

    points: Tensor
    keypoints: Tensor
    transforms: Tensor


class MaterialPoints(nn.Module):
    """Points that move by a weighted mean of the motions of parts, with weights (N, P) of a file or of eq. 3.

    Under eq. 3 weights are one for the dominating part, and ``partners`` (N, P) for its strongest neighbor.
    """

    points: Tensor
    to_parts: Tensor
    weights: Tensor
    partners: Tensor | None

    def __init__(self, points: Tensor, to_parts: Tensor, weights: Tensor, partners: Tensor | None = None) -> None:
        super().__init__()
        self.register_buffer("points", points)
        self.register_buffer("to_parts", to_parts)
        self.register_buffer("weights", weights)
        self.register_buffer("partners", partners)

    def __len__(self) -> int:
        return len(self.points)

    def forward(self, transforms: Tensor, growth: Tensor, shares: Tensor | None = None) -> Tensor:
        """Return the points (..., N, 3) for part transforms (..., P, 4, 4) and the growth (P, 4, 4) of the parts."""
        weights = self.weights
        if shares is not None and self.partners is not None:
            weights = weights + shares.unsqueeze(-1) * (self.partners - weights)
        motions = transforms @ (growth @ self.to_parts)
        rows = (weights @ motions[..., :3, :].flatten(-2)).unflatten(-1, (3, 4))
        return (rows[..., :3] @ self.points.unsqueeze(-1)).squeeze(-1) + rows[..., 3]


def mesh_points(surface: RigSurface, to_parts: Tensor) -> MaterialPoints:
    """Return the vertices of a file's mesh in their order, or samples of it where links of a robot have few or many."""
    if not surface.is_rigid:
        return MaterialPoints(surface.vertices.to(to_parts), to_parts, surface.weights.to(to_parts))
    mesh = TriangleMesh(surface.vertices.to(to_parts), surface.faces)
    count = _SAMPLING.oversampling * _SAMPLING.num_points
    points, face, barycentric = sample_surface(mesh, count, generator=torch.Generator().manual_seed(0))
    chosen = even_order(points, _SAMPLING.num_points)
    weights = interpolate(surface.weights.to(to_parts), surface.faces, face[chosen], barycentric[chosen])
    return MaterialPoints(points[chosen], to_parts, weights)


def fused_points(
    solids: PrimitiveSet, frames: Tensor, neighbors: Tensor, nu: float, to_parts: Tensor
) -> MaterialPoints:
    """Return points that cover the fused surface of solids with frames (P, 4, 4) at reference evenly."""
    sizes = list(solids.sizes)
    # As many candidates for each solid as its size asks for.
    across, _, along = solids.half_extents(sizes).unbind(-1)
    areas = across * (across + 2 * along)
    counts = (_SAMPLING.oversampling * _SAMPLING.num_points * areas / areas.sum()).ceil().long()
    local = _on_solids(solids, sizes, int(counts.max()))
    order = torch.randperm(local.shape[1], generator=torch.Generator().manual_seed(0))
    drawn = order < counts.unsqueeze(-1)
    points, owners = transform_points(frames, local)[drawn], drawn.nonzero()[:, 0]
    # Those inside of another solid are not on the surface.
    points = points[_part_distances(solids, sizes, frames, points).argmin(-1) == owners]
    for step in range(_SAMPLING.newton_steps):
        owners = _part_distances(solids, sizes, frames, points).argmin(-1)
        points = onto_fused(solids, sizes, frames[:, :3], points, neighbors[owners], nu)
        if step == 0:
            points = points[even_order(points, min(_SAMPLING.num_points, len(points)))]
    distances = _part_distances(solids, sizes, frames, points)
    dominating = distances.argmin(-1)
    others = neighbors[dominating].scatter(-1, dominating.unsqueeze(-1), False)
    partner = torch.where(others.any(-1), distances.masked_fill(~others, torch.inf).argmin(-1), dominating)
    identity = torch.eye(len(solids), dtype=points.dtype)
    return MaterialPoints(points, to_parts, identity[dominating], identity[partner])


def onto_fused(
    solids: PrimitiveSet, sizes: Sequence[Tensor], frames: Tensor, points: Tensor, fuses: Tensor, nu: float | Tensor
) -> Tensor:
    """Return points (..., N, 3) after one Newton step onto their fused surface, ``x - d grad d / |grad d|^2``."""
    inverse = frames[..., :3].mT
    local = (inverse.flatten(-3, -2) @ points.mT).unflatten(-2, (-1, 3)) - inverse @ frames[..., 3:]
    x, y, z = local.unbind(-2)
    distances, planes = solids.plane_gradient((x, y, z), sizes)
    distance, shares = fuse_given(distances.mT, fuses, nu)
    along = torch.stack(planes, dim=-2) * shares.mT.unsqueeze(-2)
    gradient = (inverse.flatten(-3, -2).mT @ along.flatten(-3, -2)).mT
    slope = gradient.square().sum(-1, keepdim=True).clamp_min(_SAMPLING.least_slope)
    return points - gradient * (distance.unsqueeze(-1) / slope)


def _on_solids(solids: PrimitiveSet, sizes: Sequence[Tensor], count: int) -> Tensor:
    """Return points (P, count, 3) on every solid, in its frame, by Newton steps from an ellipsoid around it."""
    number = torch.arange(count, dtype=torch.float64) + 0.5
    height, turn = 1 - 2 * number / count, number * (torch.pi * (5**0.5 - 1))
    radius = (1 - height.square()).sqrt()
    directions = torch.stack([radius * turn.cos(), radius * turn.sin(), height], dim=-1)
    local = directions * (BALL_FACTOR * solids.half_extents(sizes)).unsqueeze(-2)
    for _ in range(_SAMPLING.newton_steps):
        x, y, z = local.unbind(-1)
        distance, planes = solids.plane_gradient((x, y, z), sizes)
        gradient = torch.stack(torch.broadcast_tensors(*planes), dim=-1)
        slope = gradient.square().sum(-1, keepdim=True).clamp_min(_SAMPLING.least_slope)
        local = local - gradient * (distance.unsqueeze(-1) / slope)
    return local


def _part_distances(solids: PrimitiveSet, sizes: Sequence[Tensor], frames: Tensor, points: Tensor) -> Tensor:
    """Return the distances (N, P) of points to every solid."""
    x, y, z = transform_points(invert_rigid(frames), points.expand(len(frames), -1, -1)).unbind(-1)
    return solids.plane_distance((x, y, z), sizes).mT
