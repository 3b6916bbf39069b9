"""Masks on a grid as fields: how far every cell is from the border, and which cell of the mask is nearest."""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor


def signed_distance(mask: Tensor, dtype: torch.dtype = torch.float64) -> Tensor:
    """Return the distance of every cell's middle to the border of a mask, negative inside, in cells.

    The border runs half a cell beside the middles of the cells along it.

    Args:
        mask: bool of any shape and at least one cell.
        dtype: of the distances.

    Returns:
        Distances in the shape and on the device of the mask; infinite where there is no border.

    Differentiable: no.

    References: Maurer, Qi and Raghavan 2003, the transform of `scipy.ndimage.distance_transform_edt`.
    """
    inside = mask.cpu().numpy()
    if inside.all() or not inside.any():
        distance = torch.full(mask.shape, torch.inf, dtype=dtype)
    else:
        # One of the two is zero everywhere.
        apart = distance_transform_edt(inside) + distance_transform_edt(~inside)
        distance = torch.from_numpy(apart).to(dtype) - 0.5
    distance = distance.to(mask.device)
    return torch.where(mask, -distance, distance)


def nearest_inside(mask: Tensor) -> Tensor:
    """Return the running number (...) int64 of the cell of a mask (...) bool nearest to each cell of its grid.

    Args:
        mask: with at least one cell inside.

    Differentiable: no.
    """
    at = distance_transform_edt(~mask.cpu().numpy(), return_distances=False, return_indices=True)
    number = np.ravel_multi_index(tuple(at), tuple(mask.shape))
    return torch.from_numpy(number).to(mask.device)
