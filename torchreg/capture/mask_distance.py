"""Masks as signed distance fields."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.geometry.distance_transform import distance_beside, signed_distance


def signed_mask_distance(mask: Tensor) -> Tensor:
    """Return the signed distance (H, W) of pixels to a mask's outline, negative inside, float32 on the CPU.

    The outline runs half a pixel outside of the middles inside; half the diagonal without an outline.
    """
    far = _far(mask)
    return signed_distance(mask.cpu(), torch.float32).nan_to_num(posinf=far, neginf=-far)


def beside_mask(mask: Tensor) -> Tensor:
    """Return the distance (H, W) from the mask, zero inside; in half the time of the signed one."""
    return distance_beside(mask.cpu(), torch.float32).nan_to_num(posinf=_far(mask))


def _far(mask: Tensor) -> float:
    return 0.5 * float(mask.shape[0] ** 2 + mask.shape[1] ** 2) ** 0.5
