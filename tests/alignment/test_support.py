"""A table under what a cloud shows is left out, unless that is wanted or the shape has a flat foot."""

import pytest
import torch

import torchreg as tr
from torchreg.errors import FileWarning, InputError


def table(width, count=900):
    """Points of a table z = -.1."""
    side = torch.rand(count, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64) - 0.5
    return torch.cat([width * side, torch.full((count, 1), -0.1, dtype=torch.float64)], dim=-1)


@pytest.fixture(scope="module")
def case():
    """A hand, its pose, and a cloud of it on a table."""
    hand = tr.Hand(dtype=torch.float64)
    pose = hand.rest_pose()
    points = tr.sample_skin(hand, 600)(pose).detach()
    return hand, pose, torch.cat([points, table(0.6)])


@pytest.mark.parametrize("support", ["auto", "keep"])
def test_the_table_under_a_hand_is_left_out_with_a_sentence(case, support, recwarn):
    hand, pose, data = case
    found = tr.align(hand, data, pose, support=support)
    sentences = [str(warning.message) for warning in recwarn if warning.category is FileWarning]
    assert [text[:25] for text in sentences] == (["900 of 1500 points of data"[:25]] if support == "auto" else [])
    assert bool(found.distances.isnan()[600:].all()) == (support == "auto")
    assert not bool(found.distances.isnan()[:600].any())
    if support == "auto":
        assert found.inliers[:600].double().mean() > 0.99
        assert (hand.keypoints(found.pose) - hand.keypoints(pose)).norm(dim=-1).max() < 3e-3


def test_only_the_clouds_of_a_batch_that_show_a_table_lose_it(case):
    hand, pose, data = case
    pair = torch.stack([data, torch.cat([data[:600], data[:600], data[:300]])])
    with pytest.warns(FileWarning, match="900 of 3000 points"):
        found = tr.align(hand, pair, pose.expand(2, -1))
    assert found.distances.isnan().sum(-1).tolist() == [900, 0]


def test_a_foot_of_the_shape_itself_is_kept(tmp_path):
    file = tmp_path / "lamp.urdf"
    file.write_text(
        "<robot name='lamp'><link name='foot'><visual><geometry><box size='.4 .4 .0002'/></geometry></visual></link>"
        "<link name='rod'><visual><origin xyz='0 0 .15'/><geometry><cylinder radius='.02' length='.3'/></geometry>"
        "</visual></link><joint name='tilt' type='revolute'><parent link='foot'/><child link='rod'/>"
        "<axis xyz='1 0 0'/><limit lower='-1' upper='1' effort='1' velocity='1'/></joint></robot>"
    )
    lamp = tr.ArticulatedShape.from_urdf(file)
    data = tr.sample_skin(lamp, 1500)(lamp.rest_pose()).detach()
    assert tr.split_support(data).plane is not None
    found = tr.align(lamp, data, lamp.rest_pose())
    assert not bool(found.distances.isnan().any())


def test_another_word_is_refused(case):
    hand, pose, data = case
    with pytest.raises(InputError, match="support"):
        tr.align(hand, data, pose, support="leave")
