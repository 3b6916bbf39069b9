"""Made-up poses, motions and clouds of shapes: within limits, as each motion promises, the truth on the surface."""

import math

import pytest
import torch

import torchreg as tr
from torchreg.datasets import hand as made
from torchreg.geometry.visibility import visible_points


@pytest.fixture
def cloud(plain_hand, skin):
    def make(pose=None, **options):
        pose = plain_hand.rest_pose() if pose is None else pose
        return made.make_hand_cloud(plain_hand, pose, **{"skin": skin, "noise": 0.0, "outlier_ratio": 0.0, **options})

    return make


def turned(poses):
    """Return the rotations of the palm."""
    return tr.Hand().requires_grad_(False).part_transforms(poses)[..., 0, :3, :3]


def facing(poses):
    """Return the cosine (T,) between the palm's normal and the direction to the camera."""
    return turned(poses)[:, 2, 1]


def within_limits(shape, poses):
    return bool((poses >= shape.lower - 1e-6).all() and (poses <= shape.upper + 1e-6).all())


def test_surface_skins_lie_on_the_surface_or_are_those_of_files(plain_hand, skin):
    # A coarse grid cuts the creases between fingers.
    assert float(plain_hand.distance(skin.points, plain_hand.rest_pose()).abs().max()) < 0.5 * 0.006
    box = torch.tensor([[x, y, z] for x in (0.0, 0.1) for y in (0.0, 0.1) for z in (0.0, 0.2, 0.4)])
    weights = torch.nn.functional.one_hot((box[:, 2] > 0.3).long(), 2).float()
    faces = torch.tensor([[0, 1, 3], [1, 2, 4], [6, 7, 9], [7, 8, 10]])
    joints = torch.tensor([[0.05, 0.05, 0.0], [0.05, 0.05, 0.25]])
    own = made.surface_skin(tr.ArticulatedShape.from_skinned_mesh(box, faces, weights, joints, [-1, 0]))
    torch.testing.assert_close((own.points, own.faces), (box, faces))


def test_clean_clouds_lie_on_the_surface_all_around_or_on_the_side_of_the_camera(plain_hand, skin, cloud):
    found = cloud(num_points=400)
    assert bool(found.inliers.all())
    assert float(plain_hand.distance(found.points, found.pose).abs().max()) < 0.5 * 0.006
    nearest = plain_hand.part_distances(found.points, found.pose).argmin(-1)
    assert float((nearest == found.part_labels).float().mean()) > 0.95
    assert len(found.part_labels.unique()) == 16
    assert 0.1 < float((found.points[:, 1] > 0.005).float().mean()) < 0.9
    assert float((cloud(num_points=400, noise=0.002).points - found.points).std()) == pytest.approx(0.002, rel=0.1)
    camera = torch.tensor([0.0, -0.5, 0.1])
    points, mesh = cloud(camera=camera).points, tr.TriangleMesh(skin(plain_hand.rest_pose()), skin.faces)
    assert bool(visible_points(mesh, points, camera, tolerance=0.004).all())
    # The palm looks at -y.
    assert float((points[:, 1] < 0.004).float().mean()) > 0.97


@pytest.mark.parametrize(("ratio", "count"), [(0.0, 0), (0.33, 246), (0.9, 4500)])
def test_outliers_are_the_given_share_mixed_in_and_fill_the_grown_box(skin, cloud, ratio, count):
    found = cloud(outlier_ratio=ratio, noise=0.0015)
    assert len(found.points) == len(found.part_labels) == 500 + count
    assert int((~found.inliers).sum()) == count
    assert bool(((found.part_labels == -1) == ~found.inliers).all())
    first, second = (half.float().mean() for half in found.inliers.chunk(2))
    assert abs(float(first - second)) < 0.1
    if count > 1000:
        vertices = skin(found.pose)
        lower, upper = vertices.amin(0) - 0.05, vertices.amax(0) + 0.05
        share = (found.points[~found.inliers] - lower) / (upper - lower)
        assert 0 <= float(share.min()) < 0.01
        assert 0.99 < float(share.max()) <= 1
        torch.testing.assert_close(share.mean(0), torch.full((3,), 0.5), atol=0.02, rtol=0)


def test_clouds_carry_the_truth_in_either_precision(plain_hand, skin, cloud):
    pose = made.random_hand_pose(plain_hand, torch.Generator().manual_seed(4))
    found = cloud(pose, num_points=300, camera=torch.zeros(3))
    torch.testing.assert_close((found.keypoints, found.vertices), (plain_hand.keypoints(pose), skin(pose)))
    counts = [int((found.part_labels == part).sum()) for part in range(16)]
    assert found.part_counts.tolist() == counts
    assert found.seen_parts.tolist() == [count >= 8 for count in counts]
    double = tr.Hand("left", dtype=torch.float64)
    skin = made.surface_skin(double, spacing=0.01)
    found = made.make_hand_cloud(double, made.random_hand_pose(double), skin=skin, num_points=50)
    assert found.points.dtype == found.pose.dtype == torch.float64


