"""What a fit takes from a frame and says of itself: data in reach, unexplained clusters, joints at limits."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from torchreg.geometry.rigid import transform_points
from torchreg.geometry.rotation import so3_exp, so3_log
from torchreg.shapes.limbs import find_limbs
from torchreg.tracking.evidence import LimbReach, UnexplainedClusters, presence, presence_evidence
from torchreg.tracking.frame import Frame

CELL = 0.01


def test_data_in_reach_of_the_model_are_measured(arm, tracking):
    """After losses and gaps the shape may be farther away."""
    far = tracking.cloud.amax(0) + 0.12
    cloud = torch.cat([tracking.cloud, far[None], torch.full_like(far, torch.nan)[None]])
    for state, time, reached in (
        (tracking.state(), None, 0),
        (tracking.state(lost=3), None, 1),
        (tracking.state(), 3.0, 1),
    ):
        result, _ = tracking.step(state, cloud, time)
        assert result.distances.isfinite().tolist() == [True] * 300 + [bool(reached), False]
        torch.testing.assert_close(result.distances[:300], arm.distance(tracking.cloud, result.pose), atol=1e-9, rtol=0)
        assert result.inliers.tolist() == [True] * 300 + [False] * 2
        torch.testing.assert_close(result.pose, tracking.pose, atol=5e-3, rtol=0)


@pytest.mark.parametrize(("points", "status"), [(9, tr.Status.NO_DATA), (slice(300), tr.Status.LOST)])
def test_few_data_or_far_ones_are_no_shape(tracking, points, status):
    cloud = tracking.cloud[:points] if isinstance(points, int) else tracking.cloud[points] + 5
    assert tracking.step(tracking.state(), cloud)[0].status is status


def test_data_are_subsampled_alike_whenever_asked(tracking):
    state = tracking.state(pose=tracking.bent(0.05))
    first, again, later = (
        tracking.step(each, max_points=40)[0].pose for each in (state, state, replace(state, frame=state.frame + 1))
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, later)


def test_running_means_take_a_tenth_of_a_frame(arm, tracking):
    """Of the data in reach, that were drawn; of joints at their limits, whose share is one here."""
    pose = tracking.bent(float(arm.upper[6]) - 0.7)
    cloud = torch.cat([tracking.skin(pose)[::2], tracking.pose[:3] + torch.tensor([[0.3, 0.3, 0.3]] * 20)])
    state = tracking.state(pose=pose, num_data=100.0, num_inliers=90.0, ratio_in_reach=0.7, limit_share=0.9)
    result, after = tracking.step(state, cloud)
    at_limit = float(result.pose[6] >= arm.upper[6] - 1e-3)
    inliers = int(result.inliers.sum())
    assert 90 < inliers <= 100
    assert after.num_data == pytest.approx(0.9 * 100 + 0.1 * 120)
    assert after.num_inliers == pytest.approx(0.9 * 90 + 0.1 * inliers)
    in_reach = int(result.distances.isfinite().sum())
    assert after.ratio_in_reach == pytest.approx(0.9 * 0.7 + 0.1 * inliers / in_reach)
    assert after.limit_share == pytest.approx(0.9 * 0.9 + 0.1 * at_limit)
    assert after.residual == pytest.approx(0.9 * 0.001 + 0.1 * float(result.residual))


def test_new_clusters_are_background_only_after_searches_for_the_limb(arm, tracking):
    """A patch as dense as the surface where the arm could be is taken for a limb that was missed, six times."""
    offsets = torch.rand(30, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
    tip = torch.tensor([[0.25, 0.0, 0.0]], dtype=torch.float64)
    patch = transform_points(arm.part_transforms(tracking.bent(-0.4))[1], tip) + 0.03 * offsets
    made = tr.Tracker(arm, tracking.pose, model_points=tracking.skin)
    made.run([tracking.cloud] * 2)
    cloud = torch.cat([tracking.cloud, patch])
    while len(made.state.unexplained) == 0 and made.state.frame < 60:
        made.step(cloud)
    assert made.state.failed_searches == 6
    # Each search comes later after the one before than that one did.
    assert made.state.frame > 30
    # What is known as background is no reason to search.
    trunk = arm.part_transforms(made.state.pose)[0]
    distance = torch.cdist(transform_points(trunk, made.state.unexplained), patch).amin(-1)
    assert len(distance) >= 20
    assert float(distance.max()) < 5e-3
    made.state = replace(made.state, failed_searches=0, cool_down=0)
    made.step(cloud)
    assert made.state.failed_searches == 0


@pytest.fixture(scope="module")
def reach(plain_hand, plain_hand_skin):
    return LimbReach(plain_hand_skin, find_limbs(plain_hand)[0], CELL)


def test_limbs_reach_the_space_within_their_limits_but_not_behind_the_wrist(reach, plain_hand, plain_hand_skin):
    pose = plain_hand.rest_pose()
    pose[:6] = torch.tensor([0.3, -0.2, 0.6, 1.0, -2.0, 0.5])
    poses = pose.repeat(20, 1)
    shares = torch.rand(20, 21, generator=torch.Generator().manual_seed(0))
    poses[:, 6:] = plain_hand.lower[6:] + shares * (plain_hand.upper - plain_hand.lower)[6:]
    fingers = plain_hand_skin.weights.argmax(-1) > 0
    palm = plain_hand.part_transforms(pose)[0]
    reached = torch.stack([reach(points[fingers], palm) for points in plain_hand_skin(poses)])
    assert reached.float().mean() > 0.98
    fingertip = transform_points(torch.linalg.inv(palm), plain_hand.keypoints(pose)[12:13])
    outwards = torch.nn.functional.normalize(fingertip, dim=-1)
    behind = transform_points(palm, -0.06 * torch.arange(1.0, 5.0).unsqueeze(-1) * outwards)
    assert not bool(reach(behind, palm).any())
    assert not bool(reach(pose[:3] + torch.tensor([[9.0, 0, 0], [0, -9.0, 0]]), palm).any())
    # Without limbs all space counts.
    assert bool(LimbReach(plain_hand_skin, [], CELL)(9 * behind, torch.eye(4)).all())


def test_limbs_of_a_larger_shape_reach_as_far_in_its_own_size(reach):
    points = 0.08 * torch.randn(500, 3, generator=torch.Generator().manual_seed(3))
    wanted = reach(points, torch.eye(4))
    assert 0.1 < float(wanted.float().mean()) < 0.9
    assert torch.equal(reach.scaled(4.0)(4 * points, torch.eye(4)), wanted)
    assert not torch.equal(reach(4 * points, torch.eye(4)), wanted)


def test_unexplained_clusters_are_as_dense_as_the_surface(plain_hand_skin):
    generator = torch.Generator().manual_seed(2)
    sheet, patch = torch.rand(400, 3, generator=generator), torch.rand(30, 3, generator=generator)
    sheet[:, 2] = 0
    patch = torch.tensor([0.2, 0.2, 0.4]) + 0.1 * patch
    sparse = torch.rand(20, 3, generator=generator) + torch.tensor([0, 0, 1.0])
    data = torch.cat([sheet, patch, sparse])
    clusters = UnexplainedClusters(plain_hand_skin, [], 3.0)
    found = clusters.find(data, data[:, 2], torch.tensor(0.01))
    assert len(found) >= 28
    assert float(torch.cdist(found, patch).amin(-1).max()) < 1e-3
    assert len(clusters.find(data, data[:, 2], torch.tensor(9.0))) == 0


def shown(arm, skin, cloud, pose):
    """Return the unseen share and the presence of an arm that was found at a pose in a cloud."""
    made = tr.Tracker(arm, model_points=skin)
    frame = Frame(cloud=cloud, finite=torch.ones(len(cloud), dtype=torch.bool), elapsed=1.0)
    fit = made._fitter.fit_at(made.state, frame, pose, "found")
    return float(presence_evidence(fit)[0]), presence(fit)


def test_presence_counts_the_surface_that_faces_the_data_and_has_none(arm, tracking):
    """A cloud of one side misses nothing that a camera there sees; one without the tip misses it, in any base pose."""
    pose, skin, elbow = tracking.pose, tracking.skin, torch.linalg.inv(arm.part_transforms(tracking.pose)[1])
    mesh, toward = arm.surface_mesh(pose, spacing=0.01), torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    whole, sure = shown(arm, skin, mesh.vertices, pose)
    assert whole == 0.0
    assert sure > 0.9
    normals = mesh.vertex_normals()
    cloud = mesh.vertices[normals @ toward > 0.2]
    side, facing = shown(arm, skin, cloud, pose)
    assert side < 0.05
    assert facing > 0.9
    # Of the arm, what is farther out than the middle of its ellipsoid is missing.
    cut = cloud[transform_points(elbow, cloud)[:, 0] < 0.15]
    half, unsure = shown(arm, skin, cut, pose)
    model = skin(pose)
    faces = normals[torch.cdist(model, mesh.vertices).argmin(-1)] @ toward > 0.3
    expected = (torch.cdist(model[faces], cut).amin(-1) > 0.02).double().mean()
    assert half == pytest.approx(float(expected), abs=0.1)
    assert half > 0.15
    assert unsure < facing
    turn = so3_exp(torch.tensor([0.3, -0.9, 0.4], dtype=torch.float64))
    moved = torch.cat([turn @ pose[:3] + 0.7, so3_log(turn @ so3_exp(pose[3:6])), pose[6:]])
    assert shown(arm, skin, cut @ turn.mT + 0.7, moved) == pytest.approx((half, unsure), abs=0.02)
