import math

import pytest
import torch

from experiments.made_up.shape_sequences import other_hand, rig_sequence
from torchreg.datasets.hand import hand_motion, surface_skin
from torchreg.datasets.sequences import _bar, hand_sequence, range_clouds
from torchreg.datasets.stereo import StereoView, _forearm, stereo_clouds
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rigid import invert_rigid, transform_points
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.visibility import visible_points
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.skin import LinearBlendSkin

EYE = torch.eye(4, dtype=torch.float64)
SMALL = StereoView(focal=300.0, width=320, height=240)
CLEAN = StereoView(focal=400.0, width=440, height=340, disparity_noise=0.0, lateral_noise=0.0)


@pytest.fixture(scope="module")
def bending(hand, skin):
    return hand_sequence("bending_palm", 8, 2.0, shape=hand, skin=skin, stereo=SMALL, num_points=300, seed=3)


@pytest.fixture(scope="module")
def passing(hand, skin):
    return hand_sequence("occlusion", 50, shape=hand, skin=skin, stereo=SMALL, num_points=300, outlier_ratio=0.2)[20:]


def test_counts_follow_what_is_seen(bending):
    inliers = [int(cloud.inliers.sum()) for cloud in bending]
    assert max(inliers) == 300
    assert min(inliers) < 260
    assert {len(cloud.points) - count for cloud, count in zip(bending, inliers, strict=True)} == {round(300 * 3 / 7)}
    for cloud in bending:
        assert bool(((cloud.part_labels == -1) == ~cloud.inliers).all())
        assert cloud.part_counts.tolist() == torch.bincount(cloud.part_labels[cloud.inliers], minlength=16).tolist()
        half = len(cloud.inliers) // 2
        assert abs(float(cloud.inliers[:half].float().mean() - cloud.inliers[half:].float().mean())) < 0.25


def test_truth_is_that_of_the_motion(hand, skin, bending):
    poses = hand_motion(hand, "bending_palm", 8, 2.0, distance=0.6, seed=3)
    torch.testing.assert_close(torch.stack([cloud.pose for cloud in bending]), poses)
    torch.testing.assert_close(torch.stack([cloud.keypoints for cloud in bending]), hand.keypoints(poses))
    torch.testing.assert_close(torch.stack([cloud.vertices for cloud in bending]), skin(poses))
    off = torch.cat([hand.distance(cloud.points[cloud.inliers], cloud.pose).abs() for cloud in bending])
    # 300 pixels of focal length: 3 mm in depth at 0.6 m.
    assert 0.001 < float(off.mean()) < 0.004


def test_outliers_lie_on_forearm_and_wall_and_in_the_volume(hand, bending):
    for cloud in bending:
        points = cloud.points[~cloud.inliers]
        count = len(points)
        wall = points[:, 2] > 0.8
        assert int(wall.sum()) == round(0.3 * count)
        palm = invert_rigid(hand.part_transforms(cloud.pose)[0])
        local = transform_points(palm, points)
        on_arm = (local[:, 2] < 0.02) & (local[:, :2].norm(dim=-1) < 0.1) & (local[:, 2] > -0.25) & ~wall
        assert round(0.4 * count) <= int(on_arm.sum()) < 0.65 * count
        # The model has no forearm.
        assert float(hand.distance(points[on_arm], cloud.pose).median()) > 0.02
        vertices = torch.stack([cloud.vertices for cloud in bending]).flatten(0, 1)
        rest = points[~wall & ~on_arm]
        assert bool((rest > vertices.amin(0) - 0.1).all() and (rest < vertices.amax(0) + 0.1).all())


def test_forearm_and_bar_look_outwards(hand):
    for mesh, sides in ((_forearm(hand, torch.ones(2)), 24), (_bar(0.6, torch.Generator().manual_seed(0)), 4)):
        middles = mesh.vertices.unflatten(0, (-1, sides)).mean(1).repeat_interleave(sides, dim=0)
        outwards = (mesh.vertices - middles)[mesh.faces].mean(1)
        assert float((outwards * mesh.face_normals()).sum(-1).min()) > 0


