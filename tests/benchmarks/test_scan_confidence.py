import pytest


@pytest.fixture(scope="module")
def benchmark(loaded_benchmark):
    with loaded_benchmark("scan_confidence") as module:
        yield module


def test_smoke_prints_how_many_are_right(benchmark, capsys, monkeypatch):
    monkeypatch.setattr(benchmark, "held_out", lambda count: list(benchmark.training_kinds(count))[:2])
    assert benchmark.main(["--smoke"]) == 0
    printed = capsys.readouterr().out
    assert "kinds never trained on" in printed
    assert "of 1 right" in printed
    assert "skipped" in printed
