import numpy as np
import pytest
import torch

from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import walking_figure


@pytest.fixture(scope="module")
def benchmark(loaded_benchmark):
    with loaded_benchmark("spin_images") as module:
        yield module


@pytest.fixture(scope="module")
def pair(benchmark):
    sequence = walking_figure(3, scanner=DepthScanner(num_points=1200))
    return next(benchmark.made_up_pairs(sequence, 1, 1))


def test_spin_images_find_most_of_a_small_step(benchmark, pair):
    found = benchmark.described(pair, 25)
    right, reached, seconds = benchmark.shares(pair, benchmark.Recipe("", 25), found)
    assert 0.4 < right <= 1.0
    assert reached == pytest.approx(right, abs=0.01)
    assert seconds > 0


def test_stricter_recipes_are_right_more_often(benchmark, pair):
    found = benchmark.described(pair, 25)
    plain = benchmark.shares(pair, benchmark.Recipe("", 25), found)
    strict = benchmark.shares(pair, benchmark.Recipe("", 25, mutual=True, max_ratio=0.8), found)
    assert strict[0] > plain[0]
    assert strict[1] < plain[1]


def test_agreement_with_the_surroundings_is_right_most_often(benchmark, pair):
    found = benchmark.described(pair, 25)
    plain, ransac, isometry = (
        benchmark.shares(pair, benchmark.Recipe("", 25, num_candidates=number, prune=prune), found)
        for number, prune in ((1, ""), (1, "ransac"), (6, "isometry"))
    )
    assert plain[0] < ransac[0] <= 1
    assert plain[0] < isometry[0] <= 1
    assert isometry[1] > 0.2


def test_what_was_learned_is_right_more_often(benchmark, pair):
    image, learned = (benchmark.described(pair, divisions) for divisions in (25, None))
    assert learned.descriptors[0].shape == (len(learned.here), 32)
    plain = benchmark.shares(pair, benchmark.Recipe("", 25), image)
    assert benchmark.shares(pair, benchmark.Recipe("", None, "distance"), learned)[0] > plain[0]


def test_tables_are_printed_for_files_and_without(benchmark, pair, capsys, tmp_path):
    assert torch.isfinite(torch.tensor(benchmark.closest_share(pair)))
    source, target = pair.source, pair.target
    np.savez(
        tmp_path / "one.npz", source_points=source.points, source_faces=source.faces, target_points=target.points,
        target_faces=target.faces, source_truth=pair.truth, diagonal=pair.diagonal,
    )  # fmt: skip
    assert benchmark.main(["--data", str(tmp_path), "--smoke"]) == 0
    printed = capsys.readouterr().out
    assert f"{tmp_path.name}: 1 pairs" in printed
    assert "learned, within 30 %, isometry" in printed
    assert "skipped" not in printed
    assert benchmark.main(["--smoke", "--pairs", "1"]) == 0
    printed = capsys.readouterr().out
    assert "skipped: pairs from files" in printed
    assert "person, 1 apart: 1 pairs" in printed
