"""Limbs that went where no prediction leads: each as in the start that suits it, none twice on the same data."""

import pytest
import torch

import torchreg as tr
from torchreg.alignment.fit.problem import centered_problem
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes.limbs import find_limbs
from torchreg.shapes.primitives import Primitive
from torchreg.tracking import limb_combination


def shifted(x, y):
    """Return the transform (4, 4) of a shift in the plane."""
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:2, 3] = torch.tensor([x, y])
    return matrix


@pytest.fixture(scope="module")
def crab():
    """A body with two arms that hinge about the vertical, in double precision."""
    joints = [Joint("body", -1, torch.eye(4, dtype=torch.float64))]
    solids = [Primitive("ellipsoid", (0.1, 0.06, 0.05), torch.eye(4, dtype=torch.float64))]
    for name, side in (("left", -1.0), ("right", 1.0)):
        position = shifted(side * 0.07, 0.05)
        joints.append(Joint(name, 0, position, "revolute", (0.0, 0.0, 1.0), -1.2, 1.2))
        along = shifted(0.0, 0.1)
        solids.append(Primitive("ellipsoid", (0.02, 0.1, 0.02), along))
    shape = tr.ArticulatedShape(
        KinematicTree(tuple(joints)), ["body", "left", "right"], solids, nu=0.005, dtype=torch.float64
    )
    return shape.requires_grad_(False)


@pytest.fixture(scope="module")
def problem(crab):
    """The alignment of 300 points of the crab, with its arms at 0.5 and -0.3 rad, predicted at rest."""
    skin = tr.sample_skin(crab, 300)
    truth = crab.rest_pose()
    truth[6:] = torch.tensor([0.5, -0.3])
    data = skin(truth)[None]
    valid = torch.ones_like(data[..., 0], dtype=torch.bool)
    origin = torch.zeros(1, 3, dtype=torch.float64)
    built = centered_problem(skin, data, valid, crab.rest[None], origin, prior_std=0.3, pose_atol=1e-4)
    return built, truth


def arms(pose, left, right):
    pose = pose.clone()
    pose[6:] = torch.tensor([left, right])
    return pose


def test_every_limb_is_taken_from_the_pose_that_suits_it(crab, problem):
    built, truth = problem
    poses = torch.stack([arms(truth, 0.5, 0.8), arms(truth, -0.9, -0.3), arms(truth, 0.0, 0.0)])
    found = limb_combination.combine_limbs(built, poses, 2, find_limbs(crab)[0])
    torch.testing.assert_close(found[0], truth)
    torch.testing.assert_close(limb_combination.combine_limbs(built, poses[[2, 0, 1]], 0, find_limbs(crab)[0]), found)
    assert torch.equal(limb_combination.combine_limbs(built, poses, 1, []), poses[1:2])


def test_the_base_is_that_of_the_best(crab, problem):
    built, truth = problem
    off = truth.clone()
    off[:3] += 0.01
    found = limb_combination.combine_limbs(built, torch.stack([off, truth]), 1, find_limbs(crab)[0])
    assert torch.equal(found[0], truth)


def test_starts_lead_to_the_pose_though_none_is_near_in_all_limbs(crab, problem):
    built, truth = problem
    starts = torch.stack([arms(truth, 0.4, 1.1), arms(truth, -1.0, -0.4), arms(truth, -0.6, 0.6)])
    starts[:, 0] += 0.004
    found = limb_combination.fit_limbs(built, starts, find_limbs(crab)[0], torch.Generator().manual_seed(0))
    assert found.shape == (1, 8)
    torch.testing.assert_close(found[0, 6:], truth[6:], atol=0.05, rtol=0)
    again = limb_combination.fit_limbs(built, starts, find_limbs(crab)[0], torch.Generator().manual_seed(0))
    assert torch.equal(again, found)


def test_joints_are_scattered_and_the_base_is_not():
    pose = torch.arange(8.0)[None]
    poses = limb_combination.scatter_joints(pose, torch.tensor([0.1, 0.4]), 4000, torch.Generator().manual_seed(0))
    assert torch.equal(poses[:, :6], pose[:, :6].expand(4000, -1))
    torch.testing.assert_close(poses[:, 6:].mean(0), pose[0, 6:], atol=0.02, rtol=0)
    torch.testing.assert_close(poses[:, 6:].std(0), torch.tensor([0.1, 0.4]), atol=0.01, rtol=0)
