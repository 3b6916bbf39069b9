import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchreg.datasets.hand import MOTIONS, hand_motion, make_hand_cloud, placed, random_hand_pose, surface_skin
from torchreg.errors import InputError
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.visibility import visible_points
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.skin import BendingSkin, LinearBlendSkin

EYE = torch.eye(4, dtype=torch.float64)


def two_parts(free_base=True, upper=math.inf):
    away = EYE.clone()
    away[2, 3] = 0.1
    joints = (Joint("root", -1, EYE), Joint("arm", 0, away, "revolute", (1.0, 0.0, 0.0), -0.5, upper))
    balls = [Primitive("ellipsoid", (0.03, 0.03, 0.06), EYE)] * 2
    return ArticulatedShape(KinematicTree(joints), ["root", "arm"], balls, nu=0.006, free_base=free_base)


@pytest.fixture(scope="module")
def hand():
    return Hand()


@pytest.fixture(scope="module")
def skin(hand):
    return surface_skin(hand, spacing=0.007)


def cloud(hand, skin, pose=None, seed=0, **options):
    pose = hand.rest_pose() if pose is None else pose
    return make_hand_cloud(hand, pose, skin=skin, generator=torch.Generator().manual_seed(seed), **options)


def test_surface_skin_lies_on_the_surface_and_has_faces(hand, skin):
    assert isinstance(skin, BendingSkin)
    assert skin.faces is not None
    with torch.no_grad():
        distance = hand.distance(skin.points, hand.rest_pose()).abs()
    # A coarse grid cuts the creases between fingers.
    assert float(distance.mean()) < 5e-4
    assert float(distance.max()) < 0.5 * 0.007


def test_surface_skin_of_a_file_is_the_files_own():
    box = torch.tensor([[x, y, z] for x in (0.0, 0.1) for y in (0.0, 0.1) for z in (0.0, 0.2, 0.4)])
    weights = torch.zeros(12, 2)
    weights[torch.arange(12), (box[:, 2] > 0.3).long()] = 1.0
    faces = torch.tensor([[0, 1, 3], [1, 2, 4], [6, 7, 9], [7, 8, 10]])
    joints = torch.tensor([[0.05, 0.05, 0.0], [0.05, 0.05, 0.25]])
    shape = ArticulatedShape.from_skinned_mesh(box, faces, weights, joints, [-1, 0])
    own = surface_skin(shape)
    torch.testing.assert_close(own.points, box)
    torch.testing.assert_close(own.faces, faces)


def test_a_clean_cloud_lies_on_the_surface_all_around(hand, skin):
    made = cloud(hand, skin, num_points=400, noise=0.0, outlier_ratio=0.0)
    assert made.points.shape == (400, 3)
    assert bool(made.inliers.all())
    with torch.no_grad():
        distance = hand.distance(made.points, made.pose).abs()
        nearest = hand.part_distances(made.points, made.pose).argmin(-1)
    assert float(distance.mean()) < 6e-4
    assert float(distance.max()) < 0.5 * 0.007
    assert float((nearest == made.part_labels).float().mean()) > 0.95
    assert len(made.part_labels.unique()) == 16
    back = made.points[:, 1] > 0.005
    assert 0.1 < float(back.float().mean()) < 0.9


def test_noise_has_the_asked_for_spread(hand, skin):
    clean = cloud(hand, skin, num_points=2000, noise=0.0)
    noisy = cloud(hand, skin, num_points=2000, noise=0.002)
    offset = noisy.points - clean.points
    torch.testing.assert_close(noisy.inliers, clean.inliers)
    assert float(offset[clean.inliers].std()) == pytest.approx(0.002, rel=0.05)
    assert float(offset[~clean.inliers].abs().max()) == 0.0


@pytest.mark.parametrize(("ratio", "count"), [(0.0, 0), (0.33, 246), (0.5, 500), (0.9, 4500)])
def test_outliers_are_the_given_share_of_all_points(hand, skin, ratio, count):
    made = cloud(hand, skin, outlier_ratio=ratio)
    assert int((~made.inliers).sum()) == count
    assert len(made.points) == len(made.inliers) == len(made.part_labels) == 500 + count
    assert bool(((made.part_labels == -1) == ~made.inliers).all())


def test_outliers_fill_the_grown_bounding_box(hand, skin):
    made = cloud(hand, skin, num_points=500, outlier_ratio=0.9)
    vertices = skin(made.pose).detach()
    clutter = made.points[~made.inliers]
    lower, upper = vertices.amin(0) - 0.05, vertices.amax(0) + 0.05
    share = (clutter - lower) / (upper - lower)
    assert 0 <= float(share.min()) < 0.01
    assert 0.99 < float(share.max()) <= 1
    torch.testing.assert_close(share.mean(0), torch.full((3,), 0.5), atol=0.02, rtol=0)


