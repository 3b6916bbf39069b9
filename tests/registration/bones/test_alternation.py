"""The steps of scan registration: errors fall, records say so, several frames at once, joints that hold."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from scipy.spatial.transform import Rotation

import torchreg as tr
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import jointed_toy
from torchreg.registration.bones.alternation import ReducedFit, Samples
from torchreg.registration.bones.labels import CellData
from torchreg.registration.bones.motions_and_joints import fit_bones_and_joints
from torchreg.registration.bones.sparse_grid import SparseGrid


@pytest.fixture(scope="module")
def toy():
    sequence = jointed_toy(3, seed=2, scanner=DepthScanner(num_points=1000), dtype=torch.float64)
    return sequence, [sequence.pair(0, 1), sequence.pair(0, 2)]


def fit(pairs, num_bones=8, noise=0.0, config=None, on_step=None, drift=0.0):
    """Return a fit from the truth, but for noise of each point and drift of each part, and the truth."""
    source = pairs[0].source
    size, middle = source.diagonal, source.points.mean(0)
    motion = torch.eye(4, dtype=torch.float64) / size
    motion[:3, 3], motion[3, 3] = -middle / size, 1.0
    points = source.transformed(motion).points
    data = CellData(SparseGrid.from_points(points, 30), points, 60)
    generator = torch.Generator().manual_seed(0)
    truth = torch.stack([(pair.truth - middle) / size for pair in pairs])
    moved = truth + noise * torch.randn(truth.shape, generator=generator, dtype=torch.float64)
    parts = int(pairs[0].labels.max()) + 1
    moved += drift * torch.randn(len(pairs), parts, 3, generator=generator, dtype=torch.float64)[:, pairs[0].labels]
    samples = Samples(points, source.normals, moved, torch.ones_like(moved[..., 0]))
    targets = [pair.target.transformed(motion) for pair in pairs]
    config = config or tr.RegisterConfig()
    return ReducedFit(data, samples, targets, config, num_bones=num_bones, on_step=on_step), truth


def error(reduced, truth):
    return (reduced.moved(reduced.samples.points, reduced.samples.normals)[0] - truth).norm(dim=-1).mean()


def test_labels_then_weights_come_nearer_to_the_truth(toy):
    records = []
    reduced, truth = fit(toy[1][:1], noise=0.005, drift=0.005, on_step=records.append)
    first = error(reduced, truth)
    reduced.fit_labels()
    assert error(reduced, truth) < 0.8 * first
    reduced.refine()
    assert error(reduced, truth) < 0.75 * first
    assert error(reduced, truth) < 0.006
    assert records == reduced.history
    assert [record.stage for record in records] == sorted(record.stage for record in records)
    for record in records:
        assert record.kept + record.boundary + record.far + record.turned == len(reduced.samples.points)
        assert record.num_labels <= 8
        assert record.smoothness > 0
    assert records[-1].distance < records[0].distance
    energies = [sum(record.energies.values()) for record in records]
    assert energies[-1] < 0.8 * energies[0]
    assert max(later / before for before, later in pairwise(energies)) < 1.05


def test_records_hold_the_energy_of_eqs_2_and_8_by_terms(toy):
    for pairs in (toy[1][:1], toy[1]):
        reduced, _ = fit(pairs, noise=0.005, config=tr.RegisterConfig(label_steps=1))
        reduced.fit_labels()
        labels = reduced.model.weights.detach()
        (first,) = reduced.history
        assert first.energies["norm"] == pytest.approx(0, abs=1e-20)
        assert first.energies["discontinuity"] == 0
        reduced.refine()
        refine, matches = reduced.config.refine, reduced.correspondences
        energy = tr.RegistrationEnergy(
            reduced.model,
            label_weights=labels,
            point_to_point=matches.point_to_point,
            smoothness=refine.smoothness,
            discontinuity=refine.closeness,
        )
        terms = energy.terms(reduced.samples.points, matches.targets, matches.normals, matches.weights)
        assert list(reduced.history[-1].energies) == list(terms)
        for name, value in reduced.history[-1].energies.items():
            assert value == pytest.approx(terms[name].mean().item(), rel=1e-9, abs=1e-20), name
        assert reduced.history[-1].energies["discontinuity"] > 0
        assert reduced.history[-1].energies["smoothness"] < first.energies["smoothness"]


@pytest.mark.parametrize("weight", [(0.001, 0.001), (0.01, 0.01), tr.RegisterConfig().joint_weight])
def test_labels_alone_lose_little(toy, weight):
    """From the truth but for noise, which parts average out, there is nothing to gain."""
    reduced, truth = fit(toy[1][:1], noise=0.005, config=tr.RegisterConfig(joint_weight=weight))
    first = error(reduced, truth)
    reduced.fit_labels()
    assert error(reduced, truth) < 1.1 * first


def test_two_frames_share_labels_and_weights(toy):
    reduced, truth = fit(toy[1], noise=0.005)
    reduced.fit_labels()
    reduced.refine()
    assert reduced.model.transforms.shape[0] == 2
    assert error(reduced, truth) < 0.006
    assert reduced.history[-1].kept > len(reduced.samples.points)


def test_joints_hold_better_when_they_count(toy):
    gaps, few = [], tr.RegisterConfig(smoothness=0.2, label_cost=0.001, label_steps=1)
    for weight in (1e-9, 1.0):
        reduced, _ = fit(toy[1][:1], noise=0.01, config=replace(few, joint_weight=(weight, weight)))
        reduced.fit_labels()
        gaps.append(reduced.history[-1].joint)
    assert gaps[1] < 0.5 * gaps[0]


@pytest.fixture
def problems(monkeypatch):
    """The problems of all T-steps with joints, as they come."""
    noted, solve = [], fit_bones_and_joints

    def watched(problem, *args, **kwargs):
        noted.append(problem)
        return solve(problem, *args, **kwargs)

    monkeypatch.setattr("torchreg.registration.bones.alternation.fit_bones_and_joints", watched)
    return noted


def test_joints_are_held_first_and_let_go_later(toy, problems):
    config = tr.RegisterConfig(joint_weight=(1.0, 0.05), rtol=0.0, label_steps=3, max_distance=(1e5, 1e-5))
    reduced, _ = fit(toy[1], noise=0.005, config=config)
    reduced.fit_labels()
    reduced.refine()
    weights = [problem.joint_weight for problem in problems]
    assert weights[:2] == pytest.approx([1.0, 0.05**0.5])
    assert weights == sorted(weights, reverse=True)
    assert weights[-2:] == pytest.approx([0.05, 0.05])
    torch.testing.assert_close(problems[0].pair_weights, torch.ones_like(problems[0].pair_weights))
    assert problems[-1].pair_weights.max() < 0.5


@pytest.fixture(scope="module")
def rod():
    """Points and normals of a round rod, and which of them lie in its second half."""
    generator = torch.Generator().manual_seed(0)
    along, around = torch.rand(2, 4000, generator=generator, dtype=torch.float64)
    along, around = along - 0.5, 2 * torch.pi * around
    sides = torch.stack([0 * around, around.cos(), around.sin()], dim=-1)
    points = 0.1 * sides
    points[:, 0] = along
    return points, sides, (along > 0)[:, None]


def twist_left(rod, bends, twists, **weights):
    """Return what is left of twists (F, 3) of the rod's end, which was bent (F, 3), by T-steps, as vectors (F, 3)."""
    points, normals, end = rod
    bends = torch.from_numpy(Rotation.from_rotvec(bends).as_matrix())
    wrong = bends @ torch.from_numpy(Rotation.from_rotvec(twists).as_matrix())
    places, sides, moved = (
        torch.where(end, values @ turn.mT, values)
        for values, turn in ((points, bends), (normals, bends), (points, wrong))
    )
    targets = [tr.RangeScan(place, normals=side) for place, side in zip(places, sides, strict=True)]
    data = CellData(SparseGrid.from_points(points, 30), points, 60)
    samples = Samples(points, normals, moved, torch.ones_like(moved[..., 0]))
    config = tr.RegisterConfig(joint_weight=(1e-4, 1e-4), **weights)
    labels = (data.grid.cell_centers()[:, 0] > 0).long()
    reduced = ReducedFit(data, samples, targets, config, num_bones=2, labels=labels)
    for _ in range(8):
        reduced.update_correspondences(0.5)
        reduced.solve_motions()
    still, moving = reduced.model.transforms.detach()[..., :3, :3].unbind(1)
    return torch.from_numpy(Rotation.from_matrix(bends.mT @ still.mT @ moving).as_rotvec())


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


def test_matches_may_converge_before_labels_change(toy, problems):
    reduced, _ = fit(toy[1][:1], config=tr.RegisterConfig(match_steps=3, label_steps=1))
    reduced.fit_labels()
    assert len(problems) == 3


@pytest.mark.parametrize("settings", [{"refine_steps": 0}, {"joint_weight": (0.0, 0.0)}, {"blend": "dual_quaternion"}])
def test_every_step_can_be_left_out(toy, settings):
    reduced, truth = fit(toy[1][:1], config=tr.RegisterConfig(**settings))
    reduced.fit_labels()
    reduced.refine()
    assert error(reduced, truth) < 0.01
