"""How far an alignment of two scans can be trusted: evidence against it, and a learnt probability."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from torchreg.registration.dense.problem import ScanAlignProblem
from torchreg.registration.dense.stages import mismatch, uncovered


@dataclass(frozen=True)
class ScanEvidence:
    """Evidence against an alignment.

    Args:
        forward: mean cost of moved samples that the matcher calls visible, see `mismatch`.
        backward: mean squared distance of visible target samples from the moved source, in caps, capped at one.
        smoothness: of the graph, as it was judged.
        unsupported: mean of minus the logarithm of the matcher's support of where visible samples ended.
        hidden: share of samples that the matcher calls hidden.
    """

    forward: float
    backward: float
    smoothness: float
    unsupported: float
    hidden: float

    def table(self) -> Tensor:
        """Return the numbers (E,), float64."""
        return torch.tensor([getattr(self, item.name) for item in fields(self)], dtype=torch.float64)


@dataclass(frozen=True)
class ScanCalibration:
    """The logistic model of the confidence: log-odds of a right alignment, ``bias - sum_k weight_k evidence_k``.

    An alignment is right if 90 % of the points end within 2.5 % of the diagonal of the truth. Fitted to 90 pairs of the
    kinds that the matcher is trained on by ``benchmarks/scan_confidence.py --calibrate``.
    """

    bias: float = 6.48
    weights: tuple[float, ...] = (5.31, 6.97, 5.71, 2.88, 4.85)  # in the order of `ScanEvidence`
    doubtful: float = 0.5  # confidence below which a result is doubtful
    recovery: float = 0.06  # probability that a frame reached from a wrong one is right: 4 of 64 in 26 sequences


SCAN_CALIBRATION = ScanCalibration()


def confidence_of(evidence: ScanEvidence) -> float:
    """Return the probability, from 0 to 1, that an alignment with this evidence is right."""
    calibration = SCAN_CALIBRATION
    odds = calibration.bias - evidence.table() @ torch.tensor(calibration.weights, dtype=torch.float64)
    return float(torch.sigmoid(odds))


def confidence_onward(before: float, confidence: float) -> float:
    """Return the probability that a frame of a sequence is right, by that of the frame from which it is reached.

    A Markov chain: what is right stays so with the confidence of the alignment; what is wrong seldom recovers.
    """
    return before * confidence + (1 - before) * SCAN_CALIBRATION.recovery


def scan_evidence(problem: ScanAlignProblem, transforms: Tensor, smoothness: float) -> ScanEvidence:
    """Return the evidence against motions (J, 4, 4) of the nodes."""
    moved, prior = problem.moved(transforms), problem.prior
    cost, index = mismatch(problem, moved)
    support = prior.logarithm(index[:, None], problem.config.doubt)[:, 0]
    return ScanEvidence(
        forward=_share(cost, prior.visible),
        backward=_share(uncovered(problem, moved), prior.target_visible),
        smoothness=smoothness,
        unsupported=-_share(prior.visible * support, prior.visible),
        hidden=1 - float(prior.visible.mean()),
    )


def _share(weighted: Tensor, weights: Tensor) -> float:
    """Return the mean of values that are given times their weights."""
    return float(weighted.sum() / weights.sum().clamp_min(torch.finfo(weights.dtype).tiny))
