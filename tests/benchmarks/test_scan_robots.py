import math

import pytest
import torch

from torchreg.datasets.depth_scanner import DepthScanner

# A box on the ground, and one that turns on it.
URDF = """<?xml version="1.0"?><robot name="arm">
<link name="base"><visual><geometry><box size="0.3 0.3 0.2"/></geometry></visual></link>
<link name="upper"><visual><origin xyz="0 0 0.3"/><geometry><box size="0.1 0.08 0.6"/></geometry></visual></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.1"/>
  <axis xyz="0 1 0"/><limit lower="-1.6" upper="1.6" effort="1" velocity="1"/></joint>
</robot>"""


@pytest.fixture(scope="module")
def benchmark(loaded_benchmark):
    with loaded_benchmark("scan_robots") as module:
        yield module


@pytest.fixture
def folder(benchmark, tmp_path, monkeypatch):
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "arm.urdf").write_text(URDF)
    monkeypatch.setattr(benchmark, "ROBOTS", {"arm": "arm.urdf", "missing": "missing.urdf"})
    monkeypatch.setattr(benchmark, "SCANNER", DepthScanner(num_points=600, noise=0.0, num_holes=0))
    return tmp_path / "robots"


def test_the_truth_is_where_the_target_was_scanned(benchmark, folder):
    (thing,) = benchmark.robots(folder)
    with torch.no_grad():
        pair = benchmark.make_pair(thing, 2, 0)
    moved = (pair.truth - pair.source.points).norm(dim=-1)
    # What turns moves; the ground does not.
    assert float((moved < 1e-6).double().mean()) > 0.2
    assert float((moved > 0.01).double().mean()) > 0.2
    apart = torch.cdist(pair.truth, pair.target.points).amin(1)
    assert float(apart.median()) < float(pair.target.spacing)


@pytest.mark.parametrize("up", [1, 2])
def test_the_camera_has_up_up(benchmark, up):
    frame = benchmark.camera_frame(0.7, 0.0, up)
    torch.testing.assert_close(frame @ frame.mT, torch.eye(3, dtype=torch.float64))
    assert float(torch.linalg.det(frame)) == pytest.approx(1)
    torch.testing.assert_close(frame[:, up], torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    tilted = benchmark.camera_frame(0.7, math.radians(20), up)
    assert float(tilted[1, up]) == pytest.approx(-math.cos(math.radians(20)))


def test_a_table_is_printed(benchmark, folder, capsys):
    assert benchmark.main(["--robots", str(folder), "--smoke"]) == 0
    assert "1 /   1" in capsys.readouterr().out


def test_without_files_it_says_so_and_succeeds(benchmark, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark, "robots_folder", lambda: None)
    assert benchmark.main(["--data", str(tmp_path)]) == 0
    assert "skipped: no robots found" in capsys.readouterr().out
