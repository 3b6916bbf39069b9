"""Trees with labeled tips: splits, graphs and junctions against trees built by hand and at random."""

from itertools import pairwise

import pytest
import torch

from torchreg.geometry.skeleton import Skeleton
from torchreg.spines.labeled_tree import (
    LimbGraph,
    most_frequent_splits,
    path_lengths,
    place_junctions,
    skeleton_splits,
)


def splits(*rows):
    return frozenset(frozenset(row) for row in rows)


def random_tree(count, seed):
    """Nodes that each hang on one before it."""
    generator = torch.Generator().manual_seed(seed)
    parents = [int(torch.randint(0, node, (1,), generator=generator)) for node in range(1, count)]
    edges = torch.tensor([[parent, node] for node, parent in enumerate(parents, start=1)])
    nodes = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return Skeleton(nodes, edges, torch.ones(count))


def dumbbell(inner=1.0):
    """Two junctions, 4 and 5, with two tips each; every limb has a node in its middle."""
    ends = torch.tensor([[-1.0, -1, 0], [-1, 1, 0], [1 + inner, -1, 0], [1 + inner, 1, 0], [0, 0, 0], [inner, 0, 0]])
    limbs = [(0, 4), (1, 4), (2, 5), (3, 5), (4, 5)]
    middles = torch.stack([0.5 * (ends[a] + ends[b]) for a, b in limbs])
    edges = [pair for k, (a, b) in enumerate(limbs) for pair in pairwise((a, 6 + k, b))]
    nodes = torch.cat((ends, middles)).double()
    return Skeleton(nodes, torch.tensor(edges), torch.ones(len(nodes)))


@pytest.mark.parametrize("seed", range(6))
def test_the_graph_of_a_tree_has_its_splits_and_its_topology(seed):
    tree = random_tree(16, seed)
    labels = list(range(len(tree.tips)))
    graph = LimbGraph(len(labels), skeleton_splits(tree, labels))
    count = len(graph.edges) + 1
    again = Skeleton(torch.randn(count, 3), graph.edges, torch.ones(count))
    assert again.tips.tolist() == labels
    assert skeleton_splits(again, labels) == graph.splits
    assert graph.topology == tree.topology == again.topology
    assert place_junctions(again, labels, graph) == again.junctions.tolist()


@pytest.mark.parametrize("seed", range(3))
def test_splits_follow_the_labels_of_the_tips(seed):
    tree = random_tree(14, seed)
    count = len(tree.tips)
    order = torch.randperm(count, generator=torch.Generator().manual_seed(seed)).tolist()
    labels = [order.index(label) for label in range(count)]
    plain, relabeled = skeleton_splits(tree, list(range(count))), skeleton_splits(tree, labels)
    every = frozenset(range(count))
    moved = {frozenset(order[tip] for tip in split) for split in plain}
    assert relabeled == frozenset(every - split if 0 in split else split for split in moved)


def test_lengths_along_the_tree_are_sums_of_steps():
    tree = random_tree(12, 3)
    found = path_lengths(tree, torch.arange(12))
    for start in range(12):
        for end in range(12):
            path = tree.nodes[tree.path(start, end)]
            assert float(found[start, end]) == pytest.approx(float((path[1:] - path[:-1]).norm(dim=-1).sum()), abs=1e-9)


def test_junctions_lie_on_those_of_the_tree_and_labels_without_tips_do_no_harm():
    tree, graph = dumbbell(), LimbGraph(4, splits({2, 3}))
    assert graph.edges.tolist() == [[0, 4], [1, 4], [2, 5], [3, 5], [4, 5]]
    assert place_junctions(tree, [0, 1, 2, 3], graph) == [4, 5]
    assert place_junctions(tree, [1, 0, 3, 2], graph) == [4, 5]
    assert place_junctions(tree, [2, 3, 0, 1], graph) == [5, 4]
    assert skeleton_splits(tree, [0, -1, 2, 3]) == frozenset()
    assert place_junctions(tree, [0, 1, 2, -1], graph)[0] == 4


def test_one_junction_for_all_lies_in_the_middle_of_a_limb_that_splits_them_evenly():
    assert place_junctions(dumbbell(), [0, 1, 2, 3], LimbGraph(4, frozenset())) == [10]


def test_a_junction_that_the_tree_lacks_falls_on_the_one_it_has():
    star = Skeleton(
        torch.randn(5, 3, dtype=torch.float64), torch.tensor([[0, 4], [1, 4], [2, 4], [3, 4]]), torch.ones(5)
    )
    assert place_junctions(star, [0, 1, 2, 3], LimbGraph(4, splits({2, 3}))) == [4, 4]


def test_two_tips_make_one_limb():
    graph = LimbGraph(2, frozenset())
    assert graph.edges.tolist() == [[0, 1]]
    assert graph.branches == ()
    assert LimbGraph(5, frozenset()).topology == "(()()()()())"


def test_the_most_frequent_tree_wins_and_ties_go_to_frequent_splits():
    a, b, c = splits({1, 2}), splits({1, 2}, {3, 4}), splits({2, 3})
    assert most_frequent_splits([a, b, a, c]) == a
    assert most_frequent_splits([c, b, a]) == b
