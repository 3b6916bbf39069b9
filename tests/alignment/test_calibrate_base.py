"""A robot's base from clouds and depth pictures of it with known joints."""

import math

import numpy as np
import pytest
import torch

import torchreg as tr
from tests.alignment.made import ARM, offset
from torchreg.alignment.base.frames import read_joints
from torchreg.geometry.rigid import transform_points
from torchreg.geometry.rotation import so3_exp, so3_log
from torchreg.geometry.visibility import rasterize, sample_visible

JOINTS = torch.tensor([[0.3, 0.9, -0.4], [-0.8, -1.1, 0.7], [1.6, 0.5, 1.1]], dtype=torch.float64)
BASE = offset(0.1, 0.25, 1.2)
BASE[:3, :3] = so3_exp(torch.tensor([1.9, -0.4, 0.7], dtype=torch.float64))


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "arm.urdf"
    path.write_text(ARM)
    return tr.ArticulatedShape.from_urdf(path, dtype=torch.float64)


def posed_mesh(shape, joints):
    """Return the robot in camera coordinates."""
    skin = shape.file_skin()
    pose = torch.nn.functional.pad(joints, (6, 0))
    return tr.TriangleMesh(transform_points(BASE, skin(pose)), skin.faces)


@pytest.fixture(scope="module")
def clouds(arm):
    """Three clouds of the side towards a camera at the origin, with noise of 1 mm and 5 % of points elsewhere."""
    generator = torch.Generator().manual_seed(0)
    found = []
    for row in JOINTS:
        points = sample_visible(posed_mesh(arm, row), torch.zeros(3), 280, generator)[0]
        points = points + 0.001 * torch.randn(points.shape, generator=generator, dtype=torch.float64)
        found.append(torch.cat([points, BASE[:3, 3] + torch.rand(15, 3, generator=generator) - 0.5]))
    return found


def errors(base):
    """Return how far a point of the workspace is off, metres, and the base's rotation, degrees."""
    point = torch.tensor([0.3, 0.0, 0.3, 1.0], dtype=torch.float64)
    turn = ((base[:3, :3] * BASE[:3, :3]).sum() - 1) / 2
    return float(((base - BASE) @ point).norm()), math.degrees(math.acos(min(float(turn), 1.0)))


