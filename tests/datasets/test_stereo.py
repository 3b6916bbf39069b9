import pytest
import torch

from torchreg.datasets.hand import hand_motion
from torchreg.datasets.stereo import StereoView, stereo_clouds
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.visibility import visible_points
from torchreg.shapes.skin import LinearBlendSkin

EYE = torch.eye(4, dtype=torch.float64)
SMALL = StereoView(focal=300.0, width=320, height=240)
CLEAN = StereoView(focal=400.0, width=440, height=340, disparity_noise=0.0, lateral_noise=0.0)


def before(depth, count=2000, seed=0):
    """Return points at one depth, all over the picture."""
    flat = torch.rand(count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 0.5
    return torch.cat([0.5 * depth * flat, torch.full((count, 1), float(depth), dtype=torch.float64)], dim=-1)


def test_the_pair_is_rectified():
    stereo, points = StereoView(baseline=0.08, focal=500.0), before(0.7)
    (left, depth), (right, _) = (view.project(points) for view in stereo.views())
    torch.testing.assert_close(left[:, 1], right[:, 1])
    torch.testing.assert_close(left[:, 0] - right[:, 0], 500.0 * 0.08 / depth)
    middle = stereo.views()[0].project(torch.tensor([[-0.04, 0.0, 1.0]]))[0]
    torch.testing.assert_close(middle, torch.tensor([[320.0, 240.0]], dtype=torch.float64))


@pytest.mark.parametrize("depth", [0.4, 0.6, 1.2])
def test_noise_is_that_of_disparity_and_pixels(depth):
    """Measured in the pictures, whatever the depth, the noise is what was asked for."""
    stereo = StereoView(disparity_noise=0.3, lateral_noise=0.2)
    points = before(depth, 6000)
    measured = stereo.measured(points, torch.Generator().manual_seed(1))
    left = stereo.views()[0]
    (true, _), (found, found_depth) = left.project(points), left.project(measured)
    disparity = 600 * 0.1 / found_depth - 600 * 0.1 / depth
    assert float(disparity.std()) == pytest.approx(0.3, rel=0.05)
    assert abs(float(disparity.mean())) < 0.02
    torch.testing.assert_close((found - true).std(0), torch.full((2,), 0.2, dtype=torch.float64), rtol=0.05, atol=0)
    spread = float((measured - points)[:, 2].std())
    assert spread == pytest.approx(float(stereo.depth_std(points[0, 2])), rel=0.05)
    assert spread == pytest.approx(depth**2 * 0.3 / 60, rel=0.05)


def test_no_noise_leaves_points_alone():
    points = before(0.5)
    torch.testing.assert_close(CLEAN.measured(points, torch.Generator()), points)


@pytest.mark.parametrize(
    "options", [{"baseline": 0.0}, {"focal": -1.0}, {"width": 0}, {"height": -3}, {"disparity_noise": -0.1}]
)
def test_impossible_cameras_are_refused(options):
    with pytest.raises(InputError, match=f"{next(iter(options))} must be"):
        StereoView(**options)


def test_clean_points_lie_on_the_surface_and_both_cameras_see_them(arm, arm_skin):
    poses = hand_motion(arm, "rotation", 4, 1.0, distance=0.6)
    clouds = stereo_clouds(arm, poses, stereo=CLEAN, skin=arm_skin, num_points=200, outlier_ratio=0.2)
    for cloud, pose in zip(clouds, poses, strict=True):
        points = cloud.points[cloud.inliers]
        assert float(arm.distance(points, pose).abs().max()) < 1e-3
        nearest = arm.part_distances(points, pose).argmin(-1)
        assert float((nearest == cloud.part_labels[cloud.inliers]).float().mean()) > 0.95
        mesh = TriangleMesh(arm_skin(pose), arm_skin.faces)
        for side in (-0.05, 0.05):
            assert float(visible_points(mesh, points, torch.tensor([side, 0.0, 0.0])).float().mean()) > 0.99


def test_a_far_right_camera_hides_the_left_side(arm, arm_skin):
    pose = hand_motion(arm, "bend", 1, distance=0.6)
    wide = StereoView(baseline=0.6, focal=200.0, width=440, height=300, disparity_noise=0.0, lateral_noise=0.0)
    clouds = [
        stereo_clouds(arm, pose, stereo=stereo, skin=arm_skin, num_points=300, outlier_ratio=0.0)[0]
        for stereo in (CLEAN, wide)
    ]
    narrow_width, wide_width = ((cloud.points[:, 0].amax() - cloud.points[:, 0].amin()) for cloud in clouds)
    assert float(wide_width) < 0.95 * float(narrow_width)
    mesh = TriangleMesh(arm_skin(pose[0]), arm_skin.faces)
    for side in (-0.3, 0.3):
        assert float(visible_points(mesh, clouds[1].points, torch.tensor([side, 0.0, 0.0])).float().mean()) > 0.99


def test_other_shapes_have_no_forearm(arm, arm_skin):
    pose = hand_motion(arm, "bend", 1, distance=0.6)
    (cloud,) = stereo_clouds(arm, pose, stereo=CLEAN, skin=arm_skin, num_points=100, outlier_ratio=0.5)
    far = cloud.points[~cloud.inliers][:, 2] > 0.8
    assert int(far.sum()) == 30
    assert int((~cloud.inliers).sum()) == 100


def sheet_at(depth, x, y):
    corners = torch.tensor([[-x, -y, depth], [x, -y, depth], [x, y, depth], [-x, y, depth]])
    return TriangleMesh(corners, torch.tensor([[0, 2, 1], [0, 3, 2]]))


def test_obstacles_of_ones_own(arm, arm_skin):
    poses = torch.stack([hand_motion(arm, "bend", 1, distance=0.6)[0]] * 2)
    poses[1, 0] += 0.15
    sheet = sheet_at(0.3, 0.06, 0.12)
    options = {"stereo": SMALL, "skin": arm_skin, "num_points": 100, "outlier_ratio": 0.0, "obstacle": sheet}
    hidden, seen = stereo_clouds(arm, poses, **options)
    assert not bool(hidden.inliers.any())
    assert hidden.part_labels.dtype == torch.int64
    assert not bool(hidden.seen_parts.any())
    assert float((hidden.points[:, 2] - 0.3).abs().max()) < 0.02
    assert int(seen.inliers.sum()) == 100
    with pytest.raises(InputError, match="poses must show the shape to both cameras"):
        stereo_clouds(arm, poses[:1], **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_points": 0}, "num_points must be a positive integer"),
        ({"outlier_ratio": 1.0}, "outlier_ratio must be at least 0 and below 1"),
        ({"poses": torch.zeros(27)}, r"poses must have shape \(T, 27\)"),
        ({"poses": torch.zeros(2, 26)}, "poses must have shape"),
        ({"poses": torch.zeros(1, 27)}, "beside or behind"),
    ],
)
def test_stereo_clouds_refuses(hand, skin, options, message):
    poses = hand_motion(hand, num_frames=1, distance=0.6)
    with pytest.raises(InputError, match=message):
        stereo_clouds(**{"shape": hand, "poses": poses, "skin": skin, "stereo": SMALL, **options})


def test_a_skin_without_faces_is_refused(hand, skin):
    bare = LinearBlendSkin(hand, skin.points, skin.weights, hand.rest_pose())
    with pytest.raises(InputError, match="skin must have faces"):
        stereo_clouds(hand, hand.rest_pose()[None], skin=bare)
