"""Rigid fits from sums: against fits of the points themselves, joined groups, mirror images, far origins, batches."""

import torch

from torchreg.geometry.rigid import fit_rigid, se3_exp, transform_points
from torchreg.geometry.rigid_moments import least_cost, rigid_moments


def matches(count=60, seed=0, noise=0.1):
    generator = torch.Generator().manual_seed(seed)
    source = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    motion = se3_exp(torch.randn(6, generator=generator, dtype=torch.float64))
    target = transform_points(motion, source) + noise * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    weights = torch.rand(count, generator=generator, dtype=torch.float64)
    return source, target, weights, torch.arange(count) % 3


def test_costs_and_motions_are_those_of_a_fit_to_the_points():
    source, target, weights, labels = matches()
    moments = rigid_moments(source, target, weights, labels, 3)
    assert moments.num_groups == 3
    for label, motion in enumerate(moments.motions()):
        own = labels == label
        expected = fit_rigid(source[own], target[own], weights[own])
        torch.testing.assert_close(motion, expected)
        squares = (transform_points(expected, source[own]) - target[own]).square().sum(-1)
        torch.testing.assert_close(moments.cost()[label], (weights[own] * squares).sum())
        torch.testing.assert_close(moments.mass[label], weights[own].sum())


def test_joined_groups_are_groups_of_all_their_points():
    source, target, weights, labels = matches()
    joined = rigid_moments(source, target, weights, labels, 3).joined(torch.tensor([1, 0, 1]), 2)
    direct = rigid_moments(source, target, weights, (labels != 1).long(), 2)
    torch.testing.assert_close(joined.cost(), direct.cost())
    torch.testing.assert_close(joined.motions(), direct.motions())


def test_no_mirror_image_is_a_motion():
    source, _, weights, labels = matches()
    moments = rigid_moments(source, source * torch.tensor([1.0, 1.0, -1.0]), weights, labels, 3)
    torch.testing.assert_close(torch.linalg.det(moments.motions()[:, :3, :3]), torch.ones(3, dtype=torch.float64))
    for label in range(3):
        own = labels == label
        moved = transform_points(moments.motions()[label], source[own])
        squares = (moved - source[own] * torch.tensor([1.0, 1.0, -1.0])).square().sum(-1)
        torch.testing.assert_close(moments.cost()[label], (weights[own] * squares).sum())


def test_far_origins_lose_no_digits():
    source, target, weights, labels = matches(noise=0.0)
    moments = rigid_moments(source + 1e6, target - 1e6, weights, labels, 3)
    assert float(moments.cost().max()) < 1e-6
    moved = transform_points(moments.motions()[0], source + 1e6)
    torch.testing.assert_close(moved[labels == 0], (target - 1e6)[labels == 0], atol=1e-6, rtol=0)


def test_a_group_without_points_stays_and_costs_nothing():
    source, target, weights, labels = matches()
    moments = rigid_moments(source, target, weights, labels, 4)
    torch.testing.assert_close(moments.motions()[3], torch.eye(4, dtype=torch.float64))
    assert float(moments.cost()[3]) == 0


def test_a_batch_is_a_loop():
    source, target, weights, labels = matches()
    other, heavy = target.flip(0), weights.flip(0)
    both = rigid_moments(source, torch.stack([target, other]), torch.stack([weights, heavy]), labels, 3)
    for row, (place, weight) in enumerate(((target, weights), (other, heavy))):
        single = rigid_moments(source, place, weight, labels, 3)
        torch.testing.assert_close(both.cost()[row], single.cost())
        torch.testing.assert_close(both.motions()[row], single.motions())
        torch.testing.assert_close(
            both.joined(torch.zeros(3).long(), 1).cost()[row], single.joined(torch.zeros(3).long(), 1).cost()
        )


def test_costs_are_differentiable():
    source, target, weights, labels = matches(12)
    assert torch.autograd.gradcheck(
        lambda x, y, w: least_cost(rigid_moments(x, y, w, labels, 3).sums),
        [value.requires_grad_() for value in (source, target, weights)],
    )
