import pytest
import torch

from torchreg.capture.stereo import StereoConfig, rectify, stereo_points
from torchreg.datasets.pictures import PictureStyle, render, stereo_cameras
from torchreg.errors import InputError
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import StereoPair
from torchreg.geometry.mesh import TriangleMesh, unit_sphere
from torchreg.geometry.rigid import se3_exp

CONFIG = StereoConfig(nearest=0.4, farthest=1.0)


def ball_before(cameras, style=None):
    mesh = unit_sphere(4, dtype=torch.float64)
    mesh = TriangleMesh(0.1 * mesh.vertices + mesh.vertices.new_tensor([0.0, 0.0, 0.6]), mesh.faces)
    generator = torch.Generator().manual_seed(0)
    style = PictureStyle(wall=0.85) if style is None else style
    return [render(mesh, camera, style=style, generator=generator) for camera in cameras]


@pytest.fixture(scope="module")
def scene():
    pair = stereo_cameras(width=200, height=150, focal=240.0)
    left, right = ball_before((pair.left, pair.right))
    return pair, left, right, stereo_points(left.image, right.image, pair, config=CONFIG)


def errors(scene, found):
    pair, left, _, _ = scene
    column, row = found.pixels.long().unbind(-1)
    depth = pair.left.project(found.points)[1]
    return (depth - left.depth[row, column]).abs(), left.mask[row, column]


def test_points_are_within_what_they_state(scene):
    found = scene[3]
    error, on_ball = errors(scene, found)
    assert len(found) > 100
    assert on_ball.sum() > 10
    assert error.median() < 3e-3
    assert (error <= 3 * found.depth_std).float().mean() >= 0.95


def test_points_lie_on_the_rays_of_corners_of_both_pictures(scene):
    pair, _, _, found = scene
    assert torch.equal(found.pixels, found.pixels.round())
    assert (pair.left.project(found.points)[0] - found.pixels).abs().max() < 1e-2
    there, _ = pair.right.project(found.points)
    assert (found.pixels[:, 0] - there[:, 0] - found.disparity).abs().max() < 1e-2
    assert (there[:, 1] - found.pixels[:, 1]).abs().max() < 1e-2
    assert found.dense.shape == (150, 200)


def test_covariance_is_that_of_the_depth_along_the_ray(scene):
    pair, _, _, found = scene
    rays = pair.left.directions(found.pixels)
    unit = torch.nn.functional.normalize(rays, dim=-1)
    along = (unit.unsqueeze(-2) @ found.covariance @ unit.unsqueeze(-1))[:, 0, 0].sqrt()
    assert (along >= found.depth_std * rays.norm(dim=-1) * 0.999).all()
    assert torch.linalg.eigvalsh(found.covariance).min() > 0


def test_background_goes_by_depth_and_by_volume(scene):
    pair, left, right, found = scene
    near = stereo_points(left.image, right.image, pair, config=StereoConfig(nearest=0.4, farthest=0.7, both=False))
    assert 0 < len(near) < len(found)
    assert near.points[:, 2].max() < 0.71
    box = torch.tensor([[0.0, -1.0, 0.0], [1.0, 1.0, 2.0]])
    half = stereo_points(left.image, right.image, pair, config=CONFIG, box=box)
    assert 0 < len(half) < len(found)
    assert (half.points[:, 0] >= 0).all()
    few = stereo_points(left.image, right.image, pair, config=StereoConfig(num_corners=20))
    assert len(few) == 20


def test_textured_places_stand_in_for_corners(scene):
    pair, left, right, found = scene
    least = len(found) + 100
    config = StereoConfig(nearest=0.4, farthest=1.0, least=least)
    more = stereo_points(left.image, right.image, pair, config=config)
    assert len(more) >= len(found) + 50
    error, _ = errors(scene, more)
    assert error.median() < 3e-3
    assert (error <= 3 * more.depth_std).float().mean() >= 0.95
    corners = {tuple(pixel) for pixel in found.pixels.tolist()}
    assert corners <= {tuple(pixel) for pixel in more.pixels.tolist()}
    added = torch.tensor([pixel for pixel in more.pixels.tolist() if tuple(pixel) not in corners])
    apart = torch.cdist(added, more.pixels, p=torch.inf)
    assert apart[apart > 0].min() >= 3
    with pytest.raises(InputError, match="least must be at most num_corners"):
        StereoConfig(num_corners=20, least=30)


def test_rectified_pictures_of_a_turned_pair_with_lenses_match():
    pair = stereo_cameras(width=200, height=150, focal=240.0)
    twist = torch.tensor([0.0, 0.004, 0.002, 0.02, -0.03, 0.02], dtype=torch.float64)
    turned = Camera(200, 150, pair.right.intrinsics + 1, se3_exp(twist) @ pair.right.world_to_camera)
    crooked = StereoPair(pair.left, turned)
    left, right = ball_before((crooked.left, crooked.right))
    with pytest.raises(InputError, match="is not rectified"):
        stereo_points(left.image, right.image, crooked, config=CONFIG)
    first, second, straight = rectify(left.image, right.image, crooked)
    assert straight.is_rectified
    assert straight.baseline == pytest.approx(crooked.baseline)
    found = stereo_points(first, second, straight, config=CONFIG)
    # Ball or wall: the points lie on one of them.
    off = torch.minimum(
        ((found.points - found.points.new_tensor([0.0, 0.0, 0.6])).norm(dim=-1) - 0.1).abs(),
        (found.points[:, 2] - 0.85).abs(),
    )
    assert len(found) > 100
    assert off.median() < 3e-3


def test_rectify_undoes_lenses():
    pair = stereo_cameras(width=60, height=40, focal=60.0)
    bent = Camera(60, 40, pair.left.intrinsics, pair.left.world_to_camera, (-0.2, 0.05, 0.0, 0.0))
    ramp = pair.left.pixel_grid()[..., 0] / 60
    first, _, straight = rectify(ramp, ramp.unsqueeze(-1).expand(-1, -1, 3), StereoPair(bent, pair.right))
    assert straight.is_rectified
    source, _ = bent.project(bent.position + straight.left.directions(straight.left.pixel_grid()))
    inner = (slice(10, 30), slice(10, 50))
    assert torch.allclose(first[inner], source[..., 0][inner] / 60, atol=1e-6)


def test_swapped_strange_and_wrongly_sized_pictures_are_refused(scene):
    pair, left, right, _ = scene
    with pytest.raises(InputError, match="left and right pictures are swapped"):
        stereo_points(right.image, left.image, pair, config=CONFIG)
    noise = torch.rand(2, 150, 200, generator=torch.Generator().manual_seed(0))
    with pytest.raises(InputError, match="left and right hardly match"):
        stereo_points(noise[0], noise[1], pair, config=CONFIG)
    with pytest.raises(InputError, match=r"right must have shape \(150, 200\)"):
        stereo_points(noise[0], noise[1, 1:], pair, config=CONFIG)
    with pytest.raises(InputError, match="left must be finite"):
        stereo_points(noise[0] / 0, noise[1], pair, config=CONFIG)
    with pytest.raises(InputError, match="nearest must keep disparities within the picture"):
        stereo_points(noise[0], noise[1], pair, config=StereoConfig(nearest=0.05))
    with pytest.raises(InputError, match="farthest must be beyond nearest"):
        StereoConfig(nearest=1.0, farthest=0.5)
