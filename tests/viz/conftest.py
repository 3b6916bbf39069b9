"""Small results of every kind, made without running a pipeline."""

import pytest
import torch

from torchreg.datasets.hand import hand_motion
from torchreg.geometry.mesh import unit_sphere
from torchreg.geometry.rigid import se3_exp
from torchreg.geometry.sparse_grid import SparseGrid
from torchreg.models.grid_lbs import GridLBS
from torchreg.models.hand import Hand
from torchreg.models.spine import Spine
from torchreg.results.alignment import AlignResult, Calibration, PoseStarts
from torchreg.results.base import Status
from torchreg.results.scans import ScanRegistration, SequenceRegistration
from torchreg.results.spines import SpineSequence
from torchreg.results.tracking import DemoResult, TrackResult


def _bar_model(num_bones=3):
    """Return a model of a long ellipsoid that bends, its points and faces."""
    mesh = unit_sphere(3)
    points = mesh.vertices.double() * torch.tensor([3.0, 0.6, 0.5])
    grid = SparseGrid.from_points(points, 24)
    seeds = torch.linspace(-2, 2, num_bones, dtype=torch.float64)
    soft = torch.softmax(-4 * (grid.corner_points()[:, :1] - seeds).abs(), dim=-1)
    # A chain that bends: each bone turns about its joint with the one before.
    motions = [torch.eye(4, dtype=torch.float64)]
    turn = se3_exp(torch.tensor([0.0, 0, 0, 0, 0, 0.35], dtype=torch.float64))
    for joint in (seeds[1:] + seeds[:-1]) / 2:
        place = torch.eye(4, dtype=torch.float64)
        place[0, 3] = joint
        motions.append(motions[-1] @ place @ turn @ torch.linalg.inv(place))
    return GridLBS(grid, soft, torch.stack(motions)), points, mesh.faces


@pytest.fixture(scope="session")
def bar_model():
    """Return the function that makes a `GridLBS`, points and faces, given a number of bones."""
    return _bar_model


@pytest.fixture(scope="session")
def registration():
    model, points, faces = _bar_model()
    with torch.no_grad():
        deformed, weights = model(points), model.weights_at(points)
    count = len(points)
    return ScanRegistration(
        model, points, faces, deformed, weights.argmax(-1), model.transforms.detach(), weights,
        torch.linspace(0, 0.1, count, dtype=torch.float64), torch.ones(count, dtype=torch.bool), Status.CONVERGED,
        torch.zeros(4),
    )  # fmt: skip


@pytest.fixture(scope="session")
def sequence():
    model, points, faces = _bar_model()
    rest = torch.eye(4, dtype=torch.float64).expand(3, 4, 4)
    transforms = torch.stack([rest, model.transforms.detach()])
    model.set_transforms_(transforms)
    with torch.no_grad():
        deformed, weights = model(points), model.weights_at(points)
    fused = torch.cat([points, points])
    frames = torch.arange(2).repeat_interleave(len(points))
    return SequenceRegistration(
        model,
        points,
        faces,
        deformed,
        weights.argmax(-1),
        transforms,
        weights,
        fused,
        fused,
        frames,
        0,
        Status.CONVERGED,
    )


@pytest.fixture(scope="session")
def spine():
    line = torch.linspace(1, 0, 8).unsqueeze(-1)
    ends = torch.tensor([[1.0, 0, 0], [-0.5, 0.9, 0], [-0.5, -0.9, 0]])
    still = line * ends.unsqueeze(1)
    curves = torch.stack([still, still + torch.tensor([0.0, 0, 0.2]), still + torch.tensor([0.0, 0, 0.4])])
    graph = torch.tensor([[0, 3], [1, 3], [2, 3]])
    radii, frames = torch.full((3, 3, 8), 0.1), torch.eye(3).expand(3, 3, 8, 3, 3)
    model, count = Spine(curves, graph, radii), 3
    yes = torch.ones(count, 3, dtype=torch.bool)
    return SpineSequence(
        model, graph, curves, radii, frames, torch.arange(3.0), yes, yes, 0, ("(()()())",) * 3, ("(()()())",) * 3,
        (Status.CONVERGED,) * 3, Status.CONVERGED, (),
    )  # fmt: skip


@pytest.fixture(scope="session")
def hand():
    return Hand()


@pytest.fixture(scope="session")
def track(hand):
    poses = hand_motion(hand, "bend", 3)
    poses[0] = torch.nan
    count = len(poses)
    return TrackResult(
        poses, torch.zeros_like(poses), hand.keypoints(poses).detach(), torch.ones(count), torch.ones(count),
        torch.arange(float(count)) / 20, torch.ones(count), (Status.LOST, Status.CONVERGED, Status.CONVERGED),
        ("lost", "found", "tracked"),
    )  # fmt: skip


@pytest.fixture(scope="session")
def clouds(track):
    return [torch.nan_to_num(points, 0.0) + 0.001 for points in track.keypoints]


@pytest.fixture(scope="session")
def alignment(track):
    pose, points = track.poses[1], track.keypoints[1]
    inliers = torch.arange(len(points)) % 3 > 0
    return AlignResult(
        pose, points, points, torch.zeros(len(points)), inliers, torch.linspace(0, 1, len(points)),
        torch.tensor(0.002), torch.tensor(1.0), Status.CONVERGED,
    )  # fmt: skip


@pytest.fixture(scope="session")
def demo(track, clouds):
    masks = tuple(torch.arange(len(cloud)) % 2 > 0 for cloud in clouds)
    tips = torch.zeros(3, 5)
    return DemoResult(track, track.poses, tuple(clouds), masks, tips, tips > -1, 0)


@pytest.fixture(scope="session")
def starts(track):
    return PoseStarts(track.poses[1:], torch.tensor([0.1, 0.2]), torch.tensor(0.9))


@pytest.fixture(scope="session")
def calibration(hand, track):
    zeros = torch.zeros(len(hand.part_names))
    return Calibration(hand, track.poses[1:], zeros, zeros, torch.tensor(0.1), Status.CONVERGED)


@pytest.fixture(scope="session")
def everything(alignment, track, demo, starts, calibration, registration, sequence, spine):
    """Return every kind of result that can be shown, by name."""
    return {
        "alignment": alignment, "track": track, "demo": demo, "starts": starts, "calibration": calibration,
        "registration": registration, "sequence": sequence, "spine": spine,
    }  # fmt: skip
