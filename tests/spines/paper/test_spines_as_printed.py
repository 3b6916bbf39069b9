"""Vertex bins, metanodes and rigid fits of the printed spines, each beside a plain search."""

import itertools
import random
from collections import deque

import numpy as np
import pytest
import torch

import torchreg as tr
from tests.spines.bodies import STAR, star_skeleton
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


def parts_of_bins(edges, bins):
    """The connected parts of the bins by breadth-first search."""
    near = {vertex: [] for vertex in range(len(bins))}
    for a, b in edges.tolist():
        near[a].append(b)
        near[b].append(a)
    part, count = [-1] * len(bins), 0
    for start in range(len(bins)):
        if part[start] >= 0:
            continue
        waiting, part[start] = deque([start]), count
        while waiting:
            vertex = waiting.popleft()
            for other in near[vertex]:
                if part[other] < 0 and bins[other] == bins[vertex]:
                    part[other] = count
                    waiting.append(other)
        count += 1
    return part


def test_bands_are_the_connected_parts_of_bins(dumbbell):
    mesh, _, values = dumbbell
    found = vertex_level_sets(mesh, values, 0.25)
    bins = (values / 0.25).floor().long().tolist()
    expected = parts_of_bins(mesh.edges, bins)
    pairs = set(zip(found.vertex_bands.tolist(), expected, strict=True))
    assert len(pairs) == found.num_bands == max(expected) + 1


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


def random_tree(tips, generator):
    """A tree with labeled tips as neighbors by node; inner nodes are negative."""
    near = {-1: list(range(3)), 0: [-1], 1: [-1], 2: [-1]}
    for tip in range(3, tips):
        inner = [node for node in near if node < 0]
        if generator.random() < 0.4:
            joint = generator.choice(inner)
        else:
            a = generator.choice(list(near))
            b = generator.choice(near[a])
            joint = -len(inner) - 1
            near[joint] = [a, b]
            near[a][near[a].index(b)] = joint
            near[b][near[b].index(a)] = joint
        near[joint].append(tip)
        near[tip] = [joint]
    return near


def beyond(near, start, first):
    """The tips behind the limb from a node to its neighbor."""
    seen, waiting = {start, first}, [first]
    while waiting:
        for node in near[waiting.pop()]:
            if node not in seen:
                seen.add(node)
                waiting.append(node)
    return frozenset(node for node in seen - {start} if node >= 0)


def as_tip_tree(near, root):
    branches = [
        Branch(beyond(near, a, b), torch.arange(3)) for a in near for b in near[a] if root not in beyond(near, a, b)
    ]
    return TipTree(root, None, tuple(branches))


def merged_by_walking(trees):
    """Figure 3B: branch nodes next to a tip are one supernode, those that share a node one metanode."""
    parent = {(tree, node): (tree, node) for tree, near in enumerate(trees) for node in near if node < 0}

    def top(node):
        while parent[node] != node:
            node = parent[node]
        return node

    def path(near, start, end):
        before, waiting = {start: None}, deque([start])
        while waiting:
            node = waiting.popleft()
            for other in near[node]:
                if other not in before:
                    before[other] = node
                    waiting.append(other)
        row = [end]
        while before[row[-1]] is not None:
            row.append(before[row[-1]])
        return row

    for tip in range(sum(node >= 0 for node in trees[0])):
        for tree, near in enumerate(trees):
            parent[top((tree, near[tip][0]))] = top((0, trees[0][tip][0]))
    changed = True
    while changed:
        changed = False
        for tree, near in enumerate(trees):
            for a, b in itertools.combinations([node for node in near if node < 0], 2):
                if top((tree, a)) == top((tree, b)):
                    for node in path(near, a, b):
                        if top((tree, node)) != top((tree, a)):
                            parent[top((tree, node))] = top((tree, a))
                            changed = True
    near = trees[0]
    limbs = [(a, b) for a in near for b in near[a] if a < 0 and b < 0 and top((0, a)) != top((0, b))]
    return {side for a, b in limbs if 0 not in (side := beyond(near, a, b))}


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
    red = {-1: [0, 1, -2], -2: [-1, 2, 3], 0: [-1], 1: [-1], 2: [-2], 3: [-2]}
    green = {-1: [0, 2, -2], -2: [-1, 1, 3], 0: [-1], 2: [-1], 1: [-2], 3: [-2]}
    trees = [as_tip_tree(near, root) for root, near in enumerate((red, red, green, green))]
    assert len(metanode_junctions(trees)) == 1
    assert len(metanode_junctions([as_tip_tree(red, root) for root in range(4)])) == 2


def kabsch_error(a, b):
    a, b = a - a.mean(0), b - b.mean(0)
    u, s, vt = np.linalg.svd(a.T @ b)
    s[-1] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))
    return float((a**2).sum() + (b**2).sum() - 2 * s.sum())


def test_tips_are_mapped_by_the_least_rigid_error():
    generator = torch.Generator().manual_seed(0)
    base = torch.randn(5, 3, generator=generator)
    order = [torch.randperm(5, generator=generator) for _ in range(6)]
    frames = [base[row] + 0.05 * torch.randn(5, 3, generator=generator) for row in order]
    labels, reference = track_tips_rigidly([star_skeleton(tips) for tips in frames])
    assert reference == 2
    known = frames[reference].double().numpy()
    for tips, row in zip(frames, labels, strict=True):
        errors = {
            trial: kabsch_error(known, tips.double().numpy()[list(trial)]) for trial in itertools.permutations(range(5))
        }
        assert tuple(row.tolist()) == min(errors, key=errors.get)


def test_a_superfluous_tip_gets_no_name_and_a_missing_one_is_told():
    base = torch.randn(4, 3, generator=torch.Generator().manual_seed(1))
    more = torch.cat((base, torch.tensor([[0.1, 0.1, 0.2]])))
    labels, _ = track_tips_rigidly([star_skeleton(tips) for tips in (base, base, more, base, base[:3])])
    assert labels[2].tolist() == [0, 1, 2, 3]
    assert labels[4].tolist() == [0, 1, 2, -1]


def test_a_number_of_tips_that_no_frame_has_is_refused():
    with pytest.raises(tr.errors.InputError, match="num_tips must be what a frame shows, 4 at most, got 7"):
        track_tips_rigidly([star_skeleton(torch.eye(4, 3))], 7)


def test_a_starfish_has_five_arms_that_keep_their_names(starfish):
    spine = tr.extract_spine(starfish.meshes[:4], config=tr.SpineConfig.paper(), workers=1)
    assert spine.own_topologies == (STAR,) * 4
    assert spine.found.all()
    assert tr.SpineConfig.paper(num_samples=12).num_samples == 12
