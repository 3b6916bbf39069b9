"""Trees with named tips: splits, graphs and junctions against trees built by hand and at random."""

from itertools import pairwise

import pytest
import torch

from torchreg.errors import InputError
from torchreg.geometry.skeleton import Skeleton
from torchreg.spines.labeled_tree import (
    LimbGraph,
    consensus,
    fit_together,
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
    named = list(range(len(tree.tips)))
    graph = LimbGraph(len(named), skeleton_splits(tree, named))
    count = len(graph.edges) + 1
    again = Skeleton(torch.randn(count, 3), graph.edges, torch.ones(count))
    assert again.tips.tolist() == named
    assert skeleton_splits(again, named) == graph.splits
    assert graph.topology == tree.topology == again.topology
    assert place_junctions(again, named, graph) == again.junctions.tolist()


@pytest.mark.parametrize("seed", range(3))
def test_renaming_tips_renames_splits(seed):
    tree = random_tree(14, seed)
    count = len(tree.tips)
    order = torch.randperm(count, generator=torch.Generator().manual_seed(seed)).tolist()
    named = [order.index(name) for name in range(count)]  # tip number order[k] has the name... k is at order[k]
    plain, renamed = skeleton_splits(tree, list(range(count))), skeleton_splits(tree, named)
    every = frozenset(range(count))
    moved = {frozenset(order[tip] for tip in split) for split in plain}
    assert renamed == frozenset(every - split if 0 in split else split for split in moved)


def test_lengths_along_the_tree_are_sums_of_steps():
    tree = random_tree(12, 3)
    found = path_lengths(tree, torch.arange(12))
    for start in range(12):
        for end in range(12):
            path = tree.nodes[tree.path(start, end)]
            assert float(found[start, end]) == pytest.approx(float((path[1:] - path[:-1]).norm(dim=-1).sum()), abs=1e-9)


def test_junctions_lie_on_those_of_the_tree_and_names_without_tips_do_no_harm():
    tree, graph = dumbbell(), LimbGraph(4, splits({2, 3}))
    assert graph.edges.tolist() == [[0, 4], [1, 4], [2, 5], [3, 5], [4, 5]]
    assert place_junctions(tree, [0, 1, 2, 3], graph) == [4, 5]
    assert place_junctions(tree, [1, 0, 3, 2], graph) == [4, 5]
    assert place_junctions(tree, [2, 3, 0, 1], graph) == [5, 4]
    assert skeleton_splits(tree, [0, -1, 2, 3]) == frozenset()
    assert place_junctions(tree, [0, 1, 2, -1], graph)[0] == 4


def test_one_junction_for_all_lies_in_the_middle_of_a_limb_that_parts_them_evenly():
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
    assert consensus([a, b, a, c]) == a
    assert consensus([c, b, a]) == b
    with pytest.raises(InputError, match="rows must hold"):
        consensus([])


def test_splits_that_cross_do_not_fit():
    assert fit_together(frozenset({1, 2}), frozenset({3, 4}))
    assert fit_together(frozenset({1, 2}), frozenset({1, 2, 3}))
    assert not fit_together(frozenset({1, 2}), frozenset({2, 3}))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: LimbGraph(1, frozenset()), "num_tips must be at least 2"),
        (lambda: LimbGraph(5, splits({0, 1})), "splits must hold 2 to 3"),
        (lambda: LimbGraph(5, splits({1})), "splits must hold 2 to 3"),
        (lambda: LimbGraph(5, splits({1, 2}, {2, 3})), r"\[1, 2\] and \[2, 3\] do not|\[2, 3\] and \[1, 2\] do not"),
        (lambda: skeleton_splits(dumbbell(), [0, 0, 1]), "named must hold different tips"),
        (lambda: skeleton_splits(dumbbell(), [4]), "named must hold different tips from 0 to 3"),
        (lambda: place_junctions(dumbbell(), [0, 1], LimbGraph(4, frozenset())), "one entry per tip"),
        (lambda: place_junctions(dumbbell(), [-1] * 4, LimbGraph(4, frozenset())), "named must give one tip"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(InputError, match=message):
        call()
