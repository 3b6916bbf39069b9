"""How a whole picture agrees with a posed hand: rendered, hidden, absent, or a ball in its place."""

import math

import pytest
import torch

import torchreg as tr
from torchreg.alignment.evidence.picture_agreement import PICTURE_MODEL, PictureAgreement
from torchreg.alignment.search.in_picture import judged
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.visibility import rasterize

CAMERA = tr.Camera(160, 120, (190.0, 190.0, 79.5, 59.5))


@pytest.fixture(scope="module")
def pose(plain_hand):
    """A hand half a metre before the camera, its back to it."""
    pose = plain_hand.rest_pose()
    pose[:6] = torch.tensor([0.0, 0.1, 0.5, math.pi / 2, 0.0, 0.0])
    pose[7::4] += 0.3
    return pose


@pytest.fixture(scope="module")
def skin(plain_hand):
    """Points of the hand."""
    return tr.sample_skin(plain_hand, 500)


@pytest.fixture(scope="module")
def depth(plain_hand_surface, pose):
    """The picture (H, W) of the hand before a wall a metre away."""
    mesh = TriangleMesh(plain_hand_surface(pose).detach(), plain_hand_surface.faces)
    raster = rasterize(mesh, CAMERA.view())
    return torch.where(raster.face_index >= 0, raster.depth, 1.0).float()


def agreement(skin, pose, depth, mask=None):
    """How the picture agrees, with the nearer pixels as the crop."""
    return PictureAgreement.of(skin, pose, tr.DepthFrame(depth, CAMERA, depth < 0.8 if mask is None else mask))


def test_a_picture_of_the_hand_agrees(skin, pose, depth):
    found = agreement(skin, pose, depth)
    assert float(found.table().min()) >= 0
    assert float(found.behind) < 0.1
    assert float(found.uncovered) < 0.2
    assert float(found.normals) < 0.15
    assert float(found.relief) < 0.5
    assert float(PICTURE_MODEL.probability(found.table())) > 0.8


def test_what_hides_a_hand_is_no_hole_in_it(skin, pose, depth):
    half = torch.arange(CAMERA.width) < 80
    before, beyond = (agreement(skin, pose, torch.where(half, far, depth), (depth < 0.8) & ~half) for far in (0.3, 0.9))
    assert float(before.behind) < 0.1 < 0.3 < float(beyond.behind)
    assert min(float(before.uncovered), float(beyond.uncovered)) > 0.3


def ball():
    """The picture (H, W) of a ball half a metre away, before a wall."""
    column, row = torch.meshgrid(torch.arange(160) - 79.5, torch.arange(120) - 59.5, indexing="xy")
    height = (0.05**2 - (0.5 / 190) ** 2 * (column.square() + row.square())).clamp_min(0).sqrt()
    return torch.where(height > 0, 0.53 - height, 1.0).float()


def test_a_ball_has_no_relief_of_a_hand(skin, pose):
    found = agreement(skin, pose, ball())
    assert float(found.relief) > 0.7
    assert float(found.smooth) > 0.5
    assert float(PICTURE_MODEL.probability(found.table())) < PICTURE_MODEL.against


def test_a_result_is_in_doubt_where_the_picture_shows_something_else(plain_hand, skin, pose, depth):
    crop = tr.DepthFrame(depth, CAMERA, depth < 0.8)
    found = tr.align(plain_hand, crop, pose, model_points=skin, config=tr.AlignConfig(search="never"))
    assert found.status.usable
    assert judged(found, crop, skin) is found
    round_thing = tr.DepthFrame(ball(), CAMERA, ball() < 0.8)
    other = judged(found, round_thing, skin)
    assert other.status is tr.Status.DOUBTFUL
    assert float(other.confidence) < PICTURE_MODEL.against
    assert "looks like the shape with a probability of" in other.doubt


def test_the_agreement_does_not_depend_on_where_the_world_begins(skin, pose, depth):
    frame = tr.DepthFrame(depth, CAMERA, depth < 0.8)
    moved = pose.clone()
    moved[:3] += 2.0
    away = PictureAgreement.of(skin, moved, frame.near(torch.full((3,), -2.0)))
    torch.testing.assert_close(away.table(), PictureAgreement.of(skin, pose, frame).table(), atol=0.02, rtol=0)
