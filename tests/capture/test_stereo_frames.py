import pytest
import torch

from torchreg.capture.stereo import StereoConfig, StereoPoints
from torchreg.capture.stereo_frames import StereoFrames, far_end
from torchreg.datasets.pictures import PictureStyle, render, stereo_cameras
from torchreg.errors import FormatError, InputError
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import StereoPair
from torchreg.geometry.mesh import TriangleMesh, unit_sphere
from torchreg.geometry.rigid import se3_exp
from torchreg.io.images import save_image

CONFIG = StereoConfig(nearest=0.45, farthest=0.8)


@pytest.fixture(scope="module")
def pair():
    return stereo_cameras(width=160, height=120, focal=190.0)


def ball_at(x, cameras):
    mesh = unit_sphere(3, dtype=torch.float64)
    mesh = TriangleMesh(0.1 * mesh.vertices + mesh.vertices.new_tensor([x, 0.0, 0.6]), mesh.faces)
    return [render(mesh, camera, style=PictureStyle(wall=0.9)).image for camera in cameras]


@pytest.fixture(scope="module")
def folders(pair, tmp_path_factory):
    """Two frames whose numbers sort otherwise than their names."""
    place = tmp_path_factory.mktemp("pair")
    for name in ("left", "right"):
        (place / name).mkdir()
    for number, x in ((9, -0.02), (10, 0.02)):
        for name, image in zip(("left", "right"), ball_at(x, (pair.left, pair.right)), strict=True):
            save_image(place / name / f"f{number}.png", image)
    return place


def test_frames_come_in_order_as_points_on_the_ball(folders, pair):
    frames = StereoFrames(folders / "left", folders / "right", pair, config=CONFIG)
    assert len(frames) == 2
    assert [name[-7:] for name in frames.names] == ["/f9.png", "f10.png"]
    clouds = frames[:]
    for cloud, x in zip(clouds, (-0.02, 0.02), strict=True):
        off = ((cloud - torch.tensor([x, 0.0, 0.6])).norm(dim=-1) - 0.1).abs()
        assert cloud.dtype == torch.float32
        assert len(cloud) > 20
        assert off.median() < 3e-3
    assert frames[-1] is clouds[1]
    sight = frames.sight(1)
    assert sight is frames.sight(1)
    assert torch.equal(sight.points.points.float(), clouds[1])
    assert sight.left.shape == (120, 160, 3)


def test_pictures_of_a_turned_pair_are_rectified(pair, tmp_path):
    twist = torch.tensor([0.0, 0.002, 0.0, 0.01, -0.02, 0.01], dtype=torch.float64)
    turned = Camera(160, 120, pair.right.intrinsics, se3_exp(twist) @ pair.right.world_to_camera)
    crooked = StereoPair(pair.left, turned)
    for name, image in zip(("left", "right"), ball_at(0.0, (pair.left, turned)), strict=True):
        (tmp_path / name).mkdir()
        save_image(tmp_path / name / "0.png", image)
    cloud = StereoFrames(tmp_path / "left", tmp_path / "right", crooked, config=CONFIG)[0]
    assert len(cloud) > 20
    assert ((cloud - torch.tensor([0.0, 0.0, 0.6])).norm(dim=-1) - 0.1).abs().median() < 3e-3


def test_what_comes_in_through_the_border_is_cut_off(pair):
    # A strip of one depth from the upper border to the middle; its lower end is the far one.
    dense = torch.full((120, 160), torch.nan, dtype=torch.float64)
    dense[:70, 80:100] = pair.disparity(torch.tensor(0.6))
    row, column = torch.meshgrid(torch.arange(2, 70, 3), torch.arange(80, 100, 3), indexing="ij")
    pixels = torch.stack((column, row), dim=-1).reshape(-1, 2).double()
    points = pair.left.unproject(pixels, torch.full((len(pixels),), 0.6, dtype=torch.float64))
    std = torch.ones(len(points), dtype=torch.float64)
    found = StereoPoints(points, std, std[:, None, None] * torch.eye(3), pixels, std, std, dense)
    kept = far_end(found, pair, CONFIG, 0.1)
    low = points[:, 1].max()
    # The line to the farthest corner is a little slanted.
    assert (kept != (points[:, 1] >= low - 0.1)).sum() < 6
    assert 0 < kept.sum() < len(points)
    # A single point beyond is no end.
    more = [torch.cat((value, value[:1])) for value in (std, found.covariance, pixels, std, std)]
    lone = StereoPoints(torch.cat((points, points.new_tensor([[0.0, 0.3, 0.6]]))), *more, dense)
    assert torch.equal(far_end(lone, pair, CONFIG, 0.1)[:-1], kept)
    dense[:20] = torch.nan
    assert far_end(found, pair, CONFIG, 0.1).all()
    assert len(found.subset(kept)) == int(kept.sum())


def test_errors_name_the_files(folders, pair, tmp_path):
    with pytest.raises(FormatError, match=r"right.f9.png and .*left.f9.png: left and right pictures are swapped"):
        StereoFrames(folders / "right", folders / "left", pair, config=CONFIG)[0]
    (tmp_path / "one").mkdir()
    with pytest.raises(FormatError, match="holds no pictures"):
        StereoFrames(folders / "left", tmp_path / "one", pair)
    save_image(tmp_path / "one" / "0.png", torch.zeros(120, 160))
    with pytest.raises(FormatError, match=r"equally many pictures, one per frame; got .*left 2, .*one 1"):
        StereoFrames(folders / "left", tmp_path / "one", pair)
    with pytest.raises(FormatError, match="hardly match"):
        StereoFrames(tmp_path / "one", tmp_path / "one", pair, config=CONFIG)[0]
    small = stereo_cameras(width=100, height=120, focal=190.0)
    with pytest.raises(FormatError, match=r"left must have shape \(120, 100, 3\)"):
        StereoFrames(folders / "left", folders / "right", small, config=CONFIG)[0]
    with pytest.raises(FileNotFoundError, match="does not exist"):
        StereoFrames(tmp_path / "none", tmp_path / "one", pair)
    with pytest.raises(InputError, match="reach must be positive"):
        StereoFrames(folders / "left", folders / "right", pair, reach=0.0)
