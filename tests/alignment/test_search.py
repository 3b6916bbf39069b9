"""When an alignment searches around its start, and what it finds there."""

import pytest
import torch

import torchreg as tr
from tests.alignment.made import TIPS, generator, off
from torchreg.geometry.rotation import so3_exp, so3_log

CONFIG = tr.AlignConfig(num_candidates=8, search_rounds=1)


@pytest.fixture(scope="module")
def searched(plain_hand, plain_hand_skin, fit):
    """Hands aligned in one batch, the truths, and the numbers of those that were searched around their starts.

    A near start; the same amid thin clutter; with padding where fingers might be; a base that is turned; joints that
    are all far off; a finger folded flat that a descent does not find; the same with many data.
    """
    truth = plain_hand.rest_pose()
    truth[6:] = 0.5 * torch.rand(21, generator=generator(4)) * plain_hand.upper[6:].clamp_min(0)
    truth[3:6] = torch.tensor([0.3, -0.4, 0.2])
    starts = truth.repeat(7, 1)
    starts[:3, 6:] += 0.03
    starts[3, 3] += 0.5
    starts[4, 6:] += 0.5
    little = [number for number, name in enumerate(plain_hand.dof_names) if name.startswith("little")]
    starts[5:, little[1:]] += torch.tensor([0.9, 0.9, 0.5])
    starts = plain_hand.clamp(starts)
    points, clutter = plain_hand_skin(truth), 0.4 * torch.rand(400, 3, generator=generator()) - 0.2
    many = points.repeat(7, 1) + 5e-4 * torch.randn(2800, 3, generator=generator(1))
    data, mask = torch.zeros(7, 2800, 3), torch.zeros(7, 2800, dtype=torch.bool)
    data[:, :400], mask[:, :400] = points, True
    data[1, 400:800], mask[1, 400:800] = clutter + points.mean(0), True
    data[2, 400:800] = points + 0.02
    data[6], mask[6] = many, True
    apart = torch.arange(7.0)
    data[..., 0] += apart.unsqueeze(-1)
    starts[:, 0] += apart
    truths = truth.repeat(7, 1)
    truths[:, 0] += apart
    result = fit(data, starts, mask=mask, config=CONFIG)
    return result, truths, {round(float(place)) for place in torch.cat(poses_searched(result))[:, 0]}


def poses_searched(result):
    """Return the poses of each last fit after a search, which has two widths."""
    return [record.pose for record in result.history if (record.stage, record.num_steps) == ("surface", 2)]


def test_a_descent_that_went_far_or_leaves_a_finger_off_the_surface_is_not_trusted(searched):
    assert searched[2] == {3, 4, 5, 6}


def test_what_was_lost_is_found(plain_hand, searched):
    result, truths, _ = searched
    errors = off(plain_hand, result.pose, truths)[:, TIPS].amax(-1)
    assert errors.tolist() == pytest.approx([0] * 7, abs=0.005)
    assert bool(((result.pose >= plain_hand.lower) & (result.pose <= plain_hand.upper)).all())
    assert all(status.usable for status in result.statuses)


def test_clusters_of_data_without_a_finger_are_searched_though_nothing_moved(plain_hand, plain_hand_skin, fit):
    """A finger that is held away from its data."""
    truth = plain_hand.rest_pose()
    start, points = truth.clone(), plain_hand_skin(truth)
    little = [name for name in plain_hand.dof_names if name.startswith("little")]
    start[[plain_hand.dof_names.index(name) for name in little[1:]]] = torch.tensor([1.2, 1.2, 0.8])
    config = tr.AlignConfig(num_candidates=2, search_rounds=1)
    assert poses_searched(fit(points, start, locked=little, config=config))
    assert not poses_searched(fit(points, truth, locked=little, config=config))


def test_a_start_that_is_turned_far_is_searched_for_everywhere(links, links_skin, links_pose):
    """There a second EM begins, with wide kernels again, however well the first one ends."""
    data, starts = links_skin(links_pose), []
    for turn in (0.3, 1.2):
        start = links_pose.clone()
        start[3:6] = so3_log(so3_exp(torch.tensor([[turn, 0, 0]], dtype=torch.float64)) @ so3_exp(start[None, 3:6]))[0]
        starts.append(start)
    for start, is_far in zip(starts, (False, True), strict=True):
        descended = tr.align(links, data, start, model_points=links_skin, config=tr.AlignConfig(search="never"))
        found = tr.align(links, data, start, model_points=links_skin)
        assert float(descended.confidence) > 0.5
        widths = torch.stack([record.sigma[0] for record in found.history if record.stage == "em"])
        assert bool((widths.diff() > 0).any()) is is_far
        assert float(found.confidence) >= float(descended.confidence)
    both = tr.align(links, data.expand(2, -1, -1), torch.stack(starts), model_points=links_skin)
    assert torch.allclose(both.registered, data.expand(2, -1, -1), atol=2e-3)
