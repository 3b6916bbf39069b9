"""The network that proposes poses: hands at any rotation, invariances, files, training that goes on."""

import pytest
import torch

from torchreg.alignment.pose_initializer import PoseInitializer, PoseInitializerConfig
from torchreg.alignment.pose_proposer import PoseProposer, ProposerSize
from torchreg.alignment.train_initializer import TrainInitializerConfig, train_initializer
from torchreg.datasets.cloud_batches import random_clouds, random_poses
from torchreg.errors import FormatError, InputError
from torchreg.shapes.hand import Hand
from torchreg.shapes.pose_algebra import shifted
from torchreg.shapes.skin import sample_skin

TINY = ProposerSize(tokens=16, neighbors=4, width=16, heads=2, encoder=1, decoder=1, hypotheses=2, waves=2)


@pytest.fixture(scope="module")
def clouds(plain_hand):
    generator = torch.Generator().manual_seed(4)
    poses = random_poses(plain_hand, 12, generator)
    return random_clouds(sample_skin(plain_hand, 1500), 0.26, poses, 400, generator)


def test_poses_are_within_limits_and_points_on_the_posed_surface(plain_hand, clouds):
    assert (clouds.poses >= plain_hand.lower - 1e-6).all()
    assert (clouds.poses <= plain_hand.upper + 1e-6).all()
    distance = plain_hand.distance(clouds.points, clouds.poses).abs()
    on = clouds.mask & (clouds.index >= 0)
    assert distance[on].median() < 0.003
    assert distance[clouds.mask & (clouds.index < 0)].median() > 0.02


def test_hands_at_any_rotation_are_found_without_a_search(plain_hand, plain_hand_skin, clouds):
    layer = PoseInitializer(plain_hand, model_points=plain_hand_skin)
    with torch.no_grad():
        found = layer(clouds.points, clouds.mask)
    error = (found.keypoints - plain_hand.keypoints(clouds.poses)).norm(dim=-1).mean(-1)
    assert (error < 0.02).double().mean() >= 0.8
    assert ((found.confidence >= 0) & (found.confidence <= 1)).all()


def test_a_cloud_gives_alone_what_it_gives_in_a_batch_and_moved(plain_hand, plain_hand_skin, clouds):
    net = PoseInitializer(plain_hand, model_points=plain_hand_skin).proposer
    offset = torch.tensor([0.5, -1.0, 2.0])
    together = net.propose(clouds.points, clouds.mask)
    alone = net.propose(clouds.points[3:4] + offset, clouds.mask[3:4])
    torch.testing.assert_close(alone.poses, shifted(together.poses[3:4], offset), atol=1e-3, rtol=0)
    torch.testing.assert_close(together.weights.sum(-1), torch.ones(12))


def test_training_goes_on_where_it_ended_and_files_are_for_their_shape(plain_hand, arm, tmp_path):
    path, rows = tmp_path / "hand.safetensors", []
    for steps in (2, 4):
        config = TrainInitializerConfig(steps=steps, batch=4, every=2)
        trained = train_initializer(Hand(), path, config, size=TINY, progress=rows.append)
    assert [row.step for row in rows] == [2, 4]
    again = PoseProposer.load(path, plain_hand)
    points, mask = torch.randn(2, 30, 3) / 20, torch.ones(2, 30, dtype=torch.bool)
    torch.testing.assert_close(again.propose(points, mask).poses, trained.propose(points, mask).poses)
    with pytest.raises(FormatError, match="other degrees of freedom"):
        PoseProposer.load(path, arm)
    with pytest.raises(InputError, match="needs a network"):
        PoseInitializer(arm, PoseInitializerConfig(search="never"))