def test_a_bar_hides_the_passing_hand(hand, passing):
    counts = torch.tensor([int(cloud.inliers.sum()) for cloud in passing])
    assert int(counts.min()) < 30
    assert int(counts.max()) == 300
    covered = int((counts < 200).sum())
    assert 5 <= covered <= 14, "about half a second at 20 frames per second"
    bar = _bar(0.6, torch.Generator().manual_seed(0))
    for cloud in passing:
        near = cloud.points[~cloud.inliers][:, 2] < 0.45
        assert int(near.sum()) > 20
        on_bar = cloud.points[~cloud.inliers][near]
        lower, upper = bar.bounds().to(on_bar)
        assert float(((on_bar > lower - 0.02) & (on_bar < upper + 0.02)).all(-1).float().mean()) > 0.8
        for side in (-0.05, 0.05):
            camera = torch.tensor([side, 0.0, 0.0], dtype=torch.float64)
            seen = visible_points(bar, cloud.points[cloud.inliers].double(), camera)
            # Noise moves some points at its edges into its shadow.
            assert int((~seen).sum()) <= 3 + 0.03 * len(seen)


def test_fingertips_seen_are_those_with_enough_points(hand, passing):
    tips = list(hand.fingertip_parts)
    for cloud in passing:
        counts = [int((cloud.part_labels == part).sum()) for part in tips]
        assert cloud.seen_parts[tips].tolist() == [count >= 8 for count in counts]
    assert any(bool(cloud.seen_parts[tips].any()) for cloud in passing)
    assert any(not bool(cloud.seen_parts[tips].any()) for cloud in passing)


def test_sequences_repeat_and_leave_the_global_generator_alone(arm, arm_skin):
    state = torch.get_rng_state()
    options = {"shape": arm, "skin": arm_skin, "stereo": SMALL, "num_points": 50}
    first, again, other = (hand_sequence("fast", 2, **options, seed=seed) for seed in (1, 1, 2))
    assert all(torch.equal(a.points, b.points) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first[0].pose, other[0].pose)
    assert torch.equal(state, torch.get_rng_state())
    assert first[1].points.shape != first[0].points.shape or not torch.equal(first[0].points, first[1].points)


def test_double_precision_and_no_poses():
    hand = Hand("left", dtype=torch.float64)
    skin = surface_skin(hand, spacing=0.012)
    (cloud,) = hand_sequence("flip", 1, shape=hand, skin=skin, stereo=SMALL, num_points=40)
    assert cloud.points.dtype == cloud.pose.dtype == cloud.vertices.dtype == torch.float64
    assert not cloud.points.requires_grad
    assert stereo_clouds(hand, cloud.pose[None][:0], skin=skin) == []


def test_hand_and_surface_are_made_when_none_are_given():
    (cloud,) = hand_sequence(num_frames=1, num_points=60)
    assert cloud.pose.shape == (27,)
    assert int(cloud.inliers.sum()) == 60
    assert len(cloud.points) == 60 + 26


def test_another_hand_is_off_part_by_part():
    plain, other = Hand(), other_hand(torch.Generator().manual_seed(1), 0.08, nu=0.0025)
    with torch.no_grad():
        for name in ("bone_lengths", "radii"):
            ratio = getattr(other, name) / getattr(plain, name)
            off = torch.maximum(ratio, 1 / ratio)
            flat = ratio if name == "bone_lengths" else ratio[..., 0]
            assert float(off.max()) < 1.08 + 1e-4
            torch.testing.assert_close(torch.maximum(flat, 1 / flat), torch.full_like(flat, 1.08), atol=1e-4, rtol=0)
            assert float(flat.min()) < 1 < float(flat.max())
    assert other.nu == 0.0025
    assert torch.equal(other_hand().log_radius_scales, other_hand().log_radius_scales)
    assert other_hand(side="left").side == "left"
    with torch.no_grad():
        assert torch.equal(other_hand(scale=0.0).bone_lengths, plain.bone_lengths)
    with pytest.raises(InputError, match="scale must be zero or positive"):
        other_hand(scale=-0.1)


def test_range_clouds_are_those_of_a_motion(hand, skin):
    poses = hand_motion(hand, "rotate", 3, seed=3)
    clouds = range_clouds(hand, poses, skin=skin, num_points=60, camera=torch.zeros(3), seed=3)
    assert all(torch.equal(cloud.pose, pose) for cloud, pose in zip(clouds, poses, strict=True))
    again = range_clouds(hand, poses, skin=skin, num_points=60, camera=torch.zeros(3), seed=3)
    assert all(torch.equal(a.points, b.points) for a, b in zip(clouds, again, strict=True))
    assert not torch.equal(clouds[0].points, clouds[1].points)
    with pytest.raises(InputError, match=r"poses must have shape \(T, 27\)"):
        range_clouds(hand, poses[0], skin=skin)


