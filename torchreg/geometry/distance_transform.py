"""Masks on a grid: each cell's signed distance to the border, its nearest cell inside, pieces, masks without holes."""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import binary_fill_holes, distance_transform_edt, label
from torch import Tensor


def signed_distance(mask: Tensor, dtype: torch.dtype = torch.float64) -> Tensor:
    """Return distances of cells to the border of a mask, in cells, negative inside; infinite without a border."""
    inside = mask.cpu().numpy()
    if inside.all() or not inside.any():
        distance = torch.full(mask.shape, torch.inf, dtype=dtype)
    else:
        # In every cell either term is zero.
        unsigned = distance_transform_edt(inside) + distance_transform_edt(~inside)
        distance = torch.from_numpy(unsigned).to(dtype) - 0.5
    distance = distance.to(mask.device)
    return torch.where(mask, -distance, distance)


def distance_beside(mask: Tensor, dtype: torch.dtype = torch.float64) -> Tensor:
    """Return the distance from the mask, zero inside; in half the time of the signed one."""
    inside = mask.cpu().numpy()
    if not inside.any():
        return torch.full(mask.shape, torch.inf, dtype=dtype, device=mask.device)
    beside = torch.from_numpy(distance_transform_edt(~inside)).to(dtype) - 0.5
    return beside.clamp_min(0).to(mask.device)


def nearest_inside(mask: Tensor) -> Tensor:
    """Return the flat index (...) int64 of the cell inside a mask (...) that is nearest to each cell of its grid."""
    indices = distance_transform_edt(~mask.cpu().numpy(), return_distances=False, return_indices=True)
    return torch.from_numpy(np.ravel_multi_index(tuple(indices), tuple(mask.shape))).to(mask.device)


def fill_holes(mask: Tensor) -> Tensor:
    """Return a mask with the cells that no path along the axes joins to the grid's border."""
    return torch.from_numpy(binary_fill_holes(mask.cpu().numpy())).to(mask.device)


def numbered_pieces(mask: Tensor) -> Tensor:
    """Return the connected component (...) int64 of each cell of a mask, along the axes, from 1 on; 0 outside."""
    return torch.from_numpy(label(mask.cpu().numpy())[0]).long().to(mask.device)
