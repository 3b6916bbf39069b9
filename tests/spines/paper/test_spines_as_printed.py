"""Vertex bins, metanodes and rigid fits of the printed spines, each beside a plain search."""

import itertools
import random

import networkx
import numpy as np
import pytest
import torch

import torchreg as tr
from tests.geometry.draws import randn
from tests.spines.bodies import STAR, shuffled, star_skeleton
from torchreg.geometry.mesh import unit_sphere
from torchreg.spines.labeled_tree import junctions_from_splits
from torchreg.spines.paper.metanodes import metanode_junctions
from torchreg.spines.paper.rigid_tracking import track_tips_rigidly
from torchreg.spines.paper.vertex_level_sets import vertex_level_sets
from torchreg.spines.skeleton.level_sets import MeshEdges
from torchreg.spines.skeleton.tip_trees import Branch, TipTree


@pytest.fixture(scope="module")
def dumbbell():
    """A ball with two bumps: level sets of the height above its equator fall into two parts."""
    ball = unit_sphere(4)
    vertices = ball.vertices.double()
    lobed = vertices * (1 + 0.8 * vertices[:, :1].square())
    return MeshEdges(tr.TriangleMesh(lobed, ball.faces)), lobed, lobed[:, 2].abs() + 0.1 * lobed[:, 0].abs()


def random_tree(tips, generator):
    """A tree with labeled tips; inner nodes are negative."""
    near = networkx.Graph([(-1, tip) for tip in range(3)])
    for tip in range(3, tips):
        inner = [node for node in near if node < 0]
        if generator.random() < 0.4:
            joint = generator.choice(inner)
        else:
            a, b = generator.choice(list(near.edges))
            joint = -len(inner) - 1
            near.remove_edge(a, b)
            near.add_edges_from([(a, joint), (joint, b)])
        near.add_edge(joint, tip)
    return near


def beyond(near, start, first):
    """The tips behind the limb from a node to its neighbor."""
    cut = near.copy()
    cut.remove_edge(start, first)
    return frozenset(node for node in networkx.node_connected_component(cut, first) if node >= 0)


def as_tip_tree(near, root):
    limbs = [beyond(near, *ends) for edge in near.edges for ends in (edge, edge[::-1])]
    return TipTree(root, None, tuple(Branch(tips, torch.arange(3)) for tips in limbs if root not in tips))


def merged_by_walking(trees):
    """Figure 3B: branch nodes next to a tip are one supernode, those that share a node one metanode."""
    joined = networkx.Graph()
    joined.add_nodes_from((tree, node) for tree, near in enumerate(trees) for node in near if node < 0)
    for tip in range(sum(node >= 0 for node in trees[0])):
        nexts = [(tree, next(iter(near[tip]))) for tree, near in enumerate(trees)]
        joined.add_edges_from(itertools.pairwise(nexts))
    changed = True
    while changed:
        before, parts = joined.number_of_edges(), list(networkx.connected_components(joined))
        for tree, near in enumerate(trees):
            for part in parts:
                for a, b in itertools.combinations([node for owner, node in part if owner == tree], 2):
                    path = [(tree, node) for node in networkx.shortest_path(near, a, b)]
                    joined.add_edges_from(itertools.pairwise(path))
        changed = joined.number_of_edges() > before
    near, part = trees[0], {node: k for k, nodes in enumerate(networkx.connected_components(joined)) for node in nodes}
    limbs = [ends for edge in near.edges if max(edge) < 0 for ends in (edge, edge[::-1])]
    limbs = [(a, b) for a, b in limbs if part[0, a] != part[0, b]]
    return {side for a, b in limbs if 0 not in (side := beyond(near, a, b))}


def test_bands_are_the_connected_parts_of_bins(dumbbell):
    mesh, _, values = dumbbell
    found = vertex_level_sets(mesh, values, 0.25)
    bins = (values / 0.25).floor().long().tolist()
    graph = networkx.empty_graph(len(bins))
    graph.add_edges_from((a, b) for a, b in mesh.edges.tolist() if bins[a] == bins[b])
    parts = list(networkx.connected_components(graph))
    expected = {vertex: number for number, part in enumerate(parts) for vertex in part}
    pairs = {(band, expected[vertex]) for vertex, band in enumerate(found.vertex_bands.tolist())}
    assert len(pairs) == found.num_bands == len(parts)


