import math

import pytest
import torch

import torchreg as tr
from torchreg.geometry.mesh import TriangleMesh, unit_sphere


@pytest.fixture(scope="module")
def benchmark(loaded_benchmark):
    with loaded_benchmark("shape_fit") as module:
        yield module


def test_without_anny_it_says_so_and_succeeds(benchmark, capsys, monkeypatch):
    monkeypatch.setattr(benchmark, "find_spec", lambda name: None)
    monkeypatch.setattr("sys.argv", ["shape_fit.py"])
    assert benchmark.main() == 0
    assert "skipped: anny is not installed" in capsys.readouterr().out


def test_a_scan_shows_one_side_with_noise_and_outliers(benchmark):
    ball = unit_sphere(4, dtype=torch.float64)
    data = benchmark.one_sided_scan(
        TriangleMesh(ball.vertices, ball.faces), 0.01, 950, torch.Generator().manual_seed(0)
    )
    assert len(data) == 1000
    seen = data[:950]
    assert float((seen.norm(dim=-1) - 1).abs().mean()) == pytest.approx(0.01 * math.sqrt(2 / math.pi), rel=0.15)
    side = torch.nn.functional.normalize(seen.mean(0), dim=0)
    # From 1.7 diagonals away nothing is seen below the horizon at 1 / distance.
    distance = benchmark.DISTANCE * 12**0.5
    assert float((seen @ side).quantile(0.01)) > 1 / distance - 0.1


def test_a_split_rig_has_the_same_surface_and_coefficients(benchmark):
    ball = unit_sphere(1, dtype=torch.float64)
    shape = tr.ArticulatedShape.from_skinned_mesh(
        ball.vertices, ball.faces, torch.ones(len(ball.vertices), 1), torch.zeros(1, 3), [-1],
        shape_dirs=ball.vertices.unsqueeze(-1), joint_dirs=torch.zeros(1, 3, 1), dtype=torch.float64,
    )  # fmt: skip
    finer, grown = benchmark.split(shape), torch.ones(1, dtype=torch.float64)
    edges = len(ball.faces) * 3 // 2
    assert len(finer.surface.vertices) == len(ball.vertices) + edges
    assert len(finer.surface.faces) == 4 * len(ball.faces)
    meshes = [TriangleMesh(one.vertices(one.rest_pose(), grown), one.surface.faces) for one in (shape, finer)]
    assert float(meshes[0].face_areas().sum()) == pytest.approx(float(meshes[1].face_areas().sum()))
    assert float((meshes[0].vertices.norm(dim=-1) - 2).abs().max()) < 1e-9
