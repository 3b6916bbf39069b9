"""Result records: frozen, complete, and independent of the pipelines that fill them."""

from dataclasses import FrozenInstanceError, fields, replace

import pytest
import torch

from torchreg import results
from torchreg.errors import TorchregError
from torchreg.results import AlignRecord, AlignResult, Calibration, DemoResult, PoseStarts, Status


def result():
    return AlignResult(
        pose=torch.zeros(27),
        registered=torch.zeros(5, 3),
        keypoints=torch.zeros(21, 3),
        distances=torch.zeros(4),
        inliers=torch.ones(4, dtype=torch.bool),
        posterior=torch.ones(4),
        sigma=torch.tensor(0.002),
        cost=torch.tensor(1.5),
        status=Status.CONVERGED,
    )


def test_results_do_not_change():
    with pytest.raises(FrozenInstanceError):
        result().pose = torch.ones(27)
    record = AlignRecord("em", 0, 5, torch.ones(1), torch.ones(1), torch.zeros(1, 27), torch.zeros(1))
    with pytest.raises(FrozenInstanceError):
        record.step = 1


def test_history_is_empty_unless_given_and_fields_can_be_replaced():
    assert result().history == ()
    assert replace(result(), status=Status.NO_DATA).status is Status.NO_DATA


def test_every_field_is_documented():
    for record in (AlignResult, AlignRecord, Calibration, DemoResult, PoseStarts):
        for field in fields(record):
            assert f"        {field.name}: " in record.__doc__, field.name


def test_a_status_has_one_spelling_in_files():
    assert [Status(status.value) for status in Status] == list(Status)
    assert {status.value for status in Status} >= {"converged", "max_steps", "few_inliers", "no_data"}


def test_saving_needs_a_writer_and_hands_it_the_result(monkeypatch):
    monkeypatch.setattr(results, "_writer", None)
    with pytest.raises(TorchregError, match=r"import torchreg\.pipelines\.storage first"):
        result().save("r.safetensors")
    calls = []
    results.register_writer(lambda *arguments: calls.append(arguments))
    saved = result()
    saved.save("r.safetensors")
    assert calls == [(saved, "r.safetensors")]


def test_statuses_are_a_tuple_for_one_problem_and_for_many():
    assert result().statuses == (Status.CONVERGED,)
    assert replace(result(), status=(Status.NO_DATA, Status.CONVERGED)).statuses == (Status.NO_DATA, Status.CONVERGED)


def test_only_alignments_with_data_are_usable():
    assert [status for status in Status if status.usable] == [
        Status.CONVERGED,
        Status.MAX_STEPS,
        Status.WITH_WARNINGS,
    ]


def test_starts_give_their_best_and_one_cloud_of_a_batch():
    poses = torch.arange(24.0).reshape(2, 3, 4)
    starts = PoseStarts(poses, torch.arange(6.0).reshape(2, 3), torch.tensor([0.25, 0.75]))
    torch.testing.assert_close(starts.best, poses[:, 0])
    row = starts.row(1)
    torch.testing.assert_close(row.best, torch.tensor([12.0, 13, 14, 15]))
    assert row.costs.tolist() == [3.0, 4.0, 5.0]
    assert float(row.confidence) == 0.75


def bones(*shifts, weights):
    """Four points in a row on two bones or more, shifted along x by so much each."""
    motions = torch.eye(4).repeat(len(shifts), 1, 1)
    motions[:, 0, 3] = torch.tensor(shifts)
    labels = weights.argmax(-1)
    deformed = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]) + motions[labels, :3, 3]
    empty = torch.zeros(4)
    return results.ScanRegistration(
        torch.nn.Identity(),
        deformed,
        None,
        deformed,
        labels,
        motions,
        weights,
        empty,
        empty > 0,
        Status.CONVERGED,
        empty,
    )


def test_bones_that_meet_and_move_alike_are_one_part():
    blend = torch.tensor([[1, 0, 0], [0.6, 0.4, 0], [0, 0.6, 0.4], [0, 0, 1]])
    assert bones(0.0, 0.01, 1.0, weights=blend).parts().tolist() == [0, 0, 0, 1]
    assert bones(0.0, 0.5, 1.0, weights=blend).parts().tolist() == [0, 0, 1, 2]
    # The second bone joins the first, larger one and moves like it then: too far from the third.
    assert bones(0.0, 0.5, 1.0, weights=blend).parts(0.2).tolist() == [0, 0, 0, 1]
    assert bones(0.0, 0.5, 1.0, weights=blend).parts(0.3).tolist() == [0, 0, 0, 0]
    apart = torch.tensor([[1.0, 0, 0], [1, 0, 0], [0, 0, 1], [0, 0, 1]])
    assert bones(0.0, 0.0, 0.0, weights=apart).parts().tolist() == [0, 0, 1, 1]


