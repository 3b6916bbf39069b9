"""How the distances of points from a fused shape change with the lengths and radii of its parts."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.shapes.articulation import Articulation
from torchreg.shapes.primitives import fuse


@dataclass(frozen=True)
class ScaleRange:
    """How far the proportions of a shape may be off."""

    max_log: float = 0.7  # change of the logarithm of a length or a radius: a factor of two


SCALE_RANGE = ScaleRange()


def scale_jacobian(shape: Articulation, points: Tensor, poses: Tensor) -> Tensor:
    """Return the Jacobian (T, M, 2 P) of the fused distances at (T, M, 3) by the logarithms of lengths, then radii."""
    solids = shape.primitives
    centers, rotations, moves = _solid_motions(shape, poses)
    local = ((points.unsqueeze(-2) - centers.unsqueeze(1)).unsqueeze(-2) @ rotations.unsqueeze(1)).squeeze(-2)
    sizes = solids.scaled_sizes(shape.log_length_scales.detach().exp(), shape.log_radius_scales.detach().exp())
    with torch.enable_grad():
        leaves = [local.requires_grad_()]
        # A row of sizes for every point, so that one backward pass gives every point's own derivative.
        leaves += [size.detach().expand(*points.shape[:-1], *size.shape).clone().requires_grad_() for size in sizes]
        distances = solids(leaves[0], leaves[1:])
        by_local, *by_size = torch.autograd.grad(distances.sum(), leaves)
    shares = fuse(distances.detach(), shape.adjacency, shape.nu)[1]
    force = (by_local * shares.unsqueeze(-1)).flatten(-2)
    by_kind = []
    for kind, gradient, size in zip(solids.kinds, by_size, sizes, strict=True):
        is_long = solids.get_buffer(f"long_{kind}")
        growth = gradient * size * solids.get_buffer(f"scalable_{kind}")
        by_kind.append(torch.stack([(growth * is_long).sum(-1), (growth * ~is_long).sum(-1)]))
    by_length, by_radius = torch.cat(by_kind, dim=-1)[..., solids.kind_order] * shares
    return torch.cat([by_length - force @ moves.flatten(1, 2), by_radius], dim=-1).detach()


def _solid_motions(shape: Articulation, poses: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the solids' centers (T, P, 3), rotations, and motions (T, P, 3, P) by log lengths in their own frames."""
    frames = shape.frame_transforms(poses)
    turns, origins = frames[:, shape.part_index, :3, :3], frames[:, shape.part_index, :3, 3]
    centers = shape.primitives.centers * shape.log_length_scales.exp().unsqueeze(-1)
    within = (turns @ centers.unsqueeze(-1)).squeeze(-1)
    # A solid's center within its part moves with that part's own length, too.
    own = within.unsqueeze(-1) * torch.eye(shape.num_parts).to(poses).unsqueeze(-2)
    moves = shape.length_motions(frames)[:, shape.part_index] + own
    rotations = turns @ shape.primitives.rotations
    return (origins + within).detach(), rotations.detach(), (rotations.mT @ moves).detach()
