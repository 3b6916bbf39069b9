"""How a whole picture agrees with a posed hand: rendered, hidden, absent, or a ball in its place."""

import math

import pytest
import torch

import torchreg as tr
from torchreg.alignment.evidence.picture_agreement import LIMB_MODEL, PICTURE_MODEL, picture_views
from torchreg.alignment.fit.problem import centered_problem
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.visibility import rasterize
from torchreg.shapes.pose_algebra import shifted

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


def evidence(skin, pose, depth, mask=None, moved=0.0):
    """How the picture agrees with a pose, whole and by limbs, with the nearer pixels as the crop, in a moved world."""
    frame = tr.DepthFrame(depth, CAMERA, depth < 0.8 if mask is None else mask).near(torch.full((3,), -moved))
    data = frame.points[None].to(pose)
    pose = torch.cat((pose[:3] + moved, pose[3:]))[None]
    problem = centered_problem(
        skin, data, torch.ones_like(data[..., 0], dtype=torch.bool), pose, data.mean(1), prior_std=None, pose_atol=0.0
    )
    return picture_views(problem, shifted(pose, -problem.origin), [frame])[0]


def agreement(*told, **how):
    return evidence(*told, **how)[0]


def test_a_picture_of_the_hand_agrees(skin, pose, depth):
    found, limbs = evidence(skin, pose, depth)
    assert float(found.table().min()) >= 0
    assert float(found.behind) < 0.1
    assert float(found.uncovered) < 0.2
    assert float(found.normals) < 0.15
    assert float(found.relief) < 0.5
    assert float(PICTURE_MODEL.probability(found.table())) > 0.8
    assert bool((LIMB_MODEL.probability(limbs.table()) > 0.8).all())


def test_what_hides_a_hand_is_no_hole_in_it(skin, pose, depth):
    half = torch.arange(CAMERA.width) < 80
    before, beyond = (agreement(skin, pose, torch.where(half, far, depth), (depth < 0.8) & ~half) for far in (0.3, 0.9))
    assert float(before.behind) < 0.1 < 0.3 < float(beyond.behind)
    assert min(float(before.uncovered), float(beyond.uncovered)) > 0.3


def test_a_finger_through_which_the_wall_is_seen_is_elsewhere(plain_hand, skin, pose, depth):
    bent = pose.clone()
    bent[plain_hand.dof_names.index("thumb_cmc_abduction")] += 0.6
    limbs = evidence(skin, bent, depth)[1]
    probability = LIMB_MODEL.probability(limbs.table())
    assert float(limbs.behind[0]) > 0.4 > float(limbs.behind[1:].max())
    assert float(probability[0]) < 0.5 < float(probability[1:].min())


def test_the_joints_of_a_finger_that_the_picture_contradicts_are_not_determined(plain_hand, skin, pose, depth):
    bent, thumb = pose.clone(), "thumb_cmc_abduction"
    bent[plain_hand.dof_names.index(thumb)] += 0.6
    still = tr.AlignConfig(search="never", schedule=tr.SigmaSchedule.geometric(0.002, 0.001, 1), em_steps=1,
                           surface_steps=0, prior_std=None)  # fmt: skip
    frame = tr.DepthFrame(depth, CAMERA, depth < 0.8)
    right, wrong = (tr.align(plain_hand, frame, start, model_points=skin, config=still) for start in (pose, bent))
    assert wrong.named_std[thumb] > max(0.3, 4 * right.named_std[thumb])
    assert wrong.named_std["middle_mcp_flexion"] < 2 * right.named_std["middle_mcp_flexion"]
    assert f"{thumb} (+- " in wrong.doubt
    assert "hardly any data show where thumb ends" in wrong.doubt
    assert thumb not in right.doubt


def ball():
    """The picture (H, W) of a ball half a metre away, before a wall."""
    column, row = torch.meshgrid(torch.arange(160) - 79.5, torch.arange(120) - 59.5, indexing="xy")
    height = (0.05**2 - (0.5 / 190) ** 2 * (column.square() + row.square())).clamp_min(0).sqrt()
    return torch.where(height > 0, 0.53 - height, 1.0).float()


def test_a_ball_has_no_relief_of_a_hand(skin, pose):
    found = agreement(skin, pose, ball())
    assert float(found.relief) > 0.7
    assert float(found.smooth) > 0.5
    assert float(PICTURE_MODEL.probability(found.table())) < 1 - PICTURE_MODEL.told


def test_a_result_is_in_doubt_where_the_picture_shows_something_else(plain_hand, skin, pose, depth):
    found, other = (
        tr.align(plain_hand, tr.DepthFrame(picture, CAMERA), model_points=skin, config=tr.AlignConfig(search="never"))
        for picture in (depth, ball())
    )
    assert found.status.usable
    assert float(found.evidence[-2]) < 0.1 < PICTURE_MODEL.told**2 < float(other.evidence[-2])
    assert other.status in (tr.Status.DOUBTFUL, tr.Status.NOT_FOUND)
    assert "the picture more probably shows something else" in other.doubt


def test_the_agreement_does_not_depend_on_where_the_world_begins(skin, pose, depth):
    torch.testing.assert_close(
        agreement(skin, pose, depth, moved=2.0).table(), agreement(skin, pose, depth).table(), atol=0.02, rtol=0
    )
