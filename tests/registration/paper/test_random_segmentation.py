"""Seeds far apart, and unused labels for halves of the worst regions."""

import pytest
import torch

from tests.geometry.draws import rand, seeded
from torchreg.registration.bones.labels import CellData
from torchreg.registration.bones.sparse_grid import SparseGrid
from torchreg.registration.paper.segmentation import best_candidates, reuse_labels


@pytest.fixture(scope="module")
def sheet():
    """A flat square of 20 x 20 cells, each with some samples."""
    points = rand(4000, 3) * torch.tensor([1.0, 1.0, 0.02])
    return CellData(SparseGrid.from_points(points, 20, frame="world"), points)


def closest_pair(points):
    return float((torch.cdist(points, points) + 10 * torch.eye(len(points))).min())


def test_best_candidates_lie_farther_apart_than_random_points_and_are_those_of_the_generator(sheet):
    best, plain = [], []
    for seed in range(10):
        best.append(closest_pair(sheet.points[best_candidates(sheet.points, 12, seeded(seed))]))
        plain.append(closest_pair(sheet.points[torch.randperm(4000, generator=seeded(seed))[:12]]))
    assert min(best) > 0.12
    assert sum(best) > 2 * sum(plain)
    first, again, other = (best_candidates(sheet.points, 7, seeded(seed)) for seed in (3, 3, 4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert best_candidates(torch.zeros(2, 3), 5, seeded()).shape == (5,)


def split(sheet, squares, num_bones):
    labels = (sheet.grid.cell_centers()[:, 0] > 0.5).long()
    return labels, reuse_labels(sheet, squares, labels, num_bones, least_error=0.01, generator=seeded())


def test_the_region_with_the_largest_error_is_halved(sheet):
    squares = torch.where(sheet.points[:, 0] > 0.5, 0.04, 0.0).double()
    before, after = split(sheet, squares, 3)
    new, old = after == 2, before == 1
    assert torch.equal(after[~old], before[~old])
    assert bool(old[new].all())
    assert 0.2 < float(new.sum()) / float(old.sum()) < 0.8
    # Halves of the nearest of two seeds are parted by a plane.
    centers = sheet.grid.cell_centers()
    normal = centers[new].mean(0) - centers[old & ~new].mean(0)
    near, far = centers[old & ~new] @ normal, centers[new] @ normal
    assert float((near > far.min()).float().mean()) < 0.25


def test_labels_end_when_errors_are_small_or_all_are_used(sheet):
    good = torch.full((4000,), 1e-5, dtype=torch.float64)
    before, after = split(sheet, good, 6)
    assert torch.equal(before, after)
    _, after = split(sheet, torch.full((4000,), 0.04, dtype=torch.float64), 6)
    assert after.unique().tolist() == list(range(6))
