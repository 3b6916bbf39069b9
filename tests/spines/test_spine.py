"""The spine model: frames met exactly, smooth between them, shared nodes, gradients, and what it refuses."""

import math

import pytest
import torch

import torchreg as tr
from tests.geometry.draws import D, randn
from torchreg.geometry.rotation import so3_exp

GRAPH = torch.tensor([[0, 4], [1, 4], [2, 5], [3, 5], [4, 5]])  # four tips, two junctions


def made_curves(count=4, samples=7, seed=0):
    nodes, bulge = randn(count, 6, 3, seed=seed), randn(count, 5, 1, 3, seed=seed + 1)
    share = torch.linspace(0, 1, samples, dtype=D)[:, None]
    start, end = (nodes[:, GRAPH[:, k]].unsqueeze(2) for k in (0, 1))
    return start + share * (end - start) + share * (1 - share) * bulge


@pytest.fixture
def spine():
    curves = made_curves()
    radii = torch.full(curves.shape[:3], 0.1, dtype=D) * torch.arange(1, 5)[:, None, None]
    return tr.Spine(curves, GRAPH, radii, times=torch.tensor([0.0, 1.0, 3.0, 4.0]))


def test_the_frames_are_met_exactly(spine):
    torch.testing.assert_close(spine(spine.times), made_curves(), rtol=0, atol=1e-14)
    assert spine(2.0).shape == (5, 7, 3)
    assert (spine.num_tips, spine.num_limbs) == (4, 5)
    torch.testing.assert_close(spine.radii(spine.times)[:, 0, 0], torch.tensor([0.1, 0.2, 0.3, 0.4]).double())
    torch.testing.assert_close(spine.tips(3.0), made_curves()[2, :4, 0])


def test_motion_at_even_speed_and_under_even_acceleration_is_met_between_the_frames():
    times, shape = torch.tensor([0.0, 1.0, 3.0, 4.0], dtype=D), made_curves(1)
    spine = tr.Spine(shape + (times + 0.5 * times**2)[:, None, None, None], GRAPH, times=times)
    for t in (1.5, 2.0, 2.9):
        torch.testing.assert_close(spine(t), shape[0] + t + 0.5 * t**2)


def test_speed_does_not_jump_at_the_frames(spine):
    eps = 1e-6
    for t in (1.0, 3.0):
        before, after = (spine(t) - spine(t - eps)) / eps, (spine(t + eps) - spine(t)) / eps
        torch.testing.assert_close(before, after, atol=1e-4, rtol=1e-4)


def test_limbs_share_their_nodes_also_after_a_step(spine):
    with torch.no_grad():
        spine.nodes += 0.1 * randn(*spine.nodes.shape, seed=1)
    curves = spine(1.7)
    for first, second in (
        (curves[0, -1], curves[1, -1]),
        (curves[0, -1], curves[4, 0]),
        (curves[2, -1], curves[4, -1]),
    ):
        torch.testing.assert_close(first, second)


def test_many_times_at_once_equal_one_after_the_other(spine):
    times = torch.tensor([[0.2, 1.0], [2.7, 4.0]], dtype=torch.float64)
    for function in (spine, spine.radii, spine.frames, spine.lengths, spine.bend_angles, spine.tips):
        torch.testing.assert_close(function(times)[1, 0], function(2.7))


def test_frames_of_the_limbs_follow_the_curves_and_turn_with_the_body():
    curves = made_curves(1) * torch.tensor([1.0, 1.0, 0.0])
    half = so3_exp(torch.tensor([0.0, 0.0, math.pi / 6], dtype=D))
    turn, first = half @ half, tr.Spine(curves, GRAPH).rest_frames
    spine = tr.Spine(torch.cat((curves, curves @ turn.mT)), GRAPH, frames=torch.cat((first, turn @ first)))
    frames, moment = spine.frames(0.5), spine(0.5)
    ahead = torch.nn.functional.normalize(moment[:, 2:] - moment[:, :-2], dim=-1)
    assert float((frames[:, 1:-1, :, 2] * ahead).sum(-1).detach().min()) > 0.99
    torch.testing.assert_close(frames @ frames.mT, torch.eye(3, dtype=D).expand_as(frames))
    torch.testing.assert_close(frames, half @ first[0])


