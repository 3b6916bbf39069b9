"""Lengths and radii of a rig's own parts as shape coefficients."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchreg.shapes.articulation import Articulation
from torchreg.shapes.shape_space import CoefficientPrior, LinearSpace
from torchreg.shapes.spec import RigSurface


@dataclass(frozen=True)
class BonePrior:
    """Standard deviations of relative changes of a rig, and the largest ones."""

    size: float = 0.2  # of the whole: adults differ by 0.05, a made-up rig and a person by more
    girth: float = 0.15  # of all radii beyond the size
    part: float = 0.07  # of each part's length and radius beyond those, a guess that fits correct
    most: float = 0.6  # of any of them: nothing shrinks to nothing


BONE_PRIOR = BonePrior()


def bone_space(shape: Articulation, surface: RigSurface) -> LinearSpace:
    """Return the space of relative changes of a rig's size and girth and of its parts' lengths and radii."""
    frames = shape.frame_transforms(torch.zeros_like(shape.rest)).detach().double()
    index = shape.part_index
    positions, joints = frames[:, :3, 3], frames[index, :3, 3]
    by_length = shape.length_motions(frames)
    along = frames[index, :3, :3] @ shape.primitives.rotations[:, :, 2:].double()
    across = torch.eye(3, dtype=torch.float64) - along @ along.mT
    vertices, weights = surface.vertices.double(), surface.weights.double()
    levers = (vertices.unsqueeze(1) - joints) * weights.unsqueeze(-1)
    stretched, thickened = ((part @ levers.unsqueeze(-1)).squeeze(-1).mT for part in (along @ along.mT, across))
    carried = torch.einsum("vp,pck->vck", weights, by_length[index])
    whole = (vertices - positions[0]).unsqueeze(-1)
    vertex_dirs = torch.cat([whole, thickened.sum(-1, keepdim=True), carried + stretched, thickened], dim=-1)
    still = torch.zeros(len(positions), 3, 1, dtype=torch.float64)
    root = (positions - positions[0]).unsqueeze(-1)
    frame_dirs = torch.cat([root, still, by_length, still.expand(-1, -1, shape.num_parts)], dim=-1)
    return LinearSpace(vertices, vertex_dirs, positions, frame_dirs, _prior(shape.part_names))


def _prior(parts: tuple[str, ...]) -> CoefficientPrior:
    names = ("size", "girth", *(f"length of {part}" for part in parts), *(f"radius of {part}" for part in parts))
    std = torch.full((len(names),), BONE_PRIOR.part, dtype=torch.float64)
    std[0], std[1] = BONE_PRIOR.size, BONE_PRIOR.girth
    zero, most = torch.zeros_like(std), torch.full_like(std, BONE_PRIOR.most)
    alike = torch.tensor([-1, -1, *[0] * len(parts), *[1] * len(parts)])
    return CoefficientPrior(names=names, mean=zero, std=std, lower=-most, upper=most, alike=alike)
