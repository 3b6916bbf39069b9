"""Cameras: projection and its inverse, lenses, views, rigs by name, and stereo pairs."""

import math

import pytest
import torch

from tests.geometry.draws import D, rand
from torchreg.errors import InputError
from torchreg.geometry.camera import Camera, lens_jacobian
from torchreg.geometry.camera_rig import CameraRig, StereoPair
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rigid import invert_rigid, rigid_matrix, se3_exp, transform_points
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.visibility import rasterize

LENSES = {
    "none": (),
    "four": (-0.2, 0.05, 1e-3, -2e-3),
    "five": (-0.2, 0.05, 1e-3, -2e-3, 0.01),
    "eight": (0.1, -0.05, 1e-3, -2e-3, 0.01, 0.3, -0.1, 0.02),
}


def make(lens=(), dtype=D):
    motion = se3_exp(torch.tensor([0.1, -0.2, 0.3, 0.2, -0.4, 0.1], dtype=D))
    values = torch.tensor([610.0, 590.0, 322.0, 236.0], dtype=D)
    return Camera(640, 480, values, motion, torch.tensor(lens, dtype=D)).to(dtype)


def points_before(camera, count=50):
    local = (rand(count, 3) * 2 - 1) * torch.tensor([0.5, 0.4, 0.5]) + torch.tensor([0.0, 0.0, 1.5])
    return transform_points(camera.camera_to_world.double(), local)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_projection_agrees_with_kornia_and_opencv_and_is_undone(lens):
    from kornia.geometry.calibration import distort_points

    camera = make(lens)
    points = points_before(camera).reshape(5, 10, 3)
    local = transform_points(camera.world_to_camera, points).flatten(0, 1)
    plain = local[:, :2] / local[:, 2:] * camera.intrinsics[:2] + camera.intrinsics[2:]
    expected = distort_points(plain, camera.matrix, camera.distortion)
    pixels, depth = camera.project(points)
    assert (pixels.flatten(0, 1) - expected).abs().max() < 1e-6
    assert (camera.unproject(pixels, depth) - points).abs().max() < 1e-10
    single = make(lens, torch.float32)
    pixels, depth = single.project(points.float())
    assert pixels.dtype == torch.float32
    assert (single.unproject(pixels, depth) - points).abs().max() < 1e-4
    cv2 = pytest.importorskip("cv2")
    still = torch.zeros(3, dtype=D).numpy()
    theirs, _ = cv2.projectPoints(local.numpy(), still, still, camera.matrix.numpy(), camera.distortion.numpy())
    assert (expected - torch.from_numpy(theirs[:, 0])).abs().max() < 1e-6


def test_points_behind_have_no_pixel_and_no_gradient():
    camera = Camera(4, 4, (2.0, 2.0, 1.5, 1.5))
    points = torch.tensor([[0.0, 0.0, -1.0], [0.1, 0.0, 0.0], [0.5, 0.0, 1.0]], dtype=torch.float64, requires_grad=True)
    pixels, depth = camera.project(points)
    assert pixels.isnan().all(-1).tolist() == [True, True, False]
    assert depth.tolist() == [-1.0, 0.0, 1.0]
    pixels[2].sum().backward()
    assert points.grad.isfinite().all()
    assert camera.contains(pixels).tolist() == [False, False, True]


def test_gradients_of_points_lens_and_place():
    camera = make(LENSES["eight"])
    points = points_before(camera, 3).requires_grad_()
    pixels, depth = (part.detach().requires_grad_() for part in camera.project(points))
    parts = [camera.intrinsics.clone(), camera.distortion.clone(), torch.zeros(6, dtype=D)]
    parts = [part.requires_grad_() for part in parts]

    def build(intrinsics, lens, twist):
        return Camera(640, 480, intrinsics, se3_exp(twist) @ camera.world_to_camera, lens)

    assert torch.autograd.gradcheck(lambda points, *parts: build(*parts).project(points)[0], (points, *parts))
    back = (pixels, depth, *parts)
    assert torch.autograd.gradcheck(lambda pixels, depth, *parts: build(*parts).unproject(pixels, depth), back)


def test_lens_jacobian_is_the_derivative():
    camera = make(LENSES["eight"])
    plane = torch.tensor([[0.1, -0.2], [0.0, 0.0], [0.4, 0.3]], dtype=D)
    expected = torch.func.vmap(torch.func.jacrev(camera.distorted))(plane)
    assert torch.allclose(lens_jacobian(plane, camera.distortion), expected, atol=1e-12)


def test_pixels_that_the_lens_never_reaches_are_nan():
    # r (1 - 0.2 r^2) has its largest value, 0.86, at r = 1.29.
    camera = Camera(100, 100, (10.0, 10.0, 0.0, 0.0), distortion=(-0.2, 0.0, 0.0, 0.0))
    found = camera.undistorted(torch.tensor([[0.5, 0.0], [0.9, 0.0]], dtype=torch.float64))
    assert found.isnan().all(-1).tolist() == [False, True]


