"""Small results of every kind, made without running a pipeline."""

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import torchreg as tr
from tests.gltf_player import Player
from torchreg.registration.bones.sparse_grid import SparseGrid

DOUBLE = {"dtype": torch.float64}


def _ball(level, dtype=torch.float32):
    """Return a sphere of radius 1 of 10 * 4 ** level + 2 vertices."""
    mesh = trimesh.creation.icosphere(level)
    return tr.TriangleMesh(torch.tensor(mesh.vertices.tolist(), dtype=dtype), torch.tensor(mesh.faces.tolist()))


def _motion(twist):
    """Return exp of twists (..., 6): translation, rotation."""
    v, w = torch.as_tensor(twist, **DOUBLE).split(3, -1)
    matrix = torch.zeros(*w.shape[:-1], 4, 4, **DOUBLE)
    axes = torch.eye(3, **DOUBLE).expand(*w.shape, 3)
    matrix[..., :3, :3] = -torch.linalg.cross(axes, w.unsqueeze(-2).expand_as(axes))
    matrix[..., :3, 3] = v
    return torch.linalg.matrix_exp(matrix)


def _bar_model(num_bones=3):
    """Return a model of a long ellipsoid that bends, its points and faces."""
    mesh = _ball(3, torch.float64)
    points = mesh.vertices * torch.tensor([3.0, 0.6, 0.5])
    grid = SparseGrid.from_points(points, 24)
    seeds = torch.linspace(-2, 2, num_bones, **DOUBLE)
    soft = torch.softmax(-4 * (grid.corner_points()[:, :1] - seeds).abs(), dim=-1)
    # A chain that bends: each bone turns about its joint with the one before.
    motions, place = [torch.eye(4, **DOUBLE)], torch.eye(4, **DOUBLE)
    for joint in (seeds[1:] + seeds[:-1]) / 2:
        place[0, 3] = joint
        motions.append(motions[-1] @ place @ _motion([0.0, 0, 0, 0, 0, 0.35]) @ torch.linalg.inv(place))
    return tr.GridLBS(grid, soft, torch.stack(motions)), points, mesh.faces


