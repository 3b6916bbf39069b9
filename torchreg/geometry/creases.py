"""Triangles without shared vertices, as STL files hold them, with shared ones: smooth where they meet flatly."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchreg.geometry.graphs import connected_components

# Triangles that meet under less are one smooth surface: the default of modelling programs.
_SMOOTH = math.radians(30)


def welded(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return vertices to keep (V',), faces (F, 3) over these, and unit normals; edges over 30 degrees stay sharp."""
    corners = faces.reshape(-1).cpu()
    points = vertices.detach().cpu()[corners]
    corner, second, third = points.double().view(-1, 3, 3).unbind(1)
    normals = torch.linalg.cross(second - corner, third - corner).repeat_interleave(3, dim=0)
    smooth = _smooth_surfaces(normals, torch.unique(points.float(), dim=0, return_inverse=True)[1])
    total = normals.new_zeros(int(smooth.max()) + 1, 3).index_add_(0, smooth, normals)
    first = torch.full((len(total),), len(corners)).scatter_reduce(0, smooth, torch.arange(len(corners)), "amin")
    return corners[first], smooth.view(-1, 3), nn.functional.normalize(total, dim=-1)


def _smooth_surfaces(normals: Tensor, position: Tensor) -> Tensor:
    """Return the smooth surface (N,) of corners with normals (N, 3), each at one position only."""
    unit = nn.functional.normalize(normals, dim=-1)
    order = position.argsort(stable=True)
    counts = torch.bincount(position)
    starts = torch.cumsum(counts, 0) - counts
    # Every pair of corners at one position.
    many = counts[position]
    first = torch.arange(len(position)).repeat_interleave(many)
    offset = torch.arange(len(first)) - (torch.cumsum(many, 0) - many).repeat_interleave(many)
    second = order[starts[position[first]] + offset]
    near = (first < second) & ((unit[first] * unit[second]).sum(-1) > math.cos(_SMOOTH))
    return connected_components(torch.stack((first[near], second[near]), dim=1), len(position))
