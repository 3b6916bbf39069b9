"""Made-up poses, motions and clouds of shapes: within limits, as each motion promises, the truth on the surface."""

import math

import pytest
import torch

from torchreg.datasets.hand import MOTIONS, hand_motion, make_hand_cloud, random_hand_pose, surface_skin
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.visibility import visible_points
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand


@pytest.fixture
def cloud(hand, skin):
    def make(pose=None, **options):
        return make_hand_cloud(hand, hand.rest_pose() if pose is None else pose, skin=skin, **options)

    return make


def facing(poses):
    """Return how far the palm looks at the camera: cosines (T,)."""
    return so3_exp(poses[:, 3:6])[:, 2, 1]


def within_limits(shape, poses):
    return bool((poses >= shape.lower - 1e-6).all() and (poses <= shape.upper + 1e-6).all())


def test_surface_skins_lie_on_the_surface_or_are_those_of_files(hand, skin):
    # A coarse grid cuts the creases between fingers.
    assert float(hand.distance(skin.points, hand.rest_pose()).abs().max()) < 0.5 * 0.006
    box = torch.tensor([[x, y, z] for x in (0.0, 0.1) for y in (0.0, 0.1) for z in (0.0, 0.2, 0.4)])
    weights = torch.nn.functional.one_hot((box[:, 2] > 0.3).long(), 2).float()
    faces = torch.tensor([[0, 1, 3], [1, 2, 4], [6, 7, 9], [7, 8, 10]])
    joints = torch.tensor([[0.05, 0.05, 0.0], [0.05, 0.05, 0.25]])
    own = surface_skin(ArticulatedShape.from_skinned_mesh(box, faces, weights, joints, [-1, 0]))
    torch.testing.assert_close(own.points, box)
    torch.testing.assert_close(own.faces, faces)


def test_a_clean_cloud_lies_on_the_surface_all_around(hand, cloud):
    made = cloud(num_points=400, noise=0.0, outlier_ratio=0.0)
    assert bool(made.inliers.all())
    assert float(hand.distance(made.points, made.pose).abs().max()) < 0.5 * 0.006
    nearest = hand.part_distances(made.points, made.pose).argmin(-1)
    assert float((nearest == made.part_labels).float().mean()) > 0.95
    assert len(made.part_labels.unique()) == 16
    assert 0.1 < float((made.points[:, 1] > 0.005).float().mean()) < 0.9
    noisy = cloud(num_points=400, noise=0.002, outlier_ratio=0.0)
    assert float((noisy.points - made.points).std()) == pytest.approx(0.002, rel=0.1)


@pytest.mark.parametrize(("ratio", "count"), [(0.0, 0), (0.33, 246), (0.9, 4500)])
def test_outliers_are_the_given_share_mixed_in_and_fill_the_grown_box(skin, cloud, ratio, count):
    made = cloud(outlier_ratio=ratio)
    assert len(made.points) == len(made.part_labels) == 500 + count
    assert int((~made.inliers).sum()) == count
    assert bool(((made.part_labels == -1) == ~made.inliers).all())
    first, second = (half.float().mean() for half in made.inliers.chunk(2))
    assert abs(float(first - second)) < 0.1
    if count > 1000:
        vertices = skin(made.pose)
        lower, upper = vertices.amin(0) - 0.05, vertices.amax(0) + 0.05
        share = (made.points[~made.inliers] - lower) / (upper - lower)
        assert 0 <= float(share.min()) < 0.01
        assert 0.99 < float(share.max()) <= 1
        torch.testing.assert_close(share.mean(0), torch.full((3,), 0.5), atol=0.02, rtol=0)


def test_a_camera_sees_one_side(hand, skin, cloud):
    camera = torch.tensor([0.0, -0.5, 0.1])
    made = cloud(camera=camera, noise=0.0, outlier_ratio=0.0)
    mesh = TriangleMesh(skin(hand.rest_pose()), skin.faces)
    assert bool(visible_points(mesh, made.points, camera, tolerance=0.004).all())
    # The palm looks at -y.
    assert float((made.points[:, 1] < 0.004).float().mean()) > 0.97


def test_clouds_carry_the_truth_in_either_precision(hand, skin, cloud):
    pose = random_hand_pose(hand, torch.Generator().manual_seed(4))
    made = cloud(pose, num_points=300, camera=torch.zeros(3))
    torch.testing.assert_close(made.keypoints, hand.keypoints(pose))
    torch.testing.assert_close(made.vertices, skin(pose))
    counts = [int((made.part_labels == part).sum()) for part in range(16)]
    assert made.part_counts.tolist() == counts
    assert made.seen_parts.tolist() == [count >= 8 for count in counts]
    double = Hand("left", dtype=torch.float64)
    made = make_hand_cloud(double, random_hand_pose(double), skin=surface_skin(double, spacing=0.01), num_points=50)
    assert made.points.dtype == made.pose.dtype == torch.float64


