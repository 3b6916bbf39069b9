"""A tracked person is as sure as `align` is: status and confidence rest on the error of the whole surface."""

import math

import pytest
import torch

import torchreg as tr
from torchreg.alignment.evidence.reliability import SurfaceError
from torchreg.geometry.mesh import sample_surface

TRUTH = torch.tensor([0.6, -0.5, 0.4])


def scan(person, pose, seed):
    generator = torch.Generator().manual_seed(seed)
    mesh = tr.TriangleMesh(person.vertices(pose, TRUTH), person.file_surface().faces)
    points = sample_surface(mesh, 600, generator=generator)[0]
    return points + 0.002 * torch.randn(points.shape, generator=generator)


@pytest.mark.parametrize(("moved", "converged"), [(0.0, True), (0.004, True), (0.03, False)])
def test_a_surface_that_still_moves_is_neither_converged_nor_known(moved, converged):
    whole, size = torch.tensor([0.005]), 1.7
    still, moving = (SurfaceError(whole, parts=whole[:, None], moved=torch.tensor([step])) for step in (0.0, moved))
    assert bool(moving.converged) is converged
    assert float(moving.unknown(size)) >= float(still.unknown(size))
    assert (float(moving.unknown(size)) > 0.5) is (moved > 0.02)


def test_no_frame_of_a_person_is_sure_and_wrong(person):
    pose = person.rest_pose()
    start = pose.clone()
    start[:3] += torch.tensor([0.03, -0.02, 0.03])
    tracker = tr.Tracker(person, start, fit_shape=True, config=tr.TrackConfig(recovery="none"))
    bent = [pose.clone() for _ in range(3)]
    for frame, angle in zip(bent, (0, 4, 80), strict=True):
        frame[6:] += math.radians(angle) * torch.tensor([1.0, -1.0, 1.0]).repeat(len(pose))[: len(pose) - 6]
    sure = []
    for number, truth in enumerate(bent):
        result = tracker.step(scan(person, truth, number))
        off = person.vertices(result.pose, result.coefficients) - person.vertices(truth, TRUTH)
        right = float(off.norm(dim=-1).mean()) < 0.03
        sure.append(result.status is tr.Status.CONVERGED)
        assert right or not sure[-1]
        assert sure[-1] == (float(result.confidence) >= 0.5 and result.status is not tr.Status.MAX_STEPS)
    assert sure[:2] == [True, True]
