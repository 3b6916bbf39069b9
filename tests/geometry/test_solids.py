"""Solids: distances against exact ones, dense surfaces, autograd and finite differences; fits to points."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch.func import jacfwd, jacrev, vmap

from tests.geometry.draws import D, directions, rand
from torchreg.geometry.primitive_fit import fit_primitive
from torchreg.geometry.primitives import PRIMITIVE_KINDS

# torch's own forward mode compiles its decompositions with a deprecated call on first use.
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")

SIZES = {
    "ellipsoid": [(0.02, 0.03, 0.05), (1.0, 1.0, 1.0)],
    "capsule": [(0.04, 0.01), (1e-3, 0.02)],
    "cone": [(0.03, 0.02, 0.01), (0.02, 0.01, 0.03), (0.03, 0.02, 0.02), (0.005, 0.04, 0.001)],
    "superquadric": [
        *((0.02, 0.03, 0.05, 1.0, 1.0), (0.02, 0.03, 0.05, 0.1, 0.1), (0.02, 0.03, 0.02, 0.5, 1.5)),
        *((0.03, 0.03, 0.02, 1.9, 0.1), (0.03, 0.02, 0.02, 0.1, 1.9)),
    ],
}
CASES = [(kind, torch.tensor(sizes, dtype=D)) for kind, rows in SIZES.items() for sizes in rows]


def random_points(count, sizes, spread=1.5):
    """Points in and around a solid."""
    return spread * float(max(sizes[:3])) * (2 * rand(count, 3) - 1)


# --- independent oracles ---


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
    radii = torch.tensor(radii, dtype=D)
    surface = directions(30) * radii
    normal = torch.nn.functional.normalize(surface / radii**2, dim=-1)
    errors = []
    for offset in (1e-3, 5e-4, 2.5e-4):
        found = [PRIMITIVE_KINDS["ellipsoid"].distance(surface + d * normal, radii) - d for d in (offset, -offset)]
        errors.append(float(torch.cat(found).abs().max()))
    # Halving the distance divides a second-order error by four.
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.25)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.15)
    assert errors[0] < 0.1 * 1e-3


# --- capsules and cones ---


@pytest.mark.parametrize(("kind", "sizes"), [case for case in CASES if case[0] in ("capsule", "cone")])
def test_distances_to_capsules_and_cones_are_exact(kind, sizes):
    points = random_points(2000 if kind == "cone" else 400, sizes, spread=2.5)
    outline, tolerance = (cone_outline, 1e-15) if kind == "cone" else (capsule_outline, 1e-6 * float(sizes.max()))
    expected = profile_distance(points.numpy(), outline(*sizes.tolist()))
    np.testing.assert_allclose(PRIMITIVE_KINDS[kind].distance(points, sizes), expected, atol=tolerance)


@pytest.mark.parametrize("sizes", [sizes for kind, sizes in CASES if kind == "cone"])
def test_the_rim_of_a_cone_is_finite(sizes):
    half, bottom, top = sizes.tolist()
    rims = torch.tensor([[bottom, 0.0, -half], [0.0, top, half]], dtype=D, requires_grad=True)
    distance, gradient = PRIMITIVE_KINDS["cone"].gradient(rims, sizes)
    assert distance.abs().max() < 1e-16
    assert torch.isfinite(gradient).all()
    (auto,) = torch.autograd.grad(PRIMITIVE_KINDS["cone"].distance(rims, sizes).sum(), rims)
    assert torch.isfinite(auto).all()


# --- superquadrics ---


@pytest.mark.parametrize("sizes", [sizes for kind, sizes in CASES if kind == "superquadric"])
def test_superquadrics_pass_through_their_parametrization_and_are_radial(sizes):
    eta, omega = ((rand(2, 50) - 0.5) * torch.tensor([[3.0], [6.2]])).unbind(0)

    def power(value, exponent):
        return value.sign() * value.abs() ** exponent

    level, (e1, e2) = power(eta.cos(), sizes[3]), sizes[3:]
    unit = torch.stack([level * power(omega.cos(), e2), level * power(omega.sin(), e2), power(eta.sin(), e1)], dim=-1)
    surface = sizes[:3] * unit
    for factor in (1.0, 0.3, 2.5):
        distance = PRIMITIVE_KINDS["superquadric"].distance(factor * surface, sizes)
        torch.testing.assert_close(distance, (factor - 1) * surface.norm(dim=-1), atol=1e-9, rtol=1e-9)


# --- every kind ---


@pytest.mark.parametrize(("kind", "sizes"), CASES)
def test_analytic_gradients_are_those_of_autograd_and_float32_follows(kind, sizes):
    record, points = PRIMITIVE_KINDS[kind], random_points(200, sizes).requires_grad_()
    distance, gradient = record.gradient(points, sizes)
    direct = record.distance(points, sizes)
    torch.testing.assert_close(distance, direct, atol=1e-16, rtol=1e-12)
    (auto,) = torch.autograd.grad(direct.sum(), points)
    torch.testing.assert_close(gradient, auto, atol=1e-10, rtol=1e-9)
    forward = vmap(jacfwd(lambda p: record.distance(p, sizes)))(points.detach())
    torch.testing.assert_close(forward, auto, atol=1e-10, rtol=1e-9)
    single, single_gradient = record.gradient(points.float(), sizes.float())
    assert single.dtype == single_gradient.dtype == torch.float32
    torch.testing.assert_close(single.double(), distance, atol=2e-5 * float(sizes[:3].max()), rtol=1e-4)
    # A gradient may flip at a crease; the rest follows.
    close = (single_gradient - gradient).abs().amax(-1) < 1e-2 * gradient.norm(dim=-1).clamp_min(1)
    assert close.double().mean() > 0.98


@pytest.mark.parametrize(("kind", "sizes"), CASES)
def test_the_center_and_the_axis_are_safe(kind, sizes):
    axis = torch.tensor([[0.0, 0, 0], [0, 0, 1e-3], [0, 0, -1e-3], [1e-30, 0, 0]], dtype=D)
    function = PRIMITIVE_KINDS[kind].distance
    distance, gradient = PRIMITIVE_KINDS[kind].gradient(axis, sizes)
    assert bool((distance < 0).all())
    assert torch.isfinite(gradient).all()
    torch.testing.assert_close(distance, function(axis, sizes))
    for mode in (jacfwd, jacrev):
        for argument in (0, 1):
            assert torch.isfinite(mode(function, argnums=argument)(axis, sizes)).all()
    if kind in ("ellipsoid", "superquadric"):
        assert distance[0] == -sizes[:3].min()
        assert gradient[0].tolist() == [0, 0, 0]


@pytest.mark.parametrize("kind", list(SIZES))
def test_rows_of_sizes_broadcast_over_points_and_lengths_scale(kind):
    record, sizes = PRIMITIVE_KINDS[kind], torch.tensor(SIZES[kind][:2], dtype=D)
    points = random_points(50, (0.05,))
    distance, gradient = record.gradient(points.unsqueeze(1).expand(50, 2, 3), sizes)
    torch.testing.assert_close(record.distance(points.unsqueeze(1), sizes), distance)
    assert gradient.shape == (50, 2, 3)
    lengths = torch.tensor([1000.0 if size.is_length else 1.0 for size in record.sizes], dtype=D)
    for column, row in enumerate(sizes):
        torch.testing.assert_close(distance[:, column], record.distance(points, row))
        scaled = record.distance(points * 1000, row * lengths)
        torch.testing.assert_close(scaled, 1000 * distance[:, column], rtol=1e-9, atol=1e-12)


FITTED = {
    "ellipsoid": (0.01, 0.015, 0.04),
    "capsule": (0.04, 0.012),
    "cone": (0.04, 0.02, 0.008),
    "superquadric": (0.01, 0.02, 0.04, 0.1, 0.1),
}


def on_surface(kind, count=1500):
    """Points of a solid's surface, by Newton steps from around it."""
    sizes = torch.tensor(FITTED[kind], dtype=D)
    points = directions(count) * (0.052 if kind == "capsule" else 0.04)
    for _ in range(30):
        distance, gradient = PRIMITIVE_KINDS[kind].gradient(points, sizes)
        points = points - distance[:, None] * gradient / gradient.square().sum(-1, keepdim=True).clamp_min(1e-9)
    return points


