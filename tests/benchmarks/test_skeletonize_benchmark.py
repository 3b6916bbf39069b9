import numpy as np
import pytest
import torch

from experiments.made_up.bodies import person


@pytest.fixture(scope="module")
def bench(loaded_benchmark):
    with loaded_benchmark("skeletonize") as module:
        yield module


def test_smoke_prints_every_figure(bench, capsys):
    lines = bench.main(["--smoke"])
    printed = capsys.readouterr().out
    assert [line.name for line in lines] == [
        "topology starfish",
        "inside starfish",
        "tubes off the axis",
        "time",
        "sequence",
    ]
    assert printed.count("pass\n") + printed.count("FAIL\n") == 5
    assert all(line.passed for line in lines[:3])
    assert "100.0% of 1 frames alike, 1 topologies; 5 tips, junctions [5]" in printed


def test_sequences_from_files_and_gaits_are_meshed_anew(bench, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench, "RESOLUTION", 24)
    figure = person(spacing=0.06)
    vertices = figure.mesh.vertices.float().numpy()
    np.savez(tmp_path / "samba.npz", vertices=np.stack((vertices, vertices)), faces=figure.mesh.faces.int().numpy())
    frames = list(bench.from_file(tmp_path / "samba.npz"))
    assert len(frames) == 2
    assert torch.equal(frames[0].vertices, frames[1].vertices)
    assert frames[0].num_vertices != len(vertices)
    assert len(list(bench.walking(figure, bench.person_walk, 2))) == 2
    assert len(bench.everything(None)) + 2 == len(bench.everything(tmp_path))
    assert "horse and dancer are skipped" in capsys.readouterr().out


def test_bars_need_the_right_tips_as_well(bench):
    meshes = bench.creature_sequence(bench.STARFISH, 1, resolution=24).meshes
    passed = [bench.drawn("x", iter(meshes), *bars)[0].passed for bars in (((5, 5), 1), ((6, 7), 1), ((5, 5), 2))]
    assert passed == [True, False, False]
