"""Poses by name of degree of freedom, there and back, singly and in batches."""

import pytest
import torch

from torchreg.errors import InputError
from torchreg.shapes.hand import Hand


def test_names_and_numbers_go_back_and_forth(plain_hand):
    poses = torch.randn(2, 3, 27, generator=torch.Generator().manual_seed(0))
    named = plain_hand.pose_to_dict(poses)
    assert named["thumb_ip_flexion"].shape == (2, 3)
    assert torch.equal(plain_hand.pose_from_dict(named), poses)
    single = plain_hand.pose_to_dict(poses[0, 0])
    assert all(type(value) is float for value in single.values())
    assert torch.equal(plain_hand.pose_from_dict(single), poses[0, 0])


def test_what_is_not_named_stays_at_rest_and_gradients_flow(plain_hand):
    angle = torch.tensor(0.3, requires_grad=True)
    pose = plain_hand.pose_from_dict({"index_pip_flexion": angle, "base_z": 0.5})
    column = plain_hand.dof_names.index("index_pip_flexion")
    assert pose[[2, column]].tolist() == pytest.approx([0.5, 0.3])
    assert int((pose != plain_hand.rest_pose()).sum()) == 2
    pose.sum().backward()
    assert float(angle.grad) == 1.0


def test_unknown_names_are_answered_with_the_nearest(plain_hand):
    with pytest.raises(InputError, match="no degree of freedom 'index_pip_flex'; did you mean 'index_pip_flexion'"):
        plain_hand.pose_from_dict({"index_pip_flex": 0.1})
    with pytest.raises(InputError, match="no degree of freedom 'q'; known: base_x"):
        plain_hand.pose_from_dict({"q": 0.1})


def test_poses_keep_their_precision():
    far = torch.zeros(27, dtype=torch.float64)
    far[0] = 431_234.5678
    assert Hand().pose_to_dict(far)["base_x"] == 431_234.5678


def test_a_shape_prints_in_three_lines(plain_hand):
    lines = repr(plain_hand).splitlines()
    assert len(lines) == 3
    assert lines[0] == "Hand: 16 parts, 27 degrees of freedom"
    assert lines[1].startswith("  6 of the base, 21 of joints: thumb_cmc_abduction, ")
    assert lines[2].endswith("across at rest, float32 on cpu")
