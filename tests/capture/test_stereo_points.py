import pytest
import torch

import torchreg as tr
from experiments.made_up.pictures import PictureStyle, render, stereo_cameras
from torchreg.capture.stereo import StereoPoints, rectify
from torchreg.capture.stereo_frames import far_end
from torchreg.geometry.mesh import unit_sphere
from torchreg.geometry.rigid import se3_exp
from torchreg.io.images import save_image

FormatError, InputError = tr.errors.FormatError, tr.errors.InputError

NEAR = tr.StereoConfig(nearest=0.4, farthest=1.0)


def ball_before(cameras, style=None):
    mesh = unit_sphere(4, dtype=torch.float64)
    mesh = tr.TriangleMesh(0.1 * mesh.vertices + mesh.vertices.new_tensor([0.0, 0.0, 0.6]), mesh.faces)
    generator = torch.Generator().manual_seed(0)
    style = PictureStyle(wall=0.85) if style is None else style
    return [render(mesh, camera, style=style, generator=generator) for camera in cameras]


@pytest.fixture(scope="module")
def scene():
    pair = stereo_cameras(width=200, height=150, focal=240.0)
    left, right = ball_before((pair.left, pair.right))
    return pair, left, right, tr.stereo_points(left.image, right.image, pair, config=NEAR)


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
    near = tr.stereo_points(
        left.image, right.image, pair, config=tr.StereoConfig(nearest=0.4, farthest=0.7, both=False)
    )
    assert 0 < len(near) < len(found)
    assert near.points[:, 2].max() < 0.71
    box = torch.tensor([[0.0, -1.0, 0.0], [1.0, 1.0, 2.0]])
    half = tr.stereo_points(left.image, right.image, pair, config=NEAR, box=box)
    assert 0 < len(half) < len(found)
    assert (half.points[:, 0] >= 0).all()
    few = tr.stereo_points(left.image, right.image, pair, config=tr.StereoConfig(num_corners=20))
    assert len(few) == 20


def test_textured_places_stand_in_for_corners(scene):
    pair, left, right, found = scene
    least = len(found) + 100
    config = tr.StereoConfig(nearest=0.4, farthest=1.0, least=least)
    more = tr.stereo_points(left.image, right.image, pair, config=config)
    assert len(more) >= len(found) + 50
    error, _ = errors(scene, more)
    assert error.median() < 3e-3
    assert (error <= 3 * more.depth_std).float().mean() >= 0.95
    corners = {tuple(pixel) for pixel in found.pixels.tolist()}
    assert corners <= {tuple(pixel) for pixel in more.pixels.tolist()}
    added = torch.tensor([pixel for pixel in more.pixels.tolist() if tuple(pixel) not in corners])
    apart = torch.cdist(added, more.pixels, p=torch.inf)
    assert apart[apart > 0].min() >= 3


def test_rectified_pictures_of_a_turned_pair_with_lenses_match():
    pair = stereo_cameras(width=200, height=150, focal=240.0)
    twist = torch.tensor([0.0, 0.004, 0.002, 0.02, -0.03, 0.02], dtype=torch.float64)
    turned = tr.Camera(200, 150, pair.right.intrinsics + 1, se3_exp(twist) @ pair.right.world_to_camera)
    crooked = tr.StereoPair(pair.left, turned)
    left, right = ball_before((crooked.left, crooked.right))
    with pytest.raises(InputError, match="is not rectified"):
        tr.stereo_points(left.image, right.image, crooked, config=NEAR)
    first, second, straight = rectify(left.image, right.image, crooked)
    assert straight.is_rectified
    assert straight.baseline == pytest.approx(crooked.baseline)
    found = tr.stereo_points(first, second, straight, config=NEAR)
    # Ball or wall: the points lie on one of them.
    off = torch.minimum(
        ((found.points - found.points.new_tensor([0.0, 0.0, 0.6])).norm(dim=-1) - 0.1).abs(),
        (found.points[:, 2] - 0.85).abs(),
    )
    assert len(found) > 100
    assert off.median() < 3e-3


def test_swapped_strange_and_wrongly_sized_pictures_are_refused(scene):
    pair, left, right, _ = scene
    with pytest.raises(InputError, match="left and right pictures are swapped"):
        tr.stereo_points(right.image, left.image, pair, config=NEAR)


