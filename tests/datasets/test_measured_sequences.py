"""Sequences as a pair of cameras measures them: truth on the surface, noise of disparities, and outliers."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from torchreg.datasets import hand as made
from torchreg.datasets import sequences, stereo
from torchreg.geometry.visibility import visible_points

SMALL = stereo.StereoView(focal=300.0, width=320, height=240)
CLEAN = stereo.StereoView(focal=400.0, width=440, height=340, disparity_noise=0.0, lateral_noise=0.0)
WIDE = replace(CLEAN, baseline=0.6, focal=200.0, height=300)


@pytest.fixture(scope="module")
def bending(plain_hand, skin):
    options = {"shape": plain_hand, "skin": skin, "stereo": SMALL, "num_points": 300, "seed": 3}
    return sequences.hand_sequence("bending_palm", 8, 2.0, **options)


def test_truth_is_that_of_the_motion_and_counts_follow_what_is_visible(plain_hand, skin, bending):
    poses = made.hand_motion(plain_hand, "bending_palm", 8, 2.0, distance=0.6, seed=3)
    for name, expected in (("pose", poses), ("keypoints", plain_hand.keypoints(poses)), ("vertices", skin(poses))):
        torch.testing.assert_close(torch.stack([getattr(cloud, name) for cloud in bending]), expected)
    off = torch.cat([plain_hand.distance(cloud.points[cloud.inliers], cloud.pose).abs() for cloud in bending])
    # 300 pixels of focal length: 3 mm in depth at 0.6 m.
    assert 0.001 < float(off.mean()) < 0.004
    inliers = [int(cloud.inliers.sum()) for cloud in bending]
    assert max(inliers) == 300
    assert min(inliers) < 260
    for cloud, count in zip(bending, inliers, strict=True):
        assert len(cloud.points) - count == round(300 * 3 / 7)
        assert bool(((cloud.part_labels == -1) == ~cloud.inliers).all())
        assert cloud.part_counts.tolist() == torch.bincount(cloud.part_labels[cloud.inliers], minlength=16).tolist()


def test_outliers_lie_on_forearm_and_wall_and_in_the_volume(plain_hand, bending):
    vertices = torch.cat([cloud.vertices for cloud in bending])
    for cloud in bending:
        points, palm = cloud.points[~cloud.inliers], plain_hand.part_transforms(cloud.pose)[0]
        wall = points[:, 2] > 0.8
        assert int(wall.sum()) == round(0.3 * len(points))
        local = (points - palm[:3, 3]) @ palm[:3, :3]
        on_arm = (local[:, 2] < 0.02) & (local[:, :2].norm(dim=-1) < 0.1) & (local[:, 2] > -0.25) & ~wall
        assert round(0.4 * len(points)) <= int(on_arm.sum()) < 0.65 * len(points)
        # The model has no forearm.
        assert float(plain_hand.distance(points[on_arm], cloud.pose).median()) > 0.02
        rest = points[~wall & ~on_arm]
        assert bool((rest > vertices.amin(0) - 0.1).all() and (rest < vertices.amax(0) + 0.1).all())


def test_a_bar_hides_the_passing_hand(plain_hand, skin):
    options = {"shape": plain_hand, "skin": skin, "stereo": SMALL, "num_points": 300, "outlier_ratio": 0.2}
    passing = sequences.hand_sequence("occlusion", 50, **options)[20:]
    counts = torch.tensor([int(cloud.inliers.sum()) for cloud in passing])
    assert int(counts.min()) < 30
    assert int(counts.max()) == 300
    assert 5 <= int((counts < 200).sum()) <= 14, "about half a second at 20 frames per second"
    tips = torch.stack([cloud.seen_parts[list(plain_hand.fingertip_parts)].any() for cloud in passing])
    assert bool(tips.any() and not tips.all())
    for cloud in passing:
        on_bar = cloud.points[~cloud.inliers & (cloud.points[:, 2] < 0.45)]
        assert len(on_bar) > 20
        # Upright and narrow, in the middle between both cameras.
        assert float((on_bar[:, 0].abs() < 0.12).float().mean()) > 0.8
        assert float(on_bar[:, 1].std()) > 2 * float(on_bar[:, 0].std())


@pytest.mark.parametrize("depth", [0.4, 1.2])
def test_the_pair_is_rectified_and_noise_is_that_of_disparity_and_pixels(depth):
    """Measured in the pictures, whatever the depth, the noise is the given one."""
    flat = torch.rand(6000, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
    points = torch.cat([0.5 * depth * flat, torch.full((6000, 1), depth, dtype=torch.float64)], dim=-1)
    (left, z), (right, _) = (one.project(points) for one in stereo.StereoView(baseline=0.08, focal=500.0).views())
    torch.testing.assert_close((left[:, 1], left[:, 0] - right[:, 0]), (right[:, 1], 500.0 * 0.08 / z))
    torch.testing.assert_close(CLEAN.measured(points, torch.Generator()), points)
    view = stereo.StereoView(disparity_noise=0.3, lateral_noise=0.2)
    measured = view.measured(points, torch.Generator().manual_seed(1))
    (true, _), (found, found_depth) = (view.views()[0].project(values) for values in (points, measured))
    disparity = 600 * 0.1 / found_depth - 600 * 0.1 / depth
    assert float(disparity.std()) == pytest.approx(0.3, rel=0.05)
    assert abs(float(disparity.mean())) < 0.02
    torch.testing.assert_close((found - true).std(0), torch.full((2,), 0.2, dtype=torch.float64), rtol=0.05, atol=0)
    spread = float((measured - points)[:, 2].std())
    assert spread == pytest.approx(float(view.depth_std(points[0, 2])), rel=0.05)
    assert spread == pytest.approx(depth**2 * 0.3 / 60, rel=0.05)


@pytest.mark.parametrize(("view", "kind"), [(CLEAN, "rotation"), (WIDE, "bend")])
def test_clean_points_lie_on_the_surface_and_both_cameras_see_them(arms, view, kind):
    arm, skin = arms[0], made.surface_skin(arms[0], spacing=0.008)
    poses = made.hand_motion(arm, kind, 2 if kind == "rotation" else 1, 1.0, distance=0.6)
    clouds = stereo.stereo_clouds(arm, poses, stereo=view, skin=skin, num_points=200, outlier_ratio=0.5)
    for cloud, pose in zip(clouds, poses, strict=True):
        points, others = cloud.points[cloud.inliers], cloud.points[~cloud.inliers]
        assert float(arm.distance(points, pose).abs().max()) < 1e-3
        nearest = arm.part_distances(points, pose).argmin(-1)
        assert float((nearest == cloud.part_labels[cloud.inliers]).float().mean()) > 0.95
        mesh = tr.TriangleMesh(skin(pose), skin.faces)
        for side in (-view.baseline / 2, view.baseline / 2):
            assert float(visible_points(mesh, points, torch.tensor([side, 0.0, 0.0])).float().mean()) > 0.99
        # Shapes that are no hands have no forearm.
        assert int((others[:, 2] > 0.8).sum()) == 60
        assert len(others) == 200
