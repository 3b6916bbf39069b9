"""How far the joints of a robot out of scans can be trusted: evidence, and a learnt probability."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.registration.robots.fit import Mechanism
from torchreg.registration.robots.growth import GROWTH, Growth
from torchreg.registration.robots.surfaces import Surfaces
from torchreg.solvers.calibration import Logistic


@dataclass(frozen=True)
class JointCalibration(Logistic):
    """The logistic model of the confidence: log-odds of a right joint, ``bias - sum_k weight_k evidence_k``.

    A joint is right if its axis is off by less than `angle`, and by less than a share `place` of the size. Fitted by
    ``benchmarks/scan_urdf.py --calibrate`` to 103 joints found of 24 made-up robots in three to five clouds. The number
    of scans, and what a link saves against what it costs, say nothing that these do not.
    """

    bias: float = 5.41
    weights: tuple[float, ...] = (4.67, 2.34, 6.5)  # in the order of `joint_evidence`
    angle: float = math.radians(5)
    place: float = 0.02
    doubtful: float = 0.5  # confidence below which a joint is doubtful


JOINT_CALIBRATION = JointCalibration()


def unexplained(surfaces: Surfaces, mechanism: Mechanism, label: Tensor) -> Tensor:
    """Return the shares (K,) of the links' samples that most scans do not show where the joints put them.

    A link without samples is as right as the next.
    """
    motions, size = mechanism.motions(), len(mechanism.parents)
    costs = Growth(surfaces, motions, label).costs(motions).gather(1, label.unsqueeze(1))[:, 0]
    wrong = torch.zeros(size).double().index_add(0, label, (costs > GROWTH.explained).double())
    count = torch.bincount(label, minlength=size)
    shares = wrong / count
    for link in reversed(range(1, size)):
        parent = mechanism.parents[link]
        if not count[parent]:
            shares[parent] = shares[link]
    return shares


def joint_evidence(surfaces: Surfaces, mechanism: Mechanism, label: Tensor, stds: tuple[Tensor, Tensor]) -> Tensor:
    """Return what speaks against each joint (J, 3), numbers from 0 to 1.

    Its axis' standard deviations in direction and place, against those of a right one; and the share of its links'
    samples that the scans do not show, of the worse link.

    ``stds``: (K,) radians, and lengths.
    """
    right = (JOINT_CALIBRATION.angle, JOINT_CALIBRATION.place * surfaces.size)
    loose = [1 / (1 + own / std) for own, std in zip(right, stds, strict=True)]
    hidden = unexplained(surfaces, mechanism, label)
    above = torch.tensor(mechanism.parents).clamp_min(0)
    return torch.stack([*loose, torch.maximum(hidden, hidden[above])], -1)[1:].nan_to_num(1.0)
