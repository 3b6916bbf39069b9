"""Clouds of more data than a pose is fitted to: the fit takes a draw, what is told of the data is told of all."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from torchreg.alignment.inputs import Observation
from torchreg.datasets.hand import make_hand_cloud, surface_skin
from torchreg.solvers.e_step import posterior

DESCENT = tr.AlignConfig(search="never", em_steps=1, surface_steps=2)
FOUND = ("pose", "keypoints", "distances", "inliers")


@pytest.fixture(scope="module")
def truth(plain_hand):
    pose = plain_hand.rest_pose()
    pose[:6] = torch.tensor([0.05, -0.1, 0.5, 1.2, -0.4, 0.6])
    pose[6:] += 0.2
    return plain_hand.clamp(pose)


@pytest.fixture(scope="module")
def points(plain_hand, truth):
    """13,000 points of all sides, a tenth of them outliers."""
    made = make_hand_cloud(
        plain_hand, truth, num_points=11_700, noise=0.001, outlier_ratio=0.1, generator=torch.Generator().manual_seed(0)
    )
    return made.points[:13_000]


@pytest.fixture(scope="module")
def start(truth):
    return truth + torch.where(torch.arange(27) < 3, 0.004, 0.04)


@pytest.fixture(scope="module")
def found(plain_hand, plain_hand_skin, points, start):
    return tr.align(plain_hand, points, start, model_points=plain_hand_skin, config=DESCENT)


def off(hand, found, truth):
    return float((found.keypoints - hand.keypoints(truth)).norm(dim=-1).mean())


def test_distances_inliers_and_posterior_are_those_of_all_data(plain_hand, plain_hand_skin, points, truth, found):
    assert off(plain_hand, found, truth) < 0.001
    assert found.status == tr.Status.CONVERGED
    distances = plain_hand.distance(points, found.pose)
    torch.testing.assert_close(found.distances, distances, atol=1e-5, rtol=0)
    limit = 0.02 * float((plain_hand_skin.points.amax(0) - plain_hand_skin.points.amin(0)).norm())
    clear = (distances.abs() - limit).abs() > 1e-5
    assert torch.equal(found.inliers[clear], (distances.abs() < limit)[clear])
    few = slice(None, None, 50)
    alpha = posterior(found.registered, points[few], found.sigma).sum(0)
    torch.testing.assert_close(found.posterior[few], alpha, atol=1e-3, rtol=0)


def test_up_to_ten_thousand_data_all_count(plain_hand, plain_hand_skin, points, start):
    few = points[:10_000]
    found = tr.align(plain_hand, few, start, model_points=plain_hand_skin, config=DESCENT)
    padded = torch.cat([few, torch.full((5, 3), torch.nan)])
    mask = torch.arange(10_005) < 10_000
    again = tr.align(plain_hand, padded, start, mask=mask, model_points=plain_hand_skin, config=DESCENT)
    torch.testing.assert_close(again.pose, found.pose, atol=1e-4, rtol=0)
    assert found.history[-1].cost.isfinite()


def test_a_batch_of_clouds_of_different_sizes_is_aligned_as_each_alone(plain_hand, plain_hand_skin, points, start):
    clouds, mask = torch.stack([points, points.flip(0)]), torch.ones(2, len(points), dtype=torch.bool)
    mask[1, 3000:], clouds[1, 3000:], clouds[0, ::7] = False, torch.inf, torch.nan
    config = tr.AlignConfig(search="never", em_steps=1, surface_steps=2, nan_policy="omit")
    both = tr.align(plain_hand, clouds, start, mask=mask, model_points=plain_hand_skin, config=config)
    for row in range(2):
        alone = tr.align(plain_hand, clouds[row], start, mask=mask[row], model_points=plain_hand_skin, config=config)
        torch.testing.assert_close(both.pose[row], alone.pose, atol=1e-3, rtol=0)
        kept = mask[row] & clouds[row].isfinite().all(-1)
        assert torch.equal(both.distances[row].isnan(), ~kept)
        assert not both.inliers[row][~kept].any()
        assert float(both.posterior[row][~kept].abs().max()) == 0
        torch.testing.assert_close(both.distances[row][kept], alone.distances[kept], atol=2e-4, rtol=0)


def test_copies_of_a_few_outliers_do_not_outvote_the_shape(plain_hand, plain_hand_skin, points, start, truth):
    outliers = torch.tensor([0.05, 0.1, 0.5]) + 0.001 * torch.rand(40, 3, generator=torch.Generator().manual_seed(1))
    clouds = torch.cat([points[:3000], outliers.repeat(1500, 1)])
    found = tr.align(plain_hand, clouds, start, model_points=plain_hand_skin, config=DESCENT)
    assert off(plain_hand, found, truth) < 0.005
    assert len(found.inliers) == 63_000
    assert int(found.inliers[3000:].sum()) == 0


def test_no_start_and_any_kind_of_numbers(plain_hand, points, truth):
    found = tr.align(plain_hand, points.numpy())
    assert off(plain_hand, found, truth) < 0.002
    starts = tr.find_pose(plain_hand, points.double())
    assert float((plain_hand.keypoints(starts.best) - plain_hand.keypoints(truth)).norm(dim=-1).mean()) < 0.003
    # Of the data that are looked at, a tenth is left unexplained.
    assert float(starts.costs[0]) < 800


@pytest.mark.parametrize("seed", [0, 1])
def test_data_made_with_the_seed_of_the_draw_are_drawn_like_others(plain_hand, seed):
    """The numbers with which a face of a mesh was drawn for each point must not choose among the points."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(3, 50_000, generator=generator, dtype=torch.float64).T
    few = Observation.of(points, None).drawn(plain_hand, "raise", seed)
    assert len(few.points) == 10_000
    assert float(few.points[:, 0].mean()) == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("batched", [False, True])
def test_a_depth_frame_of_many_points_is_fitted_at_a_coarser_grid(links, links_skin, picture_of, batched):
    camera, pose = tr.Camera(768, 576, (880.0, 880.0, 380.0, 284.0)), links.rest_pose()
    pose[:6] = torch.tensor([-0.1, 0.0, 0.6, 0.0, 1.4, 0.0])
    pose[6:] = torch.tensor([0.3, 0.2])
    frame = picture_of(surface_skin(links), pose, camera, wall=0.0, max_points=100_000)
    assert len(frame.points) > 10_000
    found = tr.align(links, [frame] if batched else frame, pose + 0.01, model_points=links_skin, config=DESCENT)
    found = found if not batched else replace(found, **{name: getattr(found, name)[0] for name in FOUND})
    assert off(links, found, pose) < 0.003
    torch.testing.assert_close(
        found.distances, links.distance(frame.points.double(), found.pose.double()), atol=1e-5, rtol=0
    )
    assert int(found.inliers.sum()) == len(found.inliers)
