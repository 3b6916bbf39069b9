"""Degrees of freedom that are held, and what encoders read of others."""

import math

import pytest
import torch

import torchreg as tr
from torchreg.alignment.known_dofs import KnownDofs

TRUTH = torch.tensor([0.02, -0.01, 0.03, 0.1, -0.2, 0.15, 0.6, -0.4], dtype=torch.float64)
QUICK = tr.AlignConfig(search="never", num_model_points=200)


@pytest.fixture(scope="module")
def data(links, links_skin):
    return links_skin(TRUTH).detach()


def test_what_is_locked_stays_and_costs_nothing(links, links_skin, data):
    start = TRUTH.clone()
    start[6:] += 0.15
    found = tr.align(links, data, start, model_points=links_skin, locked="base", config=QUICK)
    torch.testing.assert_close(found.pose[:6], TRUTH[:6], rtol=0, atol=1e-12)
    torch.testing.assert_close(found.pose[6:], TRUTH[6:], rtol=0, atol=5e-3)
    # Held at a wrong value, a joint stays wrong, and the base makes up for it.
    wrong = tr.align(links, data, start, model_points=links_skin, locked=["elbow"], config=QUICK)
    assert float(wrong.pose[6]) == float(start[6])
    assert float((wrong.pose[:6] - TRUTH[:6]).abs().max()) > 1e-3
    mask = torch.arange(8) == 6
    same = tr.align(links, data, start, model_points=links_skin, locked=mask, config=QUICK)
    torch.testing.assert_close(same.pose, wrong.pose)
    batch = tr.align(links, data.expand(2, -1, -1), torch.stack([start, TRUTH]), locked=["elbow"], config=QUICK)
    torch.testing.assert_close(batch.pose[:, 6], torch.stack([start[6], TRUTH[6]]))


def test_a_search_around_the_start_moves_nothing_that_is_locked(links, links_skin, data):
    start = TRUTH.clone()
    start[7] = 1.5
    config = tr.AlignConfig(search="always", num_candidates=8, search_rounds=1, num_model_points=200)
    found = tr.align(links, data, start, model_points=links_skin, locked=["base", "elbow"], config=config)
    torch.testing.assert_close(found.pose[:7], TRUTH[:7], rtol=0, atol=1e-12)
    assert float(found.pose[7]) == pytest.approx(-0.4, abs=0.02)


def test_find_pose_looks_for_what_is_not_known(links, links_skin, data):
    prior = ({"base_x": 0.02, "elbow": 0.6}, {"base_x": 1e-3, "elbow": 0.05})
    config = tr.FindPoseConfig(num_candidates=12, num_placed=4, num_searched=2, search_rounds=1)
    starts = tr.find_pose(links, data, model_points=links_skin, locked=["elbow"], prior=prior, config=config)
    torch.testing.assert_close(starts.poses[:, 6], torch.full_like(starts.poses[:, 6], 0.6))
    assert float((links.keypoints(starts.best) - links.keypoints(TRUTH)).norm(dim=-1).max()) < 0.02


def test_data_outweigh_a_prior_where_they_tell_and_the_prior_holds_the_rest(links, links_skin, data):
    """Without data on the last link, its joint stays at what was read; the covariance says as much."""
    kept = data[links_skin.weights.argmax(-1) < 2]
    read = TRUTH[6:] + torch.tensor([0.1, 0.2], dtype=torch.float64)
    prior = ({"elbow": float(read[0]), "wrist": float(read[1])}, 0.2)
    start = torch.cat([TRUTH[:6], read])
    found = tr.align(links, kept, start, locked="base", prior=prior, config=QUICK)
    assert float(found.pose[6]) == pytest.approx(0.6, abs=0.02)
    assert float(found.pose[7]) == pytest.approx(float(read[1]), abs=0.1)
    std = found.covariance.diagonal().sqrt()
    assert float(std[6]) < 0.05
    assert float(std[7]) == pytest.approx(0.2, rel=0.3)
    # Without a start, a held base and what was read are one.
    placed = tr.align(links, kept, locked="base", prior=(start, 0.2), config=QUICK)
    assert float(placed.pose[:6].abs().max()) == 0
    exact = tr.align(links, kept, start, locked="base", prior=(start, 1e-4), config=QUICK)
    torch.testing.assert_close(exact.pose, start, rtol=0, atol=1e-3)


def test_a_prior_is_given_in_many_forms(links):
    mean = TRUTH.clone()
    whole = KnownDofs.of(links, (), (mean, 0.1))
    assert whole.std.tolist() == [math.inf] * 6 + [0.1] * 2
    assert not whole.places_base
    named = KnownDofs.of(links, ["base"], ({"wrist": 0.3}, 0.1))
    assert named.std.tolist() == [math.inf] * 7 + [0.1]
    assert named.places_base
    rows = KnownDofs.of(links, (), (mean.expand(3, -1), torch.full((8,), 0.2)))
    assert rows.std.shape == (3, 8)
    assert rows.places_base
    assert KnownDofs.of(links, (), None) is None
    moved = rows.near(torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(moved.mean[0, 0], TRUTH[0] - 1)
