"""A network that proposes people: from clouds of a body to several places of its surface each, and states from these."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchreg.alignment.search.pose_proposer import CloudNet, ProposerSize
from torchreg.geometry.sampling import farthest_points
from torchreg.shapes.articulated import ArticulatedShape


@dataclass(frozen=True)
class _Marks:
    """Vertices of the body whose places the network tells."""

    groups: int = 16  # that cover the body, each told by a query of its own
    each: int = 8  # vertices of a group


_MARKS = _Marks()
PERSON_SIZE = ProposerSize(tokens=96, encoder=3, hypotheses=4)


class RawPeople(NamedTuple):
    """Places of the marks (B, K, P, 3), metres, and logits (B, K); surface and token_index as of `RawPoses`."""

    marks: Tensor
    logits: Tensor
    surface: Tensor
    token_index: Tensor


class PersonProposer(CloudNet):
    """Proposes where marks on a body's surface lie, for people of any size and pose who stand about along z.

    Places rather than angles: they are linear in what is seen, and of clothes and sizes alike.

    Args:
        body: with coefficients, in metres.
        size: see `ProposerSize`.

    Shape of ``forward(points, mask)``: as of `PoseProposer`; see `RawPeople`.

    Differentiable: in its parameters and the points.

    References: Lin et al. 2021 (METRO), for places of vertices by queries; Carion et al. 2020.
    """

    marks: Tensor
    at_rest: Tensor

    def __init__(self, body: ArticulatedShape, size: ProposerSize | None = None) -> None:
        space = body.coefficient_space()
        at_mean = space.rest(space.mean)[0].detach().float()
        extent = float((at_mean.amax(0) - at_mean.amin(0)).norm())
        super().__init__(size or PERSON_SIZE, extent)
        width, marks = self.size.width, spread_marks(at_mean)
        self.register_buffer("marks", marks, persistent=False)
        self.register_buffer("at_rest", (at_mean[marks] - at_mean[marks].mean(0)) / extent, persistent=False)
        self.groups = nn.Parameter(torch.randn(_MARKS.groups, width))
        last = nn.Linear(width, 3 * _MARKS.each + 1)
        self.head = nn.Sequential(nn.Linear(width, width), nn.GELU(), last)
        self.surface = nn.Linear(width, 4)
        with torch.no_grad():
            last.weight.mul_(0.1)
            last.bias.zero_()

    def forward(self, points: Tensor, mask: Tensor) -> RawPeople:
        """Return places, see the class."""
        queries = self.queries.unsqueeze(1) + self.groups
        found = self.attended(points, mask, queries.flatten(0, 1))
        out = self.head(found.state).float().unflatten(1, queries.shape[:2])
        places, logits = out.split((3 * _MARKS.each, 1), dim=-1)
        places = places.unflatten(-1, (-1, 3)).flatten(2, 3) + self.at_rest
        return RawPeople(
            marks=self.shape_size * places + found.center[:, None, None],
            logits=logits.mean((-2, -1)),
            surface=self.surface(found.tokens).float(),
            token_index=found.token_index,
        )


def spread_marks(points: Tensor) -> Tensor:
    """Return the numbers of vertices (V, 3) that cover a body, group after group."""
    centers = points[farthest_points(points, _MARKS.groups)]
    cell = torch.cdist(points, centers).argmin(-1)
    cells = [(cell == number).nonzero()[:, 0] for number in range(_MARKS.groups)]
    return torch.cat([index[farthest_points(points[index], _MARKS.each)] for index in cells])


def is_body(shape: ArticulatedShape) -> bool:
    """Whether a shape is a body of anny's: with coefficients, and with its joints."""
    return shape.space is not None and {"upperarm01.L", "lowerleg01.R", "spine05"} <= set(shape.part_names)
