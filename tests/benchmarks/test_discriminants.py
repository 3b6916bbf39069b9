import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import eigh


@pytest.fixture(scope="module")
def discriminants(loaded_benchmark):
    with loaded_benchmark("discriminants") as module:
        yield module


def moments(size=6, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    roots = torch.randn(2, size, 2 * size, generator=generator, dtype=dtype)
    return roots[0] @ roots[0].mT, roots[1] @ roots[1].mT


@settings(deadline=None, max_examples=25)
@given(size=st.integers(1, 9), seed=st.integers(0, 1000), ridge=st.sampled_from([1e-3, 0.03, 1.0]))
def test_directions_are_generalized_eigenvectors(discriminants, size, seed, ridge):
    within, between = moments(size, seed)
    held = within + ridge * within.diagonal().mean() * torch.eye(size, dtype=within.dtype)
    values, vectors = eigh(between.numpy(), held.numpy())
    directions = discriminants.linear_discriminants(within, between, size, ridge=ridge)
    torch.testing.assert_close(directions.mT @ held @ directions, torch.eye(size, dtype=within.dtype))
    found = directions.mT @ between @ directions
    torch.testing.assert_close(found, torch.diag(torch.from_numpy(values).flip(0)), rtol=1e-6, atol=1e-6)
    angle = torch.nn.functional.cosine_similarity(directions, torch.from_numpy(vectors).flip(1), dim=0)
    if size == 1 or (values[1:] / values[:-1]).min() > 1.01:
        torch.testing.assert_close(angle.abs(), torch.ones(size, dtype=within.dtype), rtol=0, atol=1e-5)


def test_what_varies_at_one_place_is_left_out(discriminants):
    generator = torch.Generator().manual_seed(0)
    place = torch.randn(4000, 4, generator=generator)
    # The second number tells nothing of the place, the fourth hardly anything.
    noise = torch.tensor([0.1, 5.0, 0.5, 2.0])
    first, second = (
        place * torch.tensor([1, 0, 1, 1]) + noise * torch.randn(4000, 4, generator=generator) for _ in "ab"
    )
    within = discriminants.difference_moments(first, second) / 4000
    between = discriminants.difference_moments(first, second.roll(1, 0)) / 4000
    directions = discriminants.linear_discriminants(within, between, 3, ridge=1e-6)
    assert directions.shape == (4, 3)
    assert directions.abs().argmax(0).tolist() == [0, 2, 3]
    apart = (first @ directions.float() - second @ directions.float()).square().mean(0)
    torch.testing.assert_close(apart, torch.ones(3), rtol=0, atol=1e-2)


def test_units_and_bases_of_descriptors_change_no_distance(discriminants):
    within, between = moments()
    generator = torch.Generator().manual_seed(3)
    turn = torch.linalg.qr(torch.randn(6, 6, generator=generator, dtype=torch.float64)).Q
    plain = discriminants.linear_discriminants(within, between, 3)
    turned = discriminants.linear_discriminants(turn @ within @ turn.mT, turn @ between @ turn.mT, 3)
    torch.testing.assert_close(turned @ turned.mT, turn @ plain @ plain.mT @ turn.mT)
    scaled = discriminants.linear_discriminants(100 * within, 100 * between, 3)
    torch.testing.assert_close(100 * scaled @ scaled.mT, plain @ plain.mT)


def test_moments_are_sums_of_outer_products(discriminants):
    generator = torch.Generator().manual_seed(1)
    first, second = torch.randn(2, 7, 3, generator=generator)
    expected = sum(torch.outer(d, d) for d in (first - second).double())
    torch.testing.assert_close(discriminants.difference_moments(first, second), expected)
    assert discriminants.difference_moments(first[:0], second[:0]).equal(torch.zeros(3, 3, dtype=torch.float64))


def test_dtype_is_kept(discriminants):
    within, between = moments(dtype=torch.float32)
    assert discriminants.linear_discriminants(within, between, 2).dtype == torch.float32
