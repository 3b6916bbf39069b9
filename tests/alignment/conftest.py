"""A small arm in double precision; a hand, its cloud, a start and the descent from there; a depth picture."""

import math

import pytest
import torch

import torchreg as tr
from tests.alignment.made import D, cloud, generator, joint, shape_of, solid
from torchreg.datasets.hand import surface_skin
from torchreg.geometry.visibility import rasterize

# Without a search an alignment is one descent: fast, and the same whatever else is in the batch.
DESCENT = tr.AlignConfig(search="never")
CAMERA = tr.Camera(96, 72, (110.0, 110.0, 47.5, 35.5))


@pytest.fixture(scope="session")
def links():
    """Three flattened links of 10 cm with two hinges, at right angles."""
    joints = [
        joint("upper", -1),
        joint("elbow", 0, (0, 0, 0.1), "revolute", (1.0, 0.0, 0.0), -2.0, 2.0),
        joint("wrist", 1, (0, 0, 0.1), "revolute", (0.0, 1.0, 0.0), -2.0, 2.0),
    ]
    return shape_of(joints, [solid("ellipsoid", (0.03, 0.015, 0.06), 0, 0, 0.05)] * 3, nu=0.005, dtype=D)


@pytest.fixture(scope="session")
def links_skin(links):
    """300 model points of the links."""
    return tr.sample_skin(links, 300)


@pytest.fixture(scope="session")
def links_pose(links):
    return torch.tensor([-0.1, 0.0, 0.6, 0.0, 1.4, 0.0, 0.3, 0.2], dtype=D)


@pytest.fixture(scope="session")
def picture_of():
    """A function from a skin with faces, a pose and a camera to a depth frame, before a wall at some depth."""

    def make(surface, pose, camera=CAMERA, wall=1.2, **options):
        raster = rasterize(tr.TriangleMesh(surface(pose), surface.faces), camera.view())
        shown = raster.face_index >= 0
        return tr.DepthFrame(torch.where(shown, raster.depth, wall), camera, shown, **options)

    return make


@pytest.fixture(scope="session")
def picture(links, links_pose, picture_of):
    """A frame of the links before a wall at 1.2 m, without noise."""
    return picture_of(surface_skin(links), links_pose)


@pytest.fixture(scope="session")
def truth(plain_hand):
    """A hand half a metre away, turned, its fingers bent a little."""
    pose = plain_hand.rest_pose()
    pose[:6] = torch.tensor([0.05, -0.1, 0.5, 1.2, -0.4, 0.6])
    for index, name in enumerate(plain_hand.dof_names[6:], 6):
        pose[index] = 0.25 + 0.02 * (index % 5) if name.endswith("flexion") else 0.05
    return pose


@pytest.fixture(scope="session")
def start(truth):
    """Ten degrees off in every joint, alternating; 8 mm and 8 degrees off in the base."""
    pose = truth.clone()
    pose[6:] += math.radians(10) * (1 - 2.0 * (torch.arange(21) % 2))
    pose[:6] += torch.tensor([0.005, -0.005, 0.003, 0.1, 0.05, -0.08])
    return pose


@pytest.fixture(scope="session")
def clean(plain_hand, plain_hand_surface, truth):
    """The whole surface, 1 mm noise."""
    return cloud(plain_hand, truth, skin=plain_hand_surface).points


@pytest.fixture(scope="session")
def fit(plain_hand, plain_hand_skin):
    """A function that aligns the hand, by default by one descent."""

    def aligned(data, start=None, **options):
        return tr.align(plain_hand, data, start, **({"model_points": plain_hand_skin, "config": DESCENT} | options))

    return aligned


@pytest.fixture(scope="session")
def found(fit, clean, start):
    """The hand after one descent, and the records that it called back with."""
    records = []
    return fit(clean, start, on_step=records.append), records


@pytest.fixture(scope="session")
def two_hands(plain_hand):
    """Poses of two hands half a metre away, turned in any way, the fingers bent up to a third of their range."""
    poses = plain_hand.rest_pose().repeat(2, 1)
    poses[:, 6:] = 0.35 * torch.rand(2, 21, generator=generator(4)) * plain_hand.upper[6:].clamp_min(0)
    poses[:, 3:6] = torch.tensor([[2.9, 0.3, -0.4], [-1.0, 1.9, 0.6]])
    poses[:, 2] = 0.5
    return poses


@pytest.fixture(scope="session")
def two_clouds(plain_hand, plain_hand_surface, two_hands):
    clouds = [cloud(plain_hand, pose, row, skin=plain_hand_surface).points for row, pose in enumerate(two_hands)]
    return torch.stack(clouds)
