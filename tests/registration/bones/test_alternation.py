"""The steps of scan registration: errors fall, records say so, several frames at once, joints that hold."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch

import torchreg as tr
from tests.geometry.draws import rand, randn
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import jointed_toy
from torchreg.geometry.rotation import so3_exp, so3_log
from torchreg.registration.bones.alternation import ReducedFit, Samples
from torchreg.registration.bones.labels import CellData
from torchreg.registration.bones.motions_and_joints import fit_bones_and_joints
from torchreg.registration.bones.sparse_grid import SparseGrid


@pytest.fixture(scope="module")
def toy():
    sequence = jointed_toy(3, seed=2, scanner=DepthScanner(num_points=1000), dtype=torch.float64)
    return [sequence.pair(0, 1), sequence.pair(0, 2)]


def fit(pairs, noise=0.0, config=None, on_step=None, drift=0.0):
    """A fit from the truth, but for noise of each point and drift of each part, and the truth."""
    source, labels = pairs[0].source, pairs[0].labels
    size, middle = source.diagonal, source.points.mean(0)
    motion = torch.eye(4, dtype=torch.float64) / size
    motion[:3, 3], motion[3, 3] = -middle / size, 1.0
    points = source.transformed(motion).points
    truth = torch.stack([(pair.truth - middle) / size for pair in pairs])
    moved = truth + noise * randn(*truth.shape) + drift * randn(len(pairs), int(labels.max()) + 1, 3, seed=1)[:, labels]
    samples = Samples(points, source.normals, moved, torch.ones_like(moved[..., 0]))
    targets, data = (
        [pair.target.transformed(motion) for pair in pairs],
        CellData(SparseGrid.from_points(points, 30), points, 60),
    )
    config = config or tr.RegisterConfig()
    return ReducedFit(data, samples, targets, config, num_bones=8, on_step=on_step), truth


def error(reduced, truth):
    return (reduced.moved(reduced.samples.points, reduced.samples.normals)[0] - truth).norm(dim=-1).mean()


@pytest.mark.parametrize("frames", [1, 2])
def test_labels_then_weights_come_nearer_to_the_truth(toy, frames):
    records = []
    reduced, truth = fit(toy[:frames], noise=0.005, drift=0.005, on_step=records.append)
    first = error(reduced, truth)
    reduced.fit_labels()
    assert error(reduced, truth) < 0.8 * first
    reduced.refine()
    assert error(reduced, truth) < 0.75 * first
    assert error(reduced, truth) < (0.006 if frames == 1 else 0.007)
    assert reduced.model.transforms.shape[:-3] == (frames,)
    assert records == reduced.history
    assert [record.stage for record in records] == sorted(record.stage for record in records)
    for record in records:
        assert record.kept + record.boundary + record.far + record.turned == frames * len(reduced.samples.points)
        assert record.num_labels <= 8
        assert record.smoothness > 0
    assert records[-1].distance < records[0].distance
    energies = [sum(record.energies.values()) for record in records]
    assert energies[-1] < 0.8 * energies[0]
    assert max(later / before for before, later in pairwise(energies)) < 1.05


def test_records_hold_the_energy_of_eqs_2_and_8_by_terms(toy):
    reduced, _ = fit(toy, noise=0.005, config=tr.RegisterConfig(label_steps=1))
    reduced.fit_labels()
    labels, (first,) = reduced.model.weights.detach(), reduced.history
    assert first.energies["norm"] == pytest.approx(0, abs=1e-20)
    assert first.energies["discontinuity"] == 0
    reduced.refine()
    refine, matches = reduced.config.refine, reduced.correspondences
    settings = {"smoothness": refine.smoothness, "discontinuity": refine.closeness}
    energy = tr.RegistrationEnergy(
        reduced.model, label_weights=labels, point_to_point=matches.point_to_point, **settings
    )
    terms = energy.terms(reduced.samples.points, matches.targets, matches.normals, matches.weights)
    found = reduced.history[-1].energies
    assert found == pytest.approx({name: terms[name].mean().item() for name in found}, rel=1e-9, abs=1e-20)
    assert list(found) == list(terms)
    assert found["discontinuity"] > 0
    assert found["smoothness"] < first.energies["smoothness"]


def test_joints_hold_better_when_they_count(toy):
    gaps, few = [], tr.RegisterConfig(smoothness=0.2, label_cost=0.001, label_steps=1)
    for weight in (1e-9, 1.0):
        reduced, _ = fit(toy[:1], noise=0.01, config=replace(few, joint_weight=(weight, weight)))
        reduced.fit_labels()
        gaps.append(reduced.history[-1].joint)
    assert gaps[1] < 0.5 * gaps[0]


def test_joints_are_held_first_and_let_go_later_and_matches_may_converge_before_labels_change(toy, monkeypatch):
    problems, solve = [], fit_bones_and_joints

    def watched(problem, *args, **kwargs):
        problems.append(problem)
        return solve(problem, *args, **kwargs)

    monkeypatch.setattr("torchreg.registration.bones.alternation.fit_bones_and_joints", watched)
    config = tr.RegisterConfig(joint_weight=(1.0, 0.05), rtol=0.0, label_steps=3, max_distance=(1e5, 1e-5))
    reduced, _ = fit(toy, noise=0.005, config=config)
    reduced.fit_labels()
    reduced.refine()
    weights = [problem.joint_weight for problem in problems]
    assert weights[:2] == pytest.approx([1.0, 0.05**0.5])
    assert weights == sorted(weights, reverse=True)
    assert weights[-2:] == pytest.approx([0.05, 0.05])
    torch.testing.assert_close(problems[0].pair_weights, torch.ones_like(problems[0].pair_weights))
    assert problems[-1].pair_weights.max() < 0.5
    problems.clear()
    fit(toy[:1], config=tr.RegisterConfig(match_steps=3, label_steps=1))[0].fit_labels()
    assert len(problems) == 3


@pytest.fixture(scope="module")
def rod():
    """Points and normals of a round rod, and which of them lie in its second half."""
    along, around = rand(2, 4000)
    along, around = along - 0.5, 2 * torch.pi * around
    sides = torch.stack([0 * around, around.cos(), around.sin()], dim=-1)
    return torch.cat((along[:, None], 0.1 * sides[:, 1:]), 1), sides, (along > 0)[:, None]


def twist_left(rod, bends, twists, **weights):
    """What is left of twists (F, 3) of the rod's end, which was bent (F, 3), by T-steps, as vectors (F, 3)."""
    points, normals, end = rod
    bends = so3_exp(torch.tensor(bends, dtype=torch.float64))
    wrong = bends @ so3_exp(torch.tensor(twists, dtype=torch.float64))
    shapes = ((points, bends), (normals, bends), (points, wrong))
    posed, sides, moved = (torch.where(end, values @ turn.mT, values) for values, turn in shapes)
    targets = [tr.RangeScan(place, normals=side) for place, side in zip(posed, sides, strict=True)]
    data = CellData(SparseGrid.from_points(points, 30), points, 60)
    samples = Samples(points, normals, moved, torch.ones_like(moved[..., 0]))
    config = tr.RegisterConfig(joint_weight=(1e-4, 1e-4), **weights)
    labels = (data.grid.cell_centers()[:, 0] > 0).long()
    reduced = ReducedFit(data, samples, targets, config, num_bones=2, labels=labels)
    for _ in range(8):
        reduced.update_correspondences(0.5)
        reduced.solve_motions()
    still, moving = reduced.model.transforms.detach()[..., :3, :3].unbind(1)
    return so3_log(bends.mT @ still.mT @ moving)


