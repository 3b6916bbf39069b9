import math
from types import SimpleNamespace

import pytest
import torch

import torchreg as tr
from torchreg.geometry.mesh import TriangleMesh, unit_sphere
from torchreg.io.gltf_write import save_animated_skin


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


def test_people_who_are_found_are_counted(benchmark, capsys, monkeypatch):
    vertices = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)).double()
    person = SimpleNamespace(vertices=vertices)
    fits = iter([(0.001, tr.Status.CONVERGED), (0.4, tr.Status.CONVERGED), (0.4, tr.Status.DOUBTFUL)])

    def fit(shape, person, start, config):
        assert start is None
        assert config.upright == (0, 0, 1)
        off, status = next(fits)
        return vertices + off, SimpleNamespace(status=status, confidence=0.5), 1.0

    for name, value in {"load_model": None, "make_person": person, "fit": fit}.items():
        monkeypatch.setattr(benchmark, name, value if name == "fit" else lambda *_, value=value: value)
    monkeypatch.setattr(
        tr.ArticulatedShape, "from_anny", lambda kind: SimpleNamespace(part_names=["root"], up=(0, 0, 1))
    )
    assert not benchmark.search("body", range(3), upright=True)
    assert "within 1.5% of the size: 1 of 3; 1 converged and not within" in capsys.readouterr().out


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


def test_files_of_rigs_are_told(benchmark, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["shape_fit.py", "--part", "bones", "--data", str(tmp_path)])
    assert benchmark.main() == 0
    assert "skipped: --data must be a folder with rigs/*.glb" in capsys.readouterr().out
    ball = unit_sphere(2, dtype=torch.float64)
    vertices, frames = ball.vertices * torch.tensor([0.3, 0.05, 0.05]), torch.eye(4, dtype=torch.float64)
    second = torch.sigmoid(40 * vertices[:, 0])
    rest = frames.repeat(2, 1, 1)
    rest[0, 0, 3] = -0.3
    moving = rest.repeat(2, 1, 1, 1)
    moving[1, :, 1, 3] = 0.1
    weights = torch.stack([1 - second, second], dim=-1)
    times = torch.tensor([0.0, 1.0])
    save_animated_skin(tmp_path / "bar.glb", vertices, ball.faces, weights, ["a", "b"], [-1, 0], rest, moving, times)
    ((lengths, moved),) = benchmark.clip_lengths(tmp_path / "bar.glb")
    torch.testing.assert_close(lengths, torch.full((10, 1), 0.3, dtype=torch.float64))
    assert moved == pytest.approx(0.09, abs=1e-6)
    rig = tr.ArticulatedShape.from_gltf(tmp_path / "bar.glb")
    person = rig.with_bone_coefficients()
    truth, _, points = benchmark.grown_scan(person, 0.0, 0)
    assert points.shape == (benchmark.NUM_POINTS, 3)
    assert benchmark.bone_lengths(person, truth).tolist() == pytest.approx([0.3 * 1.12])
    placed = rig.rest_pose()
    placed[0] = 0.1
    result = SimpleNamespace(
        to_gltf=person.with_coefficients(truth).to_gltf, pose=placed, shape=person.with_coefficients(truth)
    )
    told = benchmark.file_report(tmp_path / "bar.glb", result)
    assert "joints move in 1 of 1 clips (before 1)" in told
    assert "vertices read back within 0.000 mm" in told
