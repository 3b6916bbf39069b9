"""Many scans together: every frame reached, one set of weights, all points in one pose, bad input."""

import math
from dataclasses import replace

import pytest
import torch

import torchreg as tr
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import jointed_toy
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.neighbors import nearest_neighbor
from torchreg.registration import register_sequence as module
from torchreg.registration.config import RegisterConfig
from torchreg.registration.dense.align_scans import align_scans
from torchreg.registration.dense.config import ScanAlignConfig
from torchreg.registration.register_sequence import ALL_FRAMES, FRAME_TO_FRAME, Motion, register_sequence

QUICK = RegisterConfig(align=ScanAlignConfig(num_samples=300), num_samples=500)


@pytest.fixture(scope="module")
def toy():
    return jointed_toy(3, seed=2, scanner=DepthScanner(num_points=700), step=math.radians(12))


@pytest.fixture(scope="module")
def found(toy):
    return register_sequence([toy[frame] for frame in range(3)], 8, 30, QUICK, reference=1)


def test_every_frame_is_reached_from_the_reference(toy, found):
    assert found.deformed.shape == (3, len(toy[1]), 3)
    assert found.transforms.shape[0] == 3
    for frame in range(3):
        errors = (found.deformed[frame] - toy.truth(1, frame)).norm(dim=-1) / toy[1].diagonal
        assert float((errors < 0.025).float().mean()) > 0.85
    with torch.no_grad():
        torch.testing.assert_close(found.model(found.points), found.deformed, atol=1e-4, rtol=0)
    assert found.status.usable


def test_the_reference_stays_where_it_is(toy, found):
    assert float((found.deformed[1] - found.points).norm(dim=-1).mean()) < 0.005 * toy[1].diagonal


def test_all_points_meet_in_the_pose_of_the_reference(toy, found):
    assert len(found.fused) == sum(len(toy[frame]) for frame in range(3))
    assert found.fused_frames.unique().tolist() == [0, 1, 2]
    torch.testing.assert_close(found.fused_normals.norm(dim=-1), torch.ones(len(found.fused)))
    distance = nearest_neighbor(found.fused, toy[1].points)[1] / toy[1].diagonal
    assert float(distance.median()) < 0.01


def test_confidence_falls_away_from_the_reference(found):
    assert found.confidence.shape == (3,)
    assert found.confidence[1] == 1
    assert 0.5 < float(found.confidence.min()) <= float(found.confidence.max()) <= 1


def test_frames_beyond_a_doubtful_one_are_doubtful(toy, monkeypatch):
    sure = iter((0.9, 0.2, 0.7))

    def judged(source, *args, **kwargs):
        plain = align_scans(source, *args, **kwargs)
        return replace(plain, confidence=next(sure))

    monkeypatch.setattr(module, "align_scans", judged)
    scans = [toy[0].subset(torch.arange(0, len(toy[0]), 2))] * 4
    found = register_sequence(scans, 2, 10, replace(QUICK, label_steps=1, refine_steps=0))
    # What is wrong stays so but for few frames.
    assert found.confidence.tolist() == pytest.approx([1.0, 0.9, 0.9 * 0.2, 0.9 * 0.2 * 0.7], abs=0.06)
    assert found.status is tr.Status.DOUBTFUL
    assert not found.status.usable


def test_results_are_the_same_on_disk(found, tmp_path):
    found.save(tmp_path / "all.safetensors")
    back = tr.load(tmp_path / "all.safetensors")
    for name in ("deformed", "transforms", "weights", "fused", "fused_frames", "confidence"):
        assert torch.equal(getattr(back, name), getattr(found, name))
    assert back.history == found.history


def test_points_are_predicted_by_half_of_a_single_step():
    first, second = torch.zeros(5, 3), torch.ones(5, 3)
    assert Motion().predict([first]) is None
    found = Motion().predict([first, second])
    torch.testing.assert_close(found.places, 1.5 * second)
    # The variance of steps being one, half of each kept leaves three quarters of it.
    assert found.std == pytest.approx(math.sqrt(0.75))


