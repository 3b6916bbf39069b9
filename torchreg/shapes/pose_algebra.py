"""Poses as a manifold: steps and differences for which no rotation of the base is singular.

A pose is (translation of the base, rotation vector of the base, joints). A step has the same layout; its rotation is
composed from the left.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.geometry.rotation import compose_rotation_vectors

BASE_DOF_NAMES = ("base_x", "base_y", "base_z", "base_rx", "base_ry", "base_rz")
# Degrees of freedom of the base, which come first in every pose.
BASE_DOFS = len(BASE_DOF_NAMES)


def retract(pose: Tensor, step: Tensor) -> Tensor:
    """Return poses (..., D) moved by steps (..., D); the base's rotations are composed, ``exp(step) exp(w)``."""
    rotated = compose_rotation_vectors(step[..., 3:6], pose[..., 3:6])
    return torch.cat([pose[..., :3] + step[..., :3], rotated, pose[..., 6:] + step[..., 6:]], dim=-1)


def difference(start: Tensor, end: Tensor) -> Tensor:
    """Return the steps (..., D) that `retract` takes from one pose to another; the base turns by at most pi."""
    rotated = compose_rotation_vectors(end[..., 3:6], -start[..., 3:6])
    return torch.cat([end[..., :3] - start[..., :3], rotated, end[..., 6:] - start[..., 6:]], dim=-1)


def shifted(pose: Tensor, offset: Tensor) -> Tensor:
    """Return poses (..., num_dofs) with the base moved by offsets (..., 3)."""
    return torch.cat([pose[..., :3] + offset, pose[..., 3:]], dim=-1)
