"""A bending arm whose truth is known, meshed anew in every frame."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from torchreg.datasets.figures import Part, meshed_figure
from torchreg.datasets.solids import RoundCone
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.scan_clusters import clustered_scan

ANGLES = (0.0, 0.35, 0.7, 1.0)
QUICK = tr.RegisterConfig(align=replace(tr.RegisterConfig().align, num_samples=300), num_samples=500)
CONFIG = tr.RigConfig(num_bones=6, num_points=700, register=QUICK)


def bending_arm():
    """Return an arm of two parts that bend at the origin."""
    parts = [
        Part("upper", None, (-0.5, 0.0, 0.0), (RoundCone((-1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.2, 0.2),)),
        Part("lower", "upper", (0.0, 0.0, 0.0), (RoundCone((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.2, 0.12),)),
    ]
    return meshed_figure(parts, spacing=0.04, blend=0.05, softness=0.05)


@pytest.fixture(scope="session")
def arm():
    return bending_arm()


def posed(figure, angle):
    """Return the arm's vertices with its elbow bent, while it turns and drifts."""
    turns = torch.eye(3, dtype=torch.float64).repeat(2, 1, 1)
    turns[0] = so3_exp(torch.tensor([0.0, 0.1 * angle, 0.0], dtype=torch.float64))
    turns[1] = so3_exp(torch.tensor([0.0, 0.0, angle], dtype=torch.float64))
    return figure.vertices(figure.transforms(turns.to(figure.mesh.vertices)))


def anew(mesh, seed):
    """Return a mesh of the same surface with other vertices."""
    turn = so3_exp(torch.tensor([0.3, 0.5, 0.2], dtype=torch.float64) * seed).to(mesh.vertices)
    scan = clustered_scan(tr.RangeScan(mesh.vertices @ turn.mT, mesh.faces), 700)[0]
    return tr.TriangleMesh(scan.points @ turn, scan.faces)


@pytest.fixture(scope="session")
def frames(arm):
    return [anew(tr.TriangleMesh(posed(arm, angle), arm.mesh.faces), seed) for seed, angle in enumerate(ANGLES, 1)]


@pytest.fixture(scope="session")
def rig(frames):
    return tr.rig_sequence(frames, template=0, config=CONFIG)
