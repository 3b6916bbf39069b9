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
    assert set(figures) == {"proposed", "gradient", "start", "roofline", "scratch", "full"}
    assert figures["gradient"]["relative_error"] < 1e-5
    assert figures["start"]["median_mm"] < figures["start"]["start_mm"]
    assert figures["start"]["per_second_2"] > 0
    assert 0 < figures["roofline"]["start_share"] < 1
    assert "gradient within 1e-05: pass" in capsys.readouterr().out


def test_auroc_counts_pairs(benchmark):
    right = torch.tensor([True, True, False, False])
    assert benchmark.auroc(torch.tensor([0.9, 0.5, 0.5, 0.1]), right) == pytest.approx(3.5 / 4)
    assert math.isnan(benchmark.auroc(torch.tensor([0.9, 0.5]), torch.tensor([True, True])))


def test_the_error_of_an_auroc_falls_with_the_number(benchmark):
    """As in the table of Hanley and McNeil 1982: 0.8, 50 of each, 0.044."""
    assert benchmark.auroc_error(0.8, 50, 50) == pytest.approx(0.044, abs=0.001)
    assert benchmark.auroc_error(0.8, 500, 500) < 0.02
    assert math.isnan(benchmark.auroc_error(math.nan, 5, 0))


def test_confidence_is_told_beside_the_share_that_is_right(benchmark):
    told = benchmark.reliability(torch.tensor([0.1, 0.9, 1.0]), torch.tensor([False, True, False]))
    assert [line.split() for line in told.splitlines()[1:]] == [
        ["0.0", "to", "0.2", "1", "0.0%"],
        ["0.8", "to", "1.0", "2", "50.0%"],
    ]


def test_views_are_told_by_what_faces_the_camera(benchmark, plain_hand):
    pose = plain_hand.rest_pose()
    pose[2] = 0.5
    # The back of the hand looks along y, the fingers along z.
    for turn, view in (((0.0, 0, 0), "along the fingers"), ((-1.5708, 0, 0), "back"), ((1.5708, 0, 0), "palm")):
        pose[3:6] = torch.tensor(turn)
        assert benchmark.view_of(plain_hand, pose) == view
    pose[3:6] = torch.tensor([0, 1.5708, 0])
    assert benchmark.view_of(plain_hand, pose) == "edge"


def test_cases_are_counted_apart(benchmark):
    told = benchmark.by_case(["b", "a", "b"], torch.tensor([0.01, 0.2, 0.02]), torch.tensor([True, False, True]))
    assert [line.split()[:5] for line in told.splitlines()] == [
        ["a", "1", "clouds,", "right", "0.0%,"],
        ["b", "2", "clouds,", "right", "50.0%,"],
    ]


def test_evaluations_are_counted(benchmark, plain_hand):
    with benchmark.counted(plain_hand) as total:
        plain_hand.distance(torch.zeros(2, 7, 3), plain_hand.rest_pose().expand(2, -1))
    assert total == [2 * 7 * plain_hand.num_parts]
    assert "plane_distance" not in vars(plain_hand.primitives)


def test_without_a_gpu_it_says_so(benchmark, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert benchmark.main(["--device", "cuda", "--smoke"]) == {}
    assert "no CUDA device" in capsys.readouterr().out