@pytest.mark.parametrize(("weight", "least", "most"), [(0.0, 0.25, 0.35), (1e-4, 0.0, 0.06)])
def test_bones_do_not_twist_unseen_but_bend_as_seen(rod, weight, least, most):
    left = twist_left(rod, [[0.0, 0.0, 0.4]], [[0.3, 0.0, 0.0]], turn_weight=weight, turn_scale=10.0)
    assert least < float(left[0, 0].abs()) < most
    assert float(left[0, 1:].norm()) < 0.07


@pytest.mark.parametrize(("weight", "least", "most"), [(0.0, 0.15, 0.4), (1e-3, 0.0, 0.08)])
def test_what_turns_about_one_axis_in_all_frames_does_not_twist_in_some(rod, weight, least, most):
    bends = [[0.0, 0.0, angle] for angle in (0.0, 0.4, -0.5, 0.7)]
    # Twists in proportion to the bends would be a hinge of another axis, along which a round rod tells nothing.
    twists = [[angle, 0.0, 0.0] for angle in (0.0, 0.3, 0.24, 0.0)]
    left = twist_left(rod, bends, twists, turn_weight=0.0, hinge_weight=weight)
    assert least < float(left[:, 0].abs().max()) < most
    assert float(left[:, 1:].norm(dim=-1).max()) < 0.1


@pytest.mark.parametrize("settings", [{"refine_steps": 0}, {"joint_weight": (0.0, 0.0)}, {"blend": "dual_quaternion"}])
def test_every_step_can_be_left_out(toy, settings):
    reduced, truth = fit(toy[:1], config=tr.RegisterConfig(**settings))
    reduced.fit_labels()
    reduced.refine()
    assert error(reduced, truth) < 0.01