def test_gradients_are_right_in_time_and_nodes(spine):
    assert torch.autograd.gradcheck(spine, (torch.tensor(1.3, dtype=D, requires_grad=True),))
    times = (torch.tensor([0.4, 3.0]).double(),)
    of_nodes = lambda nodes: torch.func.functional_call(spine, {"nodes": nodes}, times)  # noqa: E731
    assert torch.autograd.gradcheck(of_nodes, (spine.nodes.detach().requires_grad_(),))
    spine.frames(1.3).sum().backward()
    assert bool(spine.nodes.grad.isfinite().all())


def test_a_single_frame_stands_still():
    spine = tr.Spine(made_curves(1).float(), GRAPH)
    assert spine(0.0).dtype == torch.float32
    torch.testing.assert_close(spine(0.0), made_curves(1).float()[0])
    assert (spine.frames(0.0).shape, spine.radii(0.0).shape) == ((5, 7, 3, 3), (5, 7))


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"curves": torch.zeros(2, 5, 1, 3)}, "InputError", "two points at least"),
        ({"curves": torch.zeros(5, 7, 3)}, "InputError", "curves must have shape"),
        ({"curves": torch.full((1, 5, 3, 3), torch.nan)}, "InputError", "curves must be finite"),
        ({"graph": GRAPH[:4]}, "InputError", "graph must have shape"),
        ({"graph": GRAPH.double()}, "InputTypeError", "graph must hold integers"),
        ({"graph": GRAPH + 1}, "InputError", "graph must hold the nodes 0 to 5"),
        ({"graph": torch.tensor([[0, 4], [1, 4], [0, 1], [2, 3], [5, 2]])}, "InputError", "must be a tree"),
        ({"graph": 5 - GRAPH}, "InputError", "tips first"),
        ({"graph": GRAPH[[0, 2, 1, 3, 4]]}, "InputError", "must meet where graph says"),
        ({"radii": torch.zeros(4, 5, 6)}, "InputError", "radii must have shape"),
        ({"frames": torch.zeros(4, 5, 7, 3)}, "InputError", "frames must have shape"),
        ({"times": torch.tensor([0.0, 1.0, 1.0, 2.0])}, "InputError", "times must increase strictly"),
    ],
)
def test_bad_input_is_named(change, error, words):
    with pytest.raises(getattr(tr.errors, error), match=words):
        tr.Spine(**{"curves": made_curves(), "graph": GRAPH, **change})


def test_times_outside_are_refused(spine):
    with pytest.raises(tr.errors.InputError, match=r"t must lie within the times 0.0 to 4.0"):
        spine(4.5)


def test_the_record_and_the_state_make_the_same_spine_again_also_after_a_step(spine):
    with torch.no_grad():
        spine.nodes += 0.1
        spine.node_radii *= 2
    again, loaded = tr.Spine.from_record(spine.record()), tr.Spine(made_curves(seed=3), GRAPH, times=spine.times)
    loaded.load_state_dict(spine.state_dict())
    assert torch.equal(loaded(2.2), spine(2.2))
    for name in ("nodes", "node_radii", "rest_frames", "times", "graph"):
        assert torch.equal(getattr(again, name), getattr(spine, name))


def test_one_moment_is_a_skeleton(spine):
    skeleton, curves = spine.skeleton(1.5), spine(1.5).detach()
    assert (skeleton.tips.tolist(), skeleton.junctions.tolist()) == ([0, 1, 2, 3], [4, 5])
    for limb, curve in zip(skeleton.limbs[:4], curves, strict=False):
        torch.testing.assert_close(skeleton.nodes[limb], curve)
    torch.testing.assert_close(skeleton.radii[skeleton.limbs[4]], spine.radii(1.5).detach()[4])
