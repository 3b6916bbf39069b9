"""Forward kinematics of a tree, the twists of its joints, and trees from and to chains of pytorch-kinematics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from torchreg._checks import check_shape
from torchreg.errors import InputTypeError, ModelError
from torchreg.geometry.kinematic_tree import JOINT_TYPES, Joint, KinematicTree
from torchreg.geometry.rotation import skew
from torchreg.io.urdf_file.record import UrdfPrimitive, UrdfRecord

if TYPE_CHECKING:
    from pytorch_kinematics import Chain
    from pytorch_kinematics.frame import Frame

# Deepest tree: pytorch-kinematics walks it recursively when it builds a chain.
_MAX_DEPTH = 300


class ForwardKinematics(nn.Module):
    """Maps joint values to frame transforms, for any number of leading batch dimensions.

    A frame's transform in its parent is linear in sine, cosine and value of its joint; each round of products doubles
    the number of generations between a frame and the ancestor that it is given in (Hillis and Steele 1986).
    """

    axes: Tensor
    couplings: Tensor
    moves: Tensor
    joint_frames: Tensor
    is_revolute: Tensor
    lower: Tensor
    upper: Tensor
    rotation_axes: Tensor
    translation_axes: Tensor
    frame_couplings: Tensor
    frame_values: Tensor
    still: Tensor
    lengths: Tensor
    sines: Tensor
    cosines: Tensor
    slides: Tensor
    by_depth: Tensor
    tree_order: Tensor

    def __init__(self, tree: KinematicTree) -> None:
        super().__init__()
        self.tree = tree
        _check_depth(tree)
        joints = tree.joints
        moving = [index for index, joint in enumerate(joints) if joint.kind != "fixed"]
        free = [index for index in moving if joints[index].mimic is None]
        self.dof_names = tuple(joints[index].name for index in free)
        self.num_dofs = len(free)
        self.has_mimics = len(free) < len(moving)
        couplings, values = _mimic_couplings(tree, moving, free)
        self.has_slides = any(joints[index].kind == "prismatic" for index in moving)
        axes = torch.stack([_axis_of(joints[index]) for index in moving]) if moving else torch.zeros(0, 3).double()
        is_revolute = torch.tensor([joints[index].kind == "revolute" for index in moving], dtype=torch.float64)
        buffers = {
            "axes": axes,
            "couplings": couplings,
            "moves": _ancestor_matrix(tree)[:, moving],
            "joint_frames": torch.tensor(moving, dtype=torch.long),
            "is_revolute": is_revolute,
            "lower": torch.tensor([joints[index].lower for index in free], dtype=torch.float64),
            "upper": torch.tensor([joints[index].upper for index in free], dtype=torch.float64),
            "rotation_axes": (axes * is_revolute.unsqueeze(-1)).unsqueeze(-1),
            "translation_axes": (axes * (1 - is_revolute.unsqueeze(-1))).unsqueeze(-1),
            "frame_couplings": torch.zeros(len(joints), len(free), dtype=torch.float64),
            "frame_values": torch.zeros(len(joints), dtype=torch.float64),
        }
        buffers["frame_couplings"][moving], buffers["frame_values"][moving] = couplings, values
        offsets = torch.stack([joint.offset.double() for joint in joints])
        buffers.update(_local_tables(offsets, moving, axes, is_revolute))
        buffers["by_depth"], buffers["tree_order"], self._complete, jumps = _doubling(tree)
        for number, jump in enumerate(jumps):
            buffers[f"jump_{number}"] = jump
        for name, value in buffers.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, joint_values: Tensor, offset_scales: Tensor | None = None) -> Tensor:
        """Return ``T_root_frame`` (..., F, 4, 4) of joint values (..., num_dofs), with offsets scaled by (F,)."""
        check_shape(joint_values, "joint_values", (self.num_dofs,), batch=True)
        frames = self._local(joint_values, offset_scales).index_select(-3, self.by_depth)
        for number, complete in enumerate(self._complete):
            above = frames.index_select(-3, self.get_buffer(f"jump_{number}"))
            done, rest = frames[..., :complete, :, :], frames[..., complete:, :, :]
            frames = torch.cat([done, above @ rest], dim=-3)
        return frames.index_select(-3, self.tree_order)

    def ancestors(self) -> Tensor:
        """Return a matrix (F, F), float64, of ones where a frame (row) is or hangs on another (column)."""
        return _ancestor_matrix(self.tree)

    def _local(self, joint_values: Tensor, offset_scales: Tensor | None) -> Tensor:
        """Return the transform (..., F, 4, 4) of every frame in its parent."""
        values = nn.functional.linear(joint_values, self.frame_couplings, self.frame_values).unsqueeze(-1)
        if offset_scales is None:
            local = self.still + self.lengths
        else:
            local = torch.addcmul(self.still, self.lengths, offset_scales.unsqueeze(-1))
        local = torch.addcmul(local, self.sines, values.sin())
        local = torch.addcmul(local, self.cosines, values.cos())
        if self.has_slides:
            local = torch.addcmul(local, self.slides, values)
        return local.view(*local.shape[:-1], 4, 4)

    def joint_twists(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Return the twists (..., J, 6) of moving joints, (translation, rotation), and the frames (F, J) they move."""
        joints = frames.index_select(-3, self.joint_frames)[..., :3, :]
        rotation = joints[..., :3]
        angular = (rotation @ self.rotation_axes).squeeze(-1)
        linear = torch.linalg.cross(joints[..., 3], angular)
        if self.has_slides:
            linear = linear + (rotation @ self.translation_axes).squeeze(-1)
        return torch.cat([linear, angular], dim=-1), self.moves


