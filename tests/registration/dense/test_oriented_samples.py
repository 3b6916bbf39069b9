import pytest
import torch

from torchreg.errors import InputError, InputTypeError
from torchreg.registration.dense.oriented_samples import OrientedSamples


def samples(count=6, dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)
    points, normals = (torch.randn(count, 3, generator=generator, dtype=dtype) for _ in range(2))
    return OrientedSamples(points, torch.nn.functional.normalize(normals, dim=-1), torch.arange(count) > 2)


def test_first_and_moved_keep_the_rest():
    all_, few = samples(), samples().first(4)
    assert len(few) == 4
    torch.testing.assert_close(few.normals, all_.normals[:4])
    assert few.boundary.tolist() == [False, False, False, True]
    moved = few.moved(few.points + 1, -few.normals)
    torch.testing.assert_close(moved.points, all_.points[:4] + 1)
    assert moved.boundary is few.boundary


def test_embedded_distances_are_sums():
    both = samples()
    rows = both.embedded(0.5)
    squares = torch.cdist(both.points, both.points).square() + 0.25 * 2 * (1 - both.normals @ both.normals.mT)
    torch.testing.assert_close(torch.cdist(rows, rows).square(), squares)


def test_bad_input_is_named():
    good = samples()
    with pytest.raises(InputError, match="normals must have shape"):
        OrientedSamples(good.points, good.normals[:2], good.boundary)
    with pytest.raises(InputError, match="boundary must have shape"):
        OrientedSamples(good.points, good.normals, good.boundary[:2])
    with pytest.raises(InputTypeError, match=r"normals is torch.float32"):
        OrientedSamples(good.points, good.normals.float(), good.boundary)
