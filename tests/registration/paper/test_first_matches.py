"""The printed first steps: spin images matched per region, seeds far apart, halves of the worst regions."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from experiments.made_up.walks import walking_figure
from tests.geometry.draws import rand, seeded
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.bones.labels import CellData
from torchreg.registration.bones.sparse_grid import SparseGrid
from torchreg.registration.paper.segmentation import best_candidates, reuse_labels
from torchreg.registration.paper.spin_matches import spin_matches

MOTION = se3_exp(torch.tensor([0.05, -0.02, 0.03, 0.1, -0.1, 0.15]))


@pytest.fixture(scope="module")
def source():
    return walking_figure(2, scanner=DepthScanner(num_points=1500))[0]


def matches_of(source, target, regions, count):
    index, bin_size = torch.arange(0, len(source), 5), 3 * source.spacing
    config = replace(tr.RegisterConfig.paper().printed, max_distance=60.0)
    options = {"bin_size": bin_size, "generator": seeded()}
    return index, spin_matches(source, index, target, regions[index], count, config, **options)


def test_a_scan_that_moved_rigidly_gives_the_motion_of_each_region(source):
    regions = (source.points[:, 1] > source.points[:, 1].median()).long()
    index, found = matches_of(source, source.transformed(MOTION), regions, 2)
    assert found.kept.float().mean() > 0.5
    assert found.motions.shape == (2, 4, 4)
    for region, motion in enumerate(found.motions):
        body = source.points[regions == region]
        error = (transform_points(motion, body) - transform_points(MOTION, body)).norm(dim=-1)
        assert float(error.max()) < 0.02 * source.diagonal
    error = (found.targets - transform_points(MOTION, source.points[index])).norm(dim=-1)
    assert float(error[found.kept].max()) < 3 * 3 * source.spacing


def test_targets_out_of_reach_are_no_candidates(source):
    far = source.transformed(se3_exp(torch.tensor([100 * source.diagonal, 0, 0, 0, 0, 0])))
    _, found = matches_of(source, far, torch.zeros(len(source), dtype=torch.int64), 1)
    assert not found.candidates.any()
    assert not found.kept.any()
    assert torch.equal(found.motions[0], torch.eye(4))


def test_a_region_without_points_stays(source):
    _, found = matches_of(source, source, torch.zeros(len(source), dtype=torch.int64), 3)
    assert torch.equal(found.motions[1:], torch.eye(4).expand(2, 4, 4))
    assert float(torch.det(found.motions[0, :3, :3])) == pytest.approx(1, abs=1e-4)


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
