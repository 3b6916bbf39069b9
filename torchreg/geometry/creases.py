"""Triangles without shared vertices, as STL files hold them, with shared ones: smooth where they meet flatly."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class _Creases:
    """Which triangles are one smooth surface."""

    smooth: float = math.radians(30)  # those that meet under less: the default of modelling programs
    normal: float = 0.01  # normals whose coordinates differ by less are one: half a degree, which no eye sees


_CREASES = _Creases()


def welded(vertices: Tensor, faces: Tensor, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return which vertices of a soup of triangles to keep (V',), faces (F, 3) over these, and unit normals (V', 3).

    Corners at one position have the mean normal, by area, of those triangles there that meet theirs under less than 30
    degrees, and are one vertex where normals and rows of ``like`` are equal: edges stay sharp, round surfaces smooth.

    Args:
        vertices: (V, 3), most of them used by one triangle.
        faces: (F, 3) of them.
        like: (V, C) what else belongs to a vertex, such as its weights.
    """
    corners = faces.reshape(-1)
    points = vertices[corners].detach().cpu().double()
    triangle = points.view(-1, 3, 3)
    normal = torch.linalg.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
    position = torch.unique(vertices[corners].detach().cpu().float(), dim=0, return_inverse=True)[1]
    smooth = _creased(normal.repeat_interleave(3, dim=0), position)
    rounded = (smooth / _CREASES.normal).round()
    rows = torch.unique(like[corners].detach().cpu().float(), dim=0, return_inverse=True)[1]
    keys = torch.cat((position.unsqueeze(1), rows.unsqueeze(1), rounded.long()), dim=1)
    unique, index = torch.unique(keys, dim=0, return_inverse=True)
    first = torch.full((len(unique),), len(corners)).scatter_reduce(0, index, torch.arange(len(corners)), "amin")
    return corners.cpu()[first], index.view(-1, 3), smooth[first]


def _creased(normals: Tensor, position: Tensor) -> Tensor:
    """Return the unit normals (N, 3) of corners by those (N, 3), weighed by area, of the corners at their positions."""
    unit = nn.functional.normalize(normals, dim=-1)
    order = position.argsort(stable=True)
    counts = torch.bincount(position)
    starts = torch.cumsum(counts, 0) - counts
    # Every pair of corners at one position.
    many = counts[position]
    first = torch.arange(len(position)).repeat_interleave(many)
    offset = torch.arange(len(first)) - (torch.cumsum(many, 0) - many).repeat_interleave(many)
    second = order[starts[position[first]] + offset]
    near = (unit[first] * unit[second]).sum(-1) > math.cos(_CREASES.smooth)
    total = torch.zeros_like(normals).index_add_(0, first[near], normals[second[near]])
    return nn.functional.normalize(torch.where(total.norm(dim=-1, keepdim=True) > 0, total, unit), dim=-1)
