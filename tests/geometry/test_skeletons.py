import math

import networkx
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.geometry.draws import D, randn
from torchreg.geometry.rigid import rigid_matrix, se3_exp
from torchreg.geometry.skeleton import Skeleton, build_skeleton, nearest_rotation, resample_curve

# Two junctions of degree three, four tips: nodes 2 and 4.
EDGES = [(0, 1), (1, 2), (2, 3), (2, 4), (4, 5), (5, 6), (4, 7)]


def figure(edges=EDGES):
    count = 1 + max(max(edge) for edge in edges)
    return Skeleton(randn(count, 3), edges, torch.ones(count))


def contracted(edges):
    graph = networkx.Graph(edges)
    for node in [node for node in graph if graph.degree(node) == 2]:
        graph.add_edge(*graph.neighbors(node))
        graph.remove_node(node)
    return graph


def test_tips_junctions_limbs_and_paths_of_a_tree_drawn_by_hand():
    tree = figure()
    assert len(tree) == 8
    assert tree.tips.tolist() == [0, 3, 6, 7]
    assert tree.junctions.tolist() == [2, 4]
    assert tree.degrees[tree.junctions].tolist() == [3, 3]
    assert [limb.tolist() for limb in tree.limbs] == [[0, 1, 2], [3, 2], [6, 5, 4], [7, 4], [2, 4]]
    assert tree.limb_ends.tolist() == [[0, 2], [3, 2], [6, 4], [7, 4], [2, 4]]
    expected = [sum(math.dist(tree.nodes[a], tree.nodes[b]) for a, b in pair) for pair in [[(0, 1), (1, 2)], [(2, 3)]]]
    assert tree.limb_lengths[:2].tolist() == pytest.approx(expected)
    assert float(tree.length) == pytest.approx(sum(math.dist(tree.nodes[a], tree.nodes[b]) for a, b in EDGES))
    assert tree.path(0, 6).tolist() == [0, 1, 2, 4, 5, 6]
    assert tree.path(3, 3).tolist() == [3]


def test_a_single_node_is_a_tip_without_a_limb():
    point = Skeleton(torch.zeros(1, 3), [], torch.ones(1))
    assert (point.tips.tolist(), point.limbs, point.topology) == ([0], (), "()")
    assert (point.limb_lengths.shape, point.limb_ends.shape) == ((0,), (0, 2))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 10**6), min_size=2, max_size=9), st.randoms(use_true_random=False))
def test_topology_is_equal_exactly_for_isomorphic_trees(numbers, shuffler):
    def tree(values):
        return [(place + 1, value % (place + 1)) for place, value in enumerate(values)]

    first, second = tree(numbers), tree(numbers[::-1])
    same = networkx.is_isomorphic(contracted(first), contracted(second))
    assert (figure(first).topology == figure(second).topology) == same
    names = list(range(len(first) + 1))
    shuffler.shuffle(names)
    assert figure([(names[a], names[b]) for a, b in first]).topology == figure(first).topology


def test_resampled_curves_have_equal_steps_and_keep_their_ends():
    corner = torch.tensor([[0.0, 0, 0], [3, 0, 0], [3, 1, 0]], dtype=D)
    turn = se3_exp(torch.tensor([[0, 0, 0, 0, 0, angle] for angle in (0.0, 1.5, 1.5)], dtype=D))[:, :3, :3]
    points, radii, frames = resample_curve(corner, torch.tensor([1.0, 4.0, 6.0], dtype=D), turn, 5)
    assert torch.allclose(points, torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [3, 1, 0]]).double())
    assert radii.tolist() == pytest.approx([1, 2, 3, 4, 6])
    assert torch.allclose(frames @ frames.mT, torch.eye(3, dtype=D).expand(5, 3, 3))
    assert torch.allclose(frames[[0, 3, 4]], turn)
    curves, radii, frames = (tree := figure()).resample(7)
    assert (curves.shape, radii.shape, frames.shape) == ((5, 7, 3), (5, 7), (5, 7, 3, 3))
    assert torch.allclose(curves[:, [0, -1]], tree.nodes[tree.limb_ends])


def test_resampling_is_differentiable_in_points_and_radii():
    points, radii, eye = randn(4, 3, seed=1), randn(4, seed=2).requires_grad_(), torch.eye(3, dtype=D).expand(4, 3, 3)
    # The positions along the polyline are constant, so only motions that keep the steps in proportion are exact.
    scale = torch.ones((), dtype=D, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s: resample_curve(points * s, radii, eye, 6)[0], scale)
    assert torch.autograd.gradcheck(lambda r: resample_curve(points, r, eye, 6)[1], radii)


def test_nearest_rotation_is_right_handed_also_from_a_mirror():
    matrices = torch.cat((randn(5, 3, 3), -torch.eye(3, dtype=D)[None]))
    turned = nearest_rotation(matrices)
    assert torch.allclose(turned @ turned.mT, torch.eye(3, dtype=D).expand(6, 3, 3))
    assert torch.allclose(torch.linalg.det(turned), torch.ones(6, dtype=D))
    others = se3_exp(randn(200, 6, seed=3))[:, :3, :3]
    gain = torch.einsum("bij,bij->b", turned, matrices)
    assert bool((torch.einsum("nij,bij->bn", others, matrices) <= gain[:, None] + 1e-9).all())


def test_a_motion_with_scale_moves_nodes_radii_and_frames():
    tree, motion = figure(), se3_exp(randn(6, seed=4))
    moved = tree.transformed(rigid_matrix(2 * motion[:3, :3], motion[:3, 3]))
    assert torch.allclose(moved.nodes, 2 * tree.nodes @ motion[:3, :3].mT + motion[:3, 3])
    assert torch.allclose(moved.radii, 2 * tree.radii)
    assert torch.allclose(moved.frames, motion[:3, :3] @ tree.frames)
    assert torch.equal(moved.edges, tree.edges)


def test_limbs_that_share_end_numbers_are_joined():
    ends, hub, eye = randn(5, 2, 3), torch.zeros(3, dtype=D), torch.eye(3).expand(3, 3, 3)
    limbs = [(torch.cat((limb, hub[None])), hub, eye) for limb in ends]
    built = build_skeleton(limbs, [(tip, 42) for tip in range(5)], ["a note"])
    assert (built.topology, len(built), built.notes) == ("(()()()()())", 11, ("a note",))
    assert torch.equal(built.nodes[built.limbs[3]], limbs[3][0])


def test_points_belong_to_the_limb_whose_surface_is_nearest():
    # A cross: four arms of length 2 from a thick middle.
    nodes = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [-1, 0, 0], [-2, 0, 0], [0, 1, 0], [0, 2, 0], [0, -1, 0]])
    edges = torch.tensor([[0, 1], [1, 2], [0, 3], [3, 4], [0, 5], [5, 6], [0, 7]])
    skeleton = Skeleton(nodes, edges, torch.tensor([0.5, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1]))
    found = skeleton.limb_of(torch.tensor([[1.9, 0.2, 0.0], [0.1, 1.4, 0.0], [-3.0, 0.0, 1.0], [0.0, -0.8, 0.0]]))
    assert [int(skeleton.limbs[limb][0]) for limb in found] == [2, 6, 4, 7]
    moved = skeleton.transformed(se3_exp(torch.tensor([1.0, 2.0, 3.0, 0.3, -1.0, 0.4])))
    assert torch.equal(moved.limb_of(moved.nodes[1:]), skeleton.limb_of(nodes[1:]))
