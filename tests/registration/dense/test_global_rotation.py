import math
from dataclasses import replace

import pytest
import torch

from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import walking_figure
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import rigid_matrix, se3_exp, transform_points
from torchreg.geometry.rotation import so3_exp
from torchreg.registration.dense.config import ChoiceConfig, ScanAlignConfig
from torchreg.registration.dense.global_rotation import _NUM_TARGETS, _degrees, _energies, _turns, turned_motions
from torchreg.registration.dense.problem import describe
from torchreg.registration.dense.stages import judge

CONFIG = ScanAlignConfig(num_samples=400, num_target_samples=800, num_nodes=30)
CHOICE = ChoiceConfig()


@pytest.fixture(scope="module")
def pair():
    return walking_figure(6, scanner=DepthScanner(num_points=1500)).pair(0, 4)


def turned(scan, degrees, shift=(0.0, 0.0, 0.0)):
    """Return a scan turned about its long axis and shifted, and the motion."""
    away = scan.points.double() - scan.points.double().mean(0)
    axis = torch.linalg.eigh(away.mT @ away).eigenvectors[:, -1]
    rotation = so3_exp(math.radians(degrees) * axis)
    middle = scan.points.double().mean(0)
    motion = rigid_matrix(rotation, middle - rotation @ middle + torch.tensor(shift, dtype=torch.float64))
    return scan.to(torch.float64).transformed(motion), motion


@pytest.fixture(scope="module")
def problem(pair):
    """A walking figure that also turned, as each frame's camera sees it."""
    return describe(pair.source, turned(pair.target, 50)[0], CONFIG)


@pytest.mark.parametrize("degrees", [-60, -25, 40, 50])
def test_what_turned_is_turned_back(pair, degrees):
    # Seen from all sides: nothing is hidden, and no camera known.
    source = RangeScan(pair.source.points.double(), normals=pair.source.normals.double())
    target, motion = turned(source, degrees, (0.3, -0.1, 0.2))
    scans = describe(source, target, CONFIG)
    found = turned_motions(scans, CHOICE, 2)
    assert min(_degrees(each, motion) for each in found) <= 10.5
    best = scans.unit.denormalize(transform_points(found[0], scans.graph.points), source.points)
    truth = transform_points(motion, source.points[scans.samples])
    assert float((best - truth).norm(dim=-1).mean()) < 0.05 * source.diagonal


def test_what_did_not_turn_is_not_turned(pair):
    target = pair.source.transformed(se3_exp(torch.tensor([0.2, -0.3, 0.1, 0.0, 0.0, 0.0])))
    assert turned_motions(describe(pair.source, target, CONFIG), CHOICE, 2).shape == (0, 4, 4)


def test_the_best_come_first_and_are_apart(problem):
    found = turned_motions(problem, CHOICE, 4)
    assert found.shape == (4, 4, 4)
    assert torch.equal(turned_motions(problem, CHOICE, 2), found[:2])
    for number, motion in enumerate(found):
        torch.testing.assert_close(motion[:3, :3] @ motion[:3, :3].mT, torch.eye(3, dtype=torch.float64))
        assert all(_degrees(motion, other) > 12 for other in (torch.eye(4), *found[:number]))
    few = replace(problem, target=problem.target.first(_NUM_TARGETS))
    assert bool((_energies(few, found, CHOICE).diff() >= 0).all())


def test_energies_are_those_of_the_choice(problem):
    motions = turned_motions(problem, CHOICE, 3)
    energies = _energies(problem, motions, CHOICE)
    judged = [judge(problem, "", each.expand_as(problem.graph.rest()), CHOICE).energy for each in motions]
    # Of the samples only some are looked at.
    torch.testing.assert_close(energies, torch.tensor(judged).to(energies), rtol=0.1, atol=0)


def test_turns_go_all_around_and_turn_with_the_points():
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * torch.tensor(
        [1.0, 2.0, 4.0]
    )
    turns = _turns(points)
    assert len(turns) == 1 + 3 * 26
    torch.testing.assert_close(torch.linalg.det(turns), torch.ones(len(turns), dtype=torch.float64))
    # Nowhere up to 60 degrees is a turn farther off than this.
    generator = torch.Generator().manual_seed(1)
    axes = torch.nn.functional.normalize(torch.randn(300, 3, generator=generator, dtype=torch.float64), dim=-1)
    some = so3_exp(math.radians(60) * torch.rand(300, 1, generator=generator, dtype=torch.float64) * axes)
    nearest = [min(_degrees(one, turn) for turn in turns) for one in some]
    assert max(nearest) < 30
    assert sum(nearest) / len(nearest) < 15
    other = so3_exp(torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64))
    expected = other @ turns @ other.mT
    for turn in _turns(points @ other.mT + 5):
        assert float((turn - expected).abs().amax((1, 2)).min()) < 1e-9


def test_frames_and_units_change_nothing(pair):
    motion = se3_exp(torch.tensor([3.0, -8.0, 5.0, 1.0, 2.0, -0.5], dtype=torch.float64))
    larger = motion.clone()
    larger[:3] = 100 * larger[:3]
    plain = [scan.to(torch.float64) for scan in (pair.source, pair.target)]
    plain[1], _ = turned(plain[1], 50)
    scans, others = describe(*plain, CONFIG), describe(*(scan.transformed(larger) for scan in plain), CONFIG)
    one, other = (
        each.unit.denormalize(transform_points(turned_motions(each, CHOICE, 1)[0], each.graph.points), plain[0].points)
        for each in (scans, others)
    )
    torch.testing.assert_close(other, transform_points(larger, one), rtol=0, atol=1e-3 * 100 * plain[0].diagonal)
