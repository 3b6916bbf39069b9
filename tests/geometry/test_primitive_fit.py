"""Fitting solids to points drawn on known ones, and to clouds with no shape at all."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchreg.geometry.primitive_fit import fit_primitive
from torchreg.geometry.primitives import PRIMITIVE_KINDS

D = torch.float64


def directions(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=D), dim=-1)


def ellipsoid_points(radii, count=800):
    return directions(count) * torch.tensor(radii, dtype=D)


def capsule_points(half, radius, count=2000):
    d = directions(count)
    along = half * (2 * torch.rand(count, generator=torch.Generator().manual_seed(1), dtype=D) - 1)
    share = half / (half + radius)
    side = torch.rand(count, generator=torch.Generator().manual_seed(2), dtype=D) < share
    round_part = torch.nn.functional.normalize(d[:, :2], dim=-1) * radius
    mantle = torch.cat([round_part, along[:, None]], -1)
    caps = radius * d + torch.stack([d[:, 0] * 0, d[:, 0] * 0, half * d[:, 2].sign()], -1)
    return torch.where(side[:, None], mantle, caps)


def cone_points(half, bottom, top, count=2000):
    generator = torch.Generator().manual_seed(3)
    z = half * (2 * torch.rand(count, generator=generator, dtype=D) - 1)
    radius = (bottom + top) / 2 + (top - bottom) / (2 * half) * z
    around = torch.nn.functional.normalize(directions(count)[:, :2], dim=-1)
    return torch.cat([around * radius[:, None], z[:, None]], -1)


def box_points(half, count=3000):
    d = directions(count, seed=5) * torch.tensor(half, dtype=D)
    return d / (d.abs() / torch.tensor(half, dtype=D)).amax(-1, keepdim=True)


CLOUDS = {
    "ellipsoid": ellipsoid_points((0.01, 0.015, 0.04)),
    "capsule": capsule_points(0.04, 0.012),
    "cone": cone_points(0.04, 0.02, 0.008),
    "superquadric": box_points((0.01, 0.02, 0.04)),
}


def moved(points, seed=0):
    rotation = torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
    return points @ rotation.mT + torch.tensor([0.3, -0.2, 0.5], dtype=D)


def distance(fit, points):
    local = (points - fit.pose[:3, 3]) @ fit.pose[:3, :3]
    return PRIMITIVE_KINDS[fit.kind].distance(local, torch.tensor(fit.sizes, dtype=D))


@pytest.mark.parametrize("kind", list(CLOUDS))
def test_a_solid_lies_near_the_points_it_is_fitted_to(kind):
    points = moved(CLOUDS[kind])
    fit = fit_primitive(points, kind)
    assert fit.kind == kind
    assert fit.error < 0.0015
    assert distance(fit, points).abs().mean().item() == pytest.approx(fit.error)
    rotation = fit.pose[:3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=D))
    assert torch.det(rotation) == pytest.approx(1.0)


def test_sizes_come_back():
    ellipsoid = fit_primitive(moved(CLOUDS["ellipsoid"]), "ellipsoid")
    np.testing.assert_allclose(sorted(ellipsoid.sizes), [0.01, 0.015, 0.04], rtol=0.02)
    np.testing.assert_allclose(fit_primitive(moved(CLOUDS["capsule"]), "capsule").sizes, [0.04, 0.012], rtol=0.1)
    half, bottom, top = fit_primitive(moved(CLOUDS["cone"]), "cone").sizes
    assert half == pytest.approx(0.04, rel=0.02)
    np.testing.assert_allclose(sorted([bottom, top]), [0.008, 0.02], rtol=0.1)


def test_a_cut_ellipsoid_is_completed():
    points = CLOUDS["ellipsoid"]
    points = points[points[:, 2] > -0.025]
    fit = fit_primitive(moved(points), "ellipsoid")
    assert max(fit.sizes) == pytest.approx(0.04, rel=0.1)
    assert fit.error < 5e-4


@pytest.mark.parametrize("kind", list(CLOUDS))
def test_auto_is_at_least_as_near_as_every_kind(kind):
    points = moved(CLOUDS[kind])
    fit = fit_primitive(points)
    assert fit.error == min(fit_primitive(points, name).error for name in PRIMITIVE_KINDS)


def test_auto_tells_the_kinds_apart():
    assert {kind: fit_primitive(moved(points)).kind for kind, points in CLOUDS.items()} == {
        kind: kind for kind in CLOUDS
    }


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 1000), st.floats(0.1, 1000))
def test_fits_move_and_scale_with_the_points(seed, scale):
    points = CLOUDS["cone"]
    plain, other = fit_primitive(points, "cone"), fit_primitive(scale * moved(points, seed), "cone")
    assert other.error == pytest.approx(scale * plain.error, rel=1e-6)
    np.testing.assert_allclose(sorted(other.sizes), scale * np.sort(plain.sizes), rtol=1e-6)


@pytest.mark.parametrize("kind", ["auto", *CLOUDS])
@pytest.mark.parametrize(
    "points",
    [
        torch.tensor([[1.0, 2.0, 3.0]]),
        torch.tensor([[1.0, 2.0, 3.0]]).expand(9, 3),
        torch.tensor([[0.0, 0, 0], [0.1, 0, 0]]),
        torch.linspace(0, 1, 12)[:, None] * torch.tensor([[1.0, 1.0, 0.0]]),
        torch.cartesian_prod(torch.linspace(0, 1, 4), torch.linspace(0, 1, 4), torch.zeros(1)),
    ],
    ids=["one point", "one place", "two points", "a line", "a plane"],
)
def test_clouds_without_volume_give_thin_solids(points, kind):
    fit = fit_primitive(points, kind)
    extent = float((points.amax(0) - points.amin(0)).norm())
    assert all(0 < size <= 1.5 * max(extent, 1e-5) for size in fit.sizes[:3])
    assert torch.isfinite(fit.pose).all()
    assert fit.error <= max(0.5 * extent, 1e-5)
    flat = np.linalg.matrix_rank((points - points[0]).numpy(), tol=1e-5) < 2
    if kind == "auto" and flat:
        assert fit.kind == "ellipsoid"


def test_float32_and_points_with_a_graph_are_taken():
    points = moved(CLOUDS["ellipsoid"]).float().requires_grad_()
    fit = fit_primitive(points, "ellipsoid")
    assert fit.pose.dtype == D
    assert not fit.pose.requires_grad
