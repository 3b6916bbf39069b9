"""Every stage of an alignment works in centered coordinates, within limits, with a prior and one cost."""

import math
from dataclasses import replace

import pytest
import torch

import torchreg as tr
from tests.alignment.made import generator, joint, problem_of, shape_of, solid
from torchreg.alignment.fit.problem import alignment_cost


@pytest.fixture(scope="module")
def machine():
    """A bolted mast with a ball joint, a slide and a hinge behind one another."""
    x, y, z = (("revolute", axis, -1.0, 1.0) for axis in ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0)))
    joints = [
        joint("mast", -1), joint("ball_x", 0, (0, 0, 0.2), *x), joint("ball_y", 1, (0, 0, 0), *y),
        joint("ball_z", 2, (0, 0, 0), *z), joint("hinge", 4, (0, 0, 0.2), *x),
    ]  # fmt: skip
    joints.insert(4, joint("slide", 3, (0.1, 0, 0.1), "prismatic", (0.0, 0.0, 1.0), 0.0, 0.2))
    rods = [solid("capsule", (0.1, 0.02), 0, 0, 0.05)] * 4
    return shape_of(joints, rods, ["mast", "ball_z", "slide", "hinge"], free_base=False)


@pytest.fixture(scope="module")
def problem(plain_hand, plain_hand_skin):
    """Three clouds of a hand half a metre off, padded to unlike lengths."""
    pose = plain_hand.rest_pose().repeat(3, 1)
    pose[:, :3] = torch.tensor([0.1, -0.2, 0.5])
    pose[:, 6:] = torch.tensor([[0.1], [0.2], [0.3]])
    data = plain_hand_skin(pose)
    valid = torch.arange(400) < torch.tensor([[400], [300], [50]])
    origin = torch.stack([points[known].mean(0) for points, known in zip(data, valid, strict=True)])
    return problem_of(plain_hand_skin, data, pose, valid, origin, prior_std=0.25)


def test_data_and_prior_are_centered_and_padding_is_zero(problem):
    assert float(problem.data.sum(1).abs().max()) < 1e-4
    assert bool((problem.data[~problem.valid] == 0).all())
    # The same offset moved data and poses: the prior's pose still lies on its data.
    far = problem.skin(problem.prior.mean) - problem.data
    assert float(far[problem.valid].abs().max()) < 1e-6
    rest = problem.skin.points
    assert problem.size == pytest.approx(float((rest.amax(0) - rest.amin(0)).norm()))


def test_a_bolted_base_has_limits_of_its_own_for_each_cloud(machine):
    skin, pose = tr.sample_skin(machine, 60), machine.rest_pose().repeat(2, 1)
    data = skin(pose) + torch.tensor([[[0.0, 0, 0]], [[0.05, 0, 0]]])
    origin = data.mean(1)
    fixed = problem_of(skin, data, pose, origin=origin)
    torch.testing.assert_close(fixed.lower[:, :3], -origin)
    torch.testing.assert_close(fixed.upper[:, :3], -origin)
    torch.testing.assert_close(fixed.upper[:, 6:], machine.upper[6:].expand(2, -1))
    # Clamped, a base is back where it is bolted.
    wild = torch.randn(5, 2, machine.num_dofs, generator=generator())
    clamped = fixed.clamp(wild)
    assert float((clamped[..., :3] + origin).abs().max()) < 1e-6
    assert float(clamped[..., 3:6].abs().max()) < 1e-6
    torch.testing.assert_close(fixed.rows(torch.tensor([1])).lower[0, :3], -origin[1])


def precision_of(shape, std):
    skin, pose = tr.sample_skin(shape, 60), shape.rest_pose().unsqueeze(0)
    return problem_of(skin, skin(pose), pose, prior_std=std)


def test_the_prior_holds_joints_slides_by_the_size_and_balls_as_a_whole(machine):
    """A turn of a ball by the deviation, about any axis, costs what one of a hinge does: three axes, a third each."""
    held = precision_of(machine, 0.2)
    expected = [0.0] * 6 + [3 / 0.04] * 3 + [1 / (0.2 * held.size) ** 2] + [1 / 0.04]
    torch.testing.assert_close(held.prior.precision, torch.tensor(expected))
    assert bool((precision_of(machine, None).prior.precision == 0).all())


def test_a_draw_takes_data_that_count_and_no_datum_twice(problem):
    drawn = problem.draw(60, generator())
    assert drawn.data.shape == (3, 60, 3)
    assert drawn.valid.sum(-1).tolist() == [60, 60, 50]
    same = (drawn.data.unsqueeze(2) == problem.data.unsqueeze(1)).all(-1) & problem.valid.unsqueeze(1)
    assert bool((same.any(-1) == drawn.valid).all())
    assert all(len(drawn.data[row][drawn.valid[row]].unique(dim=0)) == count for row, count in enumerate((60, 60, 50)))
    again = problem.draw(60, generator())
    torch.testing.assert_close(again.data, drawn.data, rtol=0, atol=0)
    assert not torch.equal(problem.draw(60, generator(1)).data, drawn.data)


def test_the_cost_counts_outliers_and_asks_the_prior(problem, plain_hand):
    pose = problem.prior.mean.clone()
    pose[:, 8] += torch.tensor([0.0, 0.25, 0.5])
    pose[2, 2] += 0.01
    expected = []
    for row in range(3):
        total = 0.0
        for point in problem.data[row][problem.valid[row]]:
            far = float(plain_hand.distance(point.unsqueeze(0), pose[row])) / (0.02 * problem.size)
            total += 1 - math.exp(-(far**2))
        expected.append(total + 0.3 * [0.0, 0.5, 2.0][row])
    found = alignment_cost(problem, pose)
    assert found.tolist() == pytest.approx(expected, abs=2e-3)
    distances = problem.surface.distance(problem.data, pose)
    torch.testing.assert_close(alignment_cost(problem, pose, distances), found)


def test_far_data_cost_one_each_and_padding_nothing(problem):
    lost = replace(problem, data=problem.data + 3.0)
    torch.testing.assert_close(alignment_cost(lost, problem.prior.mean), torch.tensor([400.0, 300.0, 50.0]))