def test_parts_of_a_sequence_moved_as_one_in_every_frame():
    blend = torch.tensor([[1, 0, 0], [0.6, 0.4, 0], [0, 0.6, 0.4], [0, 0, 1]])
    frames = [bones(0.0, 0.0, 1.0, weights=blend), bones(0.0, 1.0, 1.0, weights=blend)]
    assert [frame.parts().tolist() for frame in frames] == [[0, 0, 0, 1], [0, 0, 1, 1]]

    def parts(*frames):
        deformed, transforms = (
            torch.stack([getattr(each, name) for each in frames]) for name in ("deformed", "transforms")
        )
        first = frames[0]
        nothing = torch.zeros(0, 3)
        return results.SequenceRegistration(
            torch.nn.Identity(), first.points, None, deformed, first.labels, transforms, first.weights,
            nothing, nothing, nothing[:, 0].long(), 0, Status.CONVERGED,
        ).parts()  # fmt: skip

    assert parts(*frames).tolist() == parts(*frames[::-1]).tolist() == [0, 0, 1, 2]
    assert parts(frames[1]).tolist() == parts(frames[1], frames[1]).tolist() == frames[1].parts().tolist()


def chain(order, step):
    """Eight bones in a row of three points each, every one shifted by ``step`` more along y than the one before."""
    row = torch.arange(8).repeat_interleave(3)
    blend = (1 - 0.6 * (row.unsqueeze(1) - torch.arange(8)).abs()).clamp(min=0)
    weights = (blend / blend.sum(1, keepdim=True))[:, order]
    motions = torch.eye(4).repeat(8, 1, 1)
    motions[:, 1, 3] = step * torch.as_tensor(order)
    labels = weights.argmax(1)
    deformed = torch.stack([torch.arange(24.0), motions[labels, 1, 3], torch.zeros(24)], dim=1)
    empty = torch.zeros(24)
    return results.ScanRegistration(
        torch.nn.Identity(), deformed, None, deformed, labels, motions, weights, empty, empty > 0,
        Status.CONVERGED, empty,
    )  # fmt: skip


def test_a_chain_that_moves_ever_more_is_not_one_part():
    order = list(range(8))
    found, size = chain(order, 0.1), 23.0
    assert found.parts(0.0).tolist() == found.labels.tolist()
    few = found.parts(0.15 / size)
    # Along the row, no bone of a part is farther than the tolerance from its largest one.
    assert 3 <= len(few.unique()) <= 4
    assert bool((few.diff() >= 0).all())
    assert found.parts(0.8 / size).tolist() == [0] * 24


@pytest.mark.parametrize("seed", range(3))
def test_parts_do_not_depend_on_the_order_of_the_bones(seed):
    order = torch.randperm(8, generator=torch.Generator().manual_seed(seed)).tolist()
    assert len(chain(order, 0.0).parts(1e-6).unique()) == 1
    assert len(chain(order, 0.1).parts(0.05 / 23).unique()) == 8
    assert len(chain(order, 0.1).parts(0.8 / 23).unique()) == 1


def test_results_print_in_one_line_without_their_numbers():
    text = repr(result())
    assert text.startswith("AlignResult(pose=float32 (27,), registered=float32 (5, 3)")
    assert "sigma=0.002, cost=1.5, status=converged, history=none)" in text
    assert "\n" not in text
    record = AlignRecord("em", 0, 5, torch.ones(1), torch.ones(1), torch.zeros(1, 27), torch.zeros(1))
    many = replace(result(), status=(Status.CONVERGED, Status.LOST, Status.CONVERGED), history=(record,) * 3)
    assert "status=2 converged, 1 lost, history=3 x AlignRecord)" in repr(many)
    shape = torch.nn.Linear(1, 1)
    calibration = Calibration(shape, torch.zeros(2, 3), torch.zeros(1), torch.zeros(4), torch.tensor(1.0), Status.LOST)
    assert "shape=Linear" in repr(calibration)
    for kind in vars(results).values():
        if isinstance(kind, type) and issubclass(kind, results.Result):
            assert kind.__repr__ is results.Result.__repr__


def test_notebooks_show_a_table():
    table = replace(result(), status=(Status.OTHER_UNITS,))._repr_html_()
    assert table.startswith("<table><caption>AlignResult</caption>")
    assert "<td style='text-align:left'>float32 (5, 3)</td>" in table
    assert table.count("<tr>") == 10
    odd = PoseStarts(torch.zeros(1, 3), torch.zeros(1), "<b>")
    assert "&lt;b&gt;" in odd._repr_html_()
