"""A tracker's state is all that the next frame depends on: it is kept, restored, read from old files, and bounded."""

import json
from dataclasses import fields
from pathlib import Path

import safetensors.torch
import torch

import torchreg as tr


def same(first, second):
    """Return whether two results agree to the last bit."""
    pairs = [(getattr(first, item.name), getattr(second, item.name)) for item in fields(first) if item.name != "shape"]
    return all(
        torch.equal(a.nan_to_num(-1), b.nan_to_num(-1)) if isinstance(a, torch.Tensor) else a == b or a != a
        for a, b in pairs
    )


def test_results_and_states_come_back_from_files(tracked, tmp_path):
    for number, saved in enumerate((tracked.result, tracked.states[-1], tracked.records[-1][1])):
        saved.save(tmp_path / f"{number}.safetensors")
        assert same(tr.load(tmp_path / f"{number}.safetensors"), saved)


def test_a_restored_state_goes_on_to_the_last_bit(tracker, frames, tracked, tmp_path):
    tracked.states[3].save(tmp_path / "state.safetensors")
    restored = tracker(state=tr.load(tmp_path / "state.safetensors"))
    result = restored.run(frames[4:6])
    for number, (_, record) in enumerate(tracked.records[4:6]):
        assert torch.equal(result.poses[number], record.pose)
        assert torch.equal(result.std[number], record.std)
    assert same(restored.state, tracked.states[5])


def test_states_of_the_first_release_are_read_under_the_new_names():
    path = Path(__file__).parents[1] / "saved" / "0.1.0" / "TrackState.safetensors"
    numbers = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))["metadata"]["fields"]
    tensors, state = safetensors.torch.load_file(path), tr.load(path)
    for former, name in {"previous": "keyframes", "strays": "unexplained", "surprise": "innovation"}.items():
        assert torch.equal(getattr(state, name), tensors[former])
    renamed = {
        "error": "prediction_error", "total": "num_data", "inliers": "num_inliers", "ratio": "ratio_in_reach",
        "held": "limit_share", "rest": "cool_down", "fails": "failed_searches", "unsure": "pending_checks",
    }  # fmt: skip
    assert all(getattr(state, name) == numbers[former] for former, name in renamed.items())


def test_states_do_not_grow(tracker, frames, tracked):
    made = tracker()
    for k in range(31):
        made.step(frames[min(k % 14, 14 - k % 14)])
    assert made.state.keyframes.shape == (3, 27)
    for state in (made.state, *tracked.states):
        assert len(state.points) <= 400
        assert len(state.unexplained) < 200
