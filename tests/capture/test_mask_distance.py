import pytest
import torch

from torchreg.capture.mask_distance import signed_mask_distance
from torchreg.errors import InputError, InputTypeError


def test_distance_to_a_disk_and_its_sign():
    row, column = torch.meshgrid(torch.arange(40.0), torch.arange(50.0), indexing="ij")
    radius = torch.hypot(row - 20, column - 25)
    distance = signed_mask_distance(radius <= 10.3)
    assert (distance - (radius - 10.3)).abs().max() < 1.0
    assert ((distance < 0) == (radius <= 10.3)).all()
    assert torch.equal(signed_mask_distance(radius > 10.3), -distance)


def test_a_straight_edge_is_exact():
    mask = torch.zeros(3, 6, dtype=torch.bool)
    mask[:, 3:] = True
    assert signed_mask_distance(mask)[1].tolist() == [2.5, 1.5, 0.5, -0.5, -1.5, -2.5]


def test_masks_without_outline_and_what_is_no_mask():
    full = torch.ones(3, 4, dtype=torch.bool)
    assert (signed_mask_distance(full) == -2.5).all()
    assert (signed_mask_distance(~full) == 2.5).all()
    with pytest.raises(InputTypeError, match="Boolean"):
        signed_mask_distance(full.float())
    with pytest.raises(InputError, match="shape"):
        signed_mask_distance(full[None])
    with pytest.raises(InputError, match="must have pixels"):
        signed_mask_distance(full[:0])
