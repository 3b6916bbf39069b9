"""The network that tells a hand's data from what it holds: on rooms, invariances, files."""

import pytest
import torch

import torchreg as tr
from experiments.hand_data.__main__ import begun_as, windows_of_room
from torchreg.alignment.search.pose_proposer import HAND_WEIGHTS, shipped_proposer
from torchreg.alignment.search.segmenter import HAND_DATA_WEIGHTS, Segmenter, shipped_segmenter
from torchreg.errors import FormatError

SIZE = 0.258  # of the built-in hand, metres


def told_of(net, shape, points, size=SIZE):
    return net.log_odds(shape, points[None], torch.ones(1, len(points), dtype=torch.bool), size)[0]


@pytest.fixture(scope="module")
def window():
    """A window of a room with a held thing, on a seed that nothing was fitted to, and which points show the hand."""
    return windows_of_room(7004, SIZE, torch.Generator().manual_seed(0))[0]


def test_a_hand_is_told_from_what_it_holds_and_its_forearm(plain_hand, window):
    points, shown = window
    told = told_of(shipped_segmenter(plain_hand), plain_hand, points) > 0
    assert told[shown].double().mean() > 0.85
    assert told[~shown].double().mean() < 0.3


def test_a_left_hand_is_told_as_a_right_one_and_a_large_one_as_a_small_one(plain_hand, window):
    points, net = window[0], shipped_segmenter(plain_hand)
    told, left = told_of(net, plain_hand, points), tr.Hand(side="left")
    mirrored = told_of(net, left, points * torch.tensor([-1.0, 1.0, 1.0]))
    torch.testing.assert_close(mirrored, told, atol=1e-4, rtol=0)
    torch.testing.assert_close(told_of(net, plain_hand, 50 * points, 50 * SIZE), told, atol=1e-2, rtol=0)


def test_tokens_have_their_own_log_odds(plain_hand, window):
    points, net = window[0] / SIZE, shipped_segmenter(plain_hand)
    cloud, mask = net.fitting(points[None], torch.ones(1, len(points), dtype=torch.bool))
    told, index = net(cloud, mask)
    between = told_of(net, plain_hand, cloud[0] * SIZE)
    torch.testing.assert_close(between[index[0]], told[0], atol=1e-3, rtol=0)


def test_a_batch_is_told_as_a_loop_and_padding_changes_nothing(plain_hand, window):
    points, net = window[0], shipped_segmenter(plain_hand)
    batch, mask = torch.zeros(2, len(points), 3), torch.zeros(2, len(points), dtype=torch.bool)
    short = len(points) // 2
    batch[0], mask[0], batch[1, :short], mask[1, :short] = points, True, points[:short], True
    told = net.log_odds(plain_hand, batch, mask, SIZE)
    torch.testing.assert_close(told[0], told_of(net, plain_hand, points), atol=1e-4, rtol=0)
    alone = net.log_odds(plain_hand, batch[1:], mask[1:], SIZE)
    torch.testing.assert_close(told[1, :short], alone[0, :short], atol=1e-4, rtol=0)


def test_only_the_built_in_hand_has_one_and_it_is_read_once(plain_hand, arm):
    assert shipped_segmenter(plain_hand) is shipped_segmenter(tr.Hand(side="left"))
    assert shipped_segmenter(arm) is None


def test_files_come_back_and_others_are_refused(plain_hand, window, tmp_path):
    net = shipped_segmenter(plain_hand)
    net.save(tmp_path / "again.safetensors", {"steps": 3})
    again = Segmenter.load(tmp_path / "again.safetensors")
    told = (told_of(each, plain_hand, window[0]) for each in (net, again))
    torch.testing.assert_close(*told, atol=0, rtol=0)
    with pytest.raises(FormatError, match="holds no Segmenter"):
        Segmenter.load(HAND_WEIGHTS)
    with pytest.raises(FormatError, match="holds no PoseProposer"):
        tr.PoseProposer.load(HAND_DATA_WEIGHTS, plain_hand)


def test_a_training_begins_with_what_the_network_of_poses_takes_for_an_outlier(plain_hand, window):
    proposer, cloud = shipped_proposer(plain_hand), window[0][None]
    net, mask = begun_as(proposer), torch.ones(cloud.shape[:2], dtype=torch.bool)
    cloud, mask = proposer.fitting(cloud, mask)
    expected = -proposer(cloud, mask).surface[..., 3]
    torch.testing.assert_close(net(cloud / proposer.shape_size, mask)[0], expected, atol=1e-4, rtol=0)
