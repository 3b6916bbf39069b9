"""What aligning and finding articulated shapes returns."""

from dataclasses import replace

import torch

from torchreg.alignment.results import PoseStarts
from torchreg.result import Status


def test_history_is_empty_unless_given_and_fields_can_be_replaced(result):
    assert result.history == ()
    assert replace(result, status=Status.NO_DATA).status is Status.NO_DATA


def test_statuses_are_a_tuple_for_one_problem_and_for_many(result):
    assert result.statuses == (Status.CONVERGED,)
    assert replace(result, status=(Status.NO_DATA, Status.CONVERGED)).statuses == (Status.NO_DATA, Status.CONVERGED)


def test_starts_give_their_best_and_one_cloud_of_a_batch():
    poses = torch.arange(24.0).reshape(2, 3, 4)
    starts = PoseStarts(poses, torch.arange(6.0).reshape(2, 3), torch.tensor([0.25, 0.75]))
    torch.testing.assert_close(starts.best, poses[:, 0])
    row = starts.row(1)
    torch.testing.assert_close(row.best, torch.tensor([12.0, 13, 14, 15]))
    assert row.costs.tolist() == [3.0, 4.0, 5.0]
    assert float(row.confidence) == 0.75
