"""What tracking returns: how far poses are known, and whether there is one."""

from dataclasses import fields, replace

import pytest
import torch

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
    assert replace(held, inliers=12.0).tracked


def test_deviations_are_roots_of_the_diagonal(result):
    covariance = torch.tensor([[4.0, 1.0], [1.0, 0.25]])
    values = {field.name: getattr(result, field.name) for field in fields(result)}
    frame = FrameResult(
        **values, covariance=covariance, acquired="tracked", frame=3, time=0.1, inlier_ratio=0.9, residual=1e-3
    )
    assert frame.std.tolist() == pytest.approx([2.0, 0.5])
    assert frame.statuses == result.statuses
