"""Motion between key poses of bones, as glTF viewers play it: joints turn, and move the bones below them."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.geometry.rigid import invert_rigid, rigid_matrix
from torchreg.geometry.rotation import so3_exp, so3_log
from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.registration.bones.joints import BoneTree


@torch.no_grad()
def between_poses(model: GridLBS, poses: Tensor, times: Tensor, *, tree: BoneTree | None = None) -> Tensor:
    """Return poses (T, B, 4, 4) at times from 0 to K - 1 between key poses (K, B, 4, 4), as glTF viewers play them.

    Relative to its parent in the tree, each bone turns at constant speed about its joint, which itself moves straight:
    limbs swing, they do not shrink.
    """
    poses = poses.to(model.weights)
    tree = model.skeleton(poses) if tree is None else tree
    origins = tree.origins.to(poses)
    rest = rigid_matrix(torch.eye(3).to(poses).expand(len(origins), 3, 3), origins)
    local = _relative(poses @ rest, tree.parents)
    index = times.long().clamp(max=max(len(poses) - 2, 0))
    after = (index + 1).clamp(max=len(poses) - 1)
    share = (times.to(poses) - index)[:, None, None]
    first, second = local[index], local[after]
    turn = so3_log(first[..., :3, :3].mT @ second[..., :3, :3])
    rotation = first[..., :3, :3] @ so3_exp(share * turn)
    position = first[..., :3, 3] + share * (second[..., :3, 3] - first[..., :3, 3])
    return _absolute(rigid_matrix(rotation, position), tree.parents) @ invert_rigid(rest)


def _relative(world: Tensor, parents: tuple[int, ...]) -> Tensor:
    """Return the motions (..., B, 4, 4) of bones relative to their parents."""
    above = torch.tensor([max(parent, 0) for parent in parents], device=world.device)
    root = torch.tensor([parent < 0 for parent in parents], device=world.device)[:, None, None]
    return torch.where(root, world, invert_rigid(world[..., above, :, :]) @ world)


def _absolute(local: Tensor, parents: tuple[int, ...]) -> Tensor:
    """Return the motions (..., B, 4, 4) of bones in the world, the inverse of `_relative`; bones are in any order."""
    world: dict[int, Tensor] = {}

    def visit(bone: int) -> Tensor:
        if bone not in world:
            relative, parent = local[..., bone, :, :], parents[bone]
            world[bone] = relative if parent < 0 else visit(parent) @ relative
        return world[bone]

    return torch.stack([visit(bone) for bone in range(len(parents))], dim=-3)
