"""Which data belong to the shape, to something that touches it, or to something else."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import torch
from torch import Tensor

from torchreg.geometry.graphs import connected_components
from torchreg.geometry.neighbors import k_nearest_others, sampling_distance


class Assignment(IntEnum):
    """What a datum belongs to."""

    ELSEWHERE = 0
    TOUCHING = 1
    SHAPE = 2


@dataclass(frozen=True)
class _Graph:
    """The graph of neighboring data."""

    neighbors: int = 8  # about as many surround a sample of a surface
    gap: float = 3.0  # distance between samples, from which on surfaces do not touch


_GRAPH = _Graph()


def assigned(points: Tensor, on_shape: Tensor) -> Tensor:
    """Return for points (M, 3) their `Assignment` (M,), int64: to the shape, to a surface touching it, or elsewhere.

    ``on_shape``: (M,) bool. Two data are neighbors if one is among the eight nearest of the other, within three times
    the typical distance; a surface is what neighbors connect off the shape.
    """
    found = torch.where(on_shape, int(Assignment.SHAPE), int(Assignment.ELSEWHERE))
    known = points.isfinite().all(-1).nonzero()[:, 0]
    if len(known) < 2:
        return found
    near, others = points[known].detach(), on_shape[known]
    index, apart = k_nearest_others(near, min(_GRAPH.neighbors, len(near) - 1))
    rows = torch.arange(len(near), device=near.device).unsqueeze(-1).expand_as(index)
    edges = torch.stack((rows, index), -1)[apart <= _GRAPH.gap * sampling_distance(near)]
    surface = connected_components(edges[~others[edges].any(-1)], len(near)).to(near.device)
    across = edges[others[edges].sum(-1) == 1].flatten()
    touching = torch.isin(surface, surface[across[~others[across]]]) & ~others
    found[known[touching]] = int(Assignment.TOUCHING)
    return found
