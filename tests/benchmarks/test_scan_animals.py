import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.solids import RoundCone, mesh_of


@pytest.fixture(scope="module")
def benchmark(loaded_benchmark):
    with loaded_benchmark("scan_animals") as module:
        yield module


@pytest.fixture
def bar(benchmark):
    """Return an upright bar, the upper half of which turns by so many radians."""
    mesh = mesh_of([RoundCone((0.0, 0.0, -0.5), (0.0, 0.0, 0.5), 0.1, 0.1)], 0.04)
    upper = (mesh.vertices[:, 2:].double() / 0.1).sigmoid()

    def poses(share, generator):
        first = mesh.vertices.double()
        turned = first @ torch.tensor(
            [[math.cos(share), 0.0, math.sin(share)], [0.0, 1.0, 0.0], [-math.sin(share), 0.0, math.cos(share)]],
            dtype=torch.float64,
        )
        return first, torch.lerp(first, turned, upper)

    return benchmark.Animal("bar", mesh.faces, poses)


def test_the_truth_is_where_the_target_was_scanned(benchmark, bar, monkeypatch):
    monkeypatch.setitem(benchmark.scan_pair.__globals__, "SCANNER", DepthScanner(600, noise=0.0, num_holes=0))
    pair = benchmark.make_pair(bar, 0.5, 1, 0)
    apart = torch.cdist(pair.truth, pair.target.points).amin(1)
    assert float(apart.median()) < float(pair.target.spacing)
    assert float((pair.truth - pair.source.points).norm(dim=-1).max()) > 0.05
    other = benchmark.make_pair(bar, 0.5, 2, 0)
    assert len(other.source) != len(pair.source) or not torch.equal(other.source.points, pair.source.points)


def test_weights_of_a_skin_add_up_to_one(benchmark):
    model = SimpleNamespace(
        nskinvert=3,
        nskinbone=2,
        skin_bonevertnum=np.array([2, 2], dtype=np.int32),
        skin_bonevertid=np.array([0, 1, 1, 2], dtype=np.int32),
        skin_bonevertweight=np.array([0.5, 0.3, 0.1, 2.0], dtype=np.float32),
    )
    expected = torch.tensor([[1.0, 0.0], [0.75, 0.25], [0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(benchmark.skin_weights(model), expected, atol=1e-6, rtol=0)


def test_a_table_is_printed(benchmark, bar, monkeypatch, capsys):
    monkeypatch.setitem(benchmark.scan_pair.__globals__, "SCANNER", DepthScanner(600, noise=0.0, num_holes=0))
    monkeypatch.setattr(benchmark, "APART", (0.05,))
    monkeypatch.setattr(benchmark, "animals_folder", lambda: "somewhere")
    monkeypatch.setattr(benchmark, "animals", lambda folder: [bar])
    assert benchmark.main(["--pairs", "1"]) == 0
    assert "bar, 5%" in (printed := capsys.readouterr().out)
    assert "all" in printed


def test_without_animals_it_says_so_and_succeeds(benchmark, capsys, monkeypatch):
    monkeypatch.setattr(benchmark, "animals_folder", lambda: None)
    assert benchmark.main([]) == 0
    assert "skipped: no animals found" in capsys.readouterr().out


def test_without_mujoco_there_are_no_animals(benchmark, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(benchmark.ANIMALS, "dog", "dog.xml")
    (tmp_path / "dog.xml").write_text("<mujoco/>")
    monkeypatch.setattr(benchmark.importlib.util, "find_spec", lambda name: None)
    assert benchmark.main(["--animals", str(tmp_path)]) == 0
    assert "torchreg-articulated[benchmark]" in capsys.readouterr().out


def test_skins_follow_their_bones_as_mujoco_draws_them(benchmark):
    mujoco = pytest.importorskip("mujoco")
    folder = benchmark.animals_folder()
    if folder is None:
        pytest.skip("dm_control is not installed")
    data = []
    with pytest.MonkeyPatch.context() as patch:
        made = mujoco.MjData
        patch.setattr(mujoco, "MjData", lambda model: data.append((model, made(model))) or data[-1][1])
        found = list(benchmark.animals(folder))
    assert {each.name for each in found} == set(benchmark.ANIMALS)
    for animal, (model, state) in zip(found, data, strict=True):
        first, second = animal.poses(0.1, torch.Generator().manual_seed(0))
        assert int(animal.faces.max()) == len(second) - 1
        assert float((second - first).norm(dim=-1).max()) > 0.01
        scene = mujoco.MjvScene(model, maxgeom=1000)
        mujoco.mjv_updateScene(
            model, state, mujoco.MjvOption(), None, mujoco.MjvCamera(), mujoco.mjtCatBit.mjCAT_ALL, scene
        )
        drawn = torch.from_numpy(np.array(scene.skinvert)).reshape(-1, 3).double()
        # MuJoCo draws in single precision, and may inflate a skin.
        torch.testing.assert_close(second, drawn, atol=1e-5 + float(model.skin_inflate[0]), rtol=0)