@pytest.mark.parametrize("side", ["right", "left"])
def test_random_poses_keep_the_limits_point_everywhere_and_stand_before_the_camera(side):
    hand, generator = tr.Hand(side).requires_grad_(False), torch.Generator().manual_seed(2)
    poses = torch.stack([made.random_hand_pose(hand, generator, bend=0.7) for _ in range(150)])
    assert within_limits(hand, poses)
    middle = hand.part_transforms(poses)[..., :3, 3].mean(-2)
    assert float((middle - torch.tensor([0.0, 0.0, 0.5])).abs().max()) < 0.031
    flexions = [index for index, name in enumerate(hand.dof_names) if name.endswith("flexion")]
    assert float((poses[:, flexions] / hand.upper[flexions]).max()) <= 0.7 + 1e-6
    axes = turned(poses)[..., 2]
    assert float(axes.mean(0).norm()) < 0.25
    # Uniform directions have mean squared components of 1/3.
    torch.testing.assert_close(axes.square().mean(0), torch.full((3,), 1 / 3), atol=0.1, rtol=0)


def test_any_shape_gets_random_poses_motions_and_clouds(arms):
    _, shape, bolted = arms
    angles = torch.stack([made.random_hand_pose(shape, torch.Generator().manual_seed(seed))[6] for seed in range(40)])
    assert -0.3 <= float(angles.min()) < 0 < float(angles.max()) <= 0.6 * math.pi / 2
    assert made.hand_motion(shape, "rotate", 4).shape == (4, 7)
    assert not made.random_hand_pose(bolted)[:6].any()
    assert not made.hand_motion(bolted, "bend", 3)[:, :6].any()
    found = made.make_hand_cloud(shape, shape.rest_pose(), num_points=50, noise=0.0, outlier_ratio=0.0)
    assert float(shape.distance(found.points, found.pose).abs().max()) < 1e-3


@pytest.mark.parametrize("kind", made.MOTIONS)
def test_every_motion_stays_in_its_limits_and_is_smooth(plain_hand, kind):
    for seed in (0, 1):
        poses = made.hand_motion(plain_hand, kind, 100, distance=0.6, seed=seed)
        assert within_limits(plain_hand, poses)
        assert float(poses[:, 3:6].norm(dim=-1).max()) <= math.pi + 1e-5
        # Halving the time step halves the change of velocity: the derivative is continuous, at rest and flipping.
        jumps = []
        for fps in (80.0, 160.0, 320.0):
            motion = made.hand_motion(plain_hand, kind, round(5 * fps), fps, distance=0.6, seed=seed)
            jumps.append(float((plain_hand.keypoints(motion).diff(dim=0) * fps).diff(dim=0).norm(dim=-1).max()))
        assert jumps[1] < 0.65 * jumps[0]
        assert jumps[2] < 0.65 * jumps[1]
    slow, fast = made.hand_motion(plain_hand, kind, 5, 10.0), made.hand_motion(plain_hand, kind, 10, 20.0)
    torch.testing.assert_close(slow, fast[::2])


@pytest.mark.parametrize("seed", range(3))
def test_motions_turn_bend_and_pass_as_they_promise(plain_hand, seed):
    def motion(kind, *options):
        return made.hand_motion(plain_hand, kind, *options, distance=0.6, seed=seed)

    palm, back = motion("bending_palm", 100), motion("bending_back", 100)
    assert float(facing(palm).min()) > 0.8
    assert float(facing(back).max()) < -0.8
    torch.testing.assert_close(palm[:, 6:], back[:, 6:])
    pip = [plain_hand.dof_names.index(f"{finger}_pip_flexion") for finger in ("index", "middle", "ring", "little")]
    assert float((palm[:, pip] / plain_hand.upper[pip]).max()) > 0.4
    if seed == 0:  # one after the other at first, all together after half of the time
        closed = palm[:, pip] / palm[:, pip].amax(0)
        assert float((closed[:20].amax(1) - closed[:20].amin(1)).max()) > 0.5
        assert float((closed[45:56].amax(1) - closed[45:56].amin(1)).max()) < 0.2
    # At the quarters of the period the turn is widest; the sway adds three degrees to each axis at most.
    turns = turned(motion("rotation", 90))
    assert 2 * 55 < math.degrees(math.acos((float((turns[67] @ turns[22].T).trace()) - 1) / 2)) < 2 * 75
    whole, flip = facing(motion("rotate", 100)), facing(motion("flip", 160))
    assert float(whole[0]) > 0.9
    assert float(whole[50]) < -0.9
    assert min(float(flip[:35].min()), float(flip[-10:].min())) > 0.8
    assert float(flip[65:110].max()) < -0.8
    slow, fast = (motion(kind, 400, 80.0)[:, 6:].diff(dim=0).abs().max() for kind in ("bending_palm", "fast"))
    assert 2.8 < float(fast / slow) < 4.2
    x = plain_hand.part_transforms(motion("occlusion", 160))[..., 0, 3].mean(-1)
    assert float(x[:30].abs().min()) > 0.12
    assert bool((x[:30].sign() == -x[70:100].sign()).all() and (x[-6:].sign() == x[:6].sign()).all())
