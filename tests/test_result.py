"""Result records: frozen, complete, and independent of the pipelines that fill them."""

import json
import sys
from dataclasses import FrozenInstanceError, fields, is_dataclass, replace

import pytest
import torch

import torchreg as tr
from torchreg.alignment.results import AlignRecord
from torchreg.result import Result

RECORDS = [
    kind
    for result in (tr.AlignResult, tr.ScanRegistration, tr.SpineSequence, tr.TrackResult)
    for kind in vars(sys.modules[result.__module__]).values()
    if is_dataclass(kind) and kind.__module__ == result.__module__
]


def test_results_do_not_change(result):
    with pytest.raises(FrozenInstanceError):
        result.pose = torch.ones(27)
    record = AlignRecord("em", 0, 5, torch.ones(1), torch.ones(1), torch.zeros(1, 27), torch.zeros(1))
    with pytest.raises(FrozenInstanceError):
        record.step = 1


@pytest.mark.parametrize("record", RECORDS, ids=lambda record: record.__name__)
def test_every_field_is_documented(record):
    documented = "".join(kind.__doc__ for kind in record.__mro__ if kind in RECORDS)
    assert [field.name for field in fields(record) if f"        {field.name}: " not in documented] == []


def test_a_status_has_one_spelling_in_files():
    assert [tr.Status(status.value) for status in tr.Status] == list(tr.Status)
    assert str(tr.Status.FEW_INLIERS) == f"{tr.Status.FEW_INLIERS}" == "few_inliers"
    assert {status.value for status in tr.Status} >= {"converged", "max_steps", "few_inliers", "no_data"}


def test_only_alignments_with_data_are_usable():
    assert [status for status in tr.Status if status.usable] == [
        tr.Status.CONVERGED,
        tr.Status.MAX_STEPS,
        tr.Status.WITH_WARNINGS,
    ]


def test_results_print_in_one_line_without_their_numbers(result):
    text = repr(result)
    assert text.startswith("AlignResult(pose=float32 (27,), registered=float32 (5, 3)")
    assert "sigma=0.002, cost=1.5, status=converged, history=none)" in text
    assert "\n" not in text
    record = AlignRecord("em", 0, 5, torch.ones(1), torch.ones(1), torch.zeros(1, 27), torch.zeros(1))
    many = replace(result, status=(tr.Status.CONVERGED, tr.Status.LOST, tr.Status.CONVERGED), history=(record,) * 3)
    assert "status=2 converged, 1 lost, history=3 x AlignRecord)" in repr(many)
    shape = torch.nn.Linear(1, 1)
    calibration = tr.Calibration(
        shape, torch.zeros(2, 3), torch.zeros(1), torch.zeros(4), torch.tensor(1.0), tr.Status.LOST
    )
    assert "shape=Linear" in repr(calibration)
    assert all(kind.__repr__ is Result.__repr__ for kind in RECORDS if issubclass(kind, Result))


def test_notebooks_show_a_table(result):
    table = replace(result, status=(tr.Status.OTHER_UNITS,))._repr_html_()
    assert table.startswith("<table><caption>AlignResult</caption>")
    assert "<td style='text-align:left'>float32 (5, 3)</td>" in table
    assert table.count("<tr>") == 10
    odd = tr.PoseStarts(torch.zeros(1, 3), torch.zeros(1), "<b>")
    assert "&lt;b&gt;" in odd._repr_html_()


def test_results_move_between_dtypes_with_all_they_hold(result, plain_hand):
    record = AlignRecord("em", 0, 5, torch.ones(1), torch.ones(1), torch.zeros(1, 27), torch.zeros(1))
    whole = replace(result, history=(record,), shape=plain_hand)
    moved = whole.to(torch.float64)
    assert {moved.pose.dtype, moved.history[0].pose.dtype, moved.shape.rest.dtype} == {torch.float64}
    assert moved.inliers.dtype == torch.bool
    assert plain_hand.rest.dtype == torch.float32
    there = whole.to("cpu", torch.float64)
    assert torch.equal(there.pose, moved.pose)
    assert moved.to("cpu").pose.dtype == torch.float64


def test_results_as_arrays_and_plain_data(result, plain_hand):
    whole = replace(result, shape=plain_hand)
    arrays = whole.numpy()
    assert arrays["pose"].shape == (27,)
    assert arrays["status"] == "converged"
    assert "shape" not in arrays
    plain = json.loads(json.dumps(whole.to_dict()))
    assert plain["pose"] == [0.0] * 27
    assert plain["inliers"] == [True] * 4
    assert plain["status"] == "converged"


def test_poses_by_name(result, plain_hand):
    whole = replace(result, pose=torch.arange(27.0), shape=plain_hand)
    assert whole.named_pose["base_z"] == 2.0
    assert list(whole.named_pose) == list(plain_hand.dof_names)
    assert torch.equal(plain_hand.pose_from_dict(whole.named_pose), whole.pose)
    with pytest.raises(tr.errors.InputError, match=r"keeps no shape; name its poses with shape\.pose_to_dict"):
        _ = result.named_pose
