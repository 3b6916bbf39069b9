import math

import numpy as np
import pytest
import torch

import torchreg as tr


@pytest.fixture(scope="module")
def benchmark(loaded_benchmark):
    with loaded_benchmark("scan_registration") as module:
        yield module


@pytest.fixture(scope="module")
def problem(benchmark):
    return next(benchmark.made_up_problems("toy", 1, 600))


def test_truth_is_scored_as_such(benchmark, problem):
    found = tr.register(problem.source, problem.target, 6, 20, start=problem.truth)
    rand, errors = benchmark.parts_and_joints(found, benchmark.PartTruth.of_pair(problem.pair))
    assert 0 < rand <= 1
    assert errors
    assert min(errors) < 0.1
    assert all(0 <= error <= math.inf for error in errors)
    benchmark.print_row("", [benchmark.Score(1.0, 1.0, 0.0, math.nan, (), (0.0,) * 4, 1)])


def test_moved_problems_are_the_same_a_hundred_times_as_large(benchmark, problem):
    moved = benchmark.moved(problem)
    assert moved.diagonal == pytest.approx(100 * problem.diagonal)
    for before, after in ((problem.source.points, moved.source.points), (problem.truth, moved.truth)):
        torch.testing.assert_close(torch.pdist(after), 100 * torch.pdist(before), rtol=1e-4, atol=1e-3)
    between = (problem.truth - problem.source.points).norm(dim=-1)
    torch.testing.assert_close((moved.truth - moved.source.points).norm(dim=-1), 100 * between, rtol=1e-3, atol=1e-3)
    assert moved.pair is None


def test_sequences_without_a_length_are_refused(benchmark, capsys):
    with pytest.raises(SystemExit):
        benchmark.main(["--sequences", "2"])
    assert "--sequences needs --frames" in capsys.readouterr().err


def test_tables_are_printed_for_files_and_without(benchmark, problem, capsys, tmp_path, monkeypatch):
    assert benchmark.main(["--smoke", "--verbose"]) == 0
    printed = capsys.readouterr().out
    assert "default" in printed
    assert "toy, moved" in printed
    assert "last over the first" in printed
    assert "last over the mean pair" in printed
    assert "animal" in printed.split("last registered")[1]
    np.savez(
        tmp_path / "one.npz", source_points=problem.source.points, source_faces=problem.source.faces,
        target_points=problem.target.points, target_faces=problem.target.faces, source_truth=problem.truth,
        diagonal=problem.diagonal,
    )  # fmt: skip

    def known(source, target, bones, grid, config):
        return real(source, target, bones, 20, config, start=problem.truth)

    real = tr.register
    monkeypatch.setattr(benchmark.tr, "register", known)
    assert benchmark.main(["--data", str(tmp_path), "--pairs", "0", "--ablations"]) == 0
    printed = capsys.readouterr().out
    assert "without turns held" in printed
    assert "bones 15" in printed
    assert benchmark.main(["--pairs", "0"]) == 0
    assert "skipped: pairs from files" in capsys.readouterr().out
    assert torch.isfinite(problem.truth).all()
