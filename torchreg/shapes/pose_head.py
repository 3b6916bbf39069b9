"""The end of a pose network: numbers without limits to poses of a shape, and back."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from torchreg._checks import check_choice, check_shape
from torchreg.geometry.rotation_representations import (
    quaternion_from_rotation_vector,
    rotation_vector_from_6d,
    rotation_vector_from_quaternion,
    rotation_vector_to_6d,
)

if TYPE_CHECKING:
    from torchreg.shapes.articulated import ArticulatedShape

_SIZES = {"6d": 6, "quaternion": 4, "vector": 3}
# Joints at a limit are taken this share of the range inside, where the sigmoid can be undone.
_INSIDE = 1e-3


class PoseHead(nn.Module):
    """Maps what the last layer of a network gives to poses: translation, rotation, joints, in this order.

    The base rotation is given as six numbers or a quaternion, both without jumps, or as a plain rotation vector. A pose
    holds a rotation vector, whose sign changes at half turns: compare poses by keypoints or rotations, not by it.

    Args:
        shape: the shape whose poses are meant; only its limits are kept.
        rotation: "6d", "quaternion" or "vector".
        joints: "sigmoid" keeps every joint with finite limits inside them; "free" leaves joints as they come.

    Raises:
        InputError: if ``rotation`` or ``joints`` is unknown.

    References: Zhou et al. 2019, On the continuity of rotation representations in neural networks.
    """

    lower: Tensor
    upper: Tensor
    limited: Tensor

    def __init__(self, shape: ArticulatedShape, *, rotation: str = "6d", joints: str = "free") -> None:
        super().__init__()
        check_choice(rotation, "rotation", tuple(_SIZES))
        check_choice(joints, "joints", ("free", "sigmoid"))
        self.rotation, self.joints = rotation, joints
        lower, upper = shape.lower[6:], shape.upper[6:]
        limited = lower.isfinite() & upper.isfinite() if joints == "sigmoid" else torch.zeros_like(lower).bool()
        self.register_buffer("limited", limited, persistent=False)
        self.register_buffer("lower", torch.where(limited, lower, 0.0), persistent=False)
        self.register_buffer("upper", torch.where(limited, upper, 1.0), persistent=False)

    @property
    def num_features(self) -> int:
        """How many numbers make a pose: the size of the layer before."""
        return 3 + _SIZES[self.rotation] + len(self.limited)

    @property
    def num_dofs(self) -> int:
        """Size of a pose."""
        return 6 + len(self.limited)

    def forward(self, features: Tensor) -> Tensor:
        """Return the poses that features stand for.

        Args:
            features: (..., num_features).

        Returns:
            (..., num_dofs), metres and radians.

        Raises:
            InputError: if the last size is not `num_features`.

        Differentiable: in ``features``, see `rotation_from_6d` and `rotation_from_quaternion`.
        """
        check_shape(features, "features", (self.num_features,), batch=True)
        place, turn, joints = features.split([3, _SIZES[self.rotation], len(self.limited)], dim=-1)
        if self.rotation == "6d":
            turn = rotation_vector_from_6d(turn)
        elif self.rotation == "quaternion":
            turn = rotation_vector_from_quaternion(turn)
        bounded = self.lower + (self.upper - self.lower) * torch.sigmoid(joints)
        return torch.cat([place, turn, torch.where(self.limited, bounded, joints)], dim=-1)

    def features(self, pose: Tensor) -> Tensor:
        """Return features that give a pose; joints at their limits are taken a thousandth of the range inside.

        Args:
            pose: (..., num_dofs).

        Returns:
            (..., num_features).

        Raises:
            InputError: if the pose has the wrong size.

        Differentiable: in ``pose``.
        """
        check_shape(pose, "pose", (self.num_dofs,), batch=True)
        place, turn, joints = pose.split([3, 3, len(self.limited)], dim=-1)
        if self.rotation == "6d":
            turn = rotation_vector_to_6d(turn)
        elif self.rotation == "quaternion":
            turn = quaternion_from_rotation_vector(turn)
        extent = self.upper - self.lower
        # A joint without range has nothing to tell.
        share = torch.where(extent > 0, (joints - self.lower) / torch.where(extent > 0, extent, 1.0), 0.5)
        logit = torch.logit(share.clamp(_INSIDE, 1 - _INSIDE))
        return torch.cat([place, turn, torch.where(self.limited, logit, joints)], dim=-1)
