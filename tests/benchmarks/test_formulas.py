"""What benchmarks compute themselves, by hand, by tables and in closed form."""

import math
import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import tensor

import torchreg as tr

YES = tensor([True, True, False, False])
TURNED = tensor([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]).double()
SKIN = SimpleNamespace(
    nskinvert=3,
    nskinbone=2,
    skin_bonevertnum=np.array([2, 2], dtype=np.int32),
    skin_bonevertid=np.array([0, 1, 1, 2], dtype=np.int32),
    skin_bonevertweight=np.array([0.5, 0.3, 0.1, 2.0], dtype=np.float32),
)
ROWS, ON_SIMPLEX = (
    [[0.5, 0.5, 0.0], [3, 0, -1], [0, 0, 0], [0.6, 0.6, -5]],
    [0.5, 0.5, 0, 1, 0, 0, *[1 / 3] * 3, 0.5, 0.5, 0],
)
INLIERS, INF = tensor([1, 1, 1, 1, 0, 0]) > 0, math.inf
ONES, MISSING = np.ones(3), np.array([1.0, np.nan])
RECORDS = [
    (ONES, ONES), (ONES, np.ones(3, np.float32)), (ONES, np.ones(4)), (MISSING, MISSING), (MISSING, np.ones(2)),
    (np.array([4.0, np.inf]), np.array([5.0, np.inf])), (np.array("a"), np.array("b")),
]  # fmt: skip


def outliers_passed(bench, precision, recall):
    scores = tensor([[precision / 100, recall / 100]])
    return bench.Row("whole", 0.4, scores, scores, math.nan, 0.001).passed


def own_hand_row(bench, errors):
    return bench.render([bench.Row("exact", "joints", "align", tensor(errors), 0.1, 1.5)]).splitlines()[1][-4:]


def big_scan(bench, capsys, *cost):
    bench.print_cost("x", bench.Cost(*cost), 10.0, 0.05, 2000.0)
    return capsys.readouterr().out.split()[-1]


def depth_table(bench, error, status):
    right = bench.Outcome("a", torch.full((5,), 0.01), tr.Status.CONVERGED, 0.9, 1.0)
    other = bench.Outcome("b", torch.full((5,), error), status, 0.9, 1.0)
    return bench.pictures_table("t", [right, other], 0.5, 1).partition("over 40 mm off: ")[2]


@pytest.mark.parametrize(
    ("script", "value", "expected"),
    [
        ("confidence", lambda b: b.area_under_curve(tensor([0.9, 0.6, 0.6, 0.2]), YES), 3.5 / 4),
        # Of 10 trials 7: Wilson's interval by hand.
        ("confidence", lambda b: b.wilson_interval(0.7, 10), (0.397, 0.892)),
        ("confidence", lambda b: b.area_under_curve(tensor([0.9, 0.5]), YES[:2]), math.nan),
        # The table of Hanley and McNeil 1982.
        ("pose_initializer", lambda b: b.auroc_error(0.8, 50, 50), 0.044),
        ("pose_initializer", lambda b: b.auroc_error(math.nan, 5, 0), math.nan),
        ("rivals", lambda b: [b.sign_test(*pair) for pair in ((5, 5), (10, 0), (1, 9))], (1, 2**-9, 22 * 2**-10)),
        ("rivals", lambda b: b.verdict(10, 0) + b.verdict(0, 10) + b.verdict(6, 4), "CONFIRMEDCONTRADICTEDNOT DECIDED"),
        ("outliers", lambda b: b.precision_recall(tensor([1, 1, 1, 0, 1, 0]) > 0, INLIERS), (0.75, 0.75)),
        ("outliers", lambda b: b.precision_recall(torch.zeros(6) > 0, INLIERS), (1, 0)),
        ("outliers", lambda b: [outliers_passed(b, *pair) for pair in ((96, 96), (94, 99), (99, 94))], (1, 0, 0)),
        ("base_calibration", lambda b: b.base_error(TURNED, torch.eye(4).double()), (300 * math.sqrt(2), 90)),
        ("grid_lbs", lambda b: b.exact_projection(tensor(ROWS)).flatten(), ON_SIMPLEX),
        ("scan_animals", lambda b: b.skin_weights(SKIN).flatten(), (1, 0, 0.75, 0.25, 0, 1)),
        ("own_hand", lambda b: own_hand_row(b, [0.001, 0.0019]) + own_hand_row(b, [0.001, 0.0021]), "passFAIL"),
        ("depth_frames", lambda b: depth_table(b, 0.05, tr.Status.DOUBTFUL), "none: pass"),
        ("depth_frames", lambda b: depth_table(b, 0.05, tr.Status.CONVERGED), "['b']: FAIL"),
        ("tracking", lambda b: [b.Line("a", "b", *bar).passed for bar in ((1, 1.5), (2, 1.5), (math.inf,))], (1, 0, 1)),
        ("tracking", lambda b: [b.Line("a", "b", x, 30.0, True).passed for x in (40.0, 20.0)], (1, 0)),
        ("tracking", lambda b: str(b.Line("a", "b", 2.0, 1.5))[-16:], "2.00   <= 1.5: FAIL"[-16:]),
        ("behavior", lambda b: [b.difference(*pair) for pair in RECORDS], (0, INF, INF, 0, INF, 0.25, INF)),
    ],
)  # fmt: skip
def test_figures_are_what_they_say(load, script, value, expected):
    assert value(load(script)) == pytest.approx(expected, abs=1e-3, nan_ok=True)


@pytest.mark.parametrize(
    ("cost", "verdict"), [((9, 1, 1, 1, 0.1), "FAIL"), ((9, 11, 1, 1, 0), "FAIL"), ((9, 1, 1, 9000, 0), "FAIL")]
)
def test_bars_of_big_scans_are_of_time_memory_and_error(load, capsys, cost, verdict):
    assert big_scan(load("big_scans"), capsys, *cost) == verdict


