"""Clouds of more data than a pose is fitted to: the fit takes a draw, what is told of the data is told of all."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from tests.alignment.conftest import DESCENT
from tests.alignment.made import D, cloud, generator, off
from torchreg.datasets.hand import surface_skin
from torchreg.solvers.e_step import posterior

FOUND = ("pose", "keypoints", "distances", "inliers")


@pytest.fixture(scope="module")
def points(plain_hand, truth):
    """13,000 points of all sides, a tenth of them outliers."""
    return cloud(plain_hand, truth, num_points=11_700, outlier_ratio=0.1).points[:13_000]


@pytest.fixture(scope="module")
def found(fit, points, start):
    return fit(points, start)


def mean_off(hand, found, truth):
    return float(off(hand, found.pose, truth).mean())


def test_distances_inliers_and_posterior_are_those_of_all_data(plain_hand, plain_hand_skin, points, truth, found):
    assert mean_off(plain_hand, found, truth) < 0.001
    assert found.status == tr.Status.CONVERGED
    distances = plain_hand.distance(points, found.pose)
    torch.testing.assert_close(found.distances, distances, atol=1e-5, rtol=0)
    limit = 0.02 * float((plain_hand_skin.points.amax(0) - plain_hand_skin.points.amin(0)).norm())
    clear = (distances.abs() - limit).abs() > 1e-5
    assert torch.equal(found.inliers[clear], (distances.abs() < limit)[clear])
    few = slice(None, None, 50)
    alpha = posterior(found.registered, points[few], found.sigma).sum(0)
    torch.testing.assert_close(found.posterior[few], alpha, atol=1e-3, rtol=0)


def test_up_to_ten_thousand_data_all_count(fit, points, start):
    few = points[:10_000]
    padded, mask = torch.cat([few, torch.full((5, 3), torch.nan)]), torch.arange(10_005) < 10_000
    torch.testing.assert_close(fit(padded, start, mask=mask).pose, fit(few, start).pose, atol=1e-4, rtol=0)


def test_a_batch_of_clouds_of_different_sizes_is_aligned_as_each_alone(fit, points, start):
    clouds, mask = torch.stack([points, points.flip(0)]), torch.ones(2, len(points), dtype=torch.bool)
    mask[1, 3000:], clouds[1, 3000:], clouds[0, ::7] = False, torch.inf, torch.nan
    config = replace(DESCENT, nan_policy="omit")
    both = fit(clouds, start, mask=mask, config=config)
    for row in range(2):
        alone = fit(clouds[row], start, mask=mask[row], config=config)
        torch.testing.assert_close(both.pose[row], alone.pose, atol=1e-3, rtol=0)
        kept = mask[row] & clouds[row].isfinite().all(-1)
        assert torch.equal(both.distances[row].isnan(), ~kept)
        assert not both.inliers[row][~kept].any()
        assert float(both.posterior[row][~kept].abs().max()) == 0
        torch.testing.assert_close(both.distances[row][kept], alone.distances[kept], atol=2e-4, rtol=0)


def test_copies_of_a_few_outliers_do_not_outvote_the_shape(plain_hand, fit, points, start, truth):
    outliers = torch.tensor([0.05, 0.1, 0.5]) + 0.001 * torch.rand(40, 3, generator=generator(1))
    found = fit(torch.cat([points[:3000], outliers.repeat(1500, 1)]), start)
    assert mean_off(plain_hand, found, truth) < 0.005
    assert len(found.inliers) == 63_000
    assert int(found.inliers[3000:].sum()) == 0


def test_no_start_and_any_kind_of_numbers(plain_hand, points, truth):
    assert mean_off(plain_hand, tr.align(plain_hand, points.numpy()), truth) < 0.002
    starts = tr.find_pose(plain_hand, points.double())
    assert float(off(plain_hand, starts.best, truth).mean()) < 0.003
    # Of the data that are looked at, a tenth is left unexplained.
    assert float(starts.costs[0]) < 800


@pytest.mark.parametrize("seed", [0, 1])
def test_data_made_with_the_seed_of_the_draw_are_drawn_like_others(links, links_skin, seed):
    """The numbers with which a face of a mesh was drawn for each point must not choose among the points."""
    points, drawn = torch.rand(3, 50_000, generator=generator(seed), dtype=D).T, []

    def source(problem, _):
        drawn.append(problem.origin[:, 0])
        return links.rest_pose().expand(1, 1, -1)

    config = tr.FindPoseConfig(num_searched=1, search_rounds=1, seed=seed)
    tr.find_pose(links, points, sources=[source], model_points=links_skin, config=config)
    # The origin is the mean of what is drawn.
    assert float(drawn[0]) == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("batched", [False, True])
def test_a_depth_frame_of_many_points_is_fitted_at_a_coarser_grid(links, links_skin, links_pose, picture_of, batched):
    camera, pose = tr.Camera(768, 576, (880.0, 880.0, 380.0, 284.0)), links_pose
    frame = picture_of(surface_skin(links), pose, camera, wall=0.0, max_points=100_000)
    assert len(frame.points) > 10_000
    found = tr.align(links, [frame] if batched else frame, pose + 0.01, model_points=links_skin, config=DESCENT)
    found = found if not batched else replace(found, **{name: getattr(found, name)[0] for name in FOUND})
    assert mean_off(links, found, pose) < 0.003
    torch.testing.assert_close(
        found.distances, links.distance(frame.points.double(), found.pose.double()), atol=1e-5, rtol=0
    )
    assert int(found.inliers.sum()) == len(found.inliers)
