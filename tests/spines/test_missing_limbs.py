"""One graph on every frame: limbs that a frame shows, limbs that touch each other, and those transferred to it."""

import math
import weakref
from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch

from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.skeleton import build_skeleton
from torchreg.spines.labeled_tree import LimbGraph
from torchreg.spines.limbs import limb_transfer
from torchreg.spines.limbs.limb_transfer import transfer_missing_limbs, transported_frames
from torchreg.spines.limbs.local_icp import LocalFits, SurfacePoints, transfer_nodes
from torchreg.spines.limbs.observed_limbs import median_lengths, observe_limbs, reject_odd_lengths, smooth_rough_limbs

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


def observed(creature, frame):
    return observe_limbs(star(creature.curves[frame], creature.radii), list(range(5)), STAR, SAMPLES)


def test_a_tree_that_has_the_graph_gives_all_limbs(creature):
    limbs = observed(creature, 1)
    assert bool(limbs.observed.all())
    assert bool(limbs.node_observed.all())
    torch.testing.assert_close(limbs.curves[:, 0], creature.curves[1, :, -1])
    torch.testing.assert_close(limbs.curves[:, -1], creature.curves[1, :, 0])
    torch.testing.assert_close(limbs.nodes[5], creature.curves[1, 0, 0])
    steps = (limbs.curves[:, 1:] - limbs.curves[:, :-1]).norm(dim=-1)
    torch.testing.assert_close(steps, steps.mean(1, keepdim=True).expand_as(steps), rtol=0.02, atol=0)


def test_limbs_that_touch_each_other_are_not_observed(creature):
    limbs = observe_limbs(merged(creature.curves[1], creature.radii), list(range(5)), STAR, SAMPLES)
    assert limbs.observed.tolist() == [False, False, True, True, True]
    torch.testing.assert_close(limbs.nodes[5], creature.curves[1, 0, 0])
    assert bool(limbs.node_observed.all())


def test_a_junction_needs_three_limbs(creature):
    skeleton = star(creature.curves[0], creature.radii, arms=(0, 3))
    limbs = observe_limbs(skeleton, [0, -1, -1, 1, -1], STAR, SAMPLES)
    assert limbs.node_observed.tolist() == [True, False, False, True, False, False]
    assert not bool(limbs.observed.any())
    nothing = observe_limbs(skeleton, [-1] * 5, STAR, SAMPLES)
    assert not bool(nothing.observed.any() | nothing.node_observed.any())


def test_limbs_of_odd_length_are_rejected_with_their_tips(creature):
    frames = [observed(creature, frame) for frame in range(3)]
    median = median_lengths(frames)
    grown = replace(frames[0], curves=frames[0].curves.clone())
    grown.curves[2] = grown.curves[2, -1:] + 1.2 * (grown.curves[2] - grown.curves[2, -1:])
    assert bool(reject_odd_lengths(grown, median, STAR, touching=False).observed.all())
    trusted = reject_odd_lengths(grown, median, STAR, touching=True)
    assert trusted.observed.tolist() == [True, True, False, True, True]
    assert trusted.node_observed.tolist() == [True, True, False, True, True, True]


@pytest.mark.parametrize("missing", [(2,), (0, 1, 2), (3, 4)])
def test_missing_limbs_are_transferred_and_lie_on_the_true_axes(creature, missing):
    frames = [observed(creature, frame) for frame in range(FRAMES)]
    for frame in missing:
        skeleton = star(creature.curves[frame], creature.radii, arms=(0, 1, 2, 4))
        frames[frame] = observe_limbs(skeleton, [0, 1, 2, -1, 3], STAR, SAMPLES)
        assert frames[frame].observed.tolist() == [True, True, True, False, True]
    meshes = list(creature.meshes)
    meshes[1] = TriangleMesh(meshes[1].vertices, meshes[1].faces.flip(1))  # the winding does not matter
    done = transfer_missing_limbs(frames, STAR, meshes)
    for frame in range(FRAMES):
        if frame not in missing:
            assert done[frame] is frames[frame]
        away = torch.cdist(done[frame].curves[3], creature.curves[frame, 3]).amin(-1)
        assert float(away.max()) < 0.12
        torch.testing.assert_close(done[frame].curves[3, -1], done[frame].curves[0, -1])
        assert torch.equal(done[frame].curves[:3], frames[frame].curves[:3])
        tip = (done[frame].curves[3, 0] - creature.curves[frame, 3, -1]).norm()
        assert float(tip) < 0.15


