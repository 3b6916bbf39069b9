"""Limits, priors and costs of alignments: bolted bases, balls and slides, draws of the data, unexplained data."""

import math
from dataclasses import replace

import pytest
import torch

import torchreg as tr
from tests.alignment.conftest import DESCENT
from tests.alignment.made import generator, joint, problem_of, shape_of, solid
from torchreg.alignment.fit.problem import alignment_cost


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


def test_the_prior_holds_joints_slides_by_the_size_and_balls_as_a_whole():
    """A turn of a ball by the deviation, about any axis, costs what one of a hinge does: three axes, a third each."""
    x, y, z = (("revolute", axis, -1.0, 1.0) for axis in ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0)))
    joints = [
        joint("mast", -1), joint("ball_x", 0, (0, 0, 0.2), *x), joint("ball_y", 1, (0, 0, 0), *y),
        joint("ball_z", 2, (0, 0, 0), *z), joint("slide", 3, (0.1, 0, 0.1), "prismatic", (0.0, 0.0, 1.0), 0.0, 0.2),
        joint("hinge", 4, (0, 0, 0.2), *x),
    ]  # fmt: skip
    rods = [solid("capsule", (0.1, 0.02), 0, 0, 0.05)] * 4
    shape = shape_of(joints, rods, ["mast", "ball_z", "slide", "hinge"], free_base=False)
    skin, pose = tr.sample_skin(shape, 60), shape.rest_pose().repeat(2, 1)
    held, free = (problem_of(skin, skin(pose), pose, prior_std=std) for std in (0.2, None))
    expected = [0.0] * 6 + [3 / 0.04] * 3 + [1 / (0.2 * held.size) ** 2] + [1 / 0.04]
    torch.testing.assert_close(held.prior.precision, torch.tensor(expected))
    assert bool((free.prior.precision == 0).all())
    # A bolted base stays where it is, whatever the data of each cloud of a batch.
    truth = pose.clone()
    truth[:, 6:] = torch.tensor([[0.2, -0.1, 0.3, 0.1, 0.4], [0.0, 0.3, -0.2, 0.02, -0.4]])
    shift = torch.tensor([[[0.0, 0, 0]], [[0.01, 0, 0]]])
    found = tr.align(shape, skin(truth) + shift, truth, model_points=skin, config=DESCENT)
    assert float(found.pose[:, :6].abs().max()) < 1e-6
    torch.testing.assert_close(found.pose[0], truth[0], rtol=0, atol=0.05)


def test_a_draw_takes_data_that_count_and_no_datum_twice(problem):
    drawn = problem.draw(60, generator())
    assert drawn.valid.sum(-1).tolist() == [60, 60, 50]
    same = (drawn.data.unsqueeze(2) == problem.data.unsqueeze(1)).all(-1) & problem.valid.unsqueeze(1)
    assert bool((same.any(-1) == drawn.valid).all())
    assert all(len(drawn.data[row][drawn.valid[row]].unique(dim=0)) == count for row, count in enumerate((60, 60, 50)))
    torch.testing.assert_close(problem.draw(60, generator()).data, drawn.data, rtol=0, atol=0)
    assert not torch.equal(problem.draw(60, generator(1)).data, drawn.data)


def test_the_cost_counts_outliers_and_asks_the_prior(problem, plain_hand):
    pose = problem.prior.mean.clone()
    pose[:, 8] += torch.tensor([0.0, 0.25, 0.5])
    pose[2, 2] += 0.01
    expected = []
    for row, prior in enumerate((0.0, 0.5, 2.0)):
        far = plain_hand.distance(problem.data[row][problem.valid[row]], pose[row]) / (0.02 * problem.size)
        expected.append(sum(1 - math.exp(-(float(each) ** 2)) for each in far) + 0.3 * prior)
    found = alignment_cost(problem, pose)
    assert found.tolist() == pytest.approx(expected, abs=2e-3)
    torch.testing.assert_close(alignment_cost(problem, pose, problem.surface.distance(problem.data, pose)), found)
    # Far data cost one each, and padding nothing.
    lost = replace(problem, data=problem.data + 3.0)
    torch.testing.assert_close(alignment_cost(lost, problem.prior.mean), torch.tensor([400.0, 300.0, 50.0]))
