"""Spin images matched per region, and the motions that these agree on."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from experiments.made_up.walks import walking_figure
from tests.geometry.draws import seeded
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.geometry.rigid import se3_exp, transform_points
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
