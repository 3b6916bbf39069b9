"""Limbs that went where no prediction leads: each as in the start that suits it, none twice on the same data."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from tests.alignment.made import joint, shape_of, solid


@pytest.fixture(scope="module")
def crab():
    """A body with two arms that hinge about the vertical, in double precision."""
    joints, solids = [joint("body", -1)], [solid("ellipsoid", (0.1, 0.06, 0.05))]
    for name, side in (("left", -0.07), ("right", 0.07)):
        joints.append(joint(name, 0, (side, 0.05, 0), "revolute", (0.0, 0.0, 1.0), -1.2, 1.2))
        solids.append(solid("ellipsoid", (0.02, 0.1, 0.02), 0, 0.1, 0))
    return shape_of(joints, solids, nu=0.005, dtype=torch.float64)


@pytest.mark.parametrize("paces", [(2, 0), (0, 1), (1, 2), (0, 0)])
def test_every_limb_is_found_at_its_own_pace(crab, paces):
    """Where predictions fail by much, limbs that went 0.5 rad a frame stop, go on or double."""
    skin, truth = tr.sample_skin(crab, 300), crab.rest_pose()
    truth[6:] = torch.tensor([-0.3, 0.4])
    before = truth.clone()
    before[6:] -= 0.5 * torch.tensor(paces)
    tracker = tr.Tracker(crab, before, model_points=skin)
    for _ in range(2):
        tracker.step(skin(before))
    velocity = torch.tensor([0.0] * 6 + [0.5, 0.5]).double()
    tracker.state = replace(tracker.state, velocity=velocity, prediction_error=0.1)
    state = tracker.state
    found = tracker.step(skin(truth))
    assert found.acquired == "tracked"
    torch.testing.assert_close(found.pose[6:], truth[6:], atol=0.03, rtol=0)
    torch.testing.assert_close(found.pose[:3], truth[:3], atol=0.004, rtol=0)
    tracker.state = state
    assert torch.equal(tracker.step(skin(truth)).pose, found.pose)
