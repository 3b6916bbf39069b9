"""One graph on every frame: limbs of a frame's own tree, limbs that hold each other, and those carried over."""

import pytest
import torch

from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.skeleton import build_skeleton
from torchreg.spines.labeled_tree import LimbGraph
from torchreg.spines.limb_transfer import (
    FrameLimbs,
    complete,
    doubt_lengths,
    own_limbs,
    steadied,
    travelling_frames,
    usual_lengths,
)

STAR = LimbGraph(5, frozenset())
FRAMES, SAMPLES = 5, 16


@pytest.fixture(scope="module")
def creature():
    return creature_sequence(STARFISH, FRAMES, resolution=48, dtype=torch.float64, seed=2)


def star(curves, radii, arms=range(5)):
    rows = []
    for arm in arms:
        limb = curves[arm].flip(0)
        rows.append((limb, radii[arm].flip(0), torch.eye(3, dtype=limb.dtype).expand(len(limb), 3, 3)))
    return build_skeleton(rows, [(k, 99) for k in range(len(rows))])


def merged(curves, radii):
    """A tree in which arms 0 and 1 go together most of their way."""
    middle, knot = curves[0, 0], 0.5 * (curves[0, 36] + curves[1, 36])
    ends = [curves[arm, -1] for arm in range(5)]
    limbs = [(torch.stack((ends[0], knot)), (0, 90)), (torch.stack((ends[1], knot)), (1, 90))]
    limbs += [(torch.stack((knot, middle)), (90, 99))]
    limbs += [(torch.stack((ends[arm], middle)), (arm, 99)) for arm in (2, 3, 4)]
    eye = torch.eye(3, dtype=curves.dtype).expand(2, 3, 3)
    return build_skeleton([(limb, torch.ones(2).to(curves), eye) for limb, _ in limbs], [row for _, row in limbs])


def own(creature, frame, **options):
    return own_limbs(star(creature.curves[frame], creature.radii, **options), list(range(5)), STAR, SAMPLES)


def test_a_tree_that_has_the_graph_gives_all_limbs(creature):
    limbs = own(creature, 1)
    assert bool(limbs.own.all())
    assert bool(limbs.placed.all())
    torch.testing.assert_close(limbs.curves[:, 0], creature.curves[1, :, -1])
    torch.testing.assert_close(limbs.curves[:, -1], creature.curves[1, :, 0])
    torch.testing.assert_close(limbs.nodes[5], creature.curves[1, 0, 0])
    steps = (limbs.curves[:, 1:] - limbs.curves[:, :-1]).norm(dim=-1)
    torch.testing.assert_close(steps, steps.mean(1, keepdim=True).expand_as(steps), rtol=0.02, atol=0)


def test_limbs_that_go_together_are_not_the_frames_own(creature):
    limbs = own_limbs(merged(creature.curves[1], creature.radii), list(range(5)), STAR, SAMPLES)
    assert limbs.own.tolist() == [False, False, True, True, True]
    torch.testing.assert_close(limbs.nodes[5], creature.curves[1, 0, 0])
    assert bool(limbs.placed.all())


def test_a_junction_needs_three_limbs(creature):
    skeleton = star(creature.curves[0], creature.radii, arms=(0, 3))
    limbs = own_limbs(skeleton, [0, -1, -1, 1, -1], STAR, SAMPLES)
    assert limbs.placed.tolist() == [True, False, False, True, False, False]
    assert not bool(limbs.own.any())


def test_odd_lengths_are_doubted_with_their_tips(creature):
    frames = [own(creature, frame) for frame in range(3)]
    usual = usual_lengths(frames)
    grown = FrameLimbs(frames[0].curves.clone(), frames[0].radii, frames[0].own, frames[0].placed, frames[0].nodes)
    grown.curves[2] = grown.curves[2, -1:] + 1.2 * (grown.curves[2] - grown.curves[2, -1:])
    assert bool(doubt_lengths(grown, usual, STAR, touching=False).own.all())
    doubted = doubt_lengths(grown, usual, STAR, touching=True)
    assert doubted.own.tolist() == [True, True, False, True, True]
    assert doubted.placed.tolist() == [True, True, False, True, True, True]


@pytest.mark.parametrize("lost", [(2,), (0, 1, 2), (3, 4)])
def test_lost_limbs_are_carried_over_and_lie_on_the_true_axes(creature, lost):
    frames = [own(creature, frame) for frame in range(FRAMES)]
    for frame in lost:
        skeleton = star(creature.curves[frame], creature.radii, arms=(0, 1, 2, 4))
        frames[frame] = own_limbs(skeleton, [0, 1, 2, -1, 3], STAR, SAMPLES)
        assert frames[frame].own.tolist() == [True, True, True, False, True]
    meshes = list(creature.meshes)
    meshes[1] = TriangleMesh(meshes[1].vertices, meshes[1].faces.flip(1))  # the winding does not matter
    done = complete(frames, STAR, meshes)
    for frame in range(FRAMES):
        if frame not in lost:
            assert done[frame] is frames[frame]
        away = torch.cdist(done[frame].curves[3], creature.curves[frame, 3]).amin(-1)
        assert float(away.max()) < 0.12
        torch.testing.assert_close(done[frame].curves[3, -1], done[frame].curves[0, -1])
        assert torch.equal(done[frame].curves[:3], frames[frame].curves[:3])
        tip = (done[frame].curves[3, 0] - creature.curves[frame, 3, -1]).norm()
        assert float(tip) < 0.15


def test_nothing_to_carry_changes_nothing(creature):
    frames = [own(creature, frame) for frame in range(2)]
    assert complete(frames, STAR, creature.meshes) == frames


def test_frames_travel_with_a_body_that_turns(creature):
    curves = torch.stack([own(creature, frame).curves for frame in range(FRAMES)])
    frames = travelling_frames(curves, 2)
    assert frames.shape == (*curves.shape[:3], 3, 3)
    torch.testing.assert_close(frames @ frames.mT, torch.eye(3, dtype=frames.dtype).expand_as(frames))
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.7, 0.2], [0.7, 0, 0.1], [-0.2, -0.1, 0]]).double())
    rigid = torch.stack((curves[0], curves[0] @ turn.mT))
    moved = travelling_frames(rigid, 0)
    torch.testing.assert_close(moved[1], turn @ moved[0], atol=1e-6, rtol=0)


def test_only_limbs_that_zigzag_are_smoothed(creature):
    plain = star(creature.curves[1], creature.radii)
    assert steadied(plain) is plain
    rough = creature.curves[1].clone()
    rough[2, 1:-1] += 0.05 * torch.randn(46, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    calm = steadied(star(rough, creature.radii))
    tips = creature.curves[1, :, -1]
    torch.testing.assert_close(calm.nodes[calm.tips], tips)
    assert calm.topology == plain.topology
    torch.testing.assert_close(calm.limb_lengths, plain.limb_lengths, rtol=0.12, atol=0)
    assert torch.equal(calm.nodes[calm.limbs[0]], plain.nodes[plain.limbs[0]])
