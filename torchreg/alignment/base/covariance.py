"""How far a fitted base may be off: noise, what all frames share, and how much it changes when frames are left out."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchreg.alignment.base.fit import BaseFit
from torchreg.shapes.pose_algebra import BASE_DOFS


@dataclass(frozen=True)
class _ModelErrors:
    """Standard deviations of what no averaging over data removes."""

    lever: float = 0.5  # of the size, over which a joint turns its links off the data by their noise
    depth_scale: float = 0.005  # relative error of a depth camera's distances, the same in all frames
    least_frames: int = 3  # that are left out in turn; the spread of fewer is unknown


_ERRORS = _ModelErrors()
_FIT = BASE_DOFS + 1  # variables without the joints: the base and the depth offset


def base_covariance(fit: BaseFit) -> tuple[Tensor, Tensor]:
    """Return the covariance (6, 6) of the base and the standard deviations (J,) of the offsets, float64.

    Data of a link share the error of its mesh, its joints and its mask. So joints and depth offset vary in two levels,
    from frame to frame and in all frames alike, by as much as moves a link by the noise; the camera's scale of depth
    varies alike in all. The first are marginalized (a linear mixed model), the scale is considered, and the jackknife
    covariance over frames, which sees errors without a model, is added.

    References: Laird and Ware 1982; Schmidt 1966; Efron and Stein 1981.
    """
    prior, seen = fit.problem.precision(), fit.problem.facing(fit.state)
    _, gradients, hessians = fit.problem.systems(fit.state, seen, fit.sigma, fit.noise)
    slides = fit.problem.skin.shape.is_sliding[BASE_DOFS:].cpu()
    joint_std = torch.where(slides, fit.noise, fit.noise / (_ERRORS.lever * fit.problem.size)).double()
    shared = torch.where(fit.problem.free, prior[_FIT:], joint_std**-2)
    own = pad(torch.cat([torch.tensor([fit.noise]).double(), joint_std]).square(), (BASE_DOFS, 1))
    identity = torch.eye(len(own), dtype=torch.float64)
    information = torch.linalg.solve(identity + hessians * own, hessians).sum(0)
    by_scale, information = information[:-1, -1], information[:-1, :-1] + torch.diag(torch.cat([prior[:_FIT], shared]))
    found = torch.linalg.pinv(0.5 * (information + information.mT), hermitian=True)
    # The fit takes the scale for right, so what it explains wrongly by the base stays whatever the data (Schmidt).
    moved = _ERRORS.depth_scale * (found @ by_scale)
    found = found + moved.unsqueeze(-1) * moved
    base = found[:BASE_DOFS, :BASE_DOFS]
    if len(hessians) >= _ERRORS.least_frames:
        base = base + _jackknife(gradients[:, :_FIT], hessians[:, :_FIT, :_FIT], torch.diag(prior[:_FIT]))
    offset_std = found.diagonal()[_FIT:].clamp_min(0).sqrt()
    return base, torch.where(fit.problem.free, offset_std, 0.0)


def _jackknife(gradients: Tensor, hessians: Tensor, prior: Tensor) -> Tensor:
    """Return the jackknife covariance (6, 6) of one Newton step without each of T frames."""
    count = len(hessians)
    left = hessians.sum(0) + prior - hessians
    moved = (torch.linalg.pinv(left, hermitian=True) @ gradients.unsqueeze(-1))[:, :BASE_DOFS, 0]
    moved = moved - moved.mean(0)
    return (count - 1) / count * moved.mT @ moved
