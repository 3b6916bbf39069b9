"""Pieces of a body on a grid, joined by bars where gaps in the data part them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.distance_transform import numbered_pieces, signed_distance
from torchreg.geometry.graphs import component_links


@dataclass(frozen=True)
class PieceJoining:
    """Which pieces belong together; sizes in cells."""

    dust: float = 1e-3  # share of the largest piece below which one is noise
    body: float = 0.5  # share of the largest piece from which on one is another body
    radius: float = 1.5  # of a bar: the least one whose cells touch each other however it runs


JOINING = PieceJoining()


def join_pieces(inside: Tensor) -> tuple[Tensor, int]:
    """Return bars (X, Y, Z) bool that join the connected components of a body's voxels, and their number."""
    numbers = numbered_pieces(inside)
    bars = torch.zeros(inside.shape, dtype=torch.bool)
    if int(numbers.max()) < 2:
        return bars, 0
    rim = (inside & (signed_distance(inside) > -1)).nonzero()
    sizes = torch.bincount(numbers[inside])
    shares = sizes / sizes.max()
    kept = (shares >= JOINING.dust) & (shares < JOINING.body)
    kept[sizes.argmax()] = True
    piece = numbers[tuple(rim.T)]
    rim, piece = rim[kept[piece]], piece[kept[piece]].unique(return_inverse=True)[1]
    links, lengths = component_links(rim.double(), piece, 1)
    lows, highs = torch.full((2, int(piece.max()) + 1, 3), 0)
    index = piece[:, None].expand_as(rim)
    lows.scatter_reduce_(0, index, rim, "amin", include_self=False)
    highs.scatter_reduce_(0, index, rim, "amax", include_self=False)
    extents = (highs - lows + 1).double().norm(dim=-1)
    joined, number = {int(piece.bincount().argmax())}, 0  # as `component_links` begins
    for ends, length in zip(links, lengths.tolist(), strict=True):
        pair = set(piece[ends].tolist())
        if length <= float(extents[list(pair - joined)].min()):
            _draw(bars, *rim[ends].double())
            number += 1
        joined |= pair
    return (signed_distance(bars) <= JOINING.radius) & bars.any(), number


def _draw(cells: Tensor, start: Tensor, end: Tensor) -> None:
    """Set the cells along a straight line."""
    shares = torch.linspace(0, 1, 2 * int((end - start).norm()) + 2, dtype=torch.float64)[:, None]
    cells[tuple((start + shares * (end - start)).round().long().T)] = True
