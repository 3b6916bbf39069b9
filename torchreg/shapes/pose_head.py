"""The output layer of a pose network: features without limits to poses of a shape, and back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
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

# Distance of a joint from its limits, as a share of its range, at which the sigmoid is inverted for joints at a limit.
_INSIDE = 1e-3


@dataclass(frozen=True)
class _Representation:
    """A parametrization of the base rotation: its number of features, and the maps to and from rotation vectors."""

    size: int
    to_vector: Callable[[Tensor], Tensor] = torch.Tensor.clone
    from_vector: Callable[[Tensor], Tensor] = torch.Tensor.clone


_REPRESENTATIONS = {
    "6d": _Representation(6, rotation_vector_from_6d, rotation_vector_to_6d),
    "quaternion": _Representation(4, rotation_vector_from_quaternion, quaternion_from_rotation_vector),
    "vector": _Representation(3),
}


class PoseHead(nn.Module):
    """Maps the features of a network's last layer to poses: translation, rotation, joints, in this order.

    The base rotation is parametrized by six numbers or a quaternion, which are continuous, or by a rotation vector. A
    pose holds a rotation vector, whose sign changes at half turns: compare poses by keypoints or rotations, not by it.

    Args:
        shape: the shape whose poses are meant; only its limits are kept.
        rotation: "6d", "quaternion" or "vector".
        joints: "sigmoid" keeps every joint with finite limits inside them; "free" takes features as joint values.

    Raises:
        InputError: if ``rotation`` or ``joints`` is unknown.

    References: Zhou et al. 2019, On the continuity of rotation representations in neural networks.
    """

    lower: Tensor
    upper: Tensor
    limited: Tensor

    def __init__(self, shape: ArticulatedShape, *, rotation: str = "6d", joints: str = "free") -> None:
        super().__init__()
        check_choice(rotation, "rotation", tuple(_REPRESENTATIONS))
        check_choice(joints, "joints", ("free", "sigmoid"))
        self.rotation, self.joints = rotation, joints
        lower, upper = shape.lower[6:], shape.upper[6:]
        limited = lower.isfinite() & upper.isfinite() if joints == "sigmoid" else torch.zeros_like(lower).bool()
        self.register_buffer("limited", limited, persistent=False)
        self.register_buffer("lower", torch.where(limited, lower, 0.0), persistent=False)
        self.register_buffer("upper", torch.where(limited, upper, 1.0), persistent=False)

    @property
    def num_features(self) -> int:
        """Number of features of a pose: the size of the layer before."""
        return 3 + _REPRESENTATIONS[self.rotation].size + len(self.limited)

    @property
    def num_dofs(self) -> int:
        """Size of a pose."""
        return 6 + len(self.limited)

    def forward(self, features: Tensor) -> Tensor:
        """Return the poses of features.

        Args:
            features: (..., num_features).

        Returns:
            (..., num_dofs), metres and radians.

        Raises:
            InputError: if the last size is not `num_features`.

        Differentiable: in ``features``, see `rotation_from_6d` and `rotation_from_quaternion`.
        """
        check_shape(features, "features", (self.num_features,), batch=True)
        representation = _REPRESENTATIONS[self.rotation]
        translation, rotation, joints = features.split([3, representation.size, len(self.limited)], dim=-1)
        bounded = self.lower + (self.upper - self.lower) * torch.sigmoid(joints)
        joints = torch.where(self.limited, bounded, joints)
        return torch.cat([translation, representation.to_vector(rotation), joints], dim=-1)

    def features(self, pose: Tensor) -> Tensor:
        """Return the features of a pose; joints at their limits are moved inside by a thousandth of their range.

        Args:
            pose: (..., num_dofs).

        Returns:
            (..., num_features).

        Raises:
            InputError: if the pose has the wrong size.

        Differentiable: in ``pose``.
        """
        check_shape(pose, "pose", (self.num_dofs,), batch=True)
        translation, rotation, joints = pose.split([3, 3, len(self.limited)], dim=-1)
        extent = self.upper - self.lower
        # Any feature gives a joint without range.
        share = torch.where(extent > 0, (joints - self.lower) / torch.where(extent > 0, extent, 1.0), 0.5)
        logit = torch.logit(share.clamp(_INSIDE, 1 - _INSIDE))
        rotation = _REPRESENTATIONS[self.rotation].from_vector(rotation)
        return torch.cat([translation, rotation, torch.where(self.limited, logit, joints)], dim=-1)