def _bones_scene(bones=6, blend="linear", smooth=False, scale=1.0, dtype=torch.float64):
    """Return a model of an ellipsoid whose bones move at random, its points and faces."""
    mesh = _ball(2, torch.float64)
    points = scale * (mesh.vertices * torch.tensor([3.0, 1.0, 0.8]))
    grid = SparseGrid.from_points(points, 12)
    seeds = points[:: len(points) // bones][:bones]
    motions = _motion(0.5 * torch.randn(bones, 6, generator=torch.Generator().manual_seed(0), **DOUBLE))
    motions[:, :3, 3] *= scale
    if smooth:
        soft = torch.softmax(-4 * torch.cdist(grid.corner_points(), seeds) / scale, dim=-1)
        return tr.GridLBS(grid, soft, motions, blend=blend), points, mesh.faces
    labels = torch.cdist(grid.cell_centers(), seeds).argmin(1)
    return tr.GridLBS.from_labels(grid, labels, bones, motions, blend=blend).to(dtype), points.to(dtype), mesh.faces


def _pictures_of(path):
    """Return the frames (H, W, 3) of a moving picture, and what Pillow says about it."""
    with Image.open(path) as file:
        frames = []
        for index in range(file.n_frames):
            file.seek(index)
            frames.append(np.asarray(file.convert("RGB")).astype(int))
        return frames, file.info


@pytest.fixture(scope="session")
def tools():
    """Return the functions that make small bodies, motions and models, and those that read files."""
    return type("Tools", (), {
        "ball": staticmethod(_ball), "motion": staticmethod(_motion), "bar_model": staticmethod(_bar_model),
        "bones_scene": staticmethod(_bones_scene), "play": Player, "pictures_of": staticmethod(_pictures_of),
    })  # fmt: skip


@pytest.fixture(scope="session")
def registration():
    model, points, faces = _bar_model()
    with torch.no_grad():
        deformed, weights = model(points), model.weights_at(points)
    return tr.ScanRegistration(
        model=model, points=points, faces=faces, deformed=deformed, labels=weights.argmax(-1), weights=weights,
        transforms=model.transforms.detach(), distances=torch.linspace(0, 0.1, len(points), **DOUBLE),
        matched=torch.ones(len(points)) > 0, status=tr.Status.CONVERGED, seconds=torch.zeros(4),
    )  # fmt: skip


@pytest.fixture(scope="session")
def sequence():
    model, points, faces = _bar_model()
    transforms = torch.stack([torch.eye(4, **DOUBLE).expand(3, 4, 4), model.transforms.detach()])
    model.set_transforms_(transforms)
    with torch.no_grad():
        deformed, weights = model(points), model.weights_at(points)
    fused, frames = torch.cat([points, points]), torch.arange(2).repeat_interleave(len(points))
    return tr.SequenceRegistration(
        model, points, faces, deformed, weights.argmax(-1), transforms, weights, fused, fused, frames, 0,
        tr.Status.CONVERGED,
    )  # fmt: skip


@pytest.fixture(scope="session")
def spine():
    line = torch.linspace(1, 0, 8).unsqueeze(-1)
    still = line * torch.tensor([[1.0, 0, 0], [-0.5, 0.9, 0], [-0.5, -0.9, 0]]).unsqueeze(1)
    curves = torch.stack([still, still + torch.tensor([0.0, 0, 0.2]), still + torch.tensor([0.0, 0, 0.4])])
    graph = torch.tensor([[0, 3], [1, 3], [2, 3]])
    radii, frames, yes = torch.full((3, 3, 8), 0.1), torch.eye(3).expand(3, 3, 8, 3, 3), torch.ones(3, 3) > 0
    return tr.SpineSequence(
        tr.Spine(curves, graph, radii), graph, curves, radii, frames, torch.arange(3.0), yes, yes, 0,
        ("(()()())",) * 3, ("(()()())",) * 3, (tr.Status.CONVERGED,) * 3, tr.Status.CONVERGED, (),
    )  # fmt: skip


@pytest.fixture(scope="session")
def hand():
    return tr.Hand()


@pytest.fixture(scope="session")
def bend(plain_hand):
    """Poses (5, D) of a hand half a metre away that closes."""
    poses = plain_hand.rest_pose().repeat(5, 1)
    poses[:, 6:] = torch.linspace(0, 0.6, 5)[:, None] * plain_hand.upper[6:]
    poses[:, 2] += 0.5
    return poses


@pytest.fixture(scope="session")
def coarse(plain_hand):
    """The surface of the hand as a skin of few triangles."""
    mesh = plain_hand.surface_mesh(spacing=0.01)
    return tr.BendingSkin(plain_hand, mesh.vertices, faces=mesh.faces).requires_grad_(False)


@pytest.fixture(scope="session")
def track(plain_hand, bend):
    poses = bend[2:].clone()
    poses[0] = torch.nan
    ones, found = torch.ones(3), tr.Status.CONVERGED
    return tr.TrackResult(
        poses, torch.zeros_like(poses), plain_hand.keypoints(poses), ones, ones, torch.arange(3.0) / 20, ones,
        (tr.Status.LOST, found, found), ("lost", "found", "tracked"),
    )  # fmt: skip


@pytest.fixture(scope="session")
def clouds(track):
    return [torch.nan_to_num(points, 0.0) + 0.001 for points in track.keypoints]


@pytest.fixture(scope="session")
def alignment(track):
    pose, points = track.poses[1], track.keypoints[1]
    inliers, posterior = torch.arange(len(points)) % 3 > 0, torch.linspace(0, 1, len(points))
    return tr.AlignResult(
        pose, points, points, torch.zeros(len(points)), inliers, posterior, torch.tensor(0.002), torch.tensor(1.0),
        tr.Status.CONVERGED,
    )  # fmt: skip


@pytest.fixture(scope="session")
def demo(track, clouds):
    masks, tips = tuple(torch.arange(len(cloud)) % 2 > 0 for cloud in clouds), torch.zeros(3, 5)
    return tr.DemoResult(track, track.poses, tuple(clouds), masks, tips, tips > -1, 0)


@pytest.fixture(scope="session")
def starts(track):
    return tr.PoseStarts(track.poses[1:], torch.tensor([0.1, 0.2]), torch.tensor(0.9))


@pytest.fixture(scope="session")
def calibration(hand, track):
    zeros = torch.zeros(len(hand.part_names))
    return tr.Calibration(hand, track.poses[1:], zeros, zeros, torch.tensor(0.1), tr.Status.CONVERGED)