def rigged_bar():
    """Return a square bar of 0.4 m along y, skinned to a root and two ball joints."""
    along = torch.linspace(0, 0.4, 21)
    ring = 0.03 * torch.tensor([[-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [1.0, -1.0]])
    vertices = torch.stack([ring[:, 0].repeat(21), along.repeat_interleave(4), ring[:, 1].repeat(21)], dim=-1)
    here = torch.arange(20)[:, None] * 4 + torch.arange(4)
    after = here.roll(-1, dims=1)
    faces = torch.cat([torch.stack([here, here + 4, after], -1), torch.stack([after, here + 4, after + 4], -1)])
    faces = torch.cat([faces.flatten(0, 1)[:, [0, 2, 1]]])
    weights = torch.nn.functional.one_hot((along.repeat_interleave(4) / 0.134).long().clamp(max=2), 3).float()
    joints = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.134, 0.0], [0.0, 0.267, 0.0]])
    return ArticulatedShape.from_skinned_mesh(vertices, faces, weights, joints, [-1, 0, 1])


@pytest.fixture(scope="module")
def rig():
    return rigged_bar().requires_grad_(False)


def bend_of(rig, degrees=60.0):
    bend = torch.zeros(rig.num_dofs)
    bend[torch.tensor([name.endswith("_x") and not name.startswith("base") for name in rig.dof_names])] = math.radians(
        degrees
    )
    bend[:6] = 0
    return bend


def test_a_rig_flexes_and_turns_before_one_camera(rig):
    bend = bend_of(rig)
    facing = torch.tensor([0.0, 0.0, math.pi])
    clouds = rig_sequence(rig, bend, facing=facing, num_points=120, distance=0.9)
    assert len(clouds) == 60
    poses = torch.stack([cloud.pose for cloud in clouds])
    moving = bend != 0
    assert int(moving.sum()) >= 2
    assert float(poses[0, moving].abs().max()) < 1e-6
    assert float(poses[25, moving].min()) == pytest.approx(math.radians(60), abs=1e-4)
    assert float(poses[:, 6:][:, ~moving[6:]].abs().max()) == 0
    upright = so3_exp(poses[:, 3:6]) @ so3_exp(facing).T
    angle = torch.rad2deg(torch.atan2(upright[:, 0, 2], upright[:, 0, 0]))
    assert float(angle.max()) == pytest.approx(40, abs=0.1)
    assert float(angle.min()) == pytest.approx(-40, abs=0.1)
    torch.testing.assert_close(upright[:, 1, 1], torch.ones(60))
    torch.testing.assert_close(rig.part_transforms(poses)[..., :3, 3].mean(1)[:, 2], torch.full((60,), 0.9))
    torch.testing.assert_close(torch.stack([cloud.vertices for cloud in clouds]), rig.file_skin()(poses))
    assert all(len(cloud.points) == 150 and int(cloud.inliers.sum()) == 120 for cloud in clouds)


def test_a_rig_is_seen_from_the_front_with_little_noise(rig):
    (cloud,) = rig_sequence(rig, bend_of(rig), 1, num_points=500, distance=0.9, outlier_ratio=0.0)
    depth = cloud.points[:, 2] - cloud.vertices[:, 2].min()
    # The front of a bar is flat.
    assert float(depth.mean().abs()) < 5e-4
    assert float(depth.std()) == pytest.approx(0.001, rel=0.15)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"full_bend": torch.zeros(3)}, "full_bend must have shape"),
        ({"full_bend": torch.ones(12)}, "full_bend must be zero for the six"),
        ({"num_frames": 0}, "num_frames must be at least 1, got 0"),
        ({"fps": 0.0}, "fps must be positive"),
        ({"turn": -1.0}, "turn must be zero or positive"),
        ({"distance": 0.0}, "distance must be positive"),
        ({"facing": (1.0, 2.0)}, r"facing must have shape \(3\)"),
    ],
)
def test_rig_sequence_refuses(rig, options, message):
    with pytest.raises(InputError, match=message):
        rig_sequence(**{"shape": rig, "full_bend": torch.zeros(rig.num_dofs), **options})


def test_facing_must_be_numbers(rig):
    with pytest.raises(InputTypeError, match="facing must be"):
        rig_sequence(rig, torch.zeros(rig.num_dofs), facing="front")


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
        ({"num_points": 0}, "num_points must be at least 1, got 0"),
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
