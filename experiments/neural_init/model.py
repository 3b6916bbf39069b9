"""Two networks with one body: a regressor that reads a cloud, and a refiner that reads it beside a first pose."""

from __future__ import annotations

import torch
from torch import Tensor, nn

import torchreg as tr

from ..neural_init.data import Clouds

# The unit of places in the network, so that they are as large as rotations and joints: metres.
UNIT = 0.1
# Distances from the parts of a posed hand are told in this unit, and cut off beyond a few of them: metres.
NEAR = 0.02
# The refiner's numbers stand for steps of this size: metres, radians.
STEP_PLACE, STEP_TURN = 0.03, 0.3


class PointNet(nn.Module):
    """A map of every point, the maximum over points, and a map of that and further numbers to the output.

    Args:
        num_channels: per point.
        num_further: numbers per cloud.
        num_outputs: of the last layer, `last`.
        width: of the first layer.
        normalized: whether what the last layer sees has zero mean and unit variance.

    References: Qi et al. 2017, PointNet.
    """

    def __init__(self, num_channels: int, num_further: int, num_outputs: int, width: int, normalized: bool) -> None:
        super().__init__()
        self.points = nn.Sequential(
            nn.Linear(num_channels, width), nn.ReLU(), nn.Linear(width, 2 * width), nn.ReLU(),
            nn.Linear(2 * width, 4 * width),
        )  # fmt: skip
        self.norm = nn.LayerNorm(4 * width)
        self.cloud = nn.Sequential(
            nn.Linear(4 * width + num_further, 8 * width), nn.ReLU(), nn.Linear(8 * width, 4 * width), nn.ReLU()
        )
        self.even = nn.LayerNorm(4 * width, elementwise_affine=False) if normalized else nn.Identity()
        self.last = nn.Linear(4 * width, num_outputs)

    def forward(self, channels: Tensor, further: Tensor) -> Tensor:
        """Return (B, num_outputs) of channels (B, M, num_channels) and further numbers (B, num_further)."""
        pooled = torch.relu(self.norm(self.points(channels).amax(dim=1)))
        return self.last(self.even(self.cloud(torch.cat([pooled, further], dim=-1))))


class PoseRegressor(nn.Module):
    """Clouds to poses: `PointNet` of the centered cloud, then torchreg's `PoseHead`.

    Args:
        hand: whose poses.
        width: of the network.
        normalized: see `PointNet`.
    """

    unit: Tensor

    def __init__(self, hand: tr.Hand, width: int, normalized: bool = False) -> None:
        super().__init__()
        self.head = tr.PoseHead(hand, rotation="6d")
        self.net = PointNet(3, 0, self.head.num_features, width, normalized)
        unit = torch.ones(self.head.num_features)
        unit[:3] = UNIT
        self.register_buffer("unit", unit, persistent=False)

    def forward(self, clouds: Clouds) -> Tensor:
        """Return poses (B, num_dofs)."""
        center = clouds.centers
        offset = (clouds.points - center.unsqueeze(1)) / UNIT
        pose = self.head(self.unit * self.net(offset, offset.new_zeros(len(offset), 0)))
        return torch.cat([pose[:, :3] + center, pose[:, 3:]], dim=-1)

    @torch.no_grad()
    def start_from_(self, prior: tr.PosePrior) -> None:
        """Let the last layer give the prior's mean pose, and its components around it."""
        prior.init_head_(self.net.last, self.head)
        self.net.last.weight.div_(self.unit.unsqueeze(-1))
        self.net.last.bias.div_(self.unit)


class PoseRefiner(nn.Module):
    """Clouds and the poses found in them to better poses: a step from them, none before training.

    The network sees the points in the palm's frame, how far each is from every part of the posed hand, and the joints
    and the confidence found.

    Args:
        hand: whose poses; called without gradients, its parameters are not the refiner's.
        width: of the network.
        normalized: see `PointNet`.
    """

    unit: Tensor

    def __init__(self, hand: tr.Hand, width: int, normalized: bool = False) -> None:
        super().__init__()
        self._hand = (hand,)
        self.net = PointNet(3 + hand.num_parts, hand.num_dofs - 5, hand.num_dofs, width, normalized)
        nn.init.zeros_(self.net.last.weight)
        nn.init.zeros_(self.net.last.bias)
        unit = torch.full((hand.num_dofs,), STEP_TURN)
        unit[:3] = STEP_PLACE
        self.register_buffer("unit", unit, persistent=False)

    def forward(self, clouds: Clouds) -> Tensor:
        """Return poses (B, num_dofs)."""
        (hand,), first = self._hand, clouds.found
        turn = hand.part_transforms(first)[:, 0, :3, :3]
        local = (clouds.points - first[:, None, :3]) @ turn / UNIT
        with torch.no_grad():
            apart = (hand.part_distances(clouds.points, first) / NEAR).clamp(-1, 2)
        further = torch.cat([first[:, 6:], clouds.confidence.unsqueeze(-1)], dim=-1)
        step = self.unit * self.net(torch.cat([local, apart], dim=-1), further)
        # The network thinks in the palm's frame, `retract` in the world's.
        base = (step[:, :6].unflatten(-1, (2, 3)) @ turn.mT).flatten(1)
        return hand.retract(first, torch.cat([base, step[:, 6:]], dim=-1))
