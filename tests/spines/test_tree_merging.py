"""Trees of rings merged into limbs: the junctions on which they agree, the best rings of each limb, its frames."""

import math

import pytest
import torch

import torchreg as tr
from tests.spines.bodies import circle, line, random, tube
from torchreg.spines.labeled_tree import junctions_from_splits
from torchreg.spines.skeleton import tip_trees
from torchreg.spines.skeleton.level_sets import LevelSets
from torchreg.spines.skeleton.limb_curves import JunctionBall, Rings, best_rings, largest_cost, limb_curve
from torchreg.spines.skeleton.tip_trees import Branch, TipTree, grow_tip_tree


@pytest.mark.parametrize(("trunk", "degrees"), [(1.2, [3, 3]), (0.1, [4])])
def test_two_junctions_far_apart_stay_two_and_near_ones_become_one(trunk, degrees):
    # A letter H that lies down: two forks, joined by a trunk along x.
    forks = [line([x * trunk / 2, 0, 0], [x * (trunk / 2 + 0.3), y, 0]) for x in (-1, 1) for y in (-0.4, 0.4)]
    found = tr.skeletonize(tube(torch.cat([*forks, line([-trunk / 2, 0, 0], [trunk / 2, 0, 0])]), 0.12, 0.06))
    assert found.degrees[found.junctions].tolist() == degrees
    wanted = [[-trunk / 2, 0, 0], [trunk / 2, 0, 0]] if len(degrees) == 2 else [[0.0, 0, 0]]
    junctions = found.nodes[found.junctions]
    torch.testing.assert_close(junctions[junctions[:, 0].argsort()], torch.tensor(wanted).double(), atol=0.1, rtol=0)
    ends = torch.stack([fork[-1] for fork in forks])
    assert float(torch.cdist(ends, found.nodes[found.tips]).amin(1).max()) < 0.2
    assert float(found.radii[found.limbs[-1]].median()) == pytest.approx(0.12, rel=0.2 if len(degrees) == 2 else 1)
    for limb in found.limbs:
        steps = (found.nodes[limb[1:]] - found.nodes[limb[:-1]]).norm(dim=1)
        assert bool(((steps > 0.5 * steps.mean()) & (steps < 1.6 * steps.mean())).all())


def chain(centers, covariances, lengths=None, lower=None, upper=None):
    """Rings that separate bands 0, 1, 2, ... from the next, if nothing else is given."""
    count = len(centers)
    lower = torch.arange(count) if lower is None else torch.tensor(lower)
    upper = torch.arange(1, count + 1) if upper is None else torch.tensor(upper)
    bands, none = int(torch.cat((lower, upper)).max()) + 1, torch.zeros(0)
    lengths = torch.ones(count) if lengths is None else lengths
    levels, vertices = torch.arange(count), torch.arange(bands)
    return LevelSets(centers, covariances, lengths, levels, lower, upper, vertices, bands, none, none)


def drawn(root, clusters):
    """A tree with branches of two rings to each of the clusters, all as long."""
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
        [[0], [1], [2, 3, 4], [5]], [[0, 1, 5], [2], [3, 4]], [[0, 1, 2, 5], [3], [4]],
    ]  # fmt: skip
    assert all(0 in junction[0] for junction in junctions)


def test_bands_may_be_joined_by_bridges_and_of_two_paths_around_a_handle_the_shorter_is_taken():
    # Two stacks of rings; bands 0-1-2 and 3-4-5, joined between 2 and 3.
    eye = torch.eye(3)
    sets = chain(torch.zeros(4, 3), eye.expand(4, 3, 3), lower=[0, 1, 3, 4], upper=[1, 2, 4, 5])
    tree = grow_tip_tree(sets, torch.tensor([0, 5]), 0, torch.tensor([[2, 3]]))
    assert [branch.rings.tolist() for branch in tree.branches] == [[0, 1, 2, 3]]
    # A ring of bands 0-1-2-3 and back; two rings lead from 2 to 3.
    lengths = torch.tensor([1.0, 1, 1, 2, 1])
    sets = chain(torch.zeros(5, 3), eye.expand(5, 3, 3), lengths, lower=[0, 1, 2, 2, 0], upper=[1, 2, 3, 3, 3])
    for start, paths in ((0, ([[4]],)), (1, ([[1, 3]], [[0, 4]]))):
        tree = grow_tip_tree(sets, torch.tensor([start, 3]), 0)
        assert [branch.rings.tolist() for branch in tree.branches] in paths


