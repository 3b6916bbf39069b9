import pytest
import torch


@pytest.fixture(scope="module")
def bench(loaded_benchmark):
    with loaded_benchmark("grid_lbs") as module:
        yield module


def test_smoke_prints_every_row(bench, capsys):
    threads = torch.get_num_threads()
    found = bench.main(["--smoke"])
    torch.set_num_threads(threads)
    printed = capsys.readouterr().out
    assert list(found["projection"]) == ["random", "zero", "negative", "large"]
    assert max(found["projection"].values()) < 1e-6
    assert 0.9 < found["weights"]["all corners"] < 1.01
    assert found["weights"]["within reach"] <= found["weights"]["all corners"]
    energies = found["energy"]["toy"]
    assert energies[-1] < energies[0]
    assert f"energy, toy: {energies[0]:.3f}" in printed
    assert f"{found['weights']['all corners']:.4f}" in printed


def test_the_exact_projection_is_one(bench):
    rows = torch.tensor([[0.5, 0.5, 0.0], [3.0, 0.0, -1.0], [0.0, 0.0, 0.0], [0.6, 0.6, -5.0]])
    expected = torch.tensor([[0.5, 0.5, 0.0], [1.0, 0.0, 0.0], [1 / 3, 1 / 3, 1 / 3], [0.5, 0.5, 0.0]])
    torch.testing.assert_close(bench.exact_projection(rows).float(), expected)