def build_chain(tree: KinematicTree, names: Sequence[str], offsets: Tensor) -> Chain:
    """Return a tree as a `pytorch_kinematics.Chain`, in dtype and device of the offsets; mimics move by themselves."""
    import pytorch_kinematics as pk

    kind = {"dtype": offsets.dtype, "device": offsets.device}
    frames: list[Frame] = []
    taken: set[str] = set()
    for joint, name, offset in zip(tree.joints, names, offsets.detach(), strict=True):
        name = new_name(name.strip("\n"), taken)
        frame = pk.Frame(name, link=pk.Link(name))
        frame.joint = pk.Joint(
            joint.name, offset=pk.Transform3d(matrix=offset.unsqueeze(0), **kind), joint_type=joint.kind,
            axis=tuple(joint.axis), limits=(joint.lower, joint.upper), **kind,
        )  # fmt: skip
        if joint.parent >= 0:
            frames[joint.parent].add_child(frame)
        frames.append(frame)
    return pk.Chain(frames[0], **kind)


def read_chain(chain: Chain) -> tuple[UrdfRecord, frozenset[int]]:
    """Return the record (without meshes) of a chain, and the links whose geometry it only names; depth first."""
    import pytorch_kinematics as pk

    if not isinstance(chain, pk.Chain):
        raise InputTypeError(f"chain must be a pytorch_kinematics.Chain, got {type(chain).__name__}")
    frames, parents = _frames_depth_first(chain)
    names = [frame.name for frame in frames]
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise ModelError(f"chain must have frames of different names, several are called {', '.join(doubled[:5])}")
    taken = {_joint_name(frame) for frame in frames if frame.joint.joint_type != "fixed"}
    joints = [_read_joint(frame, parent, taken) for frame, parent in zip(frames, parents, strict=True)]
    geometry = [_read_geometry(frame) for frame in frames]
    record = UrdfRecord(
        name=names[0],
        tree=KinematicTree(tuple(joints)),
        link_names=tuple(names),
        link_meshes=(None,) * len(names),
        link_primitives=tuple(solids for solids, _ in geometry),
    )
    return record, frozenset(link for link, (_, complete) in enumerate(geometry) if not complete)


def _frames_depth_first(chain: Chain) -> tuple[list[Frame], list[int]]:
    """Return the frames of a chain, parents first, and the index of each one's parent, -1 for the root."""
    root = chain.find_frame(chain.get_frame_names(exclude_fixed=False)[0])
    frames: list[Frame] = []
    parents: list[int] = []
    waiting = [(root, -1)]
    while waiting:
        frame, parent = waiting.pop()
        frames.append(frame)
        parents.append(parent)
        waiting += [(child, len(frames) - 1) for child in reversed(frame.children)]
    return frames, parents


def _joint_name(frame: Frame) -> str:
    return str(frame.name if frame.joint.name is None else frame.joint.name)


def _read_joint(frame: Frame, parent: int, taken: set[str]) -> Joint:
    """Return the joint of a frame; names of fixed ones, which are no degrees of freedom, avoid those ``taken``."""
    name, joint = _joint_name(frame), frame.joint
    if joint.joint_type not in JOINT_TYPES:
        raise ModelError(
            f"chain has joint {name!r} of type {joint.joint_type!r}; supported: {', '.join(JOINT_TYPES)}; "
            f"stack several frames for a joint of several degrees of freedom"
        )
    offset = torch.eye(4, dtype=torch.float64)
    for part in (frame.link.offset, joint.offset):
        if part is not None:
            offset = offset @ part.get_matrix()[0].detach().cpu().double()
    if joint.joint_type == "fixed":
        return Joint(new_name(name, taken), parent, offset)
    lower, upper = (-math.inf, math.inf) if joint.limits is None else joint.limits
    x, y, z = joint.axis.detach().cpu().double().tolist()
    return Joint(
        name, parent, offset, kind=joint.joint_type, axis=(x, y, z), lower=float(lower), upper=float(upper)
    )  # fmt: skip


