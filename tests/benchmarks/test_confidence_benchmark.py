import pytest
import torch


@pytest.fixture(scope="module")
def bench(loaded_benchmark):
    with loaded_benchmark("confidence") as module:
        yield module


def test_the_model_finds_the_odds_that_made_the_cases(bench):
    generator = torch.Generator().manual_seed(0)
    evidence = torch.rand(4000, 3, generator=generator)
    odds = 2.0 - evidence @ torch.tensor([4.0, 0.0, 1.0])
    right = torch.rand(4000, generator=generator) < torch.sigmoid(odds)
    bias, weights = bench.fitted_model(evidence, right)
    assert bias == pytest.approx(2.0, abs=0.4)
    assert weights == pytest.approx((4.0, 0.0, 1.0), abs=0.6)


def test_the_area_under_the_curve_is_that_of_all_pairs(bench):
    confidence, right = torch.tensor([0.9, 0.6, 0.6, 0.2]), torch.tensor([True, True, False, False])
    assert bench.area_under_curve(confidence, right) == pytest.approx((1 + 1 + 0.5 + 1) / 4)


def test_the_interval_of_a_share_holds_it_and_shrinks(bench):
    for share, count in ((0.0, 5), (0.7, 10), (1.0, 40)):
        low, high = bench.wilson_interval(share, count)
        assert -1e-9 <= low <= share <= high <= 1 + 1e-9
        wider = bench.wilson_interval(share, 4 * count)
        assert wider[1] - wider[0] < high - low
    # Of 10 trials 7: Wilson's interval by hand.
    assert bench.wilson_interval(0.7, 10) == pytest.approx((0.397, 0.892), abs=1e-3)


def test_the_diagram_is_drawn(bench, tmp_path):
    case = bench.Case(
        "hand", True, bench.tr.Status.CONVERGED, 0.01, torch.zeros(8), 0.95, True, 0.1, 0, torch.zeros(27)
    )
    bench.draw([case, bench.replace(case, confidence=0.2, error=1.0)], tmp_path / "r.png")
    assert (tmp_path / "r.png").stat().st_size > 1000


def test_confidence_is_judged_by_cases_of_other_halves_and_kinds(bench):
    generator = torch.Generator().manual_seed(1)
    case = bench.Case(
        "hand", True, bench.tr.Status.CONVERGED, 0.01, torch.zeros(8), 0.95, True, 0.1, 0, torch.zeros(27)
    )
    unknown = torch.rand(400, generator=generator)
    wrong = torch.rand(400, generator=generator) < unknown
    cases = [
        bench.replace(case, kind=kind, evidence=value * torch.eye(8)[5], error=float(is_wrong))
        for kind, value, is_wrong in zip(["hand", "arm"] * 200, unknown, wrong, strict=True)
    ]
    for held_out in (bench.reliability(bench.crossed(cases)), bench.left_out(cases).splitlines()):
        assert "FAIL" not in "\n".join(held_out)
    assert "calibrated without arm" in held_out[0]
    # Nothing tells them apart any more: all are as sure.
    assert "FAIL" in bench.reliability([bench.replace(entry, confidence=0.95) for entry in cases])[1]


def test_other_shapes_alone_need_data(bench, capsys):
    with pytest.raises(SystemExit):
        bench.main(["--only", "arm"])
    assert "--only arm needs --data" in capsys.readouterr().err
