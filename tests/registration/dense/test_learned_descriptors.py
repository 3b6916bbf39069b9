from dataclasses import replace

import pytest
import torch

from torchreg.errors import InputError
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.io.tensors import load_tensors
from torchreg.registration.dense.learned_descriptors import (
    BIN_SIZES,
    CURVATURE_RADII,
    METRIC_FILE,
    learned_descriptors,
    learned_directions,
    surface_descriptors,
)
from torchreg.registration.dense.oriented_samples import OrientedSamples
from torchreg.registration.dense.spin_images import image_similarity, spin_images


@pytest.fixture
def scan():
    """A bumpy ball of size one."""
    generator = torch.Generator().manual_seed(0)
    normals = torch.nn.functional.normalize(torch.randn(300, 3, generator=generator, dtype=torch.float64), dim=-1)
    points = 0.3 * normals * (1 + 0.3 * torch.sin(7 * normals[:, :1]) * torch.cos(5 * normals[:, 1:2]))
    features = torch.randn(300, 6, generator=generator, dtype=torch.float64)
    return OrientedSamples(points, normals, features, torch.zeros(300, dtype=torch.bool))


def test_surface_descriptors_are_unit_roots_of_images_beside_features(scan):
    few = scan.first(40)
    found = surface_descriptors(few, scan)
    assert found.dtype == torch.float32
    assert found.shape == (40, 2 * 225 + 6)
    for number, size in enumerate(BIN_SIZES):
        image = spin_images(few.points, few.normals, scan.points, scan.normals, bin_size=size).flatten(1)
        squares = found[:, 225 * number : 225 * (number + 1)].square().double()
        # Squares of unit roots are shares of the whole.
        torch.testing.assert_close(squares, image / image.sum(-1, keepdim=True), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(found[:, 450:].double(), few.features, rtol=1e-6, atol=1e-6)


def test_learned_descriptors_are_projections(scan):
    few = scan.first(40)
    expected = surface_descriptors(few, scan) @ learned_directions()
    torch.testing.assert_close(learned_descriptors(few, scan), expected)
    assert expected.shape == (40, 32)


def test_rigid_motion_and_order_change_nothing(scan):
    motion = se3_exp(torch.tensor([0.3, 2.0, -1.0, 0.5, 1.0, 2.0], dtype=torch.float64))
    moved = scan.moved(transform_points(motion, scan.points), scan.normals @ motion[:3, :3].mT)
    few = learned_descriptors(scan.first(40), scan)
    torch.testing.assert_close(learned_descriptors(moved.first(40), moved), few, rtol=1e-3, atol=2e-2)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(1))
    shuffled = OrientedSamples(*(value[order] for value in (scan.points, scan.normals, scan.features, scan.boundary)))
    torch.testing.assert_close(learned_descriptors(scan.first(40), shuffled), few, rtol=1e-4, atol=1e-3)


def test_directions_fit_what_is_described():
    directions, metadata = load_tensors(METRIC_FILE)
    assert directions["directions"].shape == (456, 32)
    assert metadata["bin_sizes"] == list(BIN_SIZES)
    assert metadata["curvature_radii"] == list(CURVATURE_RADII)
    assert bool(learned_directions().isfinite().all())


def test_other_features_are_refused(scan):
    odd = replace(scan, features=scan.features[:, :4])
    with pytest.raises(InputError, match="few must have the 6 features that were learned from, got 4"):
        learned_descriptors(odd, odd)


def test_samples_that_see_nothing_are_described(scan):
    alone = scan.moved(scan.points + 100, scan.normals).first(1)
    # Its own features are all there is.
    assert bool(learned_descriptors(alone, scan).isfinite().all())
    distance = -image_similarity(learned_descriptors(alone, scan), learned_descriptors(scan, scan), "distance")
    assert distance.shape == (1, 300)
