"""Robust weights of the joints of a registration, and their stiffness against turns that scans do not show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.registration.bones.config import BoneConfig
from torchreg.registration.bones.joint_moments import JointMoments
from torchreg.solvers.robust import cauchy_weight, geman_mcclure_weight


@dataclass(frozen=True)
class _Hinges:
    """Evidence that the axis of a hinge needs."""

    least_frames: int = 3  # between two frames every motion turns about one axis
    clear_turn: float = 0.03  # angle between bones, radians, at which an axis counts half


_HINGES = _Hinges()


def joint_weights(gaps: Tensor, scale: float) -> Tensor:
    """Return weights (P,) of joints, which fall with their gaps (..., P) (Geman and McClure 1987)."""
    square = gaps.square().reshape(-1, gaps.shape[-1]).mean(0)
    return geman_mcclure_weight(square / scale**2)


def with_stiffness(moments: JointMoments, rotations: Tensor, config: BoneConfig, joint_weight: float) -> JointMoments:
    """Return joints as points, with a spread by which the joint energy penalizes turns of bones against each other."""
    first, second = rotations[..., moments.pairs.mT, :, :].unbind(-4)
    differences = first - second
    squares = (differences.mT @ differences).mean(0)
    angles = 0.5 * squares.diagonal(dim1=-2, dim2=-1).sum(-1)
    weight = 0.5 * config.turn_weight * cauchy_weight(angles / config.turn_scale**2)
    spread = weight[:, None, None] * torch.eye(3, dtype=weight.dtype, device=weight.device)
    if len(rotations) >= _HINGES.least_frames:
        spread = spread + _hinge_spread(squares, config)
    return replace(moments, spread=spread / joint_weight)


def _hinge_spread(squares: Tensor, config: BoneConfig) -> Tensor:
    """Return spreads (P, 3, 3) along hinge axes, of means (P, 3, 3) of ``(R_i - R_j)^T (R_i - R_j)``."""
    chords, axes = torch.linalg.eigh(squares)
    axis, (least, second, _) = axes[..., 0], chords.clamp(min=0).unbind(-1)
    clarity = (second - least) / (second + _HINGES.clear_turn**2)
    weight = config.hinge_weight * clarity
    return weight[:, None, None] * axis.unsqueeze(-1) * axis.unsqueeze(-2)
