"""Trees of rings merged into limbs: the junctions on which they agree, the best rings of each limb, its frames."""

import math
from itertools import combinations

import pytest
import torch

from tests.spines.bodies import circle, line, random
from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.isosurface import isosurface
from torchreg.spines.labeled_tree import junctions_from_splits
from torchreg.spines.skeleton import tip_trees
from torchreg.spines.skeleton.level_sets import LevelSets, MeshEdges, level_sets
from torchreg.spines.skeleton.limb_curves import JunctionBall, Rings, best_rings, largest_cost, limb_curve
from torchreg.spines.skeleton.tip_trees import Branch, TipTree, grow_tip_tree

# Axes of a body like a letter H lying down: two forks, joined by a trunk along x.
TRUNK, ARM = 1.2, 0.4


def segment_distance(points, start, end):
    start, end = (torch.tensor(end, dtype=points.dtype) for end in (start, end))
    along = end - start
    share = (((points - start) @ along) / (along @ along)).clamp(0, 1)
    return (points - start - share[:, None] * along).norm(dim=1)


def body(trunk=TRUNK, radius=0.12):
    def field(points):
        parts = [
            segment_distance(points, (sx * trunk / 2, 0.0, 0.0), (sx * (trunk / 2 + 0.3), sy * ARM, 0.0))
            for sx in (-1, 1)
            for sy in (-1, 1)
        ]
        if trunk:
            parts.append(segment_distance(points, (-trunk / 2, 0.0, 0.0), (trunk / 2, 0.0, 0.0)))
        return torch.stack(parts).amin(0) - radius

    half = torch.tensor([trunk / 2 + 0.5, ARM + 0.2, 0.2], dtype=torch.float64)
    return isosurface(field, -half, half, 0.06)


def trees_of(mesh, trunk=TRUNK):
    ends = torch.tensor([(sx * (trunk / 2 + 0.4), sy * 2 * ARM, 0.0) for sx in (-1, 1) for sy in (-1, 1)])
    tips = torch.cdist(ends.double(), mesh.vertices).argmin(1)
    distances = GeodesicGraph.from_mesh(mesh).distances(tips)
    spacing = float(distances.max()) / 60
    trees = []
    for root, values in enumerate(distances):
        sets = level_sets(MeshEdges(mesh), values, spacing)
        trees.append(grow_tip_tree(sets, sets.vertex_bands[tips], root))
    return trees


@pytest.fixture(scope="module")
def forks():
    return trees_of(body())


def test_trees_branch_where_the_body_does(forks):
    for tree in forks:
        brother = {0: 1, 1: 0, 2: 3, 3: 2}[tree.root]
        others = frozenset(range(4)) - {tree.root, brother}
        assert {branch.tips for branch in tree.branches} == {
            frozenset(range(4)) - {tree.root},
            frozenset({brother}),
            others,
            *(frozenset({tip}) for tip in others),
        }
        near, far = (tree.sets.centers[tree.last_common(list(pair)).rings[-1]] for pair in ((brother, *others), others))
        side = -1 if tree.root < 2 else 1
        assert torch.allclose(near, torch.tensor([side * TRUNK / 2, 0, 0], dtype=torch.float64), atol=0.15)
        assert torch.allclose(far, torch.tensor([-side * TRUNK / 2, 0, 0], dtype=torch.float64), atol=0.15)
        for branch in tree.branches:
            assert tree.sets.centers[branch.rings].diff(dim=0).norm(dim=1).max() < 0.3
        rings = tree.junction_rings((frozenset({0}), frozenset({1}), frozenset({2, 3})))
        assert tree.meeting_ring((0, 1, 2)) in rings


def test_two_junctions_far_apart_stay_two_and_near_ones_become_one(forks):
    assert tip_trees.majority_splits(forks) == [frozenset({2, 3})]
    junctions = tip_trees.consensus_junctions(forks, 2 / 3)
    assert {frozenset(junction) for junction in junctions} == {
        frozenset({frozenset({0}), frozenset({1}), frozenset({2, 3})}),
        frozenset({frozenset({2}), frozenset({3}), frozenset({0, 1})}),
    }
    merged = tip_trees.consensus_junctions(trees_of(body(trunk=0.1), trunk=0.1), 2 / 3)
    assert merged == [tuple(frozenset({tip}) for tip in range(4))]
    assert tip_trees.consensus_junctions(forks, 100.0) == merged


def test_junctions_are_found_in_the_middle(forks):
    for junction in tip_trees.consensus_junctions(forks, 2 / 3):
        position, width = tip_trees.estimate_junction(junction, forks)
        side = -1 if junction[0] in (frozenset({0}), frozenset({0, 1})) and frozenset({1}) in junction else 1
        assert torch.allclose(position, torch.tensor([side * TRUNK / 2, 0, 0], dtype=torch.float64), atol=0.1)
        assert 0.1 < float(width) < 0.3