def test_the_base_is_found_without_a_start_and_a_frame_of_something_else_is_named(arm, clouds, tmp_path):
    ball = torch.nn.functional.normalize(torch.randn(300, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    found = tr.calibrate_base(arm, [*clouds, BASE[:3, 3] + 0.1 * ball], torch.cat([JOINTS, JOINTS[:1]]))
    shift, turn = errors(found.T_camera_base)
    assert shift < 0.002
    assert turn < 0.2
    std = found.covariance.diagonal().sqrt()
    assert float(std[:3].max()) < 0.006  # half a percent of the distance, by which a camera may be off
    assert float(std[3:].max()) < math.radians(1)
    assert not found.offsets.any()
    assert abs(float(found.depth_offset)) < 0.001
    assert found.outliers == (3,)
    assert found.status is tr.Status.WITH_WARNINGS
    assert float(found.residuals[:3].max()) < 0.002
    assert float(found.residuals[3]) > 0.01
    found.save(tmp_path / "base.safetensors")
    again = tr.load(tmp_path / "base.safetensors")
    torch.testing.assert_close(again.T_camera_base, found.T_camera_base)
    assert again.outliers == (3,)
    assert again.status is found.status


@pytest.mark.parametrize(("wrong", "by", "noise"), [
    (2, (0.5, -0.5, 0.0), 0.0), (0, (0.0, 0.4, 0.0), 0.0), (1, (0.4, 0.0, 0.0), 0.004), (None, (0.0, 0.0, 0.0), 0.004),
])  # fmt: skip
def test_joints_that_do_not_fit_their_frame_are_named_and_do_not_count(arm, clouds, wrong, by, noise):
    """Of three; the clutter of each, and a person beside the robot in the first, are no reason."""
    generator, given = torch.Generator().manual_seed(2), JOINTS.clone()
    person = BASE[:3, 3] + torch.tensor([0.4, 0.1, 0.1]) + 0.05 * torch.randn(60, 3, generator=generator)
    seen = [cloud + noise * torch.randn(cloud.shape, generator=generator) for cloud in clouds]
    if wrong is not None:
        given[wrong] += torch.tensor(by)
    found = tr.calibrate_base(arm, [torch.cat([seen[0], person]), *seen[1:]], given)
    assert found.outliers == (() if wrong is None else (wrong,))
    assert found.status is (tr.Status.CONVERGED if wrong is None else tr.Status.WITH_WARNINGS)
    assert errors(found.T_camera_base)[0] < 0.004


@pytest.mark.parametrize(("scale", "turned"), [(1.005, 0.0), (0.995, 0.0), (1.0, 0.01)])
def test_errors_that_all_frames_share_lie_within_the_ellipsoid(arm, clouds, scale, turned):
    """Distances that are off by half a percent, and an elbow half a degree off; 12.6 bounds 95 % of six dimensions."""
    found = tr.calibrate_base(arm, [cloud * scale for cloud in clouds], JOINTS + torch.tensor([0.0, turned, 0.0]))
    turn = so3_log((found.T_camera_base[:3, :3] @ BASE[:3, :3].mT)[None])[0]
    error = torch.cat([found.T_camera_base[:3, 3] - BASE[:3, 3], turn])
    assert float(error @ torch.linalg.solve(found.covariance, error)) < 12.6
    assert float(found.covariance.diagonal()[:3].max().sqrt()) < 0.01


OFF = torch.tensor([0.0, math.radians(1.0), math.radians(-1.5)])


def test_offsets_that_the_data_tell_are_found_and_others_stay_zero(arm, clouds):
    """The first joint's offset turns the base alone but for the base's own link."""
    found = tr.calibrate_base(arm, clouds, JOINTS - OFF, offsets=True)
    assert found.status is tr.Status.CONVERGED
    assert errors(found.T_camera_base)[0] < 0.003
    assert math.degrees(float((found.offsets - OFF)[:2].abs().max())) < 0.2
    assert float(found.offset_std[1]) > 0


def test_clouds_without_the_robot_are_told(arm):
    generator = torch.Generator().manual_seed(0)
    plane = torch.rand(1, 200, 3, generator=generator) * torch.tensor([3.0, 3.0, 0.0]) + torch.tensor([-1.5, -1.5, 3.0])
    assert tr.calibrate_base(arm, plane, JOINTS[:1]).status in (tr.Status.FEW_INLIERS, tr.Status.WITH_WARNINGS)


def test_depth_frames_in_any_world_give_the_base_in_camera_coordinates(arm):
    camera = tr.Camera(80, 60, (100.0, 100.0, 39.5, 29.5))
    moved, frames = tr.Camera(80, 60, camera.intrinsics, BASE), []
    for row in JOINTS:
        raster = rasterize(posed_mesh(arm, row), camera.view())
        frames.append(tr.DepthFrame(raster.depth, moved, raster.face_index >= 0))
    found = tr.calibrate_base(arm, frames, JOINTS)
    shift, turn = errors(found.T_camera_base)
    assert shift < 0.006
    assert turn < 0.8


def test_joints_come_in_many_forms(arm):
    names = arm.dof_names[6:]
    rows = [dict(zip(names, row.tolist(), strict=True)) | {"gripper": 9.0} for row in JOINTS]
    with_base = torch.nn.functional.pad(JOINTS, (6, 0), value=3.0)
    for form in (JOINTS, JOINTS.numpy(), JOINTS.tolist(), list(JOINTS.numpy()), rows, with_base):
        torch.testing.assert_close(read_joints(arm, form, 3), JOINTS)
    torch.testing.assert_close(read_joints(arm, JOINTS.numpy().astype(np.float32), 3), JOINTS, atol=1e-6, rtol=0)
    assert read_joints(arm, [[0, 1, -1]], 1).tolist() == [[0.0, 1.0, -1.0]]


@pytest.mark.parametrize("offsets", [False, True])
def test_a_camera_on_a_link_is_found_in_its_frame(arm, offsets):
    """Half a meter over the last link, looking down at the rest of the robot."""
    link = arm.part_names[-1]
    placed = offset(0.05, -0.1, 0.9)
    placed[:3, :3] = so3_exp(torch.tensor([1.4, 0.5, -0.3], dtype=torch.float64))
    generator, clouds = torch.Generator().manual_seed(0), []
    for row in JOINTS:
        pose = torch.nn.functional.pad(row, (6, 0))
        to_camera = placed @ torch.linalg.inv(arm.part_transforms(pose)[-1])
        skin = arm.file_skin()
        mesh = tr.TriangleMesh(transform_points(to_camera, skin(pose)), skin.faces)
        points = sample_visible(mesh, torch.zeros(3), 280, generator)[0]
        clouds.append(points + 0.001 * torch.randn(points.shape, generator=generator, dtype=torch.float64))
    found = tr.calibrate_base(arm, clouds, JOINTS - (OFF if offsets else 0), offsets, camera_link=link)
    assert found.camera_link == link
    assert found.status is tr.Status.CONVERGED
    torch.testing.assert_close(found.T_camera_base, placed, rtol=0, atol=0.006)
    assert not offsets or math.degrees(float((found.offsets - OFF)[1].abs())) < 0.3
    with pytest.raises(tr.errors.InputError, match="camera_link must be a link of the robot"):
        tr.calibrate_base(arm, clouds, JOINTS, camera_link="flange")
