"""Many scans together: every frame reached, one set of weights, all points in one pose, bad input."""

import math
from dataclasses import replace

import pytest
import torch

import torchreg as tr
from tests.geometry.draws import randn
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import jointed_toy
from torchreg.registration.dense.align_scans import align_scans
from torchreg.registration.register_sequence import Motion

QUICK = tr.RegisterConfig(align=replace(tr.RegisterConfig().align, num_samples=300), num_samples=500)


@pytest.fixture(scope="module")
def toy():
    return jointed_toy(3, seed=2, scanner=DepthScanner(num_points=700), step=math.radians(12))


@pytest.fixture(scope="module")
def found(toy):
    return tr.register_sequence([toy[frame] for frame in range(3)], 8, 30, QUICK, reference=1)


def test_every_frame_is_reached_from_the_reference(toy, found):
    assert found.deformed.shape == (3, len(toy[1]), 3)
    assert found.transforms.shape[0] == 3
    for frame in range(3):
        errors = (found.deformed[frame] - toy.truth(1, frame)).norm(dim=-1) / toy[1].diagonal
        assert float((errors < 0.025).float().mean()) > 0.85
    assert float((found.deformed[1] - found.points).norm(dim=-1).mean()) < 0.005 * toy[1].diagonal
    with torch.no_grad():
        torch.testing.assert_close(found.model(found.points), found.deformed, atol=1e-4, rtol=0)
    assert found.status.usable
    assert found.confidence.shape == (3,)
    assert found.confidence[1] == 1
    assert 0.5 < float(found.confidence.min()) <= float(found.confidence.max()) <= 1


def test_all_points_meet_in_the_pose_of_the_reference(toy, found):
    assert len(found.fused) == sum(len(toy[frame]) for frame in range(3))
    assert found.fused_frames.unique().tolist() == [0, 1, 2]
    torch.testing.assert_close(found.fused_normals.norm(dim=-1), torch.ones(len(found.fused)))
    distance = torch.cdist(found.fused, toy[1].points).amin(1) / toy[1].diagonal
    assert float(distance.median()) < 0.01


def test_frames_beyond_a_doubtful_one_are_doubtful(toy, monkeypatch):
    sure = iter((0.9, 0.2, 0.7))

    def judged(source, *args, **kwargs):
        return replace(align_scans(source, *args, **kwargs), confidence=next(sure))

    monkeypatch.setattr("torchreg.registration.register_sequence.align_scans", judged)
    scans = [toy[0].subset(torch.arange(0, len(toy[0]), 2))] * 4
    found = tr.register_sequence(scans, 2, 10, replace(QUICK, label_steps=1, refine_steps=0))
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


def test_points_are_predicted_by_half_of_a_single_step_and_hidden_ones_do_not_run_away():
    first, second = torch.zeros(5, 3), torch.ones(5, 3)
    assert Motion().predict([first]) is None
    found = Motion().predict([first, second])
    torch.testing.assert_close(found.places, 1.5 * second)
    # The variance of steps being one, half of each kept leaves three quarters of it.
    assert found.std == pytest.approx(math.sqrt(0.75))
    # Steps that were all alike go on, but those of a hidden point are predictions themselves.
    found = Motion().predict([step * torch.ones(2, 3) for step in range(20)], torch.tensor([1.0, 0.0]))
    torch.testing.assert_close(found.places[0], torch.full((3,), 20.0), rtol=0, atol=0.05)
    torch.testing.assert_close(found.places[1], torch.full((3,), 19.5))


@pytest.mark.parametrize("kept", [0.2, 0.9])
def test_how_steady_steps_are_is_estimated(kept):
    steps = [torch.zeros(4000, 3)]
    for number in range(40):
        steps.append(kept * steps[-1] + randn(4000, 3, seed=number).float())
    positions = torch.stack(steps).cumsum(0)
    found = Motion().predict(list(positions))
    torch.testing.assert_close(found.places, positions[-1] + kept * steps[-1], rtol=0, atol=0.2)
    assert found.std == pytest.approx(1, rel=0.05)


def test_far_frames_are_reached_step_by_step_as_the_config_says(toy):
    records = []
    config = replace(QUICK, refine_steps=0, joint_weight=(0.0, 0.0))
    found = tr.register_sequence([toy[frame] for frame in range(3)], 8, 30, config, on_step=records.append)
    errors = (found.deformed[2] - toy.truth(0, 2)).norm(dim=-1) / toy[0].diagonal
    assert float((errors < 0.025).float().mean()) > 0.8
    assert records[-len(found.history) :] == list(found.history)
    assert {record.stage for record in records} == {"initialize", "align"}
    assert all(record.joint == 0 for record in found.history)


@pytest.mark.parametrize(
    ("scans", "reference", "error", "words"),
    [
        (lambda toy: [toy[0]], 0, "InputError", "scans must hold at least two"),
        (lambda toy: [toy[0], toy[1]], 2, "InputError", "reference must be below"),
        (lambda toy: [toy[0], toy[1].points], 0, "InputTypeError", "RangeScan"),
    ],
)
def test_bad_arguments_are_refused_by_name(toy, scans, reference, error, words):
    with pytest.raises(getattr(tr.errors, error), match=words):
        tr.register_sequence(scans(toy), reference=reference)
