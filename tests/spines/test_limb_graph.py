"""Trees with labeled tips: splits, graphs and junctions against trees built by hand and at random."""

import pytest
import torch

import torchreg as tr
from tests.geometry.draws import seeded
from tests.spines.bodies import random, shuffled, star_skeleton
from torchreg.spines import labeled_tree
from torchreg.spines.labeled_tree import LimbGraph, place_junctions, skeleton_splits


def splits(*rows):
    return frozenset(frozenset(row) for row in rows)


def random_tree(count, seed):
    """Nodes that each hang on one before it."""
    edges = [[int(torch.randint(0, node, (1,), generator=seeded(100 * seed + node))), node] for node in range(1, count)]
    return tr.Skeleton(random(count, 3, seed=seed), torch.tensor(edges), torch.ones(count))


def dumbbell():
    """Two junctions, 4 and 5, with two tips each; every limb has a node in its middle."""
    ends = torch.tensor([[-1.0, -1, 0], [-1, 1, 0], [2, -1, 0], [2, 1, 0], [0, 0, 0], [1, 0, 0]]).double()
    limbs = torch.tensor([(0, 4), (1, 4), (2, 5), (3, 5), (4, 5)])
    middles = torch.arange(6, 11)
    edges = torch.cat((torch.stack((limbs[:, 0], middles), 1), torch.stack((middles, limbs[:, 1]), 1)))
    return tr.Skeleton(torch.cat((ends, ends[limbs].mean(1))), edges, torch.ones(11))


@pytest.mark.parametrize("seed", range(6))
def test_the_graph_of_a_tree_has_its_splits_and_its_topology(seed):
    tree = random_tree(16, seed)
    labels = list(range(len(tree.tips)))
    graph = LimbGraph(len(labels), skeleton_splits(tree, labels))
    count = len(graph.edges) + 1
    again = tr.Skeleton(torch.randn(count, 3), graph.edges, torch.ones(count))
    assert again.tips.tolist() == labels
    assert skeleton_splits(again, labels) == graph.splits
    assert graph.topology == tree.topology == again.topology
    assert place_junctions(again, labels, graph) == again.junctions.tolist()
    # Splits follow the labels of the tips.
    order = shuffled(len(labels), seed).tolist()
    moved = {frozenset(order[tip] for tip in split) for split in skeleton_splits(tree, labels)}
    relabeled = skeleton_splits(tree, [order.index(label) for label in labels])
    assert relabeled == frozenset(frozenset(labels) - split if 0 in split else split for split in moved)


def test_lengths_along_the_tree_are_sums_of_steps():
    tree = random_tree(12, 3)
    found = labeled_tree.path_lengths(tree, torch.arange(12))
    for start, end in torch.cartesian_prod(torch.arange(12), torch.arange(12)).tolist():
        steps = tree.nodes[tree.path(start, end)].diff(dim=0).norm(dim=-1)
        assert float(found[start, end]) == pytest.approx(float(steps.sum()), abs=1e-9)


def test_junctions_lie_on_those_of_the_tree_and_labels_without_tips_do_no_harm():
    tree, graph = dumbbell(), LimbGraph(4, splits({2, 3}))
    assert graph.edges.tolist() == [[0, 4], [1, 4], [2, 5], [3, 5], [4, 5]]
    for labels, junctions in (([0, 1, 2, 3], [4, 5]), ([1, 0, 3, 2], [4, 5]), ([2, 3, 0, 1], [5, 4])):
        assert place_junctions(tree, labels, graph) == junctions
    assert skeleton_splits(tree, [0, -1, 2, 3]) == frozenset()
    assert place_junctions(tree, [0, 1, 2, -1], graph)[0] == 4
    # One for all lies in the middle of the limb that splits them evenly; one that the tree lacks on the one it has.
    assert place_junctions(tree, [0, 1, 2, 3], LimbGraph(4, frozenset())) == [10]
    assert place_junctions(star_skeleton(random(4, 3)), [0, 1, 2, 3], graph) == [4, 4]
    assert LimbGraph(2, frozenset()).edges.tolist() == [[0, 1]]


def test_the_most_frequent_tree_wins_and_ties_go_to_frequent_splits():
    a, b, c = splits({1, 2}), splits({1, 2}, {3, 4}), splits({2, 3})
    assert labeled_tree.most_frequent_splits([a, b, a, c]) == a
    assert labeled_tree.most_frequent_splits([c, b, a]) == b
