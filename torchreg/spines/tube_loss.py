"""How far surface points are from the tubes around the curves of a spine, as a differentiable loss."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor, nn

from torchreg._checks import check_points, check_positive, check_shape
from torchreg.solvers.robust import geman_mcclure_loss

# Distances held at a time.
_CHUNK_ENTRIES = 4_000_000


class TubeLoss(nn.Module):
    """Mean squared distance of surface points to the surface of the tubes around curves, robust to what is no tube.

    The signed distance of a point to a tube is that to the nearest point of its axis, less the radius there, which is
    linear between the points of the curve; that to all tubes is the smallest. A point counts with
    ``rho(d) = s^2 d^2 / (s^2 + d^2)``, so that a trunk that is no tube pulls little.

    Args:
        scale: s, the distance from which points count as unexplained, in the unit of the curves.

    Raises:
        InputError: if ``scale`` is not positive.

    Differentiable: in curves and radii; which piece of a curve is nearest is held fixed.

    References: Geman and McClure 1987 for rho.
    """

    def __init__(self, scale: float) -> None:
        super().__init__()
        check_positive(scale, "scale")
        self.scale = scale

    def forward(self, curves: Tensor, radii: Tensor, points: Tensor) -> Tensor:
        """Return the loss () of one moment.

        Args:
            curves: (L, S, 3), as ``spine.model(t)``.
            radii: (L, S), as ``spine.model.radii(t)``.
            points: (N, 3) on the surface at that moment.

        Raises:
            InputError: if sizes do not fit or there are no points.
        """
        squared_ratio = (self.distances(curves, radii, points) / self.scale).square()
        return self.scale**2 * geman_mcclure_loss(squared_ratio).mean()

    def distances(self, curves: Tensor, radii: Tensor, points: Tensor) -> Tensor:
        """Return the signed distances (N,) of points to the tubes, negative inside."""
        check_shape(curves, "curves", ("L", "S", 3))
        check_shape(radii, "radii", tuple(curves.shape[:2]))
        check_points(points, "points", batch=False)
        start, end = curves[:, :-1].flatten(0, 1), curves[:, 1:].flatten(0, 1)
        first, last = radii[:, :-1].flatten(), radii[:, 1:].flatten()
        return torch.cat([_nearest(start, end, first, last, some) for some in _parts(points, len(start))])


def _parts(points: Tensor, pieces: int) -> Iterator[Tensor]:
    yield from points.split(max(1, _CHUNK_ENTRIES // pieces))


def _nearest(start: Tensor, end: Tensor, first: Tensor, last: Tensor, points: Tensor) -> Tensor:
    """Return the signed distances (N,) of points to cones between balls, the smallest over the cones."""
    with torch.no_grad():
        piece = _signed(start, end, first, last, points.unsqueeze(1)).argmin(-1)
    return _signed(start[piece], end[piece], first[piece], last[piece], points)


def _signed(start: Tensor, end: Tensor, first: Tensor, last: Tensor, points: Tensor) -> Tensor:
    axis = end - start
    square = axis.square().sum(-1)
    # A piece without length is a ball.
    share = ((points - start) * axis).sum(-1) / torch.where(square > 0, square, 1.0)
    share = share.clamp(0, 1)
    offset = points - start - share.unsqueeze(-1) * axis
    far = offset.square().sum(-1)
    # On the axis the distance has no direction, and no gradient.
    distance = torch.where(far > 0, torch.where(far > 0, far, 1.0).sqrt(), 0.0)
    return distance - (first + share * (last - first))
