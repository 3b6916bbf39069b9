"""The steps of scan registration: errors fall, records tell of them, several frames at once, joints that hold."""

from dataclasses import replace

import pytest
import torch

from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import jointed_toy
from torchreg.geometry.sparse_grid import SparseGrid
from torchreg.pipelines import reduced_fit
from torchreg.pipelines.bone_labels import CellData
from torchreg.pipelines.reduced_fit import ReducedFit, Samples
from torchreg.pipelines.register_config import RegisterConfig


@pytest.fixture(scope="module")
def toy():
    sequence = jointed_toy(3, seed=2, scanner=DepthScanner(num_points=1000), dtype=torch.float64)
    return sequence, [sequence.pair(0, 1), sequence.pair(0, 2)]


def fit(pairs, num_bones=8, noise=0.0, config=None, on_step=None):
    source = pairs[0].source
    size, middle = source.diagonal, source.points.mean(0)
    motion = torch.eye(4, dtype=torch.float64) / size
    motion[:3, 3], motion[3, 3] = -middle / size, 1.0
    points = source.transformed(motion).points
    data = CellData(SparseGrid.from_points(points, 30), points, 60)
    generator = torch.Generator().manual_seed(0)
    truth = torch.stack([(pair.truth - middle) / size for pair in pairs])
    moved = truth + noise * torch.randn(truth.shape, generator=generator, dtype=torch.float64)
    samples = Samples(points, source.normals, moved, torch.ones_like(moved[..., 0]))
    targets = [pair.target.transformed(motion) for pair in pairs]
    return ReducedFit(data, samples, targets, num_bones, config or RegisterConfig(), on_step), truth


def error(reduced, truth):
    return (reduced.moved(reduced.samples.points, reduced.samples.normals)[0] - truth).norm(dim=-1).mean()


def test_labels_then_weights_come_nearer_to_the_truth(toy):
    records = []
    reduced, truth = fit(toy[1][:1], noise=0.005, on_step=records.append)
    first = error(reduced, truth)
    reduced.fit_labels()
    assert error(reduced, truth) < 1.1 * first
    reduced.refine()
    assert error(reduced, truth) < first
    assert error(reduced, truth) < 0.006
    assert records == reduced.history
    assert [record.stage for record in records] == sorted(record.stage for record in records)
    for record in records:
        assert record.kept + record.boundary + record.far + record.turned == len(reduced.samples.points)
        assert record.num_labels <= 8
        assert record.smoothness > 0
    assert records[-1].distance < records[0].distance


def test_two_frames_share_labels_and_weights(toy):
    reduced, truth = fit(toy[1], noise=0.005)
    reduced.fit_labels()
    reduced.refine()
    assert reduced.model.transforms.shape[0] == 2
    assert error(reduced, truth) < 0.006
    assert reduced.history[-1].kept > len(reduced.samples.points)


def test_joints_hold_better_when_they_count(toy):
    gaps, few = [], RegisterConfig(smoothness=0.2, label_cost=0.001, label_steps=1)
    for weight in (1e-9, 1.0):
        reduced, _ = fit(toy[1][:1], noise=0.01, config=replace(few, joint_weight=(weight, weight)))
        reduced.fit_labels()
        gaps.append(reduced.history[-1].joint)
    assert gaps[1] < 0.5 * gaps[0]


def test_joints_count_less_from_round_to_round(toy, monkeypatch):
    weights, solve = [], reduced_fit.fit_bones

    def noted(problem, *args, **kwargs):
        weights.append(problem.joint_weight)
        return solve(problem, *args, **kwargs)

    monkeypatch.setattr(reduced_fit, "fit_bones", noted)
    reduced, _ = fit(toy[1][:1], config=RegisterConfig(joint_weight=(1.0, 0.05), rtol=0.0, label_steps=3))
    reduced.fit_labels()
    reduced.refine()
    assert weights[:2] == pytest.approx([1.0, 0.05**0.5])
    assert weights == sorted(weights, reverse=True)
    assert weights[-2:] == pytest.approx([0.05, 0.05])


@pytest.mark.parametrize("settings", [{"reuse": False}, {"refine_steps": 0}, {"blend": "dual_quaternion"}])
def test_every_step_can_be_left_out(toy, settings):
    reduced, truth = fit(toy[1][:1], config=RegisterConfig(**settings))
    reduced.fit_labels()
    reduced.refine()
    assert error(reduced, truth) < 0.01
