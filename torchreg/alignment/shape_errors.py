"""What a shape that is not quite the measured one does to a pose: a covariance beside that of the noise."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.alignment.problem import AlignProblem
from torchreg.alignment.scale_fit import SCALE_FIT, scale_jacobian
from torchreg.alignment.surface_fit import SURFACE_FIT
from torchreg.shapes.surface import FusedSurface


def shape_covariance(
    problem: AlignProblem,
    pose: Tensor,
    *,
    distance: Tensor,
    jacobian: Tensor,
    factor: Tensor,
    covariance: Tensor,
    share: Tensor,
) -> Tensor | float:
    """Return by how much what is wrong with a shape of solids may have moved its pose; zero for exact surfaces.

    The logarithms of the parts' lengths and radii are parameters that the fit left out: those of the measured thing
    differ by ``s``. With weighted Jacobians ``J`` by the pose and ``S`` by the scales, and the fit's covariance ``C``,
    that moves the pose by ``-G s``, ``G = C J^T S``, and leaves the residuals ``(S - J G) s``. If the scales differ
    independently by a standard deviation ``tau``, the pose's covariance is ``tau^2 G G^T``; ``tau`` is that of which
    such residuals are as large as what neighboring ones share, which noise does not.

    And the surface as a whole may lie too far in or out, as solids fuse more or less and skin is thick or thin. Seen
    from one side such an offset moves the pose and leaves no residual, so its standard deviation is what a model is not
    exact, `SURFACE_FIT.min_noise`, 0.3 mm of a hand. (Of the hands of ``benchmarks/confidence.py --calibrate``
    the likelihood of the true poses is largest at 0.25 to 0.3 mm.)

    Args:
        problem: the batch.
        pose: (B, num_dofs), fitted.
        distance: (B, M) of the data from the surface, metres.
        jacobian: (B, M, num_dofs) of the distances by the pose.
        factor: (B, M) by which distances count: roots of their weights, in 1 / noise.
        covariance: (B, num_dofs, num_dofs) of the fit, each datum counted as independent.
        share: (B,) of the variance of residuals that neighbors share.

    Returns:
        (B, num_dofs, num_dofs), float64.

    References: Schmidt 1966, the "consider" covariance of parameters that are not estimated.
    """
    if not isinstance(problem.surface, FusedSurface):
        return 0.0
    # Derivatives are taken, which inference mode would refuse.
    with torch.inference_mode(False):
        by_scale = scale_jacobian(problem.skin.shape, problem.data.clone(), pose.clone())
    weight = factor.double().unsqueeze(-1)
    rows, scaled = jacobian.double() * weight, by_scale.double() * weight
    moved = covariance.double() @ (rows.mT @ scaled)
    left = (scaled - rows @ moved).square().sum((-2, -1))
    shared = share.double() * (distance.double() * weight.squeeze(-1)).square().sum(-1)
    variance = (shared / left.clamp_min(torch.finfo(left.dtype).tiny)).clamp_max(SCALE_FIT.max_log_scale**2)
    offset = covariance.double() @ (rows.mT @ weight) * SURFACE_FIT.min_noise(problem.size)
    return variance[:, None, None] * (moved @ moved.mT) + offset @ offset.mT
