"""Neighbors by position and normal: against a table of all distances, scales of zero, what is refused."""

import pytest
import torch

from torchreg.errors import InputError
from torchreg.registration.bones.oriented_tree import OrientedTree


def oriented(count, seed):
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(count, 3, generator=generator)
    return points, torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)


@pytest.mark.parametrize("scale", [0.0, 0.5, 3.0])
def test_the_nearest_has_the_least_mixed_distance(scale):
    places, sides = oriented(200, 0)
    points, normals = oriented(50, 1)
    mixed = torch.cdist(points, places).square() + scale**2 * torch.cdist(normals, sides).square()
    assert OrientedTree(places, sides, scale).nearest(points, normals).tolist() == mixed.argmin(-1).tolist()


def test_what_does_not_fit_is_refused():
    places, sides = oriented(10, 0)
    tree = OrientedTree(places, sides, 1.0)
    with pytest.raises(InputError, match="normals"):
        OrientedTree(places, sides[1:], 1.0)
    with pytest.raises(InputError, match="scale"):
        OrientedTree(places, sides, -1.0)
    with pytest.raises(InputError, match="finite"):
        tree.nearest(places * torch.nan, sides)
    with pytest.raises(InputError, match="normals"):
        tree.nearest(places, sides[1:])
