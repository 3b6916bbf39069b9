import pytest
import torch


@pytest.fixture(scope="module")
def benchmark(loaded_benchmark):
    with loaded_benchmark("shape_confidence") as module:
        yield module


def test_without_anny_it_says_so_and_succeeds(benchmark, capsys, monkeypatch):
    monkeypatch.setattr(benchmark, "find_spec", lambda name: None)
    assert benchmark.main([]) == 0
    assert "skipped: anny is not installed" in capsys.readouterr().out


def test_area_reliability_and_bars(benchmark):
    right = torch.tensor([True, True, True, False, False])
    lines, met = benchmark.render(torch.tensor([0.9, 1.0, 0.7, 0.1, 0.6]), right)
    assert "5 cases, 3 right: area under the curve 1.000; 3 right and sure, 1 wrong and sure" in lines
    assert "0.8 to 1.0:   2 cases, mean confidence 0.95, right 1.00" in lines
    assert not met  # a quarter of what it is sure of is wrong
    assert benchmark.render(torch.tensor([0.9, 0.95, 0.7, 0.1, 0.4]), right)[1]


def test_each_case_is_judged_by_a_model_of_the_others(benchmark):
    evidence = torch.tensor([[0.0], [0.1], [0.2], [0.8], [0.9], [1.0]])
    found = benchmark.left_out(evidence, evidence[:, 0] < 0.5)
    assert (found > 0.5).tolist() == [True] * 3 + [False] * 3