def chain(centers, covariances, lengths=None, lower=None, upper=None):
    """Return rings that separate bands 0, 1, 2, ... from the next, unless told otherwise."""
    count = len(centers)
    lower = torch.arange(count) if lower is None else torch.tensor(lower)
    upper = torch.arange(1, count + 1) if upper is None else torch.tensor(upper)
    bands = int(torch.cat((lower, upper)).max()) + 1
    return LevelSets(
        centers=centers, covariances=covariances, lengths=torch.ones(count) if lengths is None else lengths,
        levels=torch.arange(count), lower=lower, upper=upper, vertex_bands=torch.arange(bands), num_bands=bands,
        faces=torch.zeros(0), face_rings=torch.zeros(0),
    )  # fmt: skip


def drawn(root, clusters):
    """Return a tree with branches of two rings to each of the clusters, all as long."""
    count = len(clusters) + 1
    rings = chain(torch.zeros(count, 3), torch.eye(3).expand(count, 3, 3))
    return TipTree(root, rings, tuple(Branch(frozenset(tips), torch.tensor([0, 1])) for tips in clusters))


def test_trees_that_contradict_each_other_leave_a_junction_of_higher_degree():
    # Figure 3B of the paper: one tree pairs A with B, the other B with C; each pairing is in half of the trees.
    trees = [drawn(0, [(2, 3)]), drawn(1, [(2, 3)]), drawn(2, [(0, 3)]), drawn(3, [(1, 2)])]
    assert tip_trees.majority_splits(trees) == []
    assert junctions_from_splits([], 4) == [tuple(frozenset({tip}) for tip in range(4))]
    assert tip_trees.majority_splits([*trees[:2], drawn(2, [(0, 1)]), trees[3]]) == [frozenset({2, 3})]


def test_junctions_of_nested_splits():
    junctions = junctions_from_splits([frozenset({3, 4}), frozenset({2, 3, 4})], 6)
    assert [sorted(map(sorted, junction)) for junction in junctions] == [
        [[0], [1], [2, 3, 4], [5]],
        [[0, 1, 5], [2], [3, 4]],
        [[0, 1, 2, 5], [3], [4]],
    ]
    for junction in junctions:
        assert 0 in junction[0]
        assert frozenset().union(*junction) == frozenset(range(6))
        assert all(not first & second for first, second in combinations(junction, 2))


def test_bands_may_be_joined_by_bridges():
    # Two stacks of rings; bands 0-1-2 and 3-4-5, joined between 2 and 3.
    sets = chain(torch.zeros(4, 3), torch.eye(3).expand(4, 3, 3), lower=[0, 1, 3, 4], upper=[1, 2, 4, 5])
    tree = grow_tip_tree(sets, torch.tensor([0, 5]), 0, torch.tensor([[2, 3]]))
    assert [branch.rings.tolist() for branch in tree.branches] == [[0, 1, 2, 3]]


def test_of_two_paths_around_a_handle_the_shorter_is_taken():
    # A ring of bands 0-1-2-3 and back; two rings lead from 2 to 3.
    lengths = torch.tensor([1.0, 1, 1, 2, 1])
    eye = torch.eye(3).expand(5, 3, 3)
    sets = chain(torch.zeros(5, 3), eye, lengths, lower=[0, 1, 2, 2, 0], upper=[1, 2, 3, 3, 3])
    tree = grow_tip_tree(sets, torch.tensor([0, 3]), 0)
    assert [branch.rings.tolist() for branch in tree.branches] == [[4]]
    tree = grow_tip_tree(sets, torch.tensor([1, 3]), 0)
    assert [branch.rings.tolist() for branch in tree.branches] in ([[1, 3]], [[0, 4]])


def test_widths_of_circles_are_their_radii():
    sets = level_sets(MeshEdges(body()), body().vertices[:, 0], 0.4)
    middle = int((sets.levels == 0).nonzero()[0])
    assert float(sets.widths[middle]) == pytest.approx(0.12, rel=0.1)
    assert float(sets.lengths[middle]) == pytest.approx(2 * math.pi * 0.12, rel=0.1)


def rings(centers, axes=None):
    count = len(centers)
    covariances = torch.eye(3).double().expand(count, 3, 3) if axes is None else axes
    return Rings(centers, covariances, torch.zeros(count).double())


def straight(count):
    return line([0.0, 0, 0], [1.0, 0, 0], count)


