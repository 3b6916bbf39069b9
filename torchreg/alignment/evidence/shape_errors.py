"""Model-error ("consider") covariance of a pose, in addition to that of the noise."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.alignment.fit.problem import AlignProblem
from torchreg.alignment.fit.surface_fit import SURFACE_FIT
from torchreg.shapes.scale_jacobian import SCALE_RANGE, scale_jacobian
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
    """Return the "consider" covariance (B, D, D) of a pose by errors of a shape of solids; zero for meshes.

    Scales off by s move the pose by ``-G s``, ``G = C J^T S``, and leave residuals ``(S - J G) s``; C is the covariance
    of the fit, J and S its weighted Jacobians by pose and scales. With a standard deviation tau of the scales the
    covariance is ``tau^2 G G^T``; tau is estimated from the ``share`` (B,) of the residuals' variance that neighbors
    share (Schmidt 1966). The whole surface may also be offset by `SURFACE_FIT.min_noise`, which leaves no residual from
    one side: of the hands of ``benchmarks/confidence.py --calibrate`` the true poses are likeliest at 0.25 to 0.3 mm.
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
    variance = (shared / left.clamp_min(torch.finfo(left.dtype).tiny)).clamp_max(SCALE_RANGE.max_log**2)
    offset = covariance.double() @ (rows.mT @ weight) * SURFACE_FIT.min_noise(problem.size)
    return variance[:, None, None] * (moved @ moved.mT) + offset @ offset.mT