def test_inliers_and_outliers_are_mixed(hand, skin):
    made = cloud(hand, skin)
    half = len(made.inliers) // 2
    assert abs(float(made.inliers[:half].float().mean() - made.inliers[half:].float().mean())) < 0.1


def test_a_camera_sees_one_side(hand, skin):
    camera = torch.tensor([0.0, -0.5, 0.1])
    pose = hand.rest_pose()
    made = cloud(hand, skin, pose, camera=camera, noise=0.0, outlier_ratio=0.0)
    mesh = TriangleMesh(skin(pose).detach(), skin.faces)
    assert bool(visible_points(mesh, made.points, camera, tolerance=0.004).all())
    # The palm looks at -y.
    assert float((made.points[:, 1] < 0.004).float().mean()) > 0.97


def test_clouds_repeat_and_leave_the_global_generator_alone(hand, skin):
    state = torch.get_rng_state()
    first = make_hand_cloud(hand, hand.rest_pose(), skin=skin)
    second = make_hand_cloud(hand, hand.rest_pose(), skin=skin)
    assert torch.equal(first.points, second.points)
    assert not torch.equal(first.points, cloud(hand, skin, seed=1).points)
    random_hand_pose(hand)
    hand_motion(hand, num_frames=3)
    assert torch.equal(state, torch.get_rng_state())


def test_the_default_surface_is_made_when_no_skin_is_given():
    shape = two_parts()
    made = make_hand_cloud(shape, shape.rest_pose(), num_points=50, noise=0.0, outlier_ratio=0.0)
    with torch.no_grad():
        assert float(shape.distance(made.points, made.pose).abs().max()) < 1e-3


def test_float64_shapes_give_float64_clouds():
    shape = Hand("left", dtype=torch.float64)
    skin = surface_skin(shape, spacing=0.01)
    made = cloud(shape, skin, random_hand_pose(shape), num_points=50, camera=torch.zeros(3))
    assert made.points.dtype == made.pose.dtype == torch.float64
    assert made.inliers.dtype == torch.bool


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_points": 0}, "num_points must be at least 1, got 0"),
        ({"noise": -0.1}, "noise must be zero or positive"),
        ({"outlier_ratio": 1.0}, "outlier_ratio must be at least 0 and below 1"),
        ({"pose": torch.zeros(2, 27)}, r"pose must have shape \(27,\), got \(2, 27\)"),
        ({"pose": torch.zeros(26)}, "pose must have shape"),
    ],
)
def test_make_hand_cloud_refuses(hand, skin, options, message):
    with pytest.raises(InputError, match=message):
        make_hand_cloud(**{"shape": hand, "pose": hand.rest_pose(), "skin": skin, **options})


def test_a_skin_without_faces_is_refused(hand, skin):
    bare = LinearBlendSkin(hand, skin.points, skin.weights, hand.rest_pose())
    with pytest.raises(InputError, match="skin must have faces"):
        make_hand_cloud(hand, hand.rest_pose(), skin=bare)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.floats(0, 1))
def test_random_poses_keep_the_limits_and_stand_before_the_camera(seed, bend):
    hand = HANDS[seed % 2]
    pose = random_hand_pose(hand, torch.Generator().manual_seed(seed), bend=bend)
    assert bool((pose >= hand.lower - 1e-6).all() and (pose <= hand.upper + 1e-6).all())
    assert float(pose[3:6].norm()) <= math.pi + 1e-5
    with torch.no_grad():
        middle = hand.part_transforms(pose)[:, :3, 3].mean(0)
    assert float((middle - torch.tensor([0.0, 0.0, 0.5])).abs().max()) < 0.031
    flexions = [index for index, name in enumerate(hand.dof_names) if name.endswith("flexion")]
    assert float((pose[flexions] / hand.upper[flexions]).max()) <= bend + 1e-6


HANDS = (Hand(), Hand("left"))


def test_random_rotations_point_everywhere(hand):
    generator = torch.Generator().manual_seed(2)
    turned = torch.stack([so3_exp(random_hand_pose(hand, generator)[3:6])[:, 2] for _ in range(150)])
    assert float(turned.mean(0).norm()) < 0.25
    # Uniform directions have mean squared components of 1/3.
    torch.testing.assert_close(turned.square().mean(0), torch.full((3,), 1 / 3), atol=0.1, rtol=0)


