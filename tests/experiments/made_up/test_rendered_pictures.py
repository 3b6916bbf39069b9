"""Pictures of made-up shapes: depth, mask, texture and noise as they should be."""

import pytest
import torch

from experiments.made_up.pictures import (
    PictureStyle,
    camera_ring,
    render,
    stereo_cameras,
    value_noise,
)
from experiments.made_up.videos import shape_video
from torchreg.datasets.hand import hand_motion, placed
from torchreg.geometry.camera import Camera
from torchreg.geometry.mesh import TriangleMesh, unit_sphere

CAMERA = Camera.looking_at([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], focal=60.0, width=48, height=40)


@pytest.fixture(scope="module")
def ball():
    mesh = unit_sphere(3, dtype=torch.float64)
    return TriangleMesh(0.1 * mesh.vertices + mesh.vertices.new_tensor([0.0, 0.0, 0.5]), mesh.faces)


def test_depth_and_mask_are_those_of_the_sphere(ball):
    picture = render(ball, CAMERA)
    assert picture.image.shape == (40, 48, 3)
    rays = CAMERA.directions(CAMERA.pixel_grid())
    a, b = (rays**2).sum(-1), rays[..., 2] * 0.5
    inside = b**2 - a * (0.25 - 0.01)
    assert ((inside > 0) != picture.mask).sum() < 12
    both = (inside > 1e-4) & picture.mask
    assert ((b - inside.clamp(min=0).sqrt()) / a - picture.depth)[both].abs().max() < 4e-3
    assert torch.equal(picture.mask, picture.face_index >= 0)
    assert not picture.depth[~picture.mask].any()
    assert 0 <= picture.image.min() <= picture.image.max() <= 1


def test_noise_is_as_asked_for_before_a_wall_that_is_where_it_says(ball):
    style = PictureStyle(wall=0.8, noise=0.02)
    first, other = (render(ball, CAMERA, style=style, generator=torch.Generator().manual_seed(s)) for s in (0, 1))
    assert torch.allclose(first.depth[~first.mask], first.depth.new_tensor(0.8))
    assert float((other.image - first.image).std()) == pytest.approx(0.02 * 2**0.5, rel=0.1)
    assert not torch.allclose(render(ball, CAMERA, style=style, seed=3).image, first.image, atol=0.1)
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    noise, near, far = (value_noise(points + step, 0.01) for step in (0.0, 1e-5, 0.02))
    assert noise.abs().max() <= 1
    assert (near - noise).abs().max() < 0.02
    assert max(abs(float(noise.mean())), abs(float((far * noise).mean()))) < 0.03


def test_texture_moves_with_the_surface(ball):
    style = PictureStyle(noise=0.0, light=(0.0, 0.0, -1.0))
    still = render(ball, CAMERA, style=style)
    # Two pixels to the right at every depth: the camera turns instead of the ball.
    shifted = CAMERA.intrinsics + torch.tensor([0.0, 0.0, 2.0, 0.0], dtype=torch.float64)
    moved = render(ball, Camera(48, 40, shifted, CAMERA.world_to_camera), style=style)
    assert torch.allclose(moved.image[:, 2:], still.image[:, :-2], atol=1e-6)
    step = ball.vertices.new_tensor([0.3, 0.0, 0.0])
    away = TriangleMesh(ball.vertices + step, ball.faces)
    other = Camera.looking_at(step, step + step.new_tensor([0, 0, 1]), focal=60.0, width=48, height=40)
    assert torch.allclose(render(away, other, ball.vertices, style=style).image, still.image, atol=1e-6)


def test_hand_before_a_pair_and_in_a_ring(plain_hand, plain_hand_surface):
    pair = stereo_cameras(width=80, height=60, focal=75.0)
    assert pair.is_rectified
    assert pair.baseline == pytest.approx(0.12)
    pose = placed(plain_hand, plain_hand.rest_pose(), torch.tensor([0.0, 0.0, 0.6]))
    options = {"skin": plain_hand_surface, "forearm": False}
    [(left, right)] = shape_video(plain_hand, pose[None], pair, style=PictureStyle(wall=0.9), **options)
    assert left.mask.sum() > 50
    # The disparity of the hand is about that of its distance.
    middle = [picture.mask.nonzero()[:, 1].double().mean() for picture in (left, right)]
    expected = pair.disparity(left.depth[left.mask].mean())
    assert float(middle[0] - middle[1]) == pytest.approx(float(expected), abs=1.5)
    ring = camera_ring([0.0, 0.0, 0.6], 0.5, 5, focal=50.0, width=48, height=48)
    [pictures] = shape_video(plain_hand, pose[None], ring, **options)
    assert len(pictures) == len(ring) == 5
    assert all(picture.mask.sum() > 20 for picture in pictures)
    assert all(camera.project(torch.tensor([[0.0, 0.0, 0.6]]))[1].item() == pytest.approx(0.5) for camera in ring)


@pytest.fixture(scope="module")
def pair():
    return stereo_cameras(width=80, height=60, focal=100.0)


def test_video_is_what_single_pictures_show(plain_hand, plain_hand_surface, pair):
    style = PictureStyle(wall=0.9, noise=0.0, supersampling=1)
    (pose,) = hand_motion(plain_hand, "rotation", 1, distance=0.6)
    (frame,) = shape_video(plain_hand, pose[None], pair, skin=plain_hand_surface, style=style, forearm=False, seed=3)
    mesh = TriangleMesh(plain_hand_surface(pose), plain_hand_surface.faces)
    for camera, picture in zip((pair.left, pair.right), frame, strict=True):
        single = render(mesh, camera, plain_hand_surface(plain_hand.rest_pose()), style=style, seed=3)
        assert torch.allclose(picture.image, single.image, atol=1e-6)
        assert torch.equal(picture.mask, single.mask)


def test_the_forearm_is_seen_but_not_in_the_mask(plain_hand, plain_hand_surface, pair):
    poses = hand_motion(plain_hand, "bend", 1, distance=0.6)
    style = PictureStyle(noise=0.0, supersampling=1)
    with_arm, alone = (
        next(iter(shape_video(plain_hand, poses, pair, skin=plain_hand_surface, style=style, forearm=arm)))[0]
        for arm in (True, False)
    )
    assert torch.equal(alone.mask, alone.face_index >= 0)
    assert ((with_arm.face_index >= 0).sum() - alone.mask.sum()) > 100
    assert (with_arm.mask & ~alone.mask).sum() == 0
