"""How far an alignment of two scans can be trusted, and which is best: evidence, and a learnt probability."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.registration.dense.config import Hypothesis, ScanEvidence
from torchreg.registration.dense.problem import ScanAlignProblem
from torchreg.registration.dense.stages import deviations, mismatch, uncovered


@dataclass(frozen=True)
class ScanCalibration:
    """The logistic model of the confidence: log-odds of a right alignment, ``bias - sum_k weight_k evidence_k``.

    By it hypotheses are compared, too, with prior odds: by the deviation where points are expected, else by the turn.

    An alignment is right if 90 % of the points end within 2.5 % of the diagonal of the truth. Fitted to 90 pairs of the
    kinds that the matcher is trained on by ``benchmarks/scan_confidence.py --calibrate``.
    """

    bias: float = 6.48
    weights: tuple[float, ...] = (5.31, 6.97, 5.71, 2.88, 4.85)  # in the order of `ScanEvidence`
    deviation: float = 6.0  # log-odds lost where all samples are far from where they are expected: as by residuals
    turn: float = (
        3.0  # log-odds lost by half a turn of the whole: one scan in twenty is turned by more than a right angle
    )
    doubtful: float = 0.5  # confidence below which a result is doubtful
    recovery: float = 0.06  # probability that a frame reached from a wrong one is right: 4 of 64 in 26 sequences


SCAN_CALIBRATION = ScanCalibration()


def log_odds(evidence: ScanEvidence) -> float:
    """Return the logarithm of the odds that an alignment with this evidence is right."""
    weights = torch.tensor(SCAN_CALIBRATION.weights, dtype=torch.float64)
    return SCAN_CALIBRATION.bias - float(evidence.table() @ weights)


def confidence_of(evidence: ScanEvidence) -> float:
    """Return the probability, from 0 to 1, that an alignment with this evidence is right."""
    return float(torch.tensor(log_odds(evidence), dtype=torch.float64).sigmoid())


def judge(problem: ScanAlignProblem, name: str, transforms: Tensor) -> Hypothesis:
    """Return how far motions (J, 4, 4) of the nodes can be trusted.

    The prior of turns R is a Fisher distribution about none, ``exp(c tr R / 4)``: without it a thing of which both ends
    are alike could be turned end to end.
    """
    evidence = scan_evidence(problem, transforms)
    deviation = float(deviations(problem, problem.graph(transforms)).mean())
    turn = float(3 - transforms.diagonal(dim1=1, dim2=2)[:, :3].sum(1).mean()) / 4
    against = SCAN_CALIBRATION.turn * turn if problem.expected is None else SCAN_CALIBRATION.deviation * deviation
    return Hypothesis(name, against - log_odds(evidence), evidence, deviation)


def confidence_onward(before: float, confidence: float) -> float:
    """Return the probability that a frame of a sequence is right, by that of the frame from which it is reached.

    A Markov chain: what is right stays so with the confidence of the alignment; what is wrong seldom recovers.
    """
    return before * confidence + (1 - before) * SCAN_CALIBRATION.recovery


def scan_evidence(problem: ScanAlignProblem, transforms: Tensor) -> ScanEvidence:
    """Return the evidence against motions (J, 4, 4) of the nodes."""
    moved, prior = problem.moved(transforms), problem.prior
    cost, index = mismatch(problem, moved)
    support = prior.logarithm(index[:, None], problem.config.doubt)[:, 0]
    return ScanEvidence(
        forward=_share(cost, prior.visible),
        backward=_share(uncovered(problem, moved), prior.target_visible),
        smoothness=problem.config.smoothness * float(problem.graph.smoothness(transforms)),
        unsupported=-_share(prior.visible * support, prior.visible),
        hidden=1 - float(prior.visible.mean()),
    )


def _share(weighted: Tensor, weights: Tensor) -> float:
    """Return the mean of values that are given times their weights."""
    return float(weighted.sum() / weights.sum().clamp_min(torch.finfo(weights.dtype).tiny))
