import pytest
import torch

from torchreg.errors import InputError, InputTypeError
from torchreg.registration.dense.oriented_samples import OrientedSamples, scaled_together


def samples(count=6, dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)
    points, normals = (torch.randn(count, 3, generator=generator, dtype=dtype) for _ in range(2))
    features = torch.randn(count, 4, generator=generator, dtype=dtype)
    return OrientedSamples(points, torch.nn.functional.normalize(normals, dim=-1), features, torch.arange(count) > 2)


def test_first_and_moved_keep_the_rest():
    all_, few = samples(), samples().first(4)
    assert len(few) == 4
    torch.testing.assert_close(few.features, all_.features[:4])
    assert few.boundary.tolist() == [False, False, False, True]
    moved = few.moved(few.points + 1, -few.normals)
    torch.testing.assert_close(moved.points, all_.points[:4] + 1)
    assert moved.features is few.features


def test_embedded_distances_are_sums():
    both = samples()
    rows = both.embedded(0.5, 0.2)
    squares = torch.cdist(both.points, both.points).square() + 0.04 * torch.cdist(both.features, both.features).square()
    squares = squares + 0.25 * 2 * (1 - both.normals @ both.normals.mT)
    torch.testing.assert_close(torch.cdist(rows, rows).square(), squares)


def test_scaled_features_of_random_pairs_are_two_apart():
    generator = torch.Generator().manual_seed(0)
    one = torch.randn(400, 5, generator=generator, dtype=torch.float64) * torch.tensor([1.0, 9.0, 0.1, 3.0, 0.0])
    here, there = scaled_together(one[:200] + 5, one[200:] + 5)
    assert float(here[:, 4].std()) == 0
    apart = torch.cdist(here[:, :4], there[:, :4]).square().mean()
    assert float(apart) == pytest.approx(2 * 4 / 5, rel=0.05)
    assert [value.abs().max() for value in scaled_together(torch.ones(3, 2), torch.ones(2, 2))] == [0, 0]


def test_bad_input_is_named():
    good = samples()
    with pytest.raises(InputError, match="features must have shape"):
        OrientedSamples(good.points, good.normals, good.features[:2], good.boundary)
    with pytest.raises(InputError, match="boundary must have shape"):
        OrientedSamples(good.points, good.normals, good.features, good.boundary[:2])
    with pytest.raises(InputTypeError, match=r"features is torch.float32"):
        OrientedSamples(good.points, good.normals, good.features.float(), good.boundary)