def test_nodes_are_means_of_vertices_and_cost_by_equation_4(dumbbell):
    mesh, vertices, values = dumbbell
    found = vertex_level_sets(mesh, values, 0.1)
    for ring in range(0, len(found), 7):
        own = vertices[found.vertex_bands == found.upper[ring]]
        assert torch.allclose(found.centers[ring], own.mean(0))
        singular = np.linalg.svd((own - own.mean(0)).numpy(), compute_uv=False)
        assert float(found.widths[ring]) ** 2 == pytest.approx(float((singular**2).sum()) / len(own))
        assert int(found.lower[ring]) != int(found.upper[ring])
    assert bool(values[found.vertex_bands == found.upper[0]].min() > 0)


def test_bins_are_never_narrower_than_most_edges(dumbbell):
    mesh, vertices, values = dumbbell
    found = vertex_level_sets(mesh, values, 1e-6)
    assert found.num_bands < len(vertices) / 4


@pytest.mark.parametrize("tips", [4, 5])
def test_metanodes_are_those_of_walking_inward_from_the_tips(tips):
    """With up to five tips every branch node is next to one, so that one walk reaches all."""
    generator, kept = random.Random(0), 0
    for _ in range(300):
        base = random_tree(tips, generator)
        trees = [base if generator.random() < 0.6 else random_tree(tips, generator) for _ in range(tips)]
        splits = merged_by_walking(trees)
        found = metanode_junctions([as_tip_tree(near, root) for root, near in enumerate(trees)])
        assert found == junctions_from_splits(splits, tips)
        kept += len(splits)
    assert kept > 20


def test_two_different_pairs_of_three_way_junctions_are_one_of_four_limbs():
    """The paper's figure 3B."""
    red, green = (networkx.Graph([(-1, 0), (-1, a), (-1, -2), (-2, b), (-2, 3)]) for a, b in ((1, 2), (2, 1)))
    trees = [as_tip_tree(near, root) for root, near in enumerate((red, red, green, green))]
    assert len(metanode_junctions(trees)) == 1
    assert len(metanode_junctions([as_tip_tree(red, root) for root in range(4)])) == 2


def kabsch_error(a, b):
    a, b = a - a.mean(0), b - b.mean(0)
    u, s, vt = np.linalg.svd(a.T @ b)
    s[-1] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))
    return float((a**2).sum() + (b**2).sum() - 2 * s.sum())


def test_tips_are_mapped_by_the_least_rigid_error():
    base = randn(5, 3, dtype=torch.float32)
    frames = [base[shuffled(5, k)] + 0.05 * randn(5, 3, seed=k, dtype=torch.float32) for k in range(6)]
    labels, reference = track_tips_rigidly([star_skeleton(tips) for tips in frames])
    assert reference == 2
    known, orders = frames[reference].double().numpy(), list(itertools.permutations(range(5)))
    for tips, row in zip(frames, labels, strict=True):
        errors = {order: kabsch_error(known, tips.double().numpy()[list(order)]) for order in orders}
        assert tuple(row.tolist()) == min(errors, key=errors.get)


def test_a_superfluous_tip_gets_no_name_and_a_missing_one_is_reported():
    base = randn(4, 3, seed=1, dtype=torch.float32)
    more = torch.cat((base, torch.tensor([[0.1, 0.1, 0.2]])))
    labels, _ = track_tips_rigidly([star_skeleton(tips) for tips in (base, base, more, base, base[:3])])
    assert labels[2].tolist() == [0, 1, 2, 3]
    assert labels[4].tolist() == [0, 1, 2, -1]
    with pytest.raises(tr.errors.InputError, match="num_tips must be what a frame shows, 4 at most, got 7"):
        track_tips_rigidly([star_skeleton(torch.eye(4, 3))], 7)


def test_a_starfish_has_five_arms_that_keep_their_names(starfish):
    spine = tr.extract_spine(starfish.meshes[:4], config=tr.SpineConfig.paper(), workers=1)
    assert spine.own_topologies == (STAR,) * 4
    assert spine.found.all()
    assert tr.SpineConfig.paper(num_samples=12).num_samples == 12