class Meshes(Sequence):
    """Meshes that are made when they are asked for; some frames cannot be read."""

    def __init__(self, meshes, unreadable=()):
        self.rows, self.unreadable = [(mesh.vertices, mesh.faces) for mesh in meshes], unreadable
        self.alive, self.most = weakref.WeakSet(), 0

    def __len__(self):
        return len(self.rows)

    def __getitem__(self, index):
        if index in self.unreadable:
            raise KeyboardInterrupt
        mesh = TriangleMesh(*(part.clone() for part in self.rows[index]))
        self.alive.add(mesh)
        self.most = max(self.most, len(self.alive))
        return mesh


@pytest.fixture(scope="module")
def long_gap():
    """A sequence of which the frames 1 to 4, and 6 to the end, lack an arm."""
    sequence = creature_sequence(STARFISH, 8, resolution=40, dtype=torch.float64, seed=2)
    frames = [observed(sequence, frame) for frame in range(8)]
    for frame in (1, 2, 3, 4, 6, 7):
        skeleton = star(sequence.curves[frame], sequence.radii, arms=(0, 1, 2, 4))
        frames[frame] = observe_limbs(skeleton, [0, 1, 2, -1, 3], STAR, SAMPLES)
    return frames, sequence.meshes


@pytest.fixture(scope="module")
def carried(long_gap):
    frames, meshes = long_gap
    return transfer_missing_limbs(frames, STAR, meshes, workers=1)


def same(first, second):
    pairs = zip(first, second, strict=True)
    return all(torch.equal(a.curves, b.curves) and torch.equal(a.nodes, b.nodes) for a, b in pairs)


def test_processes_give_what_one_gives_from_few_surfaces(long_gap, carried):
    frames, meshes = long_gap
    on_request = Meshes(meshes)
    assert same(transfer_missing_limbs(frames, STAR, on_request, workers=1), carried)
    assert on_request.most <= 4  # two of this step, two of the last
    assert same(transfer_missing_limbs(frames, STAR, meshes, workers=2), carried)


def test_a_transfer_that_was_interrupted_goes_on_where_it_ended(long_gap, carried, tmp_path, monkeypatch):
    frames, meshes = long_gap
    with pytest.raises(KeyboardInterrupt):
        transfer_missing_limbs(frames, STAR, Meshes(meshes, unreadable=[3]), workers=1, progress=tmp_path)
    before = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.safetensors")}
    assert before
    assert same(transfer_missing_limbs(frames, STAR, meshes, workers=2, progress=tmp_path), carried)
    after = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.safetensors")}
    assert before.items() < after.items()

    def fails(**_):
        raise AssertionError("computed again")

    monkeypatch.setattr(limb_transfer, "transfer_nodes", fails)
    assert same(transfer_missing_limbs(frames, STAR, meshes, workers=1, progress=tmp_path), carried)
    other = TriangleMesh(1.01 * meshes[7].vertices, meshes[7].faces)
    with pytest.raises(AssertionError, match="computed again"):
        transfer_missing_limbs(frames, STAR, [*meshes[:7], other], workers=1, progress=tmp_path)


def test_complete_frames_stay_as_they_are(creature):
    frames = [observed(creature, frame) for frame in range(2)]
    assert transfer_missing_limbs(frames, STAR, creature.meshes) == frames


def test_frames_are_transported_with_a_body_that_rotates(creature):
    curves = torch.stack([observed(creature, frame).curves for frame in range(FRAMES)])
    frames = transported_frames(curves, 2)
    assert frames.shape == (*curves.shape[:3], 3, 3)
    torch.testing.assert_close(frames @ frames.mT, torch.eye(3, dtype=frames.dtype).expand_as(frames))
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.7, 0.2], [0.7, 0, 0.1], [-0.2, -0.1, 0]]).double())
    rigid = torch.stack((curves[0], curves[0] @ turn.mT))
    moved = transported_frames(rigid, 0)
    torch.testing.assert_close(moved[1], turn @ moved[0], atol=1e-6, rtol=0)


