import pytest
import torch

from torchreg.datasets.hand import hand_motion
from torchreg.datasets.pictures import PictureStyle, backdrop, render, stereo_cameras
from torchreg.datasets.videos import shape_video
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh


@pytest.fixture(scope="module")
def pair():
    return stereo_cameras(width=80, height=60, focal=100.0)


def test_video_is_what_single_pictures_show_with_the_noise_drawn_anew(plain_hand, plain_hand_surface, pair):
    style = PictureStyle(wall=0.9, noise=0.0, supersampling=1)
    poses = hand_motion(plain_hand, "rotation", 2, distance=0.6)
    frames = list(shape_video(plain_hand, poses, pair, skin=plain_hand_surface, style=style, forearm=False, seed=3))
    assert [len(frame) for frame in frames] == [2, 2]
    rest = plain_hand_surface(plain_hand.rest_pose())
    for pose, frame in zip(poses, frames, strict=True):
        mesh = TriangleMesh(plain_hand_surface(pose), plain_hand_surface.faces)
        for camera, picture in zip((pair.left, pair.right), frame, strict=True):
            single = render(mesh, camera, rest, style=style, seed=3)
            assert torch.allclose(picture.image, single.image, atol=1e-6)
            assert torch.equal(picture.mask, single.mask)
    noisy = PictureStyle(wall=0.9, noise=0.05, supersampling=1)
    still = poses[:1].expand(2, -1)
    first, second = shape_video(plain_hand, still, pair, skin=plain_hand_surface, style=noisy)
    assert not torch.equal(first[0].image, second[0].image)
    assert torch.equal(first[0].depth, second[0].depth)


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
    # It hides the wrist at most.
    assert with_arm.mask.sum() > 0.9 * alone.mask.sum()
    # It goes on beyond the picture.
    assert (with_arm.face_index[-1] >= 0).any()


def test_backdrop_has_a_color_per_ray(pair):
    plain = backdrop(pair.left, style=PictureStyle(background=(0.1, 0.2, 0.3)))
    assert plain.shape == (120, 160, 3)
    assert torch.allclose(plain, torch.tensor([0.1, 0.2, 0.3]).expand_as(plain))
    wall = backdrop(pair.left, style=PictureStyle(wall=1.0))
    assert wall.std() > 0.02


def test_arguments_are_checked(plain_hand, plain_hand_skin, pair):
    with pytest.raises(InputError, match="skin must have faces"):
        next(shape_video(plain_hand, plain_hand.rest_pose()[None], pair, skin=plain_hand_skin))
    with pytest.raises(InputError, match="poses must have shape"):
        next(shape_video(plain_hand, plain_hand.rest_pose(), pair))