def _read_geometry(frame: Frame) -> tuple[tuple[UrdfPrimitive, ...], bool]:
    """Return the solids of a frame's link, and whether that is all its geometry: no mesh, no unknown kind."""
    visuals = [visual for visual in frame.link.visuals or () if visual.geom_type is not None]
    known = [visual for visual in visuals if str(visual.geom_type) in ("box", "cylinder", "capsule", "sphere")]
    solids = []
    for visual in known:
        size = torch.as_tensor(visual.geom_param, dtype=torch.float64).reshape(-1)
        origin = torch.eye(4, dtype=torch.float64)
        if visual.offset is not None:
            origin = visual.offset.get_matrix()[0].detach().cpu().double()
        solids.append(UrdfPrimitive(visual.geom_type, tuple(size.tolist()), origin))
    return tuple(solids), len(known) == len(visuals)


def new_name(name: str, taken: set[str]) -> str:
    """Return the name, lengthened while it is among those taken, which it joins."""
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def part_parents(tree: KinematicTree, frames: Sequence[int]) -> list[int]:
    """Return, per part, the next part above its frame in the tree, -1 for none."""
    part_of = {frame: part for part, frame in enumerate(frames)}
    parents = []
    for frame in frames:
        ancestor = tree.joints[frame].parent
        while ancestor >= 0 and ancestor not in part_of:
            ancestor = tree.joints[ancestor].parent
        parents.append(part_of.get(ancestor, -1))
    return parents


def neighbor_matrix(parents: Sequence[int]) -> Tensor:
    """Return (P, P) booleans: True for each part itself, its parent and its children."""
    neighbors = torch.eye(len(parents), dtype=torch.bool)
    for part, parent in enumerate(parents):
        if parent >= 0:
            neighbors[part, parent] = neighbors[parent, part] = True
    return neighbors


def offset_owners(tree: KinematicTree, frames: Sequence[int]) -> list[int]:
    """Return, per frame of the tree, 1 + the part whose length scales its offset, or 0: the nearest part above it."""
    part_of = {frame: part for part, frame in enumerate(frames)}
    owners = []
    for joint in tree.joints:
        ancestor = joint.parent
        while ancestor >= 0 and ancestor not in part_of:
            ancestor = tree.joints[ancestor].parent
        owners.append(part_of.get(ancestor, -1) + 1)
    return owners


def _check_depth(tree: KinematicTree) -> None:
    depths: list[int] = []
    for joint in tree.joints:
        depths.append(0 if joint.parent < 0 else depths[joint.parent] + 1)
        if depths[-1] > _MAX_DEPTH:
            raise ModelError(f"frame {joint.name!r} lies {depths[-1]} frames deep; at most {_MAX_DEPTH} are supported")


def _axis_of(joint: Joint) -> Tensor:
    axis = torch.tensor(joint.axis, dtype=torch.float64)
    return axis / axis.norm()


def _local_tables(offsets: Tensor, moving: list[int], axes: Tensor, is_revolute: Tensor) -> dict[str, Tensor]:
    """Return tables (F, 16) whose sum, weighted by 1, scale, sine, cosine and value, is a pose in the parent."""
    motions = {name: torch.zeros(len(offsets), 4, 4, dtype=torch.float64) for name in ("sines", "cosines", "slides")}
    along = axes.unsqueeze(-1) * axes.unsqueeze(-2)
    revolute = is_revolute[:, None, None]
    motions["sines"][moving, :3, :3] = revolute * skew(axes)
    motions["cosines"][moving, :3, :3] = revolute * (torch.eye(3, dtype=torch.float64) - along)
    motions["slides"][moving, :3, 3] = (1 - is_revolute).unsqueeze(-1) * axes
    tables = {name: (offsets @ motion).flatten(-2) for name, motion in motions.items()}
    lengths = torch.zeros_like(offsets)
    lengths[:, :3, 3] = offsets[:, :3, 3]
    still = offsets - lengths - offsets @ motions["cosines"]
    return {**tables, "lengths": lengths.flatten(-2), "still": still.flatten(-2)}


def _doubling(tree: KinematicTree) -> tuple[Tensor, Tensor, list[int], list[Tensor]]:
    """Return the order of frames by depth, its inverse, and per round the number of complete frames and ancestors."""
    depths: list[int] = []
    for joint in tree.joints:
        depths.append(0 if joint.parent < 0 else depths[joint.parent] + 1)
    order = sorted(range(len(tree)), key=lambda index: depths[index])
    rank = {index: number for number, index in enumerate(order)}
    beyond = [rank.get(tree.joints[index].parent, -1) for index in order]
    complete, jumps, reach = [], [], 1
    while reach <= max(depths):
        complete.append(sum(depth < reach for depth in depths))
        jumps.append(torch.tensor(beyond[complete[-1] :]))
        beyond = [-1 if above < 0 else beyond[above] for above in beyond]
        reach *= 2
    by_depth = torch.tensor(order)
    return by_depth, by_depth.argsort(), complete, jumps


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
