"""One graph on every frame: limbs that a frame shows, limbs that touch each other, and those transferred to it."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from tests.spines.bodies import MeshesOnRequest, arms_skeleton, moved, random, similarity, turn_matrix
from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.skeleton import build_skeleton
from torchreg.spines.labeled_tree import LimbGraph
from torchreg.spines.limbs import limb_transfer, local_icp, observed_limbs

GRAPH = LimbGraph(5, frozenset())
FRAMES, SAMPLES, COUNT = 8, 16, 21


@pytest.fixture(scope="module")
def creature():
    return creature_sequence(STARFISH, FRAMES, resolution=40, dtype=torch.float64, seed=2)


def observed(creature, frame, missing=()):
    """Return the limbs that the true skeleton of a frame shows, without some arms."""
    arms = [arm for arm in range(5) if arm not in missing]
    labels = [arms.index(arm) if arm in arms else -1 for arm in range(5)]
    return observed_limbs.observe_limbs(arms_skeleton(creature, frame, arms), labels, GRAPH, SAMPLES)


def test_limbs_that_touch_each_other_are_not_observed(creature):
    curves = creature.curves[1]
    middle, knot, ends = curves[0, 0], 0.5 * (curves[0, 36] + curves[1, 36]), curves[:, -1]
    limbs = [(ends[0], knot, 0, 90), (ends[1], knot, 1, 90), (knot, middle, 90, 99)]
    limbs += [(ends[arm], middle, arm, 99) for arm in (2, 3, 4)]
    rows = [(torch.stack(row[:2]), torch.ones(2).double(), torch.eye(3).double().expand(2, 3, 3)) for row in limbs]
    found = observed_limbs.observe_limbs(build_skeleton(rows, [row[2:] for row in limbs]), range(5), GRAPH, SAMPLES)
    assert found.observed.tolist() == [False, False, True, True, True]
    assert bool(found.node_observed.all())


def test_a_junction_needs_three_limbs(creature):
    limbs = observed(creature, 0, missing=(1, 2, 4))
    assert limbs.node_observed.tolist() == [True, False, False, True, False, False]
    assert not bool(limbs.observed.any())


def test_limbs_of_odd_length_are_rejected_with_their_tips(creature):
    frames = [observed(creature, frame) for frame in range(3)]
    median = observed_limbs.median_lengths(frames)
    grown = replace(frames[0], curves=frames[0].curves.clone())
    grown.curves[2] = grown.curves[2, -1:] + 1.2 * (grown.curves[2] - grown.curves[2, -1:])
    assert bool(observed_limbs.reject_odd_lengths(grown, median, GRAPH, touching=False).observed.all())
    trusted = observed_limbs.reject_odd_lengths(grown, median, GRAPH, touching=True)
    assert trusted.observed.tolist() == [True, True, False, True, True]
    assert trusted.node_observed.tolist() == [True, True, False, True, True, True]


@pytest.fixture(scope="module")
def gaps(creature):
    """Limbs of which the frames 1 to 4, and 6 to the end, lack arm 3; the surfaces; and the limbs transferred."""
    frames = [observed(creature, frame, missing=(3,) if frame not in (0, 5) else ()) for frame in range(FRAMES)]
    meshes = list(creature.meshes)
    meshes[1] = tr.TriangleMesh(meshes[1].vertices, meshes[1].faces.flip(1))  # the winding does not matter
    return frames, meshes, limb_transfer.transfer_missing_limbs(frames, GRAPH, meshes, workers=1)


def test_missing_limbs_are_transferred_and_lie_on_the_true_axes(creature, gaps):
    for number, (before, _, after) in enumerate(zip(*gaps, strict=True)):
        assert (after is before) == bool(before.observed.all())
        assert float(torch.cdist(after.curves[3], creature.curves[number, 3]).amin(-1).max()) < 0.12
        assert float((after.curves[3, 0] - creature.curves[number, 3, -1]).norm()) < 0.15
        torch.testing.assert_close(after.curves[3, -1], after.curves[0, -1])
        assert torch.equal(after.curves[:3], before.curves[:3])


def test_transfers_go_on_where_they_ended_in_any_process_and_from_few_surfaces(gaps, tmp_path, monkeypatch):
    frames, meshes, transferred = gaps

    def check(surfaces, **options):
        found = limb_transfer.transfer_missing_limbs(frames, GRAPH, surfaces, **options)
        for first, second in zip(found, transferred, strict=True):
            assert torch.equal(first.curves, second.curves)
            assert torch.equal(first.nodes, second.nodes)

    def files():
        return {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.safetensors")}

    def fails(**_):
        raise AssertionError("computed again")

    on_request = MeshesOnRequest(meshes)
    check(on_request, workers=1)
    assert on_request.most <= 4  # two of this step, two of the last
    with pytest.raises(KeyboardInterrupt):
        check(MeshesOnRequest(meshes, unreadable=[3]), workers=1, progress=tmp_path)
    before = files()
    assert before
    check(meshes, workers=2, progress=tmp_path)
    assert before.items() < files().items()
    monkeypatch.setattr(limb_transfer, "transfer_nodes", fails)
    check(meshes, workers=1, progress=tmp_path)
    with pytest.raises(AssertionError, match="computed again"):
        check([*meshes[:7], tr.TriangleMesh(1.01 * meshes[7].vertices, meshes[7].faces)], workers=1, progress=tmp_path)


def test_frames_are_transported_with_a_body_that_rotates(creature):
    curves = torch.stack([observed(creature, frame).curves for frame in range(5)])
    frames = limb_transfer.transported_frames(curves, 2)
    torch.testing.assert_close(frames @ frames.mT, torch.eye(3).double().expand(*curves.shape[:3], 3, 3))
    turn = turn_matrix(-0.7, 0.2, 0.1)
    rigid = limb_transfer.transported_frames(torch.stack((curves[0], curves[0] @ turn.mT)), 0)
    torch.testing.assert_close(rigid[1], turn @ rigid[0], atol=1e-6, rtol=0)


def test_only_limbs_that_zigzag_are_smoothed(creature):
    plain = arms_skeleton(creature, 1)
    assert observed_limbs.smooth_rough_limbs(plain) is plain
    rough = creature.curves.clone()
    rough[1, 2, 1:-1] += 0.05 * random(46, 3)
    smooth = observed_limbs.smooth_rough_limbs(arms_skeleton(replace(creature, curves=rough), 1))
    torch.testing.assert_close(smooth.nodes[smooth.tips], creature.curves[1, :, -1])
    assert smooth.topology == plain.topology
    torch.testing.assert_close(smooth.limb_lengths, plain.limb_lengths, rtol=0.12, atol=0)
    assert torch.equal(smooth.nodes[smooth.limbs[0]], plain.nodes[plain.limbs[0]])


def bent_tube(bend, *, turn=0.0, samples=60, start=0.0):
    """Axis (COUNT, 3), surface points and normals of a tube of radius 0.12 and length 2 that is bent into an arc."""

    def center_line(along):
        angle = bend * along / 2
        center = torch.stack((angle.sin(), 1 - angle.cos(), 0 * angle), -1) * 2 / bend
        return center, torch.stack((-angle.sin(), angle.cos(), 0 * angle), -1)

    along = torch.linspace(0, 2, samples, dtype=torch.float64) + start
    center, across = center_line(along.repeat_interleave(16))
    around = (2 * torch.pi * torch.arange(16).double() / 16 + turn).repeat(samples)[:, None]
    normals = around.cos() * across + around.sin() * torch.tensor([0.0, 0.0, 1.0]).double()
    return center_line(torch.linspace(0, 2, COUNT).double())[0], center + 0.12 * normals, normals


def fitted(axis, source, target, widths, num_rounds=4, known=None, radius=0.12):
    """Nodes on an axis after a motion; widths in the unit of the axis."""
    along = torch.cat((torch.zeros(1).double(), (axis[1:] - axis[:-1]).norm(dim=-1).cumsum(0)))
    return local_icp.transfer_nodes(
        nodes=axis,
        radii=torch.full((COUNT,), radius),
        path_lengths=(along[:, None] - along).abs(),
        source=local_icp.SurfacePoints(*source),
        target=local_icp.SurfacePoints(*target),
        known=torch.full_like(axis, torch.nan) if known is None else known,
        fits=local_icp.LocalFits(widths=tuple(width / float(along[-1]) for width in widths), num_rounds=num_rounds),
    )


def test_nodes_move_rigidly_with_the_surface():
    axis, source, normals = bent_tube(0.6)
    matrix = rigid_matrix(turn_matrix(0.1, 0.15, -0.1), torch.tensor([0.05, -0.04, 0.08]).double())
    target = moved(source, matrix), normals @ matrix[:3, :3].mT
    found = fitted(axis, (source, normals), target, [1.0, 0.3], num_rounds=20)
    torch.testing.assert_close(found, moved(axis, matrix), atol=0.04, rtol=0)


def test_nodes_follow_a_tube_that_bends_and_is_meshed_anew():
    axis, *source = bent_tube(0.3)
    goal, *target = bent_tube(0.8, turn=0.1, samples=71, start=0.01)
    known = torch.full_like(goal, torch.nan)
    known[[0, -1]] = goal[[0, -1]]
    found = fitted(axis, source, target, [1.0, 0.5, 0.25], num_rounds=8, known=known)
    assert float((found - goal).norm(dim=-1).max()) < 0.04
    assert float((axis - goal).norm(dim=-1).max()) > 0.4


def test_scale_and_common_motion_change_nothing():
    axis, *source = bent_tube(0.3)
    _, *target = bent_tube(0.5)
    matrix = similarity(1, 30.0)
    surfaces = [(moved(points, matrix), normals @ matrix[:3, :3].mT / 30) for points, normals in (source, target)]
    found = fitted(moved(axis, matrix), *surfaces, [15.0], radius=30 * 0.12)
    torch.testing.assert_close(found, moved(fitted(axis, source, target, [0.5]), matrix), rtol=0, atol=1e-6)
