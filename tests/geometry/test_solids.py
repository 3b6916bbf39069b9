"""Solids: distances against exact ones, dense surfaces, autograd and finite differences; fits to points."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from torch.func import jacfwd, jacrev, vmap

from torchreg.geometry.primitive_fit import fit_primitive
from torchreg.geometry.primitives import PRIMITIVE_KINDS

# torch's own forward mode compiles its decompositions with a deprecated call on first use.
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")

D = torch.float64
SIZES = {
    "ellipsoid": [(0.02, 0.03, 0.05), (1.0, 1.0, 1.0)],
    "capsule": [(0.04, 0.01), (1e-3, 0.02)],
    "cone": [(0.03, 0.02, 0.01), (0.02, 0.01, 0.03), (0.03, 0.02, 0.02), (0.005, 0.04, 0.001)],
    "superquadric": [
        (0.02, 0.03, 0.05, 1.0, 1.0),
        (0.02, 0.03, 0.05, 0.1, 0.1),
        (0.02, 0.03, 0.02, 0.5, 1.5),
        (0.03, 0.03, 0.02, 1.9, 0.1),
        (0.03, 0.02, 0.02, 0.1, 1.9),
    ],
}
CASES = [(kind, sizes) for kind, rows in SIZES.items() for sizes in rows]


def random_points(count, sizes, seed=0, spread=1.5):
    """Points in and around a solid."""
    generator = torch.Generator().manual_seed(seed)
    return spread * max(sizes[:3]) * (2 * torch.rand(count, 3, generator=generator, dtype=D) - 1)


def row(sizes, dtype=D):
    return torch.tensor(sizes, dtype=dtype)


# --- independent oracles ---


def exact_ellipsoid(point, radii):
    """Signed Euclidean distance: the closest point is r^2 x / (r^2 + t), t the largest root of the secular equation."""
    point, square = np.abs(point), np.square(radii)

    def secular(t):
        return np.sum(square * point**2 / (square + t) ** 2) - 1

    lowest = -square.min()
    high = np.linalg.norm(point) * np.sqrt(square.max()) + 1
    t = brentq(secular, lowest * (1 - 1e-12), high, xtol=1e-16, rtol=1e-15)
    closest = square * point / (square + t)
    return math.copysign(np.linalg.norm(point - closest), t)


def profile_distance(points, outline):
    """Signed distance to a solid of revolution whose convex outline (radius, z) runs from axis to axis, bottom up."""
    p = np.stack([np.hypot(points[:, 0], points[:, 1]), points[:, 2]], axis=-1)
    a, b = outline[:-1], outline[1:]
    edge = b - a
    share = np.clip(((p[:, None] - a) * edge).sum(-1) / (edge**2).sum(-1), 0, 1)
    distance = np.linalg.norm(p[:, None] - a - share[..., None] * edge, axis=-1).min(1)
    cross = edge[:, 0] * (p[:, None, 1] - a[:, 1]) - edge[:, 1] * (p[:, None, 0] - a[:, 0])
    return np.where((cross >= 0).all(1), -distance, distance)


def cone_outline(half, bottom, top):
    return np.array([[0, -half], [bottom, -half], [top, half], [0, half]])


def capsule_outline(half, radius, count=4000):
    angles = np.linspace(-np.pi / 2, np.pi / 2, count)
    lift = np.where(angles < 0, -half, half)
    return np.stack([radius * np.cos(angles), lift + radius * np.sin(angles)], axis=-1)


# --- ellipsoids ---


@pytest.mark.parametrize("radii", [(0.02, 0.03, 0.05), (0.01, 0.01, 0.04)])
def test_the_ellipsoid_distance_is_euclidean_to_first_order(radii):
    generator = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(30, 3, generator=generator, dtype=D), dim=-1)
    surface = direction * row(radii)
    normal = torch.nn.functional.normalize(surface / row(radii) ** 2, dim=-1)
    errors = []
    for offset in (1e-3, 5e-4, 2.5e-4):
        points = torch.cat([surface + offset * normal, surface - offset * normal])
        exact = np.array([exact_ellipsoid(p, radii) for p in points.numpy()])
        np.testing.assert_allclose(np.abs(exact), offset, rtol=1e-6)
        errors.append(np.abs(PRIMITIVE_KINDS["ellipsoid"].distance(points, row(radii)).numpy() - exact).max())
    # Halving the distance divides a second-order error by four.
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.25)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.15)
    assert errors[0] < 0.1 * 1e-3


# --- capsules and cones ---


@pytest.mark.parametrize(("kind", "sizes"), [case for case in CASES if case[0] in ("capsule", "cone")])
def test_distances_to_capsules_and_cones_are_exact(kind, sizes):
    points = random_points(2000 if kind == "cone" else 400, sizes, spread=2.5)
    outline, tolerance = (cone_outline, 1e-15) if kind == "cone" else (capsule_outline, 1e-6 * max(sizes))
    expected = profile_distance(points.numpy(), outline(*sizes))
    np.testing.assert_allclose(PRIMITIVE_KINDS[kind].distance(points, row(sizes)), expected, atol=tolerance)


def test_the_rim_of_a_cone_is_finite():
    for sizes in SIZES["cone"]:
        half, bottom, top = sizes
        rims = torch.tensor([[bottom, 0.0, -half], [0.0, top, half]], dtype=D, requires_grad=True)
        distance, gradient = PRIMITIVE_KINDS["cone"].gradient(rims, row(sizes))
        assert distance.abs().max() < 1e-16
        assert torch.isfinite(gradient).all()
        (auto,) = torch.autograd.grad(PRIMITIVE_KINDS["cone"].distance(rims, row(sizes)).sum(), rims)
        assert torch.isfinite(auto).all()


# --- superquadrics ---


@pytest.mark.parametrize("sizes", SIZES["superquadric"])
def test_superquadrics_pass_through_their_parametrization_and_are_radial(sizes):
    a, b, c, e1, e2 = sizes
    generator = torch.Generator().manual_seed(0)
    eta, omega = ((torch.rand(2, 50, generator=generator, dtype=D) - 0.5) * torch.tensor([[3.0], [6.2]])).unbind(0)

    def power(value, exponent):
        return value.sign() * value.abs() ** exponent

    surface = torch.stack(
        [
            a * power(eta.cos(), e1) * power(omega.cos(), e2),
            b * power(eta.cos(), e1) * power(omega.sin(), e2),
            c * power(eta.sin(), e1),
        ],
        dim=-1,
    )
    for factor in (1.0, 0.3, 2.5):
        distance = PRIMITIVE_KINDS["superquadric"].distance(factor * surface, row(sizes))
        torch.testing.assert_close(distance, (factor - 1) * surface.norm(dim=-1), atol=1e-9, rtol=1e-9)


# --- every kind ---


@pytest.mark.parametrize(("kind", "sizes"), CASES)
def test_analytic_gradients_are_those_of_autograd(kind, sizes):
    points = random_points(200, sizes).requires_grad_()
    distance, gradient = PRIMITIVE_KINDS[kind].gradient(points, row(sizes))
    direct = PRIMITIVE_KINDS[kind].distance(points, row(sizes))
    torch.testing.assert_close(distance, direct, atol=1e-16, rtol=1e-12)
    (auto,) = torch.autograd.grad(direct.sum(), points)
    torch.testing.assert_close(gradient, auto, atol=1e-10, rtol=1e-9)
    forward = vmap(jacfwd(lambda p: PRIMITIVE_KINDS[kind].distance(p, row(sizes))))(points.detach())
    torch.testing.assert_close(forward, auto, atol=1e-10, rtol=1e-9)


@pytest.mark.parametrize(("kind", "sizes"), CASES)
def test_the_center_and_the_axis_are_safe(kind, sizes):
    axis = torch.tensor([[0.0, 0, 0], [0, 0, 1e-3], [0, 0, -1e-3], [1e-30, 0, 0]], dtype=D)
    function = PRIMITIVE_KINDS[kind].distance
    distance, gradient = PRIMITIVE_KINDS[kind].gradient(axis, row(sizes))
    assert bool((distance < 0).all())
    assert torch.isfinite(gradient).all()
    torch.testing.assert_close(distance, function(axis, row(sizes)))
    learned = row(sizes)
    for mode in (jacfwd, jacrev):
        for argument in (0, 1):
            assert torch.isfinite(mode(function, argnums=argument)(axis, learned)).all()
    if kind in ("ellipsoid", "superquadric"):
        assert float(distance[0]) == -min(sizes[:3])
        assert gradient[0].tolist() == [0, 0, 0]


@pytest.mark.parametrize(("kind", "sizes"), CASES)
def test_float32_follows_float64(kind, sizes):
    points = random_points(200, sizes)
    exact, gradient = PRIMITIVE_KINDS[kind].gradient(points, row(sizes))
    single, single_gradient = PRIMITIVE_KINDS[kind].gradient(points.float(), row(sizes, torch.float32))
    assert single.dtype == single_gradient.dtype == torch.float32
    torch.testing.assert_close(single.double(), exact, atol=2e-5 * max(sizes[:3]), rtol=1e-4)
    # A gradient may flip at a crease; the rest follows.
    close = (single_gradient - gradient).abs().amax(-1) < 1e-2 * gradient.norm(dim=-1).clamp_min(1)
    assert close.double().mean() > 0.98


@pytest.mark.parametrize("kind", list(SIZES))
def test_rows_of_sizes_broadcast_over_points(kind):
    sizes = torch.stack([row(s) for s in SIZES[kind][:2]])
    points = random_points(5, (0.05,))
    together = PRIMITIVE_KINDS[kind].distance(points.unsqueeze(1), sizes)
    assert together.shape == (5, 2)
    for column, one in enumerate(sizes):
        torch.testing.assert_close(together[:, column], PRIMITIVE_KINDS[kind].distance(points, one))
    distance, gradient = PRIMITIVE_KINDS[kind].gradient(points.unsqueeze(1).expand(5, 2, 3), sizes)
    torch.testing.assert_close(distance, together)
    assert gradient.shape == (5, 2, 3)


@pytest.mark.parametrize(("kind", "sizes"), CASES)
def test_lengths_scale(kind, sizes):
    record = PRIMITIVE_KINDS[kind]
    points = random_points(50, sizes)
    scaled = torch.where(torch.tensor([size.is_length for size in record.sizes]), row(sizes) * 1000, row(sizes))
    torch.testing.assert_close(
        record.distance(points * 1000, scaled), 1000 * record.distance(points, row(sizes)), rtol=1e-9, atol=1e-12
    )


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


@pytest.mark.parametrize("kind", list(CLOUDS))
def test_auto_is_at_least_as_near_as_every_kind(kind):
    points = moved(CLOUDS[kind])
    fit = fit_primitive(points)
    assert fit.error == min(fit_primitive(points, name).error for name in PRIMITIVE_KINDS)


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
