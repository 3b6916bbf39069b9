"""What tracking returns: how far poses are known, and whether there is one."""

import json
from dataclasses import fields, replace
from pathlib import Path

import pytest
import safetensors.torch
import torch

from torchreg.storage import load
from torchreg.tracking.results import FrameResult, TrackState


def state(**values):
    """Return the state of a tracker that has seen nothing, but for some values."""
    empty = {field.name: torch.zeros(3) if field.type == "Tensor" else 0 for field in fields(TrackState)}
    return TrackState(**{**empty, "pose": torch.full((7,), torch.nan), **values})


def test_a_state_knows_whether_there_is_a_pose():
    assert not state().found
    assert not state().tracked
    held = state(pose=torch.zeros(7))
    assert held.found
    assert not held.tracked
    assert replace(held, num_inliers=12.0).tracked


def test_deviations_are_roots_of_the_diagonal(result):
    covariance = torch.tensor([[4.0, 1.0], [1.0, 0.25]])
    values = {field.name: getattr(result, field.name) for field in fields(result)}
    frame = FrameResult(
        **values, covariance=covariance, acquired="tracked", frame=3, time=0.1, inlier_ratio=0.9, residual=1e-3
    )
    assert frame.std.tolist() == pytest.approx([2.0, 0.5])
    assert frame.statuses == result.statuses


def test_states_of_the_first_release_are_read_under_the_new_names():
    path = Path(__file__).parents[1] / "saved" / "0.1.0" / "TrackState.safetensors"
    numbers = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))["metadata"]["fields"]
    tensors, state = safetensors.torch.load_file(path), load(path)
    for former, name in {"previous": "keyframes", "strays": "unexplained", "surprise": "innovation"}.items():
        assert torch.equal(getattr(state, name), tensors[former])
    renamed = {
        "error": "prediction_error", "total": "num_data", "inliers": "num_inliers", "ratio": "ratio_in_reach",
        "held": "limit_share", "rest": "cool_down", "fails": "failed_searches", "unsure": "pending_checks",
    }  # fmt: skip
    assert all(getattr(state, name) == numbers[former] for former, name in renamed.items())
