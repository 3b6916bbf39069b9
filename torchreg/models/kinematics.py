"""Forward kinematics of a tree: the one adapter to pytorch-kinematics, and the twists that its joints cause."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import pytorch_kinematics as pk
import torch
from torch import Tensor, nn

from torchreg._checks import check_shape
from torchreg.errors import ModelError
from torchreg.geometry.kinematic_tree import KinematicTree

# pytorch-kinematics walks the tree recursively when it builds a chain.
_MAX_DEPTH = 300


class KinematicChain(nn.Module):
    """Maps joint values to frame transforms, for any number of leading batch dimensions.

    Degrees of freedom are the joints that are neither fixed nor mimics, in the tree's order.

    Args:
        tree: the kinematic tree.

    Raises:
        ModelError: if the tree is deeper than 300 frames.
    """

    rest_offsets: Tensor
    axes: Tensor
    couplings: Tensor
    chain_couplings: Tensor
    chain_offsets: Tensor
    frame_order: Tensor
    parent_index: Tensor
    ancestors: Tensor
    moves: Tensor
    joint_frames: Tensor
    is_revolute: Tensor
    lower: Tensor
    upper: Tensor

    def __init__(self, tree: KinematicTree) -> None:
        super().__init__()
        self.tree = tree
        self._chain = _build_chain(tree)
        joints = tree.joints
        moving = [index for index, joint in enumerate(joints) if joint.kind != "fixed"]
        free = [index for index in moving if joints[index].mimic is None]
        self.dof_names = tuple(joints[index].name for index in free)
        self.num_dofs = len(free)
        self.has_mimics = len(free) < len(moving)
        couplings, coupling_offsets = _mimic_couplings(tree, moving, free)
        # pytorch-kinematics orders joints depth first, and its frames are called by their index here.
        chain_order = [moving.index(int(name)) for name in self._chain.get_joint_parameter_names()]
        axes = torch.tensor([joints[index].axis for index in moving], dtype=torch.float64).reshape(-1, 3)
        ancestors = _ancestor_matrix(tree)
        buffers = {
            "rest_offsets": torch.stack([joint.offset.double() for joint in joints]),
            "axes": axes / axes.norm(dim=-1, keepdim=True),
            "couplings": couplings,
            "chain_couplings": couplings[chain_order],
            "chain_offsets": coupling_offsets[chain_order],
            "frame_order": torch.tensor([self._chain.frame_to_idx[str(index)] for index in range(len(joints))]),
            "parent_index": torch.tensor([max(joint.parent, 0) for joint in joints]),
            "ancestors": ancestors,
            "moves": ancestors[:, moving],
            "joint_frames": torch.tensor(moving, dtype=torch.long),
            "is_revolute": torch.tensor([joints[i].kind == "revolute" for i in moving], dtype=torch.float64),
            "lower": torch.tensor([joints[index].lower for index in free], dtype=torch.float64),
            "upper": torch.tensor([joints[index].upper for index in free], dtype=torch.float64),
        }
        for name, value in buffers.items():
            self.register_buffer(name, value, persistent=False)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> KinematicChain:
        super()._apply(fn, recurse)
        self._chain.to(dtype=self.axes.dtype, device=self.axes.device)
        return self

    def forward(self, joint_values: Tensor, offset_scales: Tensor | None = None) -> Tensor:
        """Return the transform of every frame in the coordinates of the tree's root.

        Args:
            joint_values: (..., num_dofs), radians or metres.
            offset_scales: (F,) factors on the length of each frame's offset from its parent; ones by default.

        Returns:
            (..., F, 4, 4), ``T_root_frame``.

        Raises:
            InputError: if the number of joint values is not the number of degrees of freedom.

        Differentiable: in both arguments, to any order.
        """
        check_shape(joint_values, "joint_values", (self.num_dofs,), batch=True)
        batch = joint_values.shape[:-1]
        values = joint_values @ self.chain_couplings.mT + self.chain_offsets
        flat = values.reshape(math.prod(batch), values.shape[-1])
        frames = self._chain.forward_kinematics_tensor(flat, analytical_grad=False)[self.frame_order]
        frames = frames.movedim(0, 1).reshape(*batch, len(self.tree), 4, 4)
        return frames if offset_scales is None else self._stretched(frames, offset_scales)

    def _stretched(self, frames: Tensor, offset_scales: Tensor) -> Tensor:
        # Lengths change no rotation, so every frame moves by the sum of its ancestors' stretches.
        stretch = (offset_scales - 1).unsqueeze(-1) * self.rest_offsets[:, :3, 3]
        turned = (frames[..., self.parent_index, :3, :3] @ stretch.unsqueeze(-1)).squeeze(-1)
        turned = torch.cat([stretch[:1].expand_as(turned[..., :1, :]), turned[..., 1:, :]], dim=-2)
        return frames + nn.functional.pad((self.ancestors @ turned).unsqueeze(-1), (3, 0, 0, 1))

    def joint_twists(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Return the twists that the degrees of freedom cause, and which frames they move.

        A degree of freedom k moves a point x of a frame that it carries by ``linear_k + angular_k x x`` per unit.

        Args:
            frames: (..., F, 4, 4) frame transforms in the coordinates the twists are wanted in.

        Returns:
            twists (..., J, 6) of the moving joints (translation, rotation), and which frames they move: (F, J) zeros
            and ones. `couplings` (J, num_dofs) maps moving joints to degrees of freedom; without mimic joints it is
            the identity.

        Differentiable: in ``frames``.

        References: Murray, Li, Sastry 1994, the spatial manipulator Jacobian.
        """
        at_joint = frames[..., self.joint_frames, :3, :]
        axis = (at_joint[..., :3] @ self.axes.unsqueeze(-1)).squeeze(-1)
        revolute = self.is_revolute.unsqueeze(-1)
        angular = axis * revolute
        linear = torch.linalg.cross(at_joint[..., 3], angular) + axis * (1 - revolute)
        return torch.cat([linear, angular], dim=-1), self.moves


