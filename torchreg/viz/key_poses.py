"""Motion between key poses of bones, as glTF viewers play it: joints turn, and carry what hangs on them."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_finite, check_shape
from torchreg.errors import InputError
from torchreg.geometry.rigid import invert_rigid, rigid_matrix
from torchreg.geometry.rotation import so3_exp, so3_log
from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.registration.bones.joints import BoneTree


@torch.no_grad()
def between_poses(model: GridLBS, poses: Tensor, at: Tensor, *, tree: BoneTree | None = None) -> Tensor:
    """Return poses of bones between key poses.

    Relative to its parent in the tree of joints, each bone turns at an even pace about its joint, which itself moves
    straight: limbs swing, they do not shrink. `save_grid_animation` writes the same motion into glTF files.

    Args:
        model: whose bones they are.
        poses: (K, B, 4, 4) rigid key poses.
        at: (T,) from 0, the first key pose, to K - 1, the last.
        tree: of the bones; `GridLBS.skeleton` of the key poses by default.

    Returns:
        (T, B, 4, 4); key poses are met to rounding.

    Raises:
        InputError: if a shape does not fit or a place lies outside of the key poses.
    """
    poses = as_float_tensor(poses, "poses", like=model.weights)
    check_shape(poses, "poses", ("K", model.num_bones, 4, 4))
    at = as_float_tensor(at, "at", like=poses)
    check_shape(at, "at", ("T",))
    check_finite(at, "at")
    if not len(poses) or bool((at < 0).any()) or bool((at > len(poses) - 1).any()):
        raise InputError(f"at must lie from 0 to {len(poses) - 1}, the key poses, got {at.tolist()}")
    tree = model.skeleton(poses) if tree is None else tree
    origins = tree.origins.to(poses)
    rest = rigid_matrix(torch.eye(3).to(poses).expand(len(origins), 3, 3), origins)
    local = _relative(poses @ rest, tree.parents)
    index = at.long().clamp(max=max(len(poses) - 2, 0))
    after = (index + 1).clamp(max=len(poses) - 1)
    share = (at - index)[:, None, None]
    first, second = local[index], local[after]
    turn = so3_log(first[..., :3, :3].mT @ second[..., :3, :3])
    rotation = first[..., :3, :3] @ so3_exp(share * turn)
    place = first[..., :3, 3] + share * (second[..., :3, 3] - first[..., :3, 3])
    return _absolute(rigid_matrix(rotation, place), tree.parents) @ invert_rigid(rest)


def _relative(world: Tensor, parents: tuple[int, ...]) -> Tensor:
    """Return the motions (..., B, 4, 4) of bones as their parents see them."""
    above = torch.tensor([max(parent, 0) for parent in parents], device=world.device)
    root = torch.tensor([parent < 0 for parent in parents], device=world.device)[:, None, None]
    return torch.where(root, world, invert_rigid(world[..., above, :, :]) @ world)


def _absolute(local: Tensor, parents: tuple[int, ...]) -> Tensor:
    """Return what `_relative` was given; parents may have any number."""
    world: dict[int, Tensor] = {}

    def visit(bone: int) -> Tensor:
        if bone not in world:
            own, parent = local[..., bone, :, :], parents[bone]
            world[bone] = own if parent < 0 else visit(parent) @ own
        return world[bone]

    return torch.stack([visit(bone) for bone in range(len(parents))], dim=-3)
