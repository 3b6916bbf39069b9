import numpy as np
import pytest
import torch

import torchreg as tr
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.geometry.mesh import unit_sphere


@pytest.fixture(scope="module")
def benchmark(loaded_benchmark):
    with loaded_benchmark("captured_scans") as module:
        yield module


@pytest.fixture
def path(tmp_path):
    """Return a file in which an egg a hundred units high, its end up, moves along x, a tenth of its height a frame."""
    ball = unit_sphere(3)
    egg = ball.vertices.double() * torch.tensor([30.0, 50.0, 30.0]).double()
    vertices = torch.stack([egg + torch.tensor([10.0 * frame, 7.0, 0.0]) for frame in range(5)])
    np.savez(tmp_path / "egg.npz", vertices=vertices.numpy(), faces=ball.faces.numpy())
    return tmp_path / "egg.npz"


def test_scans_lie_at_their_true_places_and_move_with_them(benchmark, path):
    first, last = benchmark.captured_sequences(path, 2, 3, DepthScanner(num_points=300, num_holes=0))
    assert (len(first), len(last)) == (3, 3)
    for sequence, side in ((first, 1.0), (last, -1.0)):
        points = sequence[0].points
        torch.testing.assert_close(sequence.truth(0, 0), points, atol=0.02, rtol=0)
        moved = sequence.truth(0, 2) - sequence.truth(0, 0)
        # Half a turn later the same motion goes the other way.
        step = side * 20.0 * benchmark.DIAGONAL / np.sqrt(60**2 + 100**2 + 60**2)
        torch.testing.assert_close(moved, torch.tensor([step, 0, 0]).expand_as(moved).float(), atol=1e-4, rtol=0)
        low, high = points.amin(0), points.amax(0)
        assert float((high - low)[1]) > 1.3 * float((high - low)[0])
        assert isinstance(sequence[1], tr.RangeScan)


def test_files_of_too_few_frames_are_refused(benchmark, path):
    with pytest.raises(ValueError, match=r"egg\.npz holds 5 frames; 6 are asked for"):
        next(benchmark.captured_sequences(path, 1, 6))