@pytest.mark.parametrize("kept", [0.2, 0.9])
def test_how_steady_steps_are_is_estimated(kept):
    generator, steps = torch.Generator().manual_seed(0), [torch.zeros(4000, 3)]
    for _ in range(40):
        steps.append(kept * steps[-1] + torch.randn(4000, 3, generator=generator))
    places = torch.stack(steps).cumsum(0)
    found = Motion().predict(list(places))
    torch.testing.assert_close(found.places, places[-1] + kept * steps[-1], rtol=0, atol=0.2)
    assert found.std == pytest.approx(1, rel=0.05)


def test_hidden_points_do_not_run_away():
    # Steps that were all alike go on, but those of a hidden point are predictions themselves.
    places = [step * torch.ones(2, 3) for step in range(20)]
    found = Motion().predict(places, torch.tensor([1.0, 0.0]))
    torch.testing.assert_close(found.places[0], torch.full((3,), 20.0), rtol=0, atol=0.05)
    torch.testing.assert_close(found.places[1], torch.full((3,), 19.5))


def test_what_rests_is_expected_to_rest():
    places = torch.rand(7, 3, generator=torch.Generator().manual_seed(0))
    found = Motion().predict([places] * 3)
    assert torch.equal(found.places, places)
    assert found.std == 0


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"point_to_point": 0.01, "joint_weight": (0.001, 0.001)}, (0.1, (1e-4, 1e-4))),
        ({"point_to_point": 0.5, "joint_weight": (1e-5, 1e-6)}, (0.5, (1e-5, 1e-6))),
        ({"joint_weight": (0.0, 0.0)}, (0.1, (0.0, 0.0))),
    ],
)
def test_from_frame_to_frame_bones_are_held_along_the_surface_and_not_by_joints(given, expected):
    config = FRAME_TO_FRAME.apply(RegisterConfig(**given))
    assert (config.point_to_point, config.joint_weight) == expected


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, {"turn_scale": 0.5, "joint_weight": (0.01, 0.01), "point_to_point": 0.001}),
        ({"turn_scale": 2.0, "joint_weight": (1.0, 0.05)}, {"turn_scale": 2.0, "joint_weight": (1.0, 0.05)}),
        ({"joint_weight": (0.0, 0.0)}, {"joint_weight": (0.0, 0.0)}),
        ({}, {"match_steps": 4, "refine_steps": 3, "rtol": 0.02}),
        ({"match_steps": 6, "refine_steps": 0, "rtol": 0.0}, {"match_steps": 6, "refine_steps": 0, "rtol": 0.0}),
    ],
)
def test_all_frames_together_are_fitted_more_thoroughly_and_bones_hold_each_other(given, expected):
    config = ALL_FRAMES.apply(RegisterConfig(**given))
    assert {name: getattr(config, name) for name in expected} == expected


def test_far_frames_are_reached_step_by_step_as_the_config_says(toy):
    records = []
    config = replace(QUICK, refine_steps=0, joint_weight=(0.0, 0.0))
    found = register_sequence([toy[frame] for frame in range(3)], 8, 30, config, on_step=records.append)
    errors = (found.deformed[2] - toy.truth(0, 2)).norm(dim=-1) / toy[0].diagonal
    assert float((errors < 0.025).float().mean()) > 0.8
    assert records[-len(found.history) :] == list(found.history)
    assert {record.stage for record in records} == {"initialize", "align"}
    assert all(record.joint == 0 for record in found.history)


def test_bad_arguments_are_refused_by_name(toy):
    with pytest.raises(InputError, match="scans must hold at least two"):
        register_sequence([toy[0]])
    with pytest.raises(InputError, match="reference must be below"):
        register_sequence([toy[0], toy[1]], reference=2)
    with pytest.raises(InputTypeError, match="RangeScan"):
        register_sequence([toy[0], toy[1].points])
