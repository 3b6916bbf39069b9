import pytest
import torch

from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import walking_figure
from torchreg.io.tensors import load_tensors
from torchreg.registration.dense.config import ScanAlignConfig

CONFIG = ScanAlignConfig(num_samples=300, num_target_samples=600, num_nodes=20)


@pytest.fixture(scope="module")
def module(loaded_benchmark):
    with loaded_benchmark("learn_descriptors") as module:
        yield module


@pytest.fixture(scope="module")
def pair():
    return walking_figure(3, scanner=DepthScanner(num_points=1200)).pair(0, 1)


def test_places_differ_less_from_themselves_than_from_others(module, pair):
    within, between, count = module.moments(pair, CONFIG, torch.Generator().manual_seed(0))
    assert within.shape == between.shape == (456, 456)
    assert 100 < count <= 300
    assert float(within.trace()) < 0.7 * float(between.trace())
    assert float(torch.linalg.eigvalsh(within)[0]) > -1e-6 * float(within.trace())


def test_pairs_are_toys_people_and_animals_in_turn_and_come_again(module):
    first, again = (list(module.made_up_pairs(3, seed=5)) for _ in range(2))
    assert len(first) == 9
    for one, other in zip(first, again, strict=True):
        assert torch.equal(one.source.points, other.source.points)
        assert torch.equal(one.truth, other.truth)
    assert not torch.equal(first[0].source.points[:100], next(module.made_up_pairs(1, seed=6)).source.points[:100])


def test_a_file_is_learned_and_written(tmp_path, monkeypatch, module, pair, capsys):
    monkeypatch.setattr(module, "made_up_pairs", lambda count, seed: iter([pair] * count))
    monkeypatch.setattr(module, "ScanAlignConfig", lambda: CONFIG)
    place = tmp_path / "metric.safetensors"
    assert module.main([str(place), "--sequences", "2", "--seed", "3"]) == 0
    tensors, metadata = load_tensors(place)
    assert tensors["directions"].shape == (456, 32)
    assert tensors["directions"].dtype == torch.float16
    assert metadata["sequences"] == 2
    assert metadata["seed"] == 3
    assert metadata["matches"] > 200
    assert metadata["curvature_radii"] == [0.02, 0.035, 0.06]
    expected, _ = module.learn(2, seed=3, config=CONFIG)
    torch.testing.assert_close(tensors["directions"], expected.half())
    capsys.readouterr()
