"""Degrees of freedom that are held, and what encoders read of others."""

import pytest
import torch

import torchreg as tr

TRUTH = torch.tensor([0.02, -0.01, 0.03, 0.1, -0.2, 0.15, 0.6, -0.4], dtype=torch.float64)
QUICK = tr.AlignConfig(search="never", num_model_points=200)


@pytest.fixture(scope="module")
def data(links_skin):
    return links_skin(TRUTH).detach()


@pytest.fixture(scope="module")
def fit(links, links_skin):
    """A function that aligns the links by one descent."""
    return lambda *given, **options: tr.align(
        links, *given, **({"model_points": links_skin, "config": QUICK} | options)
    )


def test_what_is_locked_stays_and_costs_nothing(fit, data):
    start = TRUTH.clone()
    start[6:] += 0.15
    found = fit(data, start, locked="base")
    torch.testing.assert_close(found.pose[:6], TRUTH[:6], rtol=0, atol=1e-12)
    torch.testing.assert_close(found.pose[6:], TRUTH[6:], rtol=0, atol=5e-3)
    # Held at a wrong value, a joint stays wrong, and the base makes up for it.
    wrong = fit(data, start, locked=["elbow"])
    assert float(wrong.pose[6]) == float(start[6])
    assert float((wrong.pose[:6] - TRUTH[:6]).abs().max()) > 1e-3
    torch.testing.assert_close(fit(data, start, locked=torch.arange(8) == 6).pose, wrong.pose)
    batch = fit(data.expand(2, -1, -1), torch.stack([start, TRUTH]), locked=["elbow"])
    torch.testing.assert_close(batch.pose[:, 6], torch.stack([start[6], TRUTH[6]]))


def test_a_search_around_the_start_moves_nothing_that_is_locked(fit, data):
    start = TRUTH.clone()
    start[7] = 1.5
    config = tr.AlignConfig(search="always", num_candidates=8, search_rounds=1)
    found = fit(data, start, locked=["base", "elbow"], config=config)
    torch.testing.assert_close(found.pose[:7], TRUTH[:7], rtol=0, atol=1e-12)
    assert float(found.pose[7]) == pytest.approx(-0.4, abs=0.02)


def test_find_pose_looks_for_what_is_not_known(links, links_skin, data):
    prior = ({"base_x": 0.02, "elbow": 0.6}, {"base_x": 1e-3, "elbow": 0.05})
    config = tr.FindPoseConfig(num_candidates=12, num_placed=4, num_searched=2, search_rounds=1)
    starts = tr.find_pose(links, data, model_points=links_skin, locked=["elbow"], prior=prior, config=config)
    torch.testing.assert_close(starts.poses[:, 6], torch.full_like(starts.poses[:, 6], 0.6))
    assert float((links.keypoints(starts.best) - links.keypoints(TRUTH)).norm(dim=-1).max()) < 0.02


def test_data_outweigh_a_prior_where_they_tell_and_the_prior_holds_the_rest(fit, links_skin, data):
    """Without data on the last link, its joint stays at what was read; the covariance says as much."""
    kept = data[links_skin.weights.argmax(-1) < 2]
    start = TRUTH + torch.tensor([0.0] * 6 + [0.1, 0.2], dtype=torch.float64)
    elbow, wrist = start[6:].tolist()
    # One deviation, one for each degree of freedom, names, and a row for each cloud of a batch mean the same.
    each = torch.tensor([torch.inf] * 6 + [0.2, 0.2])
    for prior in ((start, 0.2), ({"elbow": elbow, "wrist": wrist}, 0.2), (start, each)):
        found = fit(kept, start, locked="base", prior=prior)
        assert float(found.pose[6]) == pytest.approx(0.6, abs=0.02)
        assert float(found.pose[7]) == pytest.approx(wrist, abs=0.1)
        std = found.covariance.diagonal().sqrt()
        assert float(std[6]) < 0.05
        assert float(std[7]) == pytest.approx(0.2, rel=0.3)
    rows = fit(kept.expand(2, -1, -1), start.expand(2, -1), locked="base", prior=(start.expand(2, -1), 0.2))
    torch.testing.assert_close(rows.pose, found.pose.expand(2, -1), rtol=0, atol=1e-3)
    # Without a start, a held base lies where it was read, or at rest.
    for std, base in ((0.2, 0 * TRUTH[:6]), (torch.full((8,), 0.2), TRUTH[:6])):
        torch.testing.assert_close(fit(kept, locked="base", prior=(start, std)).pose[:6], base, rtol=0, atol=1e-9)
    exact = fit(kept, start, locked="base", prior=(start, 1e-4))
    torch.testing.assert_close(exact.pose, start, rtol=0, atol=1e-3)
