from dataclasses import replace

import pytest
import torch

from experiments.made_up.walks import walking_figure
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.registration.dense.align_scans import align_problem, evidence_against
from torchreg.registration.dense.config import ScanAlignConfig
from torchreg.registration.dense.problem import describe
from torchreg.registration.dense.reliability import (
    SCAN_CALIBRATION,
    ScanEvidence,
    confidence_of,
    confidence_onward,
    scan_evidence,
)

CONFIG = ScanAlignConfig(num_samples=400, num_nodes=30)
GOOD = ScanEvidence(forward=0.1, backward=0.05, smoothness=0.1, unsupported=0.8, hidden=0.05)


@pytest.fixture(scope="module")
def problem():
    pair = walking_figure(3, scanner=DepthScanner(num_points=1500)).pair(0, 1)
    return describe(pair.source, pair.target, CONFIG)


@pytest.mark.parametrize("name", ["forward", "backward", "smoothness", "unsupported", "hidden"])
def test_what_speaks_against_an_alignment_lowers_its_confidence(name):
    assert confidence_of(replace(GOOD, **{name: 0.5 + getattr(GOOD, name)})) < confidence_of(GOOD)
    assert 0.8 < confidence_of(GOOD) < 1


def test_a_frame_is_as_sure_as_its_way_there():
    """As often as frames of a simulated chain are right, where alignments of right frames are right in 80 %."""
    generator = torch.Generator().manual_seed(0)
    right, sure = torch.ones(20_000, dtype=torch.bool), 1.0
    for _ in range(5):
        chance = torch.where(right, 0.8, SCAN_CALIBRATION.recovery)
        right = torch.rand(len(right), generator=generator) < chance
        sure = confidence_onward(sure, 0.8)
        assert sure == pytest.approx(float(right.double().mean()), abs=0.02)
    assert 0.3 < sure < 0.5


def test_a_right_alignment_is_trusted_and_none_at_all_is_not(problem):
    found = align_problem(problem, lambda _: None)
    right = evidence_against(problem, found[0])
    away = found[0].transforms.clone()
    away[:, 0, 3] += 1
    wrong = scan_evidence(problem, away, 0.0)
    assert confidence_of(right) > SCAN_CALIBRATION.doubtful > confidence_of(wrong)
    # All that is visible lies on nothing.
    assert (wrong.forward, wrong.backward) == (pytest.approx(1.0), pytest.approx(1.0))
    assert wrong.unsupported > right.unsupported


def test_what_is_hidden_is_no_evidence(problem):
    rest = problem.graph.rest()
    shown = torch.arange(len(problem.prior.by_source)) % 2 == 0
    half = replace(problem.prior, by_source=problem.prior.by_source * shown.unsqueeze(1))
    plain, less = (scan_evidence(replace(problem, prior=prior), rest, 0.0) for prior in (problem.prior, half))
    assert less.hidden == pytest.approx(1 - (1 - plain.hidden) / 2, abs=0.05)
    assert less.backward == pytest.approx(plain.backward)
    away = rest.clone()
    away[:, 0, 3] += 1
    assert scan_evidence(problem, away, 0.0).forward > plain.forward
