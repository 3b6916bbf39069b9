import numpy as np
import pytest
import torch

from torchreg.datasets.creatures import STARFISH, creature_sequence


@pytest.fixture(scope="module")
def benchmark(loaded_benchmark):
    with loaded_benchmark("spines") as module:
        yield module


def test_the_smoke_run_passes(benchmark, capsys):
    (row,) = benchmark.main(["--smoke"])
    assert (row.tips, row.junctions, row.named, row.trees) == (5, 1, 1.0, (1, 1))
    printed = capsys.readouterr().out
    assert "captured: left out" in printed
    assert "100.0% right" in printed
    assert "FAIL" not in printed.split("hands")[0]


def test_sequences_of_a_folder_are_judged_by_their_vertices(benchmark, tmp_path, capsys):
    still = creature_sequence(STARFISH, 1, resolution=40).meshes[0]
    turns = torch.tensor([[0.0, -0.1, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.0]]).double()
    frames = [still.vertices.double() @ torch.linalg.matrix_exp(k * turns).mT for k in range(7)]
    np.savez(tmp_path / "star.npz", vertices=torch.stack(frames).float().numpy(), faces=still.faces.int().numpy())
    (row,) = benchmark.main(["--smoke", "--part", "captured", "--data", str(tmp_path)])
    assert (row.frames, row.tips, row.own, row.named, row.trees) == (2, 5, 1.0, 1.0, (1, 1))
    assert "s on two cores: pass" in capsys.readouterr().out


def test_frames_are_timed(benchmark, tmp_path, capsys, monkeypatch):
    still = creature_sequence(STARFISH, 1, resolution=40).meshes[0]
    np.savez(tmp_path / "star.npz", vertices=still.vertices.expand(14, -1, 3).numpy(), faces=still.faces.numpy())
    given = []
    monkeypatch.setattr(benchmark.tr, "extract_spine", lambda meshes, workers: given.append((len(meshes), workers)))
    benchmark.main(["--smoke", "--part", "speed", "--data", str(tmp_path)])
    assert given == [(3, 2)]
    assert "3 frames of" in capsys.readouterr().out
