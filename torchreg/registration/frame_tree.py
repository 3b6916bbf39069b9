"""From which scan of a sequence each other one is reached."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchreg.geometry.graphs import minimum_spanning_forest, rooted
from torchreg.geometry.neighbors import NeighborTree
from torchreg.geometry.sampling import even_order


@dataclass(frozen=True)
class FrameTree:
    """Frames in an order in which every one comes after its parent; the root, whose parent is -1, comes first."""

    parents: tuple[int, ...]
    order: tuple[int, ...]

    # Points of a scan that are compared: enough for every part of a robot.
    COMPARED: ClassVar[int] = 500

    @classmethod
    def in_turn(cls, root: int, count: int) -> FrameTree:
        """Return the frames in turn, from the root forward and backward."""
        parents = [frame - 1 if frame > root else frame + 1 for frame in range(count)]
        parents[root] = -1
        return cls(tuple(parents), (*range(root, count), *range(root - 1, -1, -1)))

    @classmethod
    def alike(cls, clouds: Sequence[Tensor]) -> FrameTree:
        """Return the minimum spanning tree by the distances of clouds (N, 3), rooted in the one nearest to all."""
        trees = [NeighborTree(cloud) for cloud in clouds]
        thin = [cloud[even_order(cloud, min(len(cloud), cls.COMPARED))] for cloud in clouds]
        apart = torch.stack([torch.stack([tree.nearest(cloud)[1].mean() for tree in trees]) for cloud in thin]).cpu()
        apart = apart + apart.mT
        pairs = torch.triu_indices(len(clouds), len(clouds), 1).mT
        chosen = minimum_spanning_forest(pairs, apart[pairs[:, 0], pairs[:, 1]], len(clouds)).chosen()
        parents, order = rooted(pairs[chosen], apart.sum(0).argmin().reshape(1), len(clouds))
        return cls(tuple(parents.tolist()), tuple(order.tolist()))

    def path(self, frame: int) -> list[int]:
        """Return the frames from the root to a frame."""
        path = [frame]
        while self.parents[path[-1]] >= 0:
            path.append(self.parents[path[-1]])
        return path[::-1]
