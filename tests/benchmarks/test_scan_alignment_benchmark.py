import numpy as np
import pytest
import torch

from experiments.made_up.walks import walking_figure
from torchreg.datasets.depth_scanner import DepthScanner


@pytest.fixture(scope="module")
def benchmark(loaded_benchmark):
    threads = torch.get_num_threads()
    with loaded_benchmark("scan_alignment") as module:
        yield module
    torch.set_num_threads(threads)


def test_pairs_from_files_are_scored(benchmark, capsys, tmp_path):
    pair = walking_figure(3, scanner=DepthScanner(num_points=800)).pair(0, 1)
    source, target = pair.source, pair.target
    np.savez(
        tmp_path / "one.npz", source_points=source.points, source_faces=source.faces, target_points=target.points,
        target_faces=target.faces, source_truth=pair.truth, diagonal=source.diagonal,
    )  # fmt: skip
    assert benchmark.main(["--data", str(tmp_path), "--smoke"]) == 0
    printed = capsys.readouterr().out
    assert "skipped" not in printed
    assert "one" in printed
    assert " of 1" in printed


def test_made_up_pairs_need_no_files(benchmark, capsys):
    assert benchmark.main(["--smoke", "--pairs", "1"]) == 0
    printed = capsys.readouterr().out
    assert "skipped: pairs from files" in printed
    assert "person, 1 apart" in printed
    assert "1 of 1" in printed