def rings(centers, axes):
    return Rings(centers, axes, torch.zeros(len(centers)).double())


AXIS = line([0.0, 0, 0], [1.0, 0, 0], 50)


def tree(root, tips, widths, shift=0.0):
    count = len(widths)
    covariances = torch.tensor(widths, dtype=torch.float64)[:, None, None] ** 2 * torch.eye(3, dtype=torch.float64) / 3
    sets = chain(line([0.0, shift, 0], [1.0, shift, 0], count), covariances)
    return TipTree(root, sets, (Branch(frozenset(tips), torch.arange(count)),))


def test_the_version_with_the_best_quality_is_taken_without_rings_in_the_balls_at_its_ends():
    trees = [tree(0, {1}, [1.0] * 8), tree(1, {0}, [0.5] * 8, shift=0.1)]
    assert largest_cost(trees) == pytest.approx(1.0)
    # Q = N - sum C: 8 (1 - 1) and 8 (1 - 1/4).
    best = best_rings(frozenset({1}), trees, None, None, 1.0)
    assert best.quality == pytest.approx(6.0)
    assert torch.allclose(best.centers[:, 1], torch.full((8,), 0.1).double())
    # That tree grew from the other end.
    assert best.centers[0, 0] == 1.0
    assert len(best_rings(frozenset({0, 1}), trees, None, None, 1.0)) == 0
    trees = [tree(0, {1}, [0.1] * 11), tree(1, {0}, [1.0] * 11)]
    start, end = ball(0.25, 0.0, 0.05), ball(0.15, 0.9)
    best = best_rings(frozenset({1}), trees, start, end, 1.0)
    assert best.centers[:, 0].tolist() == pytest.approx([0.3, 0.4, 0.5, 0.6, 0.7])
    assert len(best_rings(frozenset({1}), trees, ball(2.0, 0.5), None, 1.0)) == 0


def ball(radius, x=0.0, y=0.0):
    return JunctionBall(torch.tensor([x, y, 0.0]).double(), radius)


def test_a_limb_that_comes_back_to_its_junction_is_not_cut_short():
    ring = circle(count=40, turn=(0.5, 1.4)) + torch.tensor([1.0, 0.0, 0.0])
    sets = chain(ring, 0.01 * torch.eye(3).expand(40, 3, 3).double())
    trees = [TipTree(0, sets, (Branch(frozenset({1}), torch.arange(40)),)), tree(1, {0}, [1.0])]
    assert len(best_rings(frozenset({1}), trees, ball(0.8), None, 1.0)) > 30


def test_first_axes_follow_the_major_axes_of_the_rings_without_jumps_and_do_not_spin_on_round_ones():
    # An elliptic tube that twists by 1.5 pi: the axis turns with it, through every sign.
    angle = torch.linspace(0, 1.5 * math.pi, 50).double()
    major = torch.stack((0 * angle, angle.cos(), angle.sin()), dim=1)
    minor = torch.stack((0 * angle, -angle.sin(), angle.cos()), dim=1)
    axes = 2 * major[:, :, None] * major[:, None, :] + minor[:, :, None] * minor[:, None, :]
    points, frames = limb_curve(AXIS[0] - 0.01, rings(AXIS, axes), AXIS[-1] + 0.01, 0.02)
    first = frames[:, :, 0]
    assert (first[1:] * first[:-1]).sum(1).min() > 0.97
    assert (first * major[torch.cdist(points, AXIS).argmin(1)]).sum(1).abs()[8:-8].min() > 0.98
    noise = 0.02 * random(50, 3, 3)
    _, frames = limb_curve(AXIS[0] - 0.1, rings(AXIS, torch.eye(3).double() + noise + noise.mT), AXIS[-1] + 0.1, 0.02)
    assert (frames[1:, :, 0] * frames[:-1, :, 0]).sum(1).min() > 0.95
