"""Which bones of a registration are one part."""

import pytest
import torch

import torchreg as tr


def bones(*shifts, weights, axis=0):
    """Points in a row on two bones or more, shifted along an axis by so much each."""
    motions = torch.eye(4).repeat(len(shifts), 1, 1)
    motions[:, axis, 3] = torch.tensor(shifts)
    labels, count = weights.argmax(-1), len(weights)
    deformed = torch.nn.functional.pad(torch.arange(float(count))[:, None], (0, 2)) + motions[labels, :3, 3]
    empty = torch.zeros(count)
    end = (weights, empty, empty > 0, tr.Status.CONVERGED, empty)
    return tr.ScanRegistration(torch.nn.Identity(), deformed, None, deformed, labels, motions, *end)


BLEND = torch.tensor([[1, 0, 0], [0.6, 0.4, 0], [0, 0.6, 0.4], [0, 0, 1]])


def test_bones_that_meet_and_move_alike_are_one_part():
    assert bones(0.0, 0.01, 1.0, weights=BLEND).parts().tolist() == [0, 0, 0, 1]
    assert bones(0.0, 0.5, 1.0, weights=BLEND).parts().tolist() == [0, 0, 1, 2]
    # The second bone joins the first, larger one and moves like it then: too far from the third.
    assert bones(0.0, 0.5, 1.0, weights=BLEND).parts(0.2).tolist() == [0, 0, 0, 1]
    assert bones(0.0, 0.5, 1.0, weights=BLEND).parts(0.3).tolist() == [0, 0, 0, 0]
    apart = torch.tensor([[1.0, 0, 0], [1, 0, 0], [0, 0, 1], [0, 0, 1]])
    assert bones(0.0, 0.0, 0.0, weights=apart).parts().tolist() == [0, 0, 1, 1]


def test_parts_of_a_sequence_moved_as_one_in_every_frame():
    frames = [bones(0.0, 0.0, 1.0, weights=BLEND), bones(0.0, 1.0, 1.0, weights=BLEND)]
    assert [frame.parts().tolist() for frame in frames] == [[0, 0, 0, 1], [0, 0, 1, 1]]

    def parts(*frames):
        deformed, transforms = (torch.stack([getattr(f, name) for f in frames]) for name in ("deformed", "transforms"))
        first, nothing = frames[0], torch.zeros(0, 3)
        moved = (first.points, None, deformed, first.labels, transforms, first.weights)
        fused = (nothing, nothing, nothing[:, 0].long(), 0, tr.Status.CONVERGED)
        return tr.SequenceRegistration(torch.nn.Identity(), *moved, *fused).parts()

    assert parts(*frames).tolist() == parts(*frames[::-1]).tolist() == [0, 0, 1, 2]
    assert parts(frames[1]).tolist() == parts(frames[1], frames[1]).tolist() == frames[1].parts().tolist()


def chain(order, step):
    """Eight bones in a row of three points each, every one shifted by ``step`` more along y than the one before."""
    row = torch.arange(8).repeat_interleave(3)
    blend = (1 - 0.6 * (row.unsqueeze(1) - torch.arange(8)).abs()).clamp(min=0)
    weights = (blend / blend.sum(1, keepdim=True))[:, order]
    return bones(*(step * torch.as_tensor(order)).tolist(), weights=weights, axis=1)


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
    for step, tolerance, count in ((0.0, 1e-6, 1), (0.1, 0.05 / 23, 8), (0.1, 0.8 / 23, 1)):
        assert len(chain(order, step).parts(tolerance).unique()) == count
