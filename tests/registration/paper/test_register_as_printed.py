"""The printed algorithm end to end: it registers, follows its generator, and refuses what it has no use for."""

import math
from dataclasses import replace

import pytest
import torch

import torchreg as tr
from experiments.made_up.walks import walking_figure
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.geometry.rigid import se3_exp, transform_points

PAPER = tr.RegisterConfig.paper


@pytest.fixture(scope="module")
def pair():
    """A walking figure, four tenths of which leave their place by more than a fortieth of the diagonal."""
    return walking_figure(190, scanner=DepthScanner(num_points=2500)).pair(3, 4)


@pytest.fixture(scope="module")
def found(pair):
    return tr.register(pair.source, pair.target, 7, 50, PAPER())


def near(pair, moved):
    return float(((moved - pair.truth).norm(dim=-1) < 0.025 * pair.source.diagonal).float().mean())


def test_a_pair_of_the_walking_figure_is_registered(pair, found):
    assert near(pair, pair.source.points) < 0.7
    assert near(pair, found.deformed) > 0.9
    assert found.status.usable
    assert 2 <= found.model.num_bones <= 7
    assert [record.stage for record in found.history][-2:] == ["align", "refine"]
    assert (found.seconds > 0).all()
    assert torch.equal(tr.register(pair.source, pair.target, 7, 50, PAPER()).deformed, found.deformed)


def test_the_terms_of_the_energy_fall_and_weights_are_continuous_at_the_end(found):
    weights = found.model.corner_weights()
    assert torch.allclose(weights.sum(-1), torch.ones(len(weights)))
    assert float(((weights > 0.01) & (weights < 0.99)).float().mean()) > 0.01
    totals = [sum(record.energies.values()) for record in found.history]
    assert set(found.history[0].energies) == {"distance", "joint", "smoothness", "norm", "discontinuity"}
    assert totals[-1] < totals[0]
    # Labels keep the norm; only the last step moves weights away from them.
    assert [record.energies["discontinuity"] > 1e-6 for record in found.history] == [False] * (len(totals) - 1) + [True]


def test_units_turns_and_other_seeds_change_little(pair):
    motion = se3_exp(torch.tensor([1.0, -2.0, 0.5, 0.3, 1.1, -0.7]))
    motion[:3] *= 10
    source, target = (scan.transformed(motion) for scan in (pair.source, pair.target))
    found = tr.register(source, target, 7, 50, PAPER(), torch.Generator().manual_seed(5))
    truth = transform_points(motion, pair.truth)
    assert float(((found.deformed - truth).norm(dim=-1) < 0.025 * source.diagonal).float().mean()) > 0.9


def test_stiff_joints_keep_bones_together_and_labels_stay_without_the_last_step(pair):
    config, found = PAPER(refine_steps=0, printed=replace(PAPER().printed, max_rounds=2)), []
    for weight in (0.001, 1.0):
        found.append(tr.register(pair.source, pair.target, 7, 50, replace(config, joint_weight=(weight, weight))))
    assert {record.stage for record in found[1].history} == {"align"}
    assert found[1].history[0].joint < 0.6 * found[0].history[0].joint


def test_the_constants_are_those_that_are_printed():
    config = PAPER()
    # Section 5: beta_k = e^{k ln 0.05 / 5}, 80 to 20 degrees, 0.1 sampling distances, images of 15 x 15, 90 degrees.
    expected = [math.exp(min(k, 5) * math.log(0.05) / 5) for k in range(7)]
    assert [config.joint_weight_at(k / 5) for k in range(7)] == pytest.approx(expected)
    assert [math.degrees(angle) for angle in config.max_angle] == pytest.approx([80, 20])
    assert config.printed == replace(config.printed, max_distance=20.0, image_size=15, reuse_error=0.1)
    assert math.degrees(config.printed.support_angle) == pytest.approx(90)
    assert (config.refine.normalization, config.refine.smoothness) == (1.0, 0.5)
    assert PAPER(num_samples=1200).num_samples == 1200
    assert tr.RegisterConfig().printed is None


def test_scans_near_each_other_may_start_from_closest_points(pair):
    config = PAPER(printed=replace(PAPER().printed, first_matches="closest"))
    found = tr.register(pair.source, pair.source, 7, 50, config)
    assert float((found.deformed - pair.source.points).norm(dim=-1).max()) < 0.02 * pair.source.diagonal


@pytest.mark.parametrize("name", ["max_distance", "max_rounds", "annealing_rounds", "ransac_trials", "first_matches"])
def test_what_is_out_of_range_is_refused_by_name(name):
    with pytest.raises(tr.errors.InputError, match=name):
        replace(PAPER().printed, **{name: "random" if name == "first_matches" else 0})
    with pytest.raises(tr.errors.InputError, match="rtol"):
        replace(PAPER().printed, rtol=-1.0)


def test_a_start_has_no_place_in_it(pair):
    for name, value in (("start", pair.truth), ("parts", pair.labels)):
        with pytest.raises(tr.errors.InputError, match=rf"{name} cannot be used by RegisterConfig.paper\(\)"):
            tr.register(pair.source, pair.target, config=PAPER(), **{name: value})
    with pytest.raises(tr.errors.InputError, match="registers pairs only"):
        tr.register_sequence([pair.source, pair.target], config=PAPER())