def test_true_correspondences_have_the_largest_logits(load):
    truth, places = (
        tensor([[0.0, 0, 0], [1, 0, 0], [9, 0, 0]]).double(),
        tensor([[1.0, 0, 0], [0, 0, 0], [4, 0, 0]]).double(),
    )
    logits = load("scan_matching").true_logits(truth, places, tensor([True, True, False]))
    assert logits[:-1].argmax(1).tolist() == [1, 0, 3]
    assert logits[:, :2].argmax(0).tolist() == [1, 0]


def test_each_family_has_a_bias_of_its_own_and_each_case_is_judged_by_models_of_others(load, monkeypatch):
    bench, generator, cases = load("calibrate_confidence"), torch.Generator().manual_seed(0), []
    for name in ("CALIBRATION", "PICTURE_CALIBRATION"):
        monkeypatch.setattr(bench.reliability, name, bench.Calibration(bias=0.0, weights=(2.0, 2.0)))
    monkeypatch.setattr(bench, "RIVALS", [])
    truths = {"hand": 2.0, "rig": 0.5, "room with a hand": 1.0}
    for seed in range(3000):
        family, evidence = list(truths)[seed % 3], torch.rand(2, generator=generator)
        odds = truths[family] - evidence @ tensor([4.0, 1.0])
        cases.append(bench.Judged(
            kind=family, family=family, seed=seed, told=(None, None, 0.0), ends=None, near=True,
            is_answer=True, evidence=evidence, right=bool(torch.rand((), generator=generator) < odds.sigmoid()),
        ))  # fmt: skip
    models = bench.fitted_poses(cases)
    assert models["hand"].weights == models["rig"].weights
    every = torch.stack([case.evidence for case in cases])
    for family, bias in truths.items():
        true = (bias - every @ tensor([4.0, 1.0])).sigmoid()
        assert float((models[family].probability(every) - true).abs().mean()) < 0.05
    table = bench.render(cases, bench.crossed(cases))
    assert re.search(r"hand +1000 answers: mean confidence (\S+), right .*area under the curve 0.[78]", table)


def test_each_case_is_judged_by_the_other_cases(load):
    bench, evidence = load("shape_confidence"), tensor([[0.0], [0.1], [0.2], [0.8], [0.9], [1.0]])
    assert (bench.left_out(evidence, evidence[:, 0] < 0.5) > 0.5).tolist() == [True] * 3 + [False] * 3


def row_of(bench, errors, seen, confidence, case="front", seconds=1.0):
    seconds = torch.full((len(errors),), seconds).double()
    return bench.Row(case, tensor(errors), tensor(seen), tensor(confidence), seconds)


def test_found_poses_are_judged_by_all_tips_and_by_the_visible_ones(load):
    bench, errors = load("find_pose"), [[0.001] * 4 + [0.1], [0.005] * 5, [0.02] * 5]
    row = row_of(bench, errors, [[True] * 4 + [False], [True] * 5, [False] * 5], [0.1, 0.95, 0.3])
    assert (row.right.tolist(), row.seen_right.tolist()) == ([False, True, False], [True, True, True])
    assert (row.passed, row.fast) == (False, True)
    assert bench.render([row]).splitlines()[1].endswith("right >= 80%: FAIL, < 2 s: pass")
    slow = row_of(bench, errors[1:2], [[True] * 5], [1.0], "whole", 2.5)
    assert bench.render([slow]).splitlines()[1].endswith("right >= 95%: pass, < 2 s: FAIL")
    # Every cloud is in one bin of confidence.
    row = row_of(bench, [[0.001] * 5, [0.03] * 5] * 2, [[True] * 5] * 4, [0.0, 0.2, 1.0, 0.9])
    lines = [line.split() for line in bench.reliability([row]).splitlines()[1:]]
    assert [(line[3], line[5]) for line in lines] == [("1", "100.0%"), ("1", "0.0%"), ("2", "50.0%")]


def rivals_row(bench, method, tips, **condition):
    tips = tensor(tips, dtype=torch.float64)
    return bench.Row(bench.Condition("whole", **condition), method, tips, tips, 10 * tips, torch.ones_like(tips))


def test_claims_on_rivals_follow_from_paired_alignments(load):
    bench, good, bad = load("rivals"), [0.001, 0.002, 0.003, 0.02], [0.002, 0.004, 0.03, 0.01]
    rows = [rivals_row(bench, name, tips, points=p) for name, tips in (("a", good), ("b", bad)) for p in (1, 2, 3)]
    claim = bench.better_claim(rows, "a is better", "a", "b")
    assert "a nearer in 9 of 12" in claim.figures
    assert "failures 25% against 25%" in claim.figures
    assert claim.verdict == "NOT DECIDED"
    assert claim.figures.endswith("b has the lower median in 0 of 3 conditions")
    worse = bench.better_claim(rows, "", "b", "a").figures
    assert worse.endswith("a has the lower median in 3 of 3 conditions (1 points | 2 points | 3 points)")
    # Where both fail nothing can be compared.
    lost = bench.better_claim([rivals_row(bench, "a", [0.02]), rivals_row(bench, "b", [0.03])], "", "a", "b")
    assert "in 0 of 0" in lost.figures
    fast = [rivals_row(bench, "a", [0.001] * 9), rivals_row(bench, "b", [0.002] * 9)]
    assert bench.faster_claim(fast, "", "a", "b").verdict == "CONFIRMED"
    assert bench.faster_claim(fast, "", "b", "a").verdict == "CONTRADICTED"
    assert bench.falls_claim(fast, "", "a", "b").verdict == "NOT DECIDED"
