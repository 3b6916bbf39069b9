import math
from itertools import combinations

import pytest
import torch

from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.isosurface import isosurface
from torchreg.spines.level_sets import LevelSets, level_sets
from torchreg.spines.tip_trees import (
    Branch,
    TipTree,
    consensus,
    grow_tip_tree,
    joints_of,
    locate,
    majority_splits,
    partings,
    ring_widths,
)

# Axes of a body like a letter H lying down: two forks, joined by a trunk along x.
TRUNK, ARM = 1.2, 0.4


def segment_distance(points, start, end):
    start, end = (torch.tensor(place, dtype=points.dtype) for place in (start, end))
    line = end - start
    share = (((points - start) @ line) / (line @ line)).clamp(0, 1)
    return (points - start - share[:, None] * line).norm(dim=1)


def body(trunk=TRUNK, radius=0.12):
    def field(points):
        sides = [
            ((sx * trunk / 2, 0.0, 0.0), (sx * (trunk / 2 + 0.3), sy * ARM, 0.0)) for sx in (-1, 1) for sy in (-1, 1)
        ]
        parts = [segment_distance(points, *ends) for ends in sides]
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
        sets = level_sets(mesh, values, spacing)
        trees.append(grow_tip_tree(sets, sets.vertex_bands[tips], root))
    return trees


@pytest.fixture(scope="module")
def forks():
    return trees_of(body())


def test_trees_part_where_the_body_does(forks):
    for tree in forks:
        brother = {0: 1, 1: 0, 2: 3, 3: 2}[tree.root]
        others = frozenset(range(4)) - {tree.root, brother}
        assert {branch.tips for branch in tree.branches} == {
            frozenset(range(4)) - {tree.root},
            frozenset({brother}),
            others,
            *(frozenset({tip}) for tip in others),
        }
        near, far = (tree.sets.centers[tree.towards(list(pair)).rings[-1]] for pair in ((brother, *others), others))
        side = -1 if tree.root < 2 else 1
        assert torch.allclose(near, torch.tensor([side * TRUNK / 2, 0, 0], dtype=torch.float64), atol=0.15)
        assert torch.allclose(far, torch.tensor([-side * TRUNK / 2, 0, 0], dtype=torch.float64), atol=0.15)
        assert tree.parting((0, 1, 2)) in partings((frozenset({0}), frozenset({1}), frozenset({2, 3})), tree)


def test_branches_are_chains_of_neighboring_rings(forks):
    for tree in forks:
        for branch in tree.branches:
            centers = tree.sets.centers[branch.rings]
            assert (centers[1:] - centers[:-1]).norm(dim=1).max() < 0.3


def test_two_junctions_far_apart_stay_two_and_near_ones_become_one(forks):
    assert majority_splits(forks) == [frozenset({2, 3})]
    joints = consensus(forks, 2 / 3)
    assert {frozenset(joint) for joint in joints} == {
        frozenset({frozenset({0}), frozenset({1}), frozenset({2, 3})}),
        frozenset({frozenset({2}), frozenset({3}), frozenset({0, 1})}),
    }
    one = consensus(trees_of(body(trunk=0.1), trunk=0.1), 2 / 3)
    assert one == [tuple(frozenset({tip}) for tip in range(4))]
    assert consensus(forks, 100.0) == one


def test_junctions_are_found_in_the_middle(forks):
    for joint in consensus(forks, 2 / 3):
        place, width = locate(joint, forks)
        side = -1 if joint[0] in (frozenset({0}), frozenset({0, 1})) and frozenset({1}) in joint else 1
        assert torch.allclose(place, torch.tensor([side * TRUNK / 2, 0, 0], dtype=torch.float64), atol=0.1)
        assert 0.1 < float(width) < 0.3


def drawn(root, clusters):
    """Return a tree with branches of two rings to each of the clusters, all as long."""
    count = len(clusters) + 1
    rings = LevelSets(
        torch.zeros(count, 3), torch.eye(3).expand(count, 3, 3), *[torch.zeros(count)] * 2, *[torch.zeros(0)] * 3, 1,
        *[torch.zeros(0)] * 2,
    )  # fmt: skip
    return TipTree(root, rings, tuple(Branch(frozenset(tips), torch.tensor([0, 1])) for tips in clusters))


def test_trees_that_contradict_each_other_leave_a_junction_of_higher_degree():
    # Figure 3B of the paper: one tree pairs A with B, the other B with C; each pairing is in half of the trees.
    trees = [drawn(0, [(2, 3)]), drawn(1, [(2, 3)]), drawn(2, [(0, 3)]), drawn(3, [(1, 2)])]
    assert majority_splits(trees) == []
    assert joints_of([], 4) == [tuple(frozenset({tip}) for tip in range(4))]
    assert majority_splits([*trees[:2], drawn(2, [(0, 1)]), trees[3]]) == [frozenset({2, 3})]


def test_joints_of_nested_splits():
    joints = joints_of([frozenset({3, 4}), frozenset({2, 3, 4})], 6)
    assert [sorted(map(sorted, joint)) for joint in joints] == [
        [[0], [1], [2, 3, 4], [5]],
        [[0, 1, 5], [2], [3, 4]],
        [[0, 1, 2, 5], [3], [4]],
    ]
    for joint in joints:
        assert 0 in joint[0]
        assert frozenset().union(*joint) == frozenset(range(6))
        assert all(not one & other for one, other in combinations(joint, 2))


def test_bands_may_be_joined_by_bridges():
    # Two stacks of rings; bands 0-1-2 and 3-4-5, joined between 2 and 3.
    sets = LevelSets(
        centers=torch.zeros(4, 3), covariances=torch.eye(3).expand(4, 3, 3), lengths=torch.ones(4),
        levels=torch.arange(4), lower=torch.tensor([0, 1, 3, 4]), upper=torch.tensor([1, 2, 4, 5]),
        vertex_bands=torch.arange(6), num_bands=6, faces=torch.zeros(0), face_rings=torch.zeros(0),
    )  # fmt: skip
    tree = grow_tip_tree(sets, torch.tensor([0, 5]), 0, torch.tensor([[2, 3]]))
    assert [branch.rings.tolist() for branch in tree.branches] == [[0, 1, 2, 3]]


def test_of_two_ways_around_a_handle_one_is_taken():
    # A ring of bands 0-1-2-3 and back; two rings lead from 2 to 3.
    sets = LevelSets(
        centers=torch.zeros(5, 3), covariances=torch.eye(3).expand(5, 3, 3), lengths=torch.tensor([1.0, 1, 1, 2, 1]),
        levels=torch.arange(5), lower=torch.tensor([0, 1, 2, 2, 0]), upper=torch.tensor([1, 2, 3, 3, 3]),
        vertex_bands=torch.arange(4), num_bands=4, faces=torch.zeros(0), face_rings=torch.zeros(0),
    )  # fmt: skip
    tree = grow_tip_tree(sets, torch.tensor([0, 3]), 0)
    assert [branch.rings.tolist() for branch in tree.branches] == [[4]]
    tree = grow_tip_tree(sets, torch.tensor([1, 3]), 0)
    assert [branch.rings.tolist() for branch in tree.branches] in ([[1, 3]], [[0, 4]])


def test_widths_of_circles_are_their_radii():
    sets = level_sets(body(), body().vertices[:, 0], 0.4)
    middle = int((sets.levels == 0).nonzero()[0])
    assert float(ring_widths(sets)[middle]) == pytest.approx(0.12, rel=0.1)
    assert float(sets.lengths[middle]) == pytest.approx(2 * math.pi * 0.12, rel=0.1)
