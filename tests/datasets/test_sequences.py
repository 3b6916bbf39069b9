import math

import pytest
import torch

from torchreg.datasets.hand import hand_motion, surface_skin
from torchreg.datasets.sequences import (
    _bar,
    hand_sequence,
    other_hand,
    range_clouds,
    rig_sequence,
)
from torchreg.datasets.stereo import StereoView, _forearm, stereo_clouds
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.rigid import invert_rigid, transform_points
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.visibility import visible_points
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand

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
        ({"num_frames": 0}, "num_frames must be a positive integer"),
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