def part_parents(tree: KinematicTree, frames: Sequence[int]) -> list[int]:
    """Return, per part, the next part above it in the tree, -1 for none.

    Args:
        tree: the kinematic tree.
        frames: index of each part's frame.
    """
    part_of = {frame: part for part, frame in enumerate(frames)}
    parents = []
    for frame in frames:
        ancestor = tree.joints[frame].parent
        while ancestor >= 0 and ancestor not in part_of:
            ancestor = tree.joints[ancestor].parent
        parents.append(part_of.get(ancestor, -1))
    return parents


def neighbor_matrix(parents: Sequence[int]) -> Tensor:
    """Return (P, P) booleans: True for each part itself, its parent and its children.

    Args:
        parents: parent of each part, -1 for none.
    """
    neighbors = torch.eye(len(parents), dtype=torch.bool)
    for part, parent in enumerate(parents):
        if parent >= 0:
            neighbors[part, parent] = neighbors[parent, part] = True
    return neighbors


def _build_chain(tree: KinematicTree) -> pk.Chain:
    depths: list[int] = []
    frames: list[pk.Frame] = []
    for index, joint in enumerate(tree.joints):
        depths.append(0 if joint.parent < 0 else depths[joint.parent] + 1)
        if depths[-1] > _MAX_DEPTH:
            raise ModelError(f"frame {joint.name!r} lies {depths[-1]} frames deep; at most {_MAX_DEPTH} are supported")
        offset = pk.Transform3d(matrix=joint.offset.double().unsqueeze(0), dtype=torch.float64)
        # Indices as names: pytorch-kinematics strips and compares names, which here may hold any character.
        name = str(index)
        frame = pk.Frame(name, link=pk.Link(name))
        frame.joint = pk.Joint(name, offset=offset, joint_type=joint.kind, axis=tuple(joint.axis), dtype=torch.float64)
        if joint.parent >= 0:
            frames[joint.parent].add_child(frame)
        frames.append(frame)
    return pk.Chain(frames[0], dtype=torch.float64)


def stack_sizes(tree: KinematicTree) -> list[int]:
    """Return, per degree of freedom, how many revolute frames coincide in its joint: three for a ball joint."""
    stacks: list[list[int]] = []
    stack_of: dict[int, int] = {}
    identity = torch.eye(4, dtype=torch.float64)
    for index, joint in enumerate(tree.joints):
        if joint.kind != "revolute":
            continue
        if joint.parent in stack_of and torch.equal(joint.offset.double(), identity):
            stack_of[index] = stack_of[joint.parent]
            stacks[stack_of[index]].append(index)
        else:
            stack_of[index] = len(stacks)
            stacks.append([index])
    free = [index for index, joint in enumerate(tree.joints) if joint.kind != "fixed" and joint.mimic is None]
    return [len(stacks[stack_of[index]]) if index in stack_of else 1 for index in free]


def _ancestor_matrix(tree: KinematicTree) -> Tensor:
    ancestors = torch.eye(len(tree), dtype=torch.float64)
    for index, joint in enumerate(tree.joints):
        if joint.parent >= 0:
            ancestors[index] += ancestors[joint.parent]
    return ancestors


def _mimic_couplings(tree: KinematicTree, moving: list[int], free: list[int]) -> tuple[Tensor, Tensor]:
    """Return (J, num_dofs) and (J,): joint values = couplings @ dofs + offsets."""
    couplings = torch.zeros(len(moving), len(free), dtype=torch.float64)
    offsets = torch.zeros(len(moving), dtype=torch.float64)
    for row, index in enumerate(moving):
        factor, shift, followed = 1.0, 0.0, index
        while (mimic := tree.joints[followed].mimic) is not None:
            followed, multiplier, offset = mimic
            shift, factor = shift + factor * offset, factor * multiplier
        couplings[row, free.index(followed)] = factor
        offsets[row] = shift
    return couplings, offsets
