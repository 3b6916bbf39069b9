import math

import pytest
import torch

import torchreg as tr
from torchreg.alignment import annealed_em, config

METHODS = [
    "EM", "EM c / 10", "EM own sigma", "SoftAssign", "ICP", "EM debiased", "SoftAssign debiased", "EM + surface fit",
    "default",
]  # fmt: skip


@pytest.fixture(scope="module")
def bench(loaded_benchmark):
    with pytest.MonkeyPatch.context() as patch:
        # The benchmark adds an E-step of its own, which other tests must not see.
        registry = dict(annealed_em.CORRESPONDENCES)
        for user in (config, annealed_em):
            patch.setattr(user, "CORRESPONDENCES", registry)
        with loaded_benchmark("rivals") as module:
            yield module


def make_row(bench, method, tips, **condition):
    tips = torch.tensor(tips, dtype=torch.float64)
    return bench.Row(bench.Condition("whole", **condition), method, tips, tips, 10 * tips, torch.ones_like(tips))


def test_smoke_prints_table_claims_and_pictures(bench, capsys, tmp_path):
    rows = bench.main(["--smoke", "--threads", str(torch.get_num_threads()), "--output", str(tmp_path / "new")])
    printed = capsys.readouterr().out
    assert [row.method for row in rows] == 2 * METHODS
    assert all(bool(torch.isfinite(row.tips).all()) for row in rows)
    assert printed.count("\n- ") == 9
    assert printed.count("CONFIRMED") + printed.count("CONTRADICTED") + printed.count("NOT DECIDED") == 9
    assert (tmp_path / "new" / "rivals_whole.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "new" / "rivals.txt").read_text(encoding="utf-8").strip() in printed


def test_conditions_differ_from_the_middle_in_one_respect(bench):
    middle, *others = sorted(bench.conditions("whole"), key=lambda condition: condition != bench.Condition("whole"))
    assert len(others) == 11
    for condition in others:
        fields = ("outliers", "start_deg", "points")
        assert sum(getattr(condition, name) != getattr(middle, name) for name in fields) == 1


def test_rivals_get_the_same_iterations_and_range_of_sigma(bench):
    configs = bench.methods(0.2)
    assert list(configs) == METHODS
    for name in METHODS[:7]:
        config = configs[name]
        assert config.schedule.steps * config.em_steps == 30
        assert config.schedule.values[0] == pytest.approx(0.016)
        assert config.schedule.values[-1] == pytest.approx(0.004)
        assert (config.surface_steps, config.search, config.prior_std) == (0, "never", None)
    assert configs["default"] == tr.AlignConfig()


def test_starts_are_as_far_off_as_stated(bench, plain_hand, plain_hand_surface, plain_hand_skin):
    def make_trial(condition):
        return bench.make_trial(plain_hand, plain_hand_surface, plain_hand_skin, condition, 3)

    trial = make_trial(bench.Condition("one side", start_deg=10))
    off = torch.rad2deg((trial.start - trial.cloud.pose).abs())
    assert float(off[6:].max()) == pytest.approx(10, abs=1e-3)
    assert float(off[:6].max()) < 1e-5
    assert 1 <= int(trial.seen.sum()) <= 5
    assert trial.skin is plain_hand_skin
    again = make_trial(bench.Condition("whole", outliers=0.5))
    torch.testing.assert_close(again.cloud.pose, trial.cloud.pose)
    assert float(again.cloud.inliers.double().mean()) == pytest.approx(0.5)


def test_the_sign_test_is_the_binomial_one(bench):
    assert bench.sign_test(5, 5) == 1
    assert bench.sign_test(0, 0) == 1
    assert bench.sign_test(10, 0) == pytest.approx(2 / 2**10)
    assert bench.sign_test(1, 9) == pytest.approx(2 * 11 / 2**10)
    assert bench.verdict(10, 0) == "CONFIRMED"
    assert bench.verdict(0, 10) == "CONTRADICTED"
    assert bench.verdict(6, 4) == "NOT DECIDED"


def test_claims_follow_from_paired_alignments(bench):
    good, bad = [0.001, 0.002, 0.003, 0.02], [0.002, 0.004, 0.03, 0.01]
    rows = [make_row(bench, "a", good, points=p) for p in (1, 2, 3)]
    rows += [make_row(bench, "b", bad, points=p) for p in (1, 2, 3)]
    claim = bench.better_claim(rows, "a is better", "a", "b")
    assert "a nearer in 9 of 12" in claim.figures
    assert "failures 25% against 25%" in claim.figures
    assert claim.verdict == "NOT DECIDED"
    assert claim.figures.endswith("b has the lower median in 0 of 3 conditions")
    worse = bench.better_claim(rows, "", "b", "a").figures
    assert worse.endswith("a has the lower median in 3 of 3 conditions (1 points | 2 points | 3 points)")
    # Where both fail there is nothing to tell.
    lost = bench.better_claim([make_row(bench, "a", [0.02]), make_row(bench, "b", [0.03])], "", "a", "b")
    assert "in 0 of 0" in lost.figures
    fast = [make_row(bench, "a", [0.001] * 9), make_row(bench, "b", [0.002] * 9)]
    assert bench.faster_claim(fast, "", "a", "b").verdict == "CONFIRMED"
    assert bench.faster_claim(fast, "", "b", "a").verdict == "CONTRADICTED"
    assert bench.falls_claim(fast, "", "a", "b").verdict == "NOT DECIDED"
    assert math.isclose(rows[0].failures, 0.25)


def test_tracked_model_points_lie_where_the_camera_saw_the_start(
    bench, plain_hand, plain_hand_surface, plain_hand_skin
):
    trial = bench.make_trial(plain_hand, plain_hand_surface, plain_hand_skin, bench.Condition("tracked"), 3)
    assert len(trial.skin.points) == 500
    with torch.no_grad():
        posed, every = trial.skin(trial.start), plain_hand_surface(trial.start)
    assert float(plain_hand.distance(posed, trial.start).abs().mean()) < 0.003
    # Toward the camera at the origin, which looks along z.
    assert float(posed[:, 2].mean()) < float(every[:, 2].mean())
