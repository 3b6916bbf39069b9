"""Pictures of made-up shapes: depth, mask, texture and noise as they should be."""

import pytest
import torch
import trimesh

import torchreg as tr
from experiments.made_up.pictures import PictureStyle, camera_ring, render, stereo_cameras, value_noise
from experiments.made_up.videos import shape_video

CAMERA = tr.Camera.looking_at([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], focal=60.0, width=48, height=40)
SHARP = PictureStyle(noise=0.0, supersampling=1)


@pytest.fixture(scope="module")
def ball():
    mesh = trimesh.creation.icosphere(3)
    vertices = 0.1 * torch.tensor(mesh.vertices.tolist(), dtype=torch.float64) + torch.tensor([0.0, 0.0, 0.5])
    return tr.TriangleMesh(vertices, torch.tensor(mesh.faces.tolist()))


@pytest.fixture(scope="module")
def pair():
    return stereo_cameras(width=80, height=60, focal=100.0)


@pytest.fixture(scope="module")
def video(plain_hand, plain_hand_surface):
    """Return the function that renders a hand at rest, 0.6 m away."""
    pose = plain_hand.rest_pose()
    pose[2] += 0.6

    def frame(cameras, skin=plain_hand_surface, poses=pose[None], **settings):
        return next(iter(shape_video(plain_hand, poses, cameras, skin=skin, **settings)))

    frame.pose = pose
    return frame


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda video, pair, ball: PictureStyle(noise=-1.0), "noise must be zero or positive"),
        (lambda video, pair, ball: PictureStyle(supersampling=0), "supersampling must be at least 1"),
        (lambda video, pair, ball: PictureStyle(wall=0.0), "wall must be positive"),
        (lambda video, pair, ball: render(ball, pair.left, torch.zeros(3, 3)), "rest must have shape"),
        (lambda video, pair, ball: camera_ring([0, 0, 0], 1.0, 1), "count must be at least 2"),
        (lambda video, pair, ball: value_noise(torch.zeros(2, 3), 0.0), "wavelength must be positive"),
        (lambda video, pair, ball: video(pair, skin=tr.sample_skin(tr.Hand(), 50)), "skin must have faces"),
        (lambda video, pair, ball: video(pair, poses=video.pose), "poses must have shape"),
    ],
)
def test_bad_arguments_are_named(video, pair, ball, call, message):
    with pytest.raises((tr.errors.InputError, tr.errors.InputTypeError), match=message):
        call(video, pair, ball)


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


def test_texture_moves_with_the_surface(ball):
    style = PictureStyle(noise=0.0, light=(0.0, 0.0, -1.0))
    still = render(ball, CAMERA, style=style)
    # Two pixels to the right at every depth: the camera turns instead of the ball.
    shifted = CAMERA.intrinsics + torch.tensor([0.0, 0.0, 2.0, 0.0], dtype=torch.float64)
    moved = render(ball, tr.Camera(48, 40, shifted, CAMERA.world_to_camera), style=style)
    assert torch.allclose(moved.image[:, 2:], still.image[:, :-2], atol=1e-6)
    step = ball.vertices.new_tensor([0.3, 0.0, 0.0])
    away = tr.TriangleMesh(ball.vertices + step, ball.faces)
    other = tr.Camera.looking_at(step, step + step.new_tensor([0, 0, 1]), focal=60.0, width=48, height=40)
    assert torch.allclose(render(away, other, ball.vertices, style=style).image, still.image, atol=1e-6)


def test_video_is_what_single_pictures_show(video, plain_hand, plain_hand_surface, pair):
    frame, other = (video(pair, style=SHARP, forearm=False, seed=seed) for seed in (3, 4))
    mesh = tr.TriangleMesh(plain_hand_surface(video.pose), plain_hand_surface.faces)
    for camera, picture in zip((pair.left, pair.right), frame, strict=True):
        single = render(mesh, camera, plain_hand_surface(plain_hand.rest_pose()), style=SHARP, seed=3)
        assert torch.allclose(picture.image, single.image, atol=1e-6)
        assert torch.equal(picture.mask, single.mask)
    assert not torch.equal(frame[0].image, other[0].image)
    # The forearm is visible but not in the mask.
    with_arm, alone = video(pair, style=SHARP, forearm=True)[0], frame[0]
    assert torch.equal(alone.mask, alone.face_index >= 0)
    assert ((with_arm.face_index >= 0).sum() - alone.mask.sum()) > 100
    assert (with_arm.mask & ~alone.mask).sum() == 0