NOISE = torch.rand(2, 150, 200, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    ("left", "right", "options", "words"),
    [
        (NOISE[0], NOISE[1], {}, "left and right hardly match"),
        (NOISE[0], NOISE[1, 1:], {}, r"right must have shape \(150, 200\)"),
        (NOISE[0] / 0, NOISE[1], {}, "left must be finite"),
        (
            NOISE[0],
            NOISE[1],
            {"config": tr.StereoConfig(nearest=0.05)},
            "nearest must keep disparities within the pict",
        ),
        (NOISE[0], NOISE[1], {"box": torch.zeros(3)}, r"box must have shape \(2, 3\)"),
    ],
)
def test_bad_pictures_are_refused(scene, left, right, options, words):
    with pytest.raises(InputError, match=words):
        tr.stereo_points(left, right, scene[0], **{"config": NEAR, **options})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"nearest": 1.0, "farthest": 0.5}, "farthest must be beyond nearest"),
        ({"method": "magic"}, "method must be one of semi-global, block, opencv; got 'magic'"),
        ({"num_corners": 20, "least": 30}, "least must be at most num_corners"),
    ],
)
def test_bad_settings_are_named(change, words):
    with pytest.raises(InputError, match=words):
        tr.StereoConfig(**change)


NEAR_BALL = tr.StereoConfig(nearest=0.45, farthest=0.8)


@pytest.fixture(scope="module")
def pair():
    return stereo_cameras(width=160, height=120, focal=190.0)


def ball_at(x, cameras):
    mesh = unit_sphere(3, dtype=torch.float64)
    mesh = tr.TriangleMesh(0.1 * mesh.vertices + mesh.vertices.new_tensor([x, 0.0, 0.6]), mesh.faces)
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
    frames = tr.StereoFrames(folders / "left", folders / "right", pair, config=NEAR_BALL)
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


def test_what_comes_in_through_the_border_is_cut_off(pair):
    # A strip of one depth from the upper border to the middle; its lower end is the far one.
    dense = torch.full((120, 160), torch.nan, dtype=torch.float64)
    dense[:70, 80:100] = pair.disparity(torch.tensor(0.6))
    row, column = torch.meshgrid(torch.arange(2, 70, 3), torch.arange(80, 100, 3), indexing="ij")
    pixels = torch.stack((column, row), dim=-1).reshape(-1, 2).double()
    points = pair.left.unproject(pixels, torch.full((len(pixels),), 0.6, dtype=torch.float64))
    std = torch.ones(len(points), dtype=torch.float64)
    found = StereoPoints(points, std, std[:, None, None] * torch.eye(3), pixels, std, std, dense)
    kept = far_end(found, pair, NEAR_BALL, 0.1)
    low = points[:, 1].max()
    # The line to the farthest corner is a little slanted.
    assert (kept != (points[:, 1] >= low - 0.1)).sum() < 6
    assert 0 < kept.sum() < len(points)
    # A single point beyond is no end.
    more = [torch.cat((value, value[:1])) for value in (std, found.covariance, pixels, std, std)]
    lone = StereoPoints(torch.cat((points, points.new_tensor([[0.0, 0.3, 0.6]]))), *more, dense)
    assert torch.equal(far_end(lone, pair, NEAR_BALL, 0.1)[:-1], kept)
    dense[:20] = torch.nan
    assert far_end(found, pair, NEAR_BALL, 0.1).all()
    assert len(found.subset(kept)) == int(kept.sum())


def test_errors_name_the_files(folders, pair, tmp_path):
    with pytest.raises(FormatError, match=r"right.f9.png and .*left.f9.png: left and right pictures are swapped"):
        tr.StereoFrames(folders / "right", folders / "left", pair, config=NEAR_BALL)[0]
    (tmp_path / "one").mkdir()
    with pytest.raises(FormatError, match="holds no pictures"):
        tr.StereoFrames(folders / "left", tmp_path / "one", pair)
    save_image(tmp_path / "one" / "0.png", torch.zeros(120, 160))
    with pytest.raises(FormatError, match=r"equally many pictures, one per frame; got .*left 2, .*one 1"):
        tr.StereoFrames(folders / "left", tmp_path / "one", pair)
    with pytest.raises(FormatError, match="hardly match"):
        tr.StereoFrames(tmp_path / "one", tmp_path / "one", pair, config=NEAR_BALL)[0]
    small = stereo_cameras(width=100, height=120, focal=190.0)
    with pytest.raises(FormatError, match=r"left must have shape \(120, 100, 3\)"):
        tr.StereoFrames(folders / "left", folders / "right", small, config=NEAR_BALL)[0]
    with pytest.raises(FileNotFoundError, match="does not exist"):
        tr.StereoFrames(tmp_path / "none", tmp_path / "one", pair)
    with pytest.raises(InputError, match="reach must be positive"):
        tr.StereoFrames(folders / "left", folders / "right", pair, reach=0.0)