def tree(root, tips, widths, shift=0.0):
    count = len(widths)
    covariances = torch.tensor(widths, dtype=torch.float64)[:, None, None] ** 2 * torch.eye(3, dtype=torch.float64) / 3
    sets = chain(straight(count) + torch.tensor([0.0, shift, 0.0]), covariances)
    return TipTree(root, sets, (Branch(frozenset(tips), torch.arange(count)),))


def test_the_version_with_the_best_quality_is_taken():
    trees = [tree(0, {1}, [1.0] * 8), tree(1, {0}, [0.5] * 8, shift=0.1)]
    assert largest_cost(trees) == pytest.approx(1.0)
    # Q = N - sum C: 8 (1 - 1) and 8 (1 - 1/4).
    best = best_rings(frozenset({1}), trees, None, None, 1.0)
    assert best.quality == pytest.approx(6.0)
    assert torch.allclose(best.centers[:, 1], torch.full((8,), 0.1).double())
    # That tree grew from the other end.
    assert best.centers[0, 0] == 1.0
    assert len(best_rings(frozenset({0, 1}), trees, None, None, 1.0)) == 0


def test_rings_in_the_balls_at_the_ends_are_left_out():
    trees = [tree(0, {1}, [0.1] * 11), tree(1, {0}, [1.0] * 11)]
    start = JunctionBall(torch.tensor([0.0, 0.05, 0.0]).double(), 0.25)
    end = JunctionBall(torch.tensor([0.9, 0.0, 0.0]).double(), 0.15)
    best = best_rings(frozenset({1}), trees, start, end, 1.0)
    assert best.centers[:, 0].tolist() == pytest.approx([0.3, 0.4, 0.5, 0.6, 0.7])
    large = JunctionBall(torch.tensor([0.5, 0.0, 0.0]).double(), 2.0)
    assert len(best_rings(frozenset({1}), trees, large, None, 1.0)) == 0


def test_a_limb_that_comes_back_to_its_junction_is_not_cut_short():
    ring = circle(count=40, turn=(0.5, 1.4)) + torch.tensor([1.0, 0.0, 0.0])
    sets = chain(ring, 0.01 * torch.eye(3).expand(40, 3, 3).double())
    trees = [TipTree(0, sets, (Branch(frozenset({1}), torch.arange(40)),)), tree(1, {0}, [1.0])]
    best = best_rings(frozenset({1}), trees, JunctionBall(torch.zeros(3).double(), 0.8), None, 1.0)
    assert len(best) > 30


def test_curves_have_equal_steps_and_keep_their_ends():
    start, end = torch.tensor([-0.5, 0.0, 0.0]).double(), torch.tensor([1.5, 0.0, 0.0]).double()
    points, frames = limb_curve(start, rings(straight(30)), end, 0.1)
    steps = (points[1:] - points[:-1]).norm(dim=1)
    assert torch.equal(points[[0, -1]], torch.stack((start, end)))
    assert torch.allclose(steps, torch.full_like(steps, 0.1), rtol=0.02)
    assert torch.allclose(frames @ frames.mT, torch.eye(3, dtype=torch.float64).expand(len(frames), 3, 3))
    assert torch.allclose(frames[:, 0, 2], torch.ones(len(points)).double())
    short, _ = limb_curve(start, rings(straight(0)), end, 10.0)
    assert len(short) == 3


def test_first_axes_follow_the_major_axes_of_the_rings_without_jumps():
    # An elliptic tube that twists by 1.5 pi: the axis turns with it, through every sign.
    count = 120
    angle = torch.linspace(0, 1.5 * math.pi, count).double()
    major = torch.stack((0 * angle, angle.cos(), angle.sin()), dim=1)
    minor = torch.stack((0 * angle, -angle.sin(), angle.cos()), dim=1)
    axes = 2 * major[:, :, None] * major[:, None, :] + minor[:, :, None] * minor[:, None, :]
    centers = straight(count)
    points, frames = limb_curve(centers[0] - 0.01, rings(centers, axes), centers[-1] + 0.01, 1 / (count - 1))
    first = frames[:, :, 0]
    assert (first[1:] * first[:-1]).sum(1).min() > 0.97
    nearest = torch.cdist(points, centers).argmin(1)
    inner = slice(8, -8)
    assert (first * major[nearest]).sum(1).abs()[inner].min() > 0.98


def test_round_rings_do_not_spin():
    noise = 0.02 * random(50, 3, 3)
    axes = torch.eye(3, dtype=torch.float64) + noise + noise.mT
    _, frames = limb_curve(straight(50)[0] - 0.1, rings(straight(50), axes), straight(50)[-1] + 0.1, 0.02)
    first = frames[:, :, 0]
    assert (first[1:] * first[:-1]).sum(1).min() > 0.95
