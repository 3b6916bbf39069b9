import math

import pytest
import torch

from torchreg.spines.level_sets import LevelSets
from torchreg.spines.limb_curves import Ball, Rings, best_rings, largest_cost, limb_curve
from torchreg.spines.tip_trees import Branch, TipTree


def rings(centers, axes=None, costs=None):
    count = len(centers)
    covariances = torch.eye(3, dtype=torch.float64).expand(count, 3, 3) if axes is None else axes
    return Rings(centers.double(), covariances, torch.zeros(count).double() if costs is None else costs)


def line(count):
    return torch.stack((torch.linspace(0, 1, count), torch.zeros(count), torch.zeros(count)), dim=1)


def tree(root, tips, widths, shift=0.0):
    count = len(widths)
    sets = LevelSets(
        line(count).double() + torch.tensor([0.0, shift, 0.0]),
        torch.tensor(widths, dtype=torch.float64)[:, None, None] ** 2 * torch.eye(3, dtype=torch.float64) / 3,
        *[torch.zeros(count)] * 2, *[torch.zeros(0)] * 3, 1, *[torch.zeros(0)] * 2,
    )  # fmt: skip
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
    start = Ball(torch.tensor([0.0, 0.05, 0.0]).double(), 0.25)
    end = Ball(torch.tensor([0.9, 0.0, 0.0]).double(), 0.15)
    best = best_rings(frozenset({1}), trees, start, end, 1.0)
    assert best.centers[:, 0].tolist() == pytest.approx([0.3, 0.4, 0.5, 0.6, 0.7])
    whole = Ball(torch.tensor([0.5, 0.0, 0.0]).double(), 2.0)
    assert len(best_rings(frozenset({1}), trees, whole, None, 1.0)) == 0


def test_a_limb_that_comes_back_to_its_junction_is_not_cut_short():
    turn = torch.linspace(0, 1.8 * math.pi, 40)
    circle = torch.stack((1 - turn.cos(), turn.sin(), torch.zeros(40)), dim=1)
    sets = LevelSets(
        circle.double(), 0.01 * torch.eye(3).expand(40, 3, 3).double(), *[torch.zeros(40)] * 2,
        *[torch.zeros(0)] * 3, 1, *[torch.zeros(0)] * 2,
    )  # fmt: skip
    trees = [TipTree(0, sets, (Branch(frozenset({1}), torch.arange(40)),)), tree(1, {0}, [1.0])]
    best = best_rings(frozenset({1}), trees, Ball(torch.zeros(3).double(), 0.8), None, 1.0)
    assert len(best) > 30


def test_curves_have_equal_steps_and_keep_their_ends():
    start, end = torch.tensor([-0.5, 0.0, 0.0]).double(), torch.tensor([1.5, 0.0, 0.0]).double()
    points, frames = limb_curve(start, rings(line(30)), end, 0.1)
    steps = (points[1:] - points[:-1]).norm(dim=1)
    assert torch.equal(points[[0, -1]], torch.stack((start, end)))
    assert torch.allclose(steps, torch.full_like(steps, 0.1), rtol=0.02)
    assert torch.allclose(frames @ frames.mT, torch.eye(3, dtype=torch.float64).expand(len(frames), 3, 3))
    assert torch.allclose(frames[:, 0, 2], torch.ones(len(points)).double())
    short, _ = limb_curve(start, rings(line(0)), end, 10.0)
    assert len(short) == 3


def test_first_axes_follow_the_major_axes_of_the_rings_without_jumps():
    # An elliptic tube that twists by 1.5 pi: the axis turns with it, through every sign.
    count = 120
    angle = torch.linspace(0, 1.5 * math.pi, count).double()
    major = torch.stack((0 * angle, angle.cos(), angle.sin()), dim=1)
    minor = torch.stack((0 * angle, -angle.sin(), angle.cos()), dim=1)
    axes = 2 * major[:, :, None] * major[:, None, :] + minor[:, :, None] * minor[:, None, :]
    places = line(count).double()
    points, frames = limb_curve(places[0] - 0.01, rings(places, axes), places[-1] + 0.01, 1 / (count - 1))
    first = frames[:, :, 0]
    assert (first[1:] * first[:-1]).sum(1).min() > 0.97
    nearest = torch.cdist(points, places).argmin(1)
    inner = slice(8, -8)
    assert (first * major[nearest]).sum(1).abs()[inner].min() > 0.98


def test_round_rings_do_not_spin():
    generator = torch.Generator().manual_seed(0)
    noise = 0.02 * torch.randn(50, 3, 3, generator=generator, dtype=torch.float64)
    axes = torch.eye(3, dtype=torch.float64) + noise + noise.mT
    _, frames = limb_curve(line(50)[0].double() - 0.1, rings(line(50), axes), line(50)[-1].double() + 0.1, 0.02)
    first = frames[:, :, 0]
    assert (first[1:] * first[:-1]).sum(1).min() > 0.95
