"""The benchmark of `PoseInitializer` runs, and its figures are what they say."""

import math

import pytest
import torch


@pytest.fixture(scope="module")
def benchmark(loaded_benchmark):
    with loaded_benchmark("pose_initializer") as module:
        yield module


def test_a_smoke_run_tells_every_figure(benchmark, capsys):
    figures = benchmark.main(["--smoke", "--threads", "1"])
    assert set(figures) == {"gradient", "start", "scratch"}
    assert figures["gradient"]["relative_error"] < 1e-5
    assert figures["start"]["median_mm"] < figures["start"]["start_mm"]
    assert "gradient within 1e-05: pass" in capsys.readouterr().out


def test_auroc_counts_pairs(benchmark):
    right = torch.tensor([True, True, False, False])
    assert benchmark.auroc(torch.tensor([0.9, 0.5, 0.5, 0.1]), right) == pytest.approx(3.5 / 4)
    assert math.isnan(benchmark.auroc(torch.tensor([0.9, 0.5]), torch.tensor([True, True])))
