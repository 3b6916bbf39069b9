"""Motion between key poses: it is the one that a glTF viewer plays, limbs keep their length."""

import pytest
import torch

from torchreg.viz.key_poses import between_poses


@pytest.fixture(scope="module")
def keys(bar_model):
    model, points, _ = bar_model(4)
    own = model.transforms.detach()
    rest = torch.eye(4, dtype=own.dtype).expand_as(own)
    return model, points, torch.stack([rest, own, own @ own])


def test_key_poses_are_met(keys):
    model, _, poses = keys
    found = between_poses(model, poses, torch.tensor([0.0, 1.0, 2.0]))
    torch.testing.assert_close(found, poses, atol=1e-9, rtol=0)
    torch.testing.assert_close(between_poses(model, poses[:1], torch.zeros(2)), poses[[0, 0]], atol=1e-9, rtol=0)


def test_limbs_swing_and_keep_their_length(keys):
    model, _, poses = keys
    tree = model.skeleton(poses)
    halves = between_poses(model, poses, torch.tensor([0.5, 1.25]), tree=tree)
    rotation = halves[..., :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).to(rotation).expand_as(rotation))
    # Bones that meet at a joint in the key poses meet there in between.
    for bone, parent in enumerate(tree.parents):
        if parent >= 0:
            joint = torch.cat([tree.origins[bone], torch.ones(1)]).to(halves)
            gap = (halves[:, bone] @ joint - halves[:, parent] @ joint).norm(dim=-1)
            ends = (poses[:, bone] @ joint - poses[:, parent] @ joint).norm(dim=-1)
            assert float(gap.max()) <= float(ends.max()) + 1e-9
    # Halfway between rest and a turn of 0.35 about z per joint is half of that turn.
    relative = rotation[0, 0].mT @ rotation[0, 1]
    assert float(torch.atan2(relative[1, 0], relative[0, 0]).abs()) == pytest.approx(0.175, abs=1e-6)
