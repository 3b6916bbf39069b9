"""Nearest neighbors of points with normals, by a tree over both."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg._checks import check_finite, check_points, check_positive, check_shape
from torchreg.geometry.neighbors import NeighborTree


class OrientedTree:
    """Points with normals, to be searched by ``|x - y|^2 + s^2 |n - n_y|^2``.

    Args:
        points: (K, 3) at least one.
        normals: (K, 3) unit vectors.
        scale: s, the distance that counts as much as normals 60 degrees apart.

    Raises:
        InputError: if a shape does not fit, a number is not finite, or ``scale`` is negative.

    References: Johnson 1997, for positions and normals in one tree.
    """

    def __init__(self, points: Tensor, normals: Tensor, scale: float) -> None:
        check_points(points, "points", batch=False)
        check_shape(normals, "normals", tuple(points.shape))
        check_finite(normals, "normals")
        check_positive(scale, "scale", allow_zero=True)
        self._scale = scale
        self._tree = NeighborTree(self._features(points, normals))

    def nearest(self, points: Tensor, normals: Tensor) -> Tensor:
        """Return the index (N,) int64 of the nearest of the tree's points to each of points (N, 3), on their device.

        Raises:
            InputError: if a shape does not fit or a number is not finite.

        Differentiable: no.
        """
        check_points(points, "points", batch=False)
        check_shape(normals, "normals", tuple(points.shape))
        check_finite(normals, "normals")
        return self._tree.nearest(self._features(points, normals))[0]

    def _features(self, points: Tensor, normals: Tensor) -> Tensor:
        return torch.cat([points.detach().double(), self._scale * normals.detach().double()], dim=-1)
