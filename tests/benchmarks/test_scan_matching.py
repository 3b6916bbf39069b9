import pytest
import torch


@pytest.fixture(scope="module")
def benchmark(loaded_benchmark):
    with loaded_benchmark("scan_matching") as module:
        yield module


def test_smoke_prints_every_kind(benchmark, capsys, monkeypatch):
    kinds = dict(list(benchmark.HELD_OUT_KINDS.items())[1:2])
    monkeypatch.setattr(benchmark, "HELD_OUT_KINDS", kinds)
    assert benchmark.main(["--smoke"]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in (*kinds, "all", "skipped"))


def test_points_belong_to_the_tokens_around_them(benchmark):
    tokens = torch.eye(3, dtype=torch.float64).repeat(2, 1)
    tokens[3:] += 10
    rows = benchmark.shares(torch.tensor([[0.9, 0.0, 0.0]], dtype=torch.float64), tokens)
    assert float(rows.sum()) == pytest.approx(1.0)
    assert int(rows.argmax()) == 0
    assert float(rows[0, 3:].sum()) == 0.0
