"""Kinematic trees as plain data: read from files, and the basis of articulated shapes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.errors import ModelError
from torchreg.geometry.rigid import RIGID_TOLERANCE, rotation_error

JOINT_TYPES = ("fixed", "revolute", "prismatic")


@dataclass(frozen=True)
class Joint:
    """A frame of the tree and the joint that connects it to its parent.

    ``T_parent_frame = offset @ motion(value)``, the motion about or along ``axis`` in the frame's own coordinates.
    Joints with several degrees of freedom are stacked frames, which coincide.

    Args:
        parent: index of the parent frame, -1 for the root.
        offset: (4, 4) float64 ``T_parent_frame`` at value zero.
        kind: one of ``JOINT_TYPES``.
        lower, upper: limits, radians or metres.
        mimic: (index of the followed frame, multiplier, offset), or None; ``value = multiplier * followed + offset``.
    """

    name: str
    parent: int
    offset: Tensor
    kind: str = "fixed"
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    lower: float = -float("inf")
    upper: float = float("inf")
    mimic: tuple[int, float, float] | None = None


@dataclass(frozen=True)
class KinematicTree:
    """A validated tree of frames in topological order (every parent before its children, one root)."""

    joints: tuple[Joint, ...]

    def __post_init__(self) -> None:
        if not self.joints:
            raise ModelError("the kinematic tree is empty: it needs at least one frame")
        names = [joint.name for joint in self.joints]
        doubled = sorted({name for name in names if names.count(name) > 1})
        if doubled:
            raise ModelError(f"frame names must be unique, these occur more than once: {', '.join(doubled[:5])}")
        for index, joint in enumerate(self.joints):
            _check_joint(index, joint, len(self.joints))
            _check_axis_and_limits(joint)
        for joint in self.joints:
            _check_mimic(joint, self.joints)

    def __len__(self) -> int:
        return len(self.joints)

    def index(self, name: str) -> int:
        """Return the index of the frame called ``name``; KeyError lists the known names."""
        for index, joint in enumerate(self.joints):
            if joint.name == name:
                return index
        raise KeyError(f"no frame is called {name!r}; known: {', '.join(joint.name for joint in self.joints)}")


def stack_sizes(tree: KinematicTree) -> list[int]:
    """Return, per degree of freedom, the number of coincident revolute frames in its joint: three for a ball joint."""
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


def _check_joint(index: int, joint: Joint, count: int) -> None:
    if (index == 0) != (joint.parent == -1):
        problem = "is a second root: the tree is disconnected" if joint.parent == -1 else "must be the root (parent -1)"
        raise ModelError(f"frame {joint.name!r} {problem}")
    if not -1 <= joint.parent < index:
        raise ModelError(
            f"frame {joint.name!r} (index {index}) has parent index {joint.parent} of {count}: parents come "
            f"first (-1 marks the root), so the tree is cyclic or out of order"
        )
    if joint.kind not in JOINT_TYPES:
        raise ModelError(f"joint {joint.name!r} has kind {joint.kind!r}; known: {', '.join(JOINT_TYPES)}")
    if tuple(joint.offset.shape) != (4, 4) or not bool(torch.isfinite(joint.offset).all()):
        raise ModelError(f"joint {joint.name!r} needs a finite (4, 4) offset")
    rotation, last_row = joint.offset[:3, :3].double(), joint.offset[3].tolist()
    if last_row != [0.0, 0.0, 0.0, 1.0]:
        raise ModelError(f"joint {joint.name!r} has an offset whose last row is {last_row}; it must be 0, 0, 0, 1")
    if rotation_error(rotation) > RIGID_TOLERANCE.single or rotation.det() < 0:
        raise ModelError(f"joint {joint.name!r} has an offset that is not a rigid motion (scale, shear or mirror)")


def _check_axis_and_limits(joint: Joint) -> None:
    length = sum(a * a for a in joint.axis) ** 0.5
    if joint.kind != "fixed" and not (len(joint.axis) == 3 and abs(length - 1) < 1e-6):
        raise ModelError(f"joint {joint.name!r} has axis {joint.axis} of length {length}; a unit vector is needed")
    if not joint.lower <= joint.upper:
        raise ModelError(f"joint {joint.name!r} has limits {joint.lower} to {joint.upper}; lower must not exceed upper")
    if joint.lower == math.inf or joint.upper == -math.inf:
        raise ModelError(f"joint {joint.name!r} has limits {joint.lower} to {joint.upper}, which no finite value meets")


def _check_mimic(joint: Joint, joints: tuple[Joint, ...]) -> None:
    """Raise ModelError unless the chain of joints that ``joint`` mimics ends in a joint that moves by itself."""
    seen = [joint.name]
    source = joint
    while source.mimic is not None:
        followed, multiplier, offset = source.mimic
        if not 0 <= followed < len(joints):
            raise ModelError(f"joint {source.name!r} mimics the joint of index {followed}, but there are {len(joints)}")
        if not (math.isfinite(multiplier) and math.isfinite(offset)):
            raise ModelError(
                f"joint {source.name!r} has a mimic of multiplier {multiplier} and offset {offset}; not finite"
            )
        source = joints[followed]
        if source.name in seen:
            raise ModelError(f"joint {joint.name!r} follows itself through its mimic joints: {', '.join(seen)}")
        seen.append(source.name)
    if len(seen) > 1 and "fixed" in (joint.kind, source.kind):
        raise ModelError(f"joint {joint.name!r} mimics {source.name!r}: neither of the two may be fixed")
