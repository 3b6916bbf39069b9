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


def test_who_knows_the_truth_is_sure_of_it(benchmark):
    truth = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [9.0, 0, 0]], dtype=torch.float64)
    places = torch.tensor([[1.0, 0, 0], [0.0, 0, 0], [4.0, 0, 0]], dtype=torch.float64)
    logits = benchmark.true_logits(truth, places, torch.tensor([True, True, False]))
    assert logits[:-1].argmax(1).tolist() == [1, 0, 3]
    assert logits[:, :2].argmax(0).tolist() == [1, 0]