def test_looking_at_puts_the_target_in_the_middle():
    camera = Camera.looking_at([1.0, 2.0, 3.0], [0.0, 0.5, 0.0], focal=500.0, width=64, height=48, name="a")
    pixels, depth = camera.project(torch.tensor([[0.0, 0.5, 0.0]], dtype=torch.float64))
    assert torch.allclose(pixels, pixels.new_tensor([[31.5, 23.5]]))
    assert float(depth) == pytest.approx(math.sqrt(1 + 2.25 + 9))
    assert torch.allclose(camera.position, pixels.new_tensor([1.0, 2.0, 3.0]))
    assert camera.name == "a"


def test_scaled_and_moved_cameras_see_the_same():
    camera = make(LENSES["five"])
    points = points_before(camera)
    pixels, _ = camera.project(points)
    half, _ = camera.scaled(0.5).project(points)
    assert torch.allclose((half + 0.5) * 2 - 0.5, pixels)
    motion = se3_exp(torch.tensor([0.3, 0.1, -0.2, 0.5, 0.2, 0.1], dtype=torch.float64))
    assert torch.allclose(camera.moved(motion).project(transform_points(motion, points))[0], pixels)


def test_view_rasterizes_what_project_says():
    camera = Camera(32, 24, (30.0, 30.0, 14.0, 11.0), make().world_to_camera)
    local = torch.tensor([[-2.0, -2.0, 2.0], [2.0, -2.0, 3.0], [0.0, 3.0, 2.5]], dtype=torch.float64)
    triangle = TriangleMesh(transform_points(invert_rigid(camera.world_to_camera), local), torch.tensor([[0, 1, 2]]))
    raster = rasterize(triangle, camera.view())
    seen = raster.face_index >= 0
    points = (raster.barycentric[seen].unsqueeze(-1) * triangle.vertices).sum(-2)
    pixels, depth = camera.project(points)
    assert torch.allclose(pixels, camera.pixel_grid()[seen], atol=1e-9)
    assert torch.allclose(depth, raster.depth[seen])


def at(x, turn=(0.0, 0.0, 0.0), intrinsics=(600.0, 600.0, 319.5, 239.5), **kwargs):
    rotation = so3_exp(torch.tensor(turn, dtype=D))
    return Camera(
        640, 480, intrinsics, rigid_matrix(rotation, -rotation @ torch.tensor([x, 0.0, 0.0]).double()), **kwargs
    )


def test_disparity_is_the_difference_of_columns_and_deviations_its_derivative():
    motion = se3_exp(torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], dtype=D))
    pair = StereoPair(at(-0.06).moved(motion), at(0.06, intrinsics=(600.0, 600.0, 310.0, 239.5)).moved(motion))
    assert pair.baseline == pytest.approx(0.12)
    assert pair.is_rectified
    depth = torch.tensor([0.5, 0.8], dtype=D)
    pixels = torch.tensor([[400.0, 100.0], [300.0, 200.0]], dtype=D)
    other, _ = pair.right.project(pair.left.unproject(pixels, depth))
    disparity = pixels[:, 0] - other[:, 0]
    assert torch.allclose(pair.disparity(depth), disparity)
    assert torch.allclose(pair.depth(disparity), depth)
    assert torch.allclose(other[:, 1], pixels[:, 1])
    assert pair.depth(torch.tensor([0.0])).isnan().all()
    assert torch.allclose((pair.depth(disparity - 1e-4) - depth) / 1e-4, pair.depth_std(depth, 1.0), rtol=1e-5)


@pytest.mark.parametrize(
    "change",
    [
        *({"turn": tuple(row)} for row in (0.01 * torch.eye(3)).tolist()),
        {"intrinsics": (600.0, 600.0, 319.5, 250.0)},
        {"intrinsics": (620.0, 600.0, 319.5, 239.5)},
        {"distortion": (0.1, 0.0, 0.0, 0.0)},
        None,
    ],
)
def test_other_pairs_are_not_rectified(change):
    pair = StereoPair(at(-0.06), at(0.06).scaled(0.5) if change is None else at(0.06, **change))
    assert not pair.is_rectified
    with pytest.raises(InputError, match="the pair is not rectified"):
        pair.check_rectified()


def test_rig_finds_cameras_by_name_and_index():
    rig = CameraRig((at(0.0, name="left"), at(0.1)))
    assert rig.names == ("left", "camera1")
    assert rig["left"] is rig[0]
    assert len(rig) == len(list(rig)) == 2
    assert rig.stereo().baseline == pytest.approx(0.1)