def test_any_shape_gets_random_poses_and_motions():
    shape = two_parts()
    angles = torch.stack([random_hand_pose(shape, torch.Generator().manual_seed(seed))[6] for seed in range(40)])
    assert -0.3 <= float(angles.min()) < 0 < float(angles.max()) <= 0.6 * math.pi / 2
    assert hand_motion(shape, "rotate", 4).shape == (4, 7)
    bolted = two_parts(free_base=False, upper=0.5)
    assert torch.equal(random_hand_pose(bolted)[:6], torch.zeros(6))
    assert torch.equal(hand_motion(bolted, "bend", 3)[:, :6], torch.zeros(3, 6))


@pytest.mark.parametrize("kind", ["bend", "rotate"])
def test_motions_are_smooth_within_limits_and_before_the_camera(hand, kind):
    poses = hand_motion(hand, kind, 100)
    assert poses.shape == (100, 27)
    assert bool((poses >= hand.lower - 1e-6).all() and (poses <= hand.upper + 1e-6).all())
    with torch.no_grad():
        keypoints = hand.keypoints(poses)
        middle = hand.part_transforms(poses)[..., :3, 3].mean(-2)
    velocity = keypoints.diff(dim=0).norm(dim=-1)
    assert float(velocity.max()) < 0.02
    acceleration = keypoints.diff(dim=0).diff(dim=0).norm(dim=-1)
    assert float(acceleration.max()) < 0.003
    assert float((middle - torch.tensor([0.0, 0.0, 0.5])).abs().max()) < 0.031
    assert float(velocity.max()) > 0.003


def test_bending_closes_fingers_and_rotating_shows_the_back(hand):
    bend = hand_motion(hand, "bend", 50)
    flexion = hand.dof_names.index("index_pip_flexion")
    assert float(bend[:, flexion].min()) < 0.05 * float(hand.upper[flexion])
    assert float(bend[:, flexion].max()) > 0.4 * float(hand.upper[flexion])
    back = so3_exp(hand_motion(hand, "rotate", 100)[:, 3:6])[:, 2, 1]
    assert float(back[0]) > 0.9
    assert float(back[50]) < -0.9


def test_frames_depend_on_time_alone_and_seeds_differ(hand):
    slow, fast = hand_motion(hand, "bend", 5, 10.0), hand_motion(hand, "bend", 10, 20.0)
    torch.testing.assert_close(slow, fast[::2])
    assert not torch.equal(hand_motion(hand, seed=1), hand_motion(hand, seed=2))
    further = hand_motion(hand, "rotate", 3, distance=2.0)
    assert float(further[:, 2].min()) > 1.6


def facing(poses):
    """Return how far the palm looks at the camera: cosines (T,)."""
    return so3_exp(poses[:, 3:6])[:, 2, 1]


@pytest.mark.parametrize("kind", MOTIONS)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_every_motion_stays_in_its_limits_and_is_smooth(hand, kind, seed):
    poses = hand_motion(hand, kind, 100, distance=0.6, seed=seed)
    assert poses.shape == (100, 27)
    assert bool((poses >= hand.lower - 1e-6).all() and (poses <= hand.upper + 1e-6).all())
    assert float(poses[:, 3:6].norm(dim=-1).max()) <= math.pi + 1e-5
    # Halving the time step halves the change of velocity: the motion has a continuous derivative, at rest and flipping.
    with torch.no_grad():
        jumps = [
            hand.keypoints(hand_motion(hand, kind, round(5 * fps), fps, distance=0.6, seed=seed)).diff(dim=0) * fps
            for fps in (80.0, 160.0, 320.0)
        ]
    coarse, middle, fine = (float(velocity.diff(dim=0).norm(dim=-1).max()) for velocity in jumps)
    assert middle < 0.65 * coarse
    assert fine < 0.65 * middle


@pytest.mark.parametrize("seed", range(6))
def test_rotation_goes_to_and_fro_by_sixty_to_seventy_degrees(hand, seed):
    poses = hand_motion(hand, "rotation", 90, seed=seed)
    turns = so3_exp(poses[:, 3:6])
    # At the quarters of the period the turn is widest; the sway adds three degrees to each axis at most.
    apart = turns[67] @ turns[22].T
    angle = math.degrees(math.acos((float(apart.trace()) - 1) / 2))
    assert 2 * 55 < angle < 2 * 75
    axis = torch.stack([apart[2, 1] - apart[1, 2], apart[0, 2] - apart[2, 0], apart[1, 0] - apart[0, 1]])
    axis = axis / axis.norm()
    assert abs(float(axis[2])) < 0.15
    assert abs(float(axis[1])) > math.cos(math.radians(32))
    flexions = [index for index, name in enumerate(hand.dof_names) if name.endswith("flexion")]
    assert 0.05 < float((poses[:, flexions] / hand.upper[flexions]).mean()) < 0.25


