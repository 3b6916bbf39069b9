import math

import pytest
import torch


@pytest.fixture(scope="module")
def bench(loaded_benchmark):
    with loaded_benchmark("outliers") as module:
        yield module


def test_smoke_prints_both_views(bench, capsys):
    rows = bench.main(["--smoke"])
    printed = capsys.readouterr().out
    assert [row.view for row in rows] == ["whole", "one side"]
    assert printed.count("both >= 0.95: ") == 2
    for row in rows:
        assert 0 < row.near < 0.2
        assert bool(((row.scores >= 0) & (row.scores <= 1)).all())


def test_precision_and_recall_of_a_known_labeling(bench):
    truth = torch.tensor([True, True, True, True, False, False])
    found = torch.tensor([True, True, True, False, True, False])
    assert bench.precision_recall(found, truth).tolist() == pytest.approx([3 / 4, 3 / 4])
    assert bench.precision_recall(torch.zeros(6, dtype=torch.bool), truth).tolist() == [1.0, 0.0]


def test_the_bar_needs_both(bench):
    def row(precision, recall):
        scores = torch.tensor([[precision, recall]])
        return bench.Row("whole", 0.4, scores, scores, math.nan, 0.001)

    assert row(0.96, 0.96).passed
    assert not row(0.94, 0.99).passed
    assert not row(0.99, 0.94).passed
    assert bench.render([row(0.94, 0.99)]).endswith("both >= 0.95: FAIL")
