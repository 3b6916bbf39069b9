"""Distance transforms against the distances between all pairs of cells."""

import pytest
import torch

from torchreg.geometry.distance_transform import nearest_inside, signed_distance


def random_mask(shape, seed, share=0.3):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed)) < share


def middles(mask):
    return torch.ones_like(mask).nonzero().double()


@pytest.mark.parametrize("shape", [(9,), (7, 8), (4, 5, 6)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_distances_are_those_to_the_nearest_cell_of_the_other_kind(shape, dtype):
    mask = random_mask(shape, len(shape))
    flat = mask.flatten()
    apart = torch.cdist(middles(mask), middles(mask)).masked_fill(flat[:, None] == flat, torch.inf).amin(1) - 0.5
    found = signed_distance(mask, dtype)
    assert found.dtype == dtype
    torch.testing.assert_close(found.flatten(), torch.where(flat, -apart, apart).to(dtype))


def test_without_a_border_it_is_infinitely_far():
    assert signed_distance(torch.ones(2, 3, dtype=torch.bool)).tolist() == [[-torch.inf] * 3] * 2
    assert signed_distance(torch.zeros(2, 1, dtype=torch.bool)).tolist() == [[torch.inf]] * 2


@pytest.mark.parametrize("shape", [(9,), (7, 8), (4, 5, 6), (1, 1, 3)])
def test_the_nearest_cell_is_inside_and_none_is_nearer(shape):
    mask = random_mask(shape, 3)
    mask[(0,) * len(shape)] = True
    number = nearest_inside(mask)
    assert number.shape == mask.shape
    assert bool(mask.flatten()[number].all())
    inside = number[mask]
    assert torch.equal(inside, mask.flatten().nonzero()[:, 0])
    places = middles(mask)
    apart = (places - places[number.flatten()]).norm(dim=-1)
    torch.testing.assert_close(apart, torch.cdist(places, places[mask.flatten()]).amin(1))
