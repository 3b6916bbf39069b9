"""The network that proposes poses: hands at any rotation, invariances, files, training that goes on."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from tests.alignment.made import off
from torchreg.alignment import train_initializer as train_module
from torchreg.alignment.search.pose_proposer import HAND_WEIGHTS
from torchreg.datasets.cloud_batches import random_clouds, random_poses

TINY = tr.ProposerSize(tokens=16, neighbors=4, width=16, heads=2, encoder=1, decoder=1, hypotheses=2, waves=2)


@pytest.fixture(scope="module")
def clouds(plain_hand):
    generator = torch.Generator().manual_seed(4)
    poses = random_poses(plain_hand, 12, generator)
    return random_clouds(tr.sample_skin(plain_hand, 1500), 0.26, poses, 400, generator)


def test_hands_at_any_rotation_are_found_without_a_search(plain_hand, plain_hand_skin, clouds):
    layer = tr.PoseInitializer(plain_hand, tr.PoseInitializerConfig(search="never"), model_points=plain_hand_skin)
    with torch.no_grad():
        found = layer(clouds.points, clouds.mask)
    error = off(plain_hand, found.pose, clouds.poses).mean(-1)
    assert (error < 0.02).double().mean() >= 0.8
    assert ((found.confidence >= 0) & (found.confidence <= 1)).all()


def test_a_left_hand_and_one_as_large_as_a_house_are_found_by_the_same_network(plain_hand, clouds):
    right, left = tr.PoseInitializer(plain_hand).proposer, tr.PoseInitializer(tr.Hand(side="left")).proposer
    flip = torch.tensor([-1.0, 1.0, 1.0])
    found, seen = right.propose(clouds.points, clouds.mask), left.propose(clouds.points * flip, clouds.mask)
    posed = tr.Hand(side="left").keypoints(seen.poses[:, 0])
    torch.testing.assert_close(posed, plain_hand.keypoints(found.poses[:, 0]) * flip, atol=1e-4, rtol=0)
    torch.testing.assert_close(seen.surface, found.surface * flip, atol=1e-4, rtol=0)
    large = tr.PoseInitializer(tr.Hand(scale=50.0)).proposer.propose(50 * clouds.points, clouds.mask)
    torch.testing.assert_close(large.poses[..., 6:], found.poses[..., 6:], atol=1e-3, rtol=0)
    torch.testing.assert_close(large.poses[..., :3], 50 * found.poses[..., :3], atol=1e-2, rtol=0)
    with pytest.raises(tr.errors.FormatError, match="another shape"):
        tr.PoseProposer.load(HAND_WEIGHTS, tr.Hand(side="left"))


def test_only_what_is_doubtful_is_searched_for(plain_hand, plain_hand_skin, clouds, monkeypatch):
    searched = []

    def find(shape, data, **options):
        searched.append(len(data))
        return tr.find_pose(shape, data, **options)

    monkeypatch.setattr("torchreg.alignment.pose_initializer.find_pose", find)
    quick = tr.FindPoseConfig(num_candidates=4, num_placed=2, num_searched=1, search_rounds=1)
    poses = [tr.PoseInitializer(plain_hand, tr.PoseInitializerConfig(search=search, find_pose=quick),
                             model_points=plain_hand_skin) for search in ("never", "doubtful")]  # fmt: skip
    with torch.no_grad():
        never = poses[0](clouds.points, clouds.mask)
        assert not searched
        sure = never.confidence.argmax()
        poses[1](clouds.points[sure : sure + 1], clouds.mask[sure : sure + 1])
        assert len(searched) == int(never.confidence[sure] < 0.5)
        least = never.confidence.argmin()
        found = poses[1](clouds.points[least : least + 1], clouds.mask[least : least + 1])
    assert searched
    assert found.confidence[0] >= never.confidence[least] - 1e-6


def test_a_cloud_gives_alone_what_it_gives_in_a_batch_and_moved(plain_hand, plain_hand_skin, clouds):
    net = tr.PoseInitializer(plain_hand, model_points=plain_hand_skin).proposer
    offset = torch.tensor([0.5, -1.0, 2.0])
    together = net.propose(clouds.points, clouds.mask)
    alone = net.propose(clouds.points[3:4] + offset, clouds.mask[3:4])
    moved = together.poses[3:4] + torch.nn.functional.pad(offset, (0, 24))
    torch.testing.assert_close(alone.poses, moved, atol=1e-3, rtol=0)
    torch.testing.assert_close(together.weights.sum(-1), torch.ones(12))


def test_where_the_network_is_sure_nothing_is_searched(plain_hand, plain_hand_skin, clouds, monkeypatch):
    searched = []
    monkeypatch.setattr("torchreg.alignment.find_pose._search", lambda *given: searched.append(given))
    row = int(clouds.mask.sum(-1).argmax())
    points = clouds.points[row, clouds.mask[row]]
    found = tr.find_pose(plain_hand, points, model_points=plain_hand_skin)
    assert not searched
    assert float(off(plain_hand, found.best, clouds.poses[row]).mean()) < 0.015
    layer = tr.PoseInitializer(plain_hand, model_points=plain_hand_skin)
    for network in (layer, layer.proposer):
        again = tr.find_pose(plain_hand, points, initializer=network, model_points=plain_hand_skin)
        torch.testing.assert_close(again.poses, found.poses)


def test_what_a_poor_network_proposes_does_not_spoil_a_search(plain_hand, plain_hand_skin, clouds):
    row = int(clouds.mask.sum(-1).argmax())
    points = clouds.points[row, clouds.mask[row]]
    quick = tr.FindPoseConfig(num_candidates=16, num_placed=5, num_searched=2, search_rounds=1)
    untrained = tr.PoseProposer(plain_hand, TINY).eval()
    found = tr.find_pose(plain_hand, points, initializer=untrained, model_points=plain_hand_skin, config=quick)
    assert float(off(plain_hand, found.best, clouds.poses[row]).mean()) < 0.02
    assert (found.costs[0] <= found.costs).all()


def test_a_network_of_another_shape_is_refused(plain_hand, arm, clouds):
    network = tr.PoseProposer(arm, TINY)
    with pytest.raises(tr.errors.InputError, match="must be a network for this shape's 27 degrees of freedom"):
        tr.find_pose(plain_hand, clouds.points[0], initializer=network)
    with pytest.raises(tr.errors.InputTypeError, match=r"must be a PoseProposer, or a PoseInitializer .* NoneType"):
        tr.find_pose(arm, clouds.points[0], initializer=tr.PoseInitializer(arm))


def test_training_goes_on_where_it_ended_and_files_are_for_their_shape(plain_hand, arm, tmp_path, monkeypatch):
    small = replace(train_module._TRAINING, surface_points=200, validation=8)
    monkeypatch.setattr(train_module, "_TRAINING", small)
    path, rows, hand = tmp_path / "hand.safetensors", [], tr.Hand().requires_grad_(True)
    for steps in (2, 4):
        config = tr.TrainInitializerConfig(steps=steps, batch=4, every=2)
        trained = tr.train_initializer(hand, path, config, size=TINY, progress=rows.append)
    assert [row.step for row in rows] == [2, 4]
    assert all(parameter.requires_grad for parameter in hand.parameters())
    state = torch.get_rng_state()
    again = tr.PoseProposer.load(path, plain_hand)
    assert torch.equal(torch.get_rng_state(), state)
    points, mask = torch.randn(2, 30, 3) / 20, torch.ones(2, 30, dtype=torch.bool)
    torch.testing.assert_close(again.propose(points, mask).poses, trained.propose(points, mask).poses)
    points = points.to(plain_hand.rest)
    loaded = tr.PoseInitializer.load(path, plain_hand, tr.PoseInitializerConfig(search="never"))
    assert not loaded.proposer.training
    torch.testing.assert_close(loaded.proposer.propose(points, mask).poses, again.propose(points, mask).poses)
    with pytest.raises(tr.errors.FormatError, match="another shape"):
        tr.PoseInitializer.load(path, arm)
    with pytest.raises(tr.errors.FormatError, match="of another shape or network"):
        tr.train_initializer(tr.Hand(), path, tr.TrainInitializerConfig(steps=5, batch=4))
    with pytest.raises(tr.errors.InputError, match="needs a network"):
        tr.PoseInitializer(arm, tr.PoseInitializerConfig(search="never"))


def test_an_exported_network_takes_any_number_of_clouds(plain_hand):
    net = tr.PoseProposer(plain_hand, TINY, shape_size=0.26).eval()
    points, mask = torch.randn(3, 32, 3) / 20, torch.ones(3, 32, dtype=torch.bool)
    mask[1, 20:] = False
    batch = {0: torch.export.Dim("batch", min=2)}
    program = torch.export.export(net, (points, mask), dynamic_shapes={"points": batch, "mask": batch})
    many, shown = points.repeat(2, 1, 1).flip(0), mask.repeat(2, 1).flip(0)
    torch.testing.assert_close(tuple(program.module()(many, shown)), tuple(net(many, shown)))