def test_only_limbs_that_zigzag_are_smoothed(creature):
    plain = star(creature.curves[1], creature.radii)
    assert smooth_rough_limbs(plain) is plain
    rough = creature.curves[1].clone()
    rough[2, 1:-1] += 0.05 * torch.randn(46, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    smooth = smooth_rough_limbs(star(rough, creature.radii))
    tips = creature.curves[1, :, -1]
    torch.testing.assert_close(smooth.nodes[smooth.tips], tips)
    assert smooth.topology == plain.topology
    torch.testing.assert_close(smooth.limb_lengths, plain.limb_lengths, rtol=0.12, atol=0)
    assert torch.equal(smooth.nodes[smooth.limbs[0]], plain.nodes[plain.limbs[0]])


COUNT = 21


def tube(bend, *, turn=0.0, radius=0.12, length=2.0, samples=60, start=0.0):
    """Axis (COUNT, 3), surface points and normals of a tube that is bent into an arc."""

    def center_line(along):
        angle = bend * along / length
        if bend:
            center = torch.stack((angle.sin(), 1 - angle.cos(), 0 * angle), -1) * length / bend
        else:
            center = torch.stack((along, 0 * along, 0 * along), -1)
        return center, torch.stack((-angle.sin(), angle.cos(), 0 * angle), -1)

    axis, _ = center_line(torch.linspace(0, length, COUNT, dtype=torch.float64))
    along = torch.linspace(0, length, samples, dtype=torch.float64) + start
    center, across = center_line(along.repeat_interleave(16))
    around = (2 * math.pi * torch.arange(16, dtype=torch.float64) / 16 + turn).repeat(samples)[:, None]
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    normals = around.cos() * across + around.sin() * up
    return axis, center + radius * normals, normals


def transferred(axis, source, target, widths, num_rounds=4, known=None, radius=0.12):
    """Nodes on an axis after a motion; widths in the unit of the axis."""
    along = torch.cat((torch.zeros(1).double(), (axis[1:] - axis[:-1]).norm(dim=-1).cumsum(0)))
    return transfer_nodes(
        nodes=axis,
        radii=torch.full((COUNT,), radius),
        path_lengths=(along[:, None] - along).abs(),
        source=SurfacePoints(*source),
        target=SurfacePoints(*target),
        known=torch.full_like(axis, torch.nan) if known is None else known,
        fits=LocalFits(widths=tuple(width / float(along[-1]) for width in widths), num_rounds=num_rounds),
    )


def test_nodes_move_rigidly_with_the_surface():
    axis, source, normals = tube(0.6)
    turn = so3_exp(torch.tensor([0.1, 0.15, -0.1], dtype=torch.float64))
    shift = torch.tensor([0.05, -0.04, 0.08], dtype=torch.float64)
    target = source @ turn.mT + shift, normals @ turn.mT
    moved = transferred(axis, (source, normals), target, [1.0, 0.3], num_rounds=20)
    torch.testing.assert_close(moved, axis @ turn.mT + shift, atol=0.04, rtol=0)


def test_nodes_follow_a_tube_that_bends_and_is_meshed_anew():
    axis, *source = tube(0.3)
    goal, *target = tube(0.8, turn=0.1, samples=71, start=0.01)
    known = torch.full_like(goal, torch.nan)
    known[[0, -1]] = goal[[0, -1]]
    moved = transferred(axis, source, target, [1.0, 0.5, 0.25], num_rounds=8, known=known)
    assert float((moved - goal).norm(dim=-1).max()) < 0.04
    assert float((axis - goal).norm(dim=-1).max()) > 0.4


def test_scale_and_common_motion_change_nothing():
    axis, source, normals = tube(0.3)
    _, target, target_normals = tube(0.5)
    plain = transferred(axis, (source, normals), (target, target_normals), [0.5])
    turn = so3_exp(torch.tensor([1.0, -0.4, 2.0], dtype=torch.float64))

    def scaled(points):
        return 30 * points @ turn.mT + 7

    surfaces = (scaled(source), normals @ turn.mT), (scaled(target), target_normals @ turn.mT)
    moved = transferred(scaled(axis), *surfaces, [15.0], radius=30 * 0.12)
    torch.testing.assert_close(moved, scaled(plain), rtol=0, atol=1e-6)