def test_bending_is_seen_from_both_sides(hand):
    palm, back = (hand_motion(hand, f"bending_{side}", 100) for side in ("palm", "back"))
    assert float(facing(palm).min()) > 0.8
    assert float(facing(back).max()) < -0.8
    torch.testing.assert_close(palm[:, 6:], back[:, 6:])
    pip = [hand.dof_names.index(f"{finger}_pip_flexion") for finger in ("index", "middle", "ring", "little")]
    closed = palm[:, pip] / palm[:, pip].amax(0)
    # One after the other at first, all together after half of the time.
    assert float((closed[:20].amax(1) - closed[:20].amin(1)).max()) > 0.5
    assert float((closed[45:56].amax(1) - closed[45:56].amin(1)).max()) < 0.2


@pytest.mark.parametrize("seed", range(5))
def test_flip_hides_all_within_a_second_and_turns_back_later(hand, seed):
    palm = facing(hand_motion(hand, "flip", 160, seed=seed))
    assert float(palm[:35].min()) > 0.8
    assert float(palm[65:110].max()) < -0.8
    assert float(palm[-10:].min()) > 0.8
    assert int(((palm < 0.7) & (palm > -0.7))[:100].sum()) < 15


def test_fast_is_three_to_four_times_as_fast(hand):
    for seed in range(4):
        slow, fast = (hand_motion(hand, kind, 400, 80.0, seed=seed) for kind in ("bending_palm", "fast"))
        ratio = fast[:, 6:].diff(dim=0).abs().max() / slow[:, 6:].diff(dim=0).abs().max()
        assert 2.8 < float(ratio) < 4.2
        ranges = [float((poses[:, :3].amax(0) - poses[:, :3].amin(0)).max()) for poses in (slow, fast)]
        assert ranges[1] > 1.2 * ranges[0]


def test_occlusion_passes_the_middle_and_returns(hand):
    sides = set()
    for seed in range(6):
        poses = hand_motion(hand, "occlusion", 160, distance=0.6, seed=seed)
        with torch.no_grad():
            x = hand.part_transforms(poses)[..., 0, 3].mean(-1)
        first, second, third = x[:30], x[70:110], x[-6:]
        assert float(first.abs().min()) > 0.12
        assert bool((first.sign() == -second.sign()[:30]).all() and (third.sign() == first.sign()[:6]).all())
        sides.add(float(first[0].sign()))
    assert sides == {-1.0, 1.0}


def test_placed_moves_the_middle_and_clamps(hand):
    pose = torch.randn(3, 27, generator=torch.Generator().manual_seed(0))
    moved = placed(hand, pose, torch.tensor([0.1, 0.2, 0.3]))
    with torch.no_grad():
        middle = hand.part_transforms(moved)[..., :3, 3].mean(-2)
    torch.testing.assert_close(middle, torch.tensor([0.1, 0.2, 0.3]).expand(3, 3), atol=1e-5, rtol=0)
    assert bool((moved >= hand.lower).all() and (moved <= hand.upper).all())


def test_clouds_carry_the_truth(hand, skin):
    pose = random_hand_pose(hand, torch.Generator().manual_seed(4))
    made = cloud(hand, skin, pose, num_points=300, camera=torch.zeros(3))
    with torch.no_grad():
        torch.testing.assert_close(made.keypoints, hand.keypoints(pose))
        torch.testing.assert_close(made.vertices, skin(pose))
    counts = [int((made.part_labels == part).sum()) for part in range(16)]
    assert made.part_counts.tolist() == counts
    assert made.seen_parts.tolist() == [count >= 8 for count in counts]
    assert 0 < int(made.seen_parts.sum()) < 16


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "wave"}, "kind must be one of bend, rotate"),
        ({"num_frames": 0}, "num_frames must be at least 1, got 0"),
        ({"fps": 0.0}, "fps must be positive"),
        ({"bend": 1.5}, "bend must be between 0 and 1"),
        ({"distance": -1.0}, "distance must be positive"),
    ],
)
def test_hand_motion_refuses(hand, options, message):
    with pytest.raises(InputError, match=message):
        hand_motion(hand, **options)


def test_random_hand_pose_refuses(hand):
    with pytest.raises(InputError, match="bend must be"):
        random_hand_pose(hand, bend=-0.1)
    with pytest.raises(InputError, match="distance must be positive"):
        random_hand_pose(hand, distance=0.0)
