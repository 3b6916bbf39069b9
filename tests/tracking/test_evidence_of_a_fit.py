"""What a fit takes from a frame and says of itself: data in reach, inliers, unexplained clusters, joints at limits."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from torchreg.geometry.rigid import transform_points
from torchreg.shapes.limbs import find_limbs
from torchreg.tracking import unexplained

CELL = 0.01
HINGE = 6


def test_views_hold_the_data_in_reach_of_the_model(tracking):
    far = tracking.cloud.amax(0) + 0.12
    cloud = torch.cat([tracking.cloud, far[None], torch.full_like(far, torch.nan)[None]])
    fitter = tracking.fitter()
    view = fitter.view(tracking.state(), tracking.frame(cloud), tracking.pose)
    assert view.in_reach.tolist() == [True] * 300 + [False] * 2
    assert torch.equal(view.origin, tracking.pose[:3])
    torch.testing.assert_close(view.problem.data[0], tracking.cloud - view.origin)
    torch.testing.assert_close(view.problem.prior.mean[0, 3:], tracking.pose[3:])
    assert not view.problem.prior.mean[0, :3].any()
    # After losses and gaps the shape may be farther away.
    assert fitter.view(tracking.state(lost=3), tracking.frame(cloud), tracking.pose).in_reach[300]


def test_views_of_few_data_are_none(tracking):
    fitter, state = tracking.fitter(), tracking.state()
    assert fitter.view(state, tracking.frame(tracking.cloud[:9]), tracking.pose) is None
    assert fitter.fit_at(state, tracking.frame(tracking.cloud + 5), tracking.pose, "found") is None
    assert fitter.view(state, tracking.frame(tracking.cloud[:10]), tracking.pose) is not None


def test_views_subsample_the_data_alike_whenever_asked(tracking):
    fitter, state = tracking.fitter(max_points=40), tracking.state()
    first, again = (fitter.view(state, tracking.frame(), tracking.pose).problem.data for _ in range(2))
    assert first.shape == (1, 40, 3)
    assert torch.equal(first, again)
    later = replace(state, frame=state.frame + 1)
    assert not torch.equal(first, fitter.view(later, tracking.frame(), tracking.pose).problem.data)


def test_views_ahead_register_the_points_that_were_seen(tracking):
    half = tracking.skin.points[:, 1] > 0
    state = tracking.state(points=tracking.skin.points[half], weights=tracking.skin.weights[half])
    fitter, pose = tracking.fitter(), tracking.pose + 0.1
    view = fitter.look(state, tracking.frame(), pose)
    assert len(view.problem.skin) == half.sum()
    torch.testing.assert_close(view.origin, pose[:3])
    assert fitter.look(replace(state, num_inliers=0.0), tracking.frame(), pose) is None


def test_fits_lie_on_the_surface_and_say_how_well(arm, tracking):
    fit = tracking.fitter().fit_at(tracking.state(), tracking.frame(), tracking.bent(0.1), "surface")
    assert fit.acquired == "surface"
    torch.testing.assert_close(fit.world_pose, tracking.pose, atol=5e-3, rtol=0)
    torch.testing.assert_close(fit.distance[0], arm.distance(tracking.cloud, fit.world_pose), atol=1e-9, rtol=0)
    assert fit.num_inliers == 300
    assert (fit.num_new_unexplained, len(fit.unexplained), fit.limit_share) == (0, 0, 0.0)
    # The tip of the arm is 0.3 m from its hinge; most points moved less than it, and more than nothing.
    assert 0.005 < fit.deviation < 0.03
    assert fit.cost < 1.0


def test_a_fit_counts_what_it_explains(tracking):
    fit = tracking.fitter(max_points=100).fit_at(tracking.state(), tracking.frame(), tracking.pose, "tracked")
    in_reach = int(fit.view.in_reach.sum())
    assert in_reach == 300
    assert fit.distance.shape == (1, 100)
    half = replace(fit, num_inliers=50, cost=25.0)
    assert half.ratio_in_reach == 0.5
    # What is true of the data that were drawn is true of all in reach.
    assert half.soft_inliers == pytest.approx(0.75 * in_reach)
    assert replace(fit, distance=fit.distance[:, :0], num_inliers=0).ratio_in_reach == 0


def test_joints_at_their_limits_are_counted(arm, tracking):
    pose = tracking.bent(float(arm.upper[HINGE]) - 0.7)
    fit = tracking.fitter().fit_at(tracking.state(), tracking.frame(tracking.skin(pose)), pose, "tracked")
    assert fit.limit_share == float(fit.pose[0, HINGE] >= arm.upper[HINGE] - 1e-3)


def patch_beside_the_arm(arm, tracking):
    """A patch as dense as the surface where the arm could be, but is not."""
    generator = torch.Generator().manual_seed(0)
    offsets = torch.rand(30, 3, generator=generator, dtype=torch.float64) - 0.5
    tip = torch.tensor([[0.25, 0.0, 0.0]], dtype=torch.float64)
    return transform_points(arm.part_transforms(tracking.bent(-0.4))[1], tip) + 0.03 * offsets


def test_dense_data_where_a_limb_could_be_are_new_once(arm, tracking):
    fitter, state = tracking.fitter(), tracking.state()
    frame = tracking.frame(torch.cat([tracking.cloud, patch_beside_the_arm(arm, tracking)]))
    fit = fitter.fit_at(state, frame, tracking.pose, "tracked")
    assert len(fit.unexplained) >= 20
    assert fit.num_new_unexplained >= 20
    trunk = fit.transforms[0]
    learned = fitter.clusters.remember(state, fit.unexplained, trunk)
    torch.testing.assert_close(transform_points(trunk, learned), fit.unexplained)
    again = fitter.fit_at(replace(state, unexplained=learned), frame, tracking.pose, "tracked")
    assert again.num_new_unexplained == 0


def test_new_clusters_are_background_only_after_searches_for_the_limb(arm, tracking):
    """A tracker takes a patch beside the arm for a limb that it missed, and searches it six times."""
    made = tr.Tracker(arm, tracking.pose, model_points=tracking.skin)
    made.run([tracking.cloud] * 2)
    cloud = torch.cat([tracking.cloud, patch_beside_the_arm(arm, tracking)])
    while len(made.state.unexplained) == 0 and made.state.frame < 60:
        made.step(cloud)
    assert made.state.failed_searches == 6
    # Each search comes later after the one before than that one did.
    assert made.state.frame > 30


@pytest.fixture(scope="module")
def reach(plain_hand, plain_hand_skin):
    return unexplained.LimbReach(plain_hand_skin, find_limbs(plain_hand)[0], CELL)


def moved_pose(hand):
    pose = hand.rest_pose()
    pose[:6] = torch.tensor([0.3, -0.2, 0.6, 1.0, -2.0, 0.5])
    return pose


def test_limbs_reach_the_space_within_their_limits(reach, plain_hand, plain_hand_skin):
    shares = torch.rand(20, 21, generator=torch.Generator().manual_seed(0))
    pose = moved_pose(plain_hand)
    poses = pose.repeat(20, 1)
    poses[:, 6:] = plain_hand.lower[6:] + shares * (plain_hand.upper - plain_hand.lower)[6:]
    fingers = plain_hand_skin.weights.argmax(-1) > 0
    trunk = plain_hand.part_transforms(pose)[0]
    reached = torch.stack([reach(points[fingers], trunk) for points in plain_hand_skin(poses)])
    assert reached.float().mean() > 0.98


def test_no_limb_reaches_behind_the_wrist_or_far_away(reach, plain_hand):
    pose = moved_pose(plain_hand)
    palm = plain_hand.part_transforms(pose)[0]
    fingertips = torch.linalg.inv(palm) @ torch.nn.functional.pad(plain_hand.keypoints(pose), (0, 1), value=1.0).T
    outwards = torch.nn.functional.normalize(fingertips[:3, 12], dim=0)
    behind = transform_points(palm, -0.06 * torch.arange(1.0, 5.0).unsqueeze(-1) * outwards)
    assert not bool(reach(behind, palm).any())
    assert not bool(reach(pose[:3] + torch.tensor([[9.0, 0, 0], [0, -9.0, 0]]), palm).any())


def test_without_limbs_all_space_counts(plain_hand_skin):
    points = 5 * torch.randn(7, 3, generator=torch.Generator().manual_seed(1))
    assert bool(unexplained.LimbReach(plain_hand_skin, [], CELL)(points, torch.eye(4)).all())


def test_unexplained_clusters_are_as_dense_as_the_surface(plain_hand_skin):
    generator = torch.Generator().manual_seed(2)
    sheet, patch = torch.rand(400, 3, generator=generator), torch.rand(30, 3, generator=generator)
    sheet[:, 2] = 0
    patch = torch.tensor([0.2, 0.2, 0.4]) + 0.1 * patch
    sparse = torch.rand(20, 3, generator=generator) + torch.tensor([0, 0, 1.0])
    data = torch.cat([sheet, patch, sparse])
    clusters = unexplained.UnexplainedClusters(plain_hand_skin, [], 3.0)
    found = clusters.find(data, data[:, 2], torch.tensor(0.01))
    assert len(found) >= 28
    assert float(unexplained.nearest_distance(found, patch).max()) < 1e-3
    assert len(clusters.find(data, data[:, 2], torch.tensor(9.0))) == 0
    assert unexplained.nearest_distance(found, patch[:0]).isinf().all()
