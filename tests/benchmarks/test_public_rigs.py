"""Rigs of a folder are opened, timed, and told why they are not."""

import pytest
import torch

from torchreg.geometry.mesh import unit_sphere
from torchreg.io.gltf_write import save_animated_skin


@pytest.fixture(scope="module")
def bench(loaded_benchmark):
    with loaded_benchmark("public_rigs") as module:
        yield module


def test_a_folder_of_rigs_is_summed_up(bench, tmp_path, monkeypatch, capsys):
    ball = unit_sphere(2)
    weights = torch.stack([ball.vertices[:, 0] <= 0, ball.vertices[:, 0] > 0], dim=-1).float()
    frames = torch.eye(4).repeat(2, 1, 1)
    save_animated_skin(
        tmp_path / "ball.glb", ball.vertices, ball.faces, weights, ["a", "b"], [-1, 0], frames, frames[None],
        torch.zeros(1),
    )  # fmt: skip
    for name in "cd":
        (tmp_path / f"{name}.gltf").write_text("{}", encoding="utf-8")
    monkeypatch.setattr("sys.argv", ["public_rigs.py", "--data", str(tmp_path)])
    bench.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("1 of 3 opened")
    assert [row.split()[:2] for row in lines[1:]] == [["loaded", "1"], ["refined", "1"], ["refused", "2"]]
    assert "no node carries both a mesh and a skin" in lines[3]
