"""What skeletonizing a sequence returns: where tips and junctions are."""

import torch

from torchreg.result import Status
from torchreg.spines.results import SpineSequence


def sequence(graph, curves, num_tips):
    num_frames, num_limbs, num_samples, _ = curves.shape
    names = ("",) * num_frames
    return SpineSequence(
        torch.nn.Identity(), graph, curves, torch.ones(num_frames, num_limbs, num_samples),
        torch.eye(3).expand(num_frames, num_limbs, num_samples, 3, 3), torch.arange(float(num_frames)),
        torch.ones(num_frames, num_tips, dtype=torch.bool), torch.ones(num_frames, num_limbs, dtype=torch.bool),
        0, names, names, (Status.CONVERGED,) * num_frames, Status.CONVERGED, (),
    )  # fmt: skip


def test_tips_are_where_limbs_start_and_junctions_where_they_meet():
    # An H: four tips, two junctions, the bar last.
    places = torch.tensor([[0.0, 1], [0, -1], [2, 1], [2, -1], [0, 0], [2, 0]])
    graph = torch.tensor([[0, 4], [1, 4], [2, 5], [3, 5], [4, 5]])
    ends = torch.nn.functional.pad(places, (0, 1))[graph]
    steps = torch.linspace(0, 1, 4)[:, None]
    curve = torch.lerp(ends[:, :1], ends[:, 1:], steps)
    curves = torch.stack((curve, curve + torch.tensor([0.0, 0, 5])))
    found = sequence(graph, curves, num_tips=4)
    assert found.num_tips == 4
    torch.testing.assert_close(found.tips[..., :2], places[:4].expand(2, 4, 2))
    torch.testing.assert_close(found.junctions[..., :2], places[4:].expand(2, 2, 2))
    assert found.junctions[..., 2].unique().tolist() == [0, 5]


def test_a_single_limb_has_no_junction():
    curves = torch.rand(3, 2, 4, 3, generator=torch.Generator().manual_seed(0))[:, :1]
    found = sequence(torch.tensor([[0, 1]]), curves, num_tips=2)
    assert found.junctions.shape == (3, 0, 3)