def test_random_poses_keep_the_limits_point_everywhere_and_stand_before_the_camera():
    generator = torch.Generator().manual_seed(2)
    for hand in (Hand().requires_grad_(False), Hand("left").requires_grad_(False)):
        poses = torch.stack([random_hand_pose(hand, generator, bend=0.7) for _ in range(150)])
        assert within_limits(hand, poses)
        middle = hand.part_transforms(poses)[..., :3, 3].mean(-2)
        assert float((middle - torch.tensor([0.0, 0.0, 0.5])).abs().max()) < 0.031
        flexions = [index for index, name in enumerate(hand.dof_names) if name.endswith("flexion")]
        assert float((poses[:, flexions] / hand.upper[flexions]).max()) <= 0.7 + 1e-6
        turned = so3_exp(poses[:, 3:6])[..., 2]
        assert float(turned.mean(0).norm()) < 0.25
        # Uniform directions have mean squared components of 1/3.
        torch.testing.assert_close(turned.square().mean(0), torch.full((3,), 1 / 3), atol=0.1, rtol=0)


def test_any_shape_gets_random_poses_motions_and_clouds(arm_of):
    shape, bolted = arm_of(math.inf), arm_of(0.5, free_base=False)
    angles = torch.stack([random_hand_pose(shape, torch.Generator().manual_seed(seed))[6] for seed in range(40)])
    assert -0.3 <= float(angles.min()) < 0 < float(angles.max()) <= 0.6 * math.pi / 2
    assert hand_motion(shape, "rotate", 4).shape == (4, 7)
    assert torch.equal(random_hand_pose(bolted)[:6], torch.zeros(6))
    assert torch.equal(hand_motion(bolted, "bend", 3)[:, :6], torch.zeros(3, 6))
    made = make_hand_cloud(shape, shape.rest_pose(), num_points=50, noise=0.0, outlier_ratio=0.0)
    assert float(shape.distance(made.points, made.pose).abs().max()) < 1e-3


@pytest.mark.parametrize("kind", MOTIONS)
def test_every_motion_stays_in_its_limits_and_is_smooth(hand, kind):
    for seed in (0, 1):
        poses = hand_motion(hand, kind, 100, distance=0.6, seed=seed)
        assert within_limits(hand, poses)
        assert float(poses[:, 3:6].norm(dim=-1).max()) <= math.pi + 1e-5
        # Halving the time step halves the change of velocity: the derivative is continuous, at rest and flipping.
        jumps = [
            hand.keypoints(hand_motion(hand, kind, round(5 * fps), fps, distance=0.6, seed=seed)).diff(dim=0) * fps
            for fps in (80.0, 160.0, 320.0)
        ]
        coarse, middle, fine = (float(velocity.diff(dim=0).norm(dim=-1).max()) for velocity in jumps)
        assert middle < 0.65 * coarse
        assert fine < 0.65 * middle
    slow, fast = hand_motion(hand, kind, 5, 10.0), hand_motion(hand, kind, 10, 20.0)
    torch.testing.assert_close(slow, fast[::2])


def test_bending_closes_fingers_and_is_seen_from_both_sides(hand):
    palm, back = (hand_motion(hand, f"bending_{side}", 100) for side in ("palm", "back"))
    assert float(facing(palm).min()) > 0.8
    assert float(facing(back).max()) < -0.8
    torch.testing.assert_close(palm[:, 6:], back[:, 6:])
    pip = [hand.dof_names.index(f"{finger}_pip_flexion") for finger in ("index", "middle", "ring", "little")]
    assert float((palm[:, pip] / hand.upper[pip]).max()) > 0.4
    closed = palm[:, pip] / palm[:, pip].amax(0)
    # One after the other at first, all together after half of the time.
    assert float((closed[:20].amax(1) - closed[:20].amin(1)).max()) > 0.5
    assert float((closed[45:56].amax(1) - closed[45:56].amin(1)).max()) < 0.2


@pytest.mark.parametrize("seed", range(3))
def test_motions_turn_and_pass_as_they_promise(hand, seed):
    # At the quarters of the period the turn is widest; the sway adds three degrees to each axis at most.
    turns = so3_exp(hand_motion(hand, "rotation", 90, seed=seed)[:, 3:6])
    assert 2 * 55 < math.degrees(math.acos((float((turns[67] @ turns[22].T).trace()) - 1) / 2)) < 2 * 75
    whole = facing(hand_motion(hand, "rotate", 100, seed=seed))
    assert float(whole[0]) > 0.9
    assert float(whole[50]) < -0.9
    palm = facing(hand_motion(hand, "flip", 160, seed=seed))
    assert float(palm[:35].min()) > 0.8
    assert float(palm[65:110].max()) < -0.8
    assert float(palm[-10:].min()) > 0.8
    slow, fast = (hand_motion(hand, kind, 400, 80.0, seed=seed) for kind in ("bending_palm", "fast"))
    assert 2.8 < float(fast[:, 6:].diff(dim=0).abs().max() / slow[:, 6:].diff(dim=0).abs().max()) < 4.2
    x = hand.part_transforms(hand_motion(hand, "occlusion", 160, distance=0.6, seed=seed))[..., 0, 3].mean(-1)
    assert float(x[:30].abs().min()) > 0.12
    assert bool((x[:30].sign() == -x[70:100].sign()).all() and (x[-6:].sign() == x[:6].sign()).all())