CLOUDS = {kind: on_surface(kind) for kind in FITTED}


def moved(points, seed=0):
    rotation = torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
    return points @ rotation.mT + torch.tensor([0.3, -0.2, 0.5], dtype=D)


@pytest.mark.parametrize("kind", list(CLOUDS))
def test_a_solid_lies_near_the_points_it_is_fitted_to_and_auto_takes_the_nearest(kind):
    points = moved(CLOUDS[kind])
    fits = {name: fit_primitive(points, name) for name in PRIMITIVE_KINDS}
    fit = fits[kind]
    assert fit.kind == kind
    assert fit.error < 0.0015
    local = (points - fit.pose[:3, 3]) @ fit.pose[:3, :3]
    distance = PRIMITIVE_KINDS[kind].distance(local, torch.tensor(fit.sizes, dtype=D))
    assert float(distance.abs().mean()) == pytest.approx(fit.error)
    torch.testing.assert_close(fit.pose[:3, :3] @ fit.pose[:3, :3].mT, torch.eye(3, dtype=D))
    assert torch.det(fit.pose[:3, :3]) == pytest.approx(1.0)
    assert fit_primitive(points).error == min(fit.error for fit in fits.values())
    if kind != "superquadric":
        np.testing.assert_allclose(sorted(fit.sizes), sorted(FITTED[kind]), rtol=0.1)


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
