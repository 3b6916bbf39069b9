import math

import pytest
import torch

from torchreg.errors import InputError
from torchreg.registration.dense.curvature import curvature_features, shape_operators

F64 = torch.float64


def sphere(count, radius, seed=0):
    normals = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=F64)
    normals = torch.nn.functional.normalize(normals, dim=-1)
    return radius * normals, normals


def cylinder(radius, num=60):
    angle = torch.arange(num, dtype=F64) * (2 * math.pi / num)
    height = torch.linspace(-1, 1, 41, dtype=F64)
    angle, height = torch.meshgrid(angle, height, indexing="ij")
    normals = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), dim=-1).reshape(-1, 3)
    points = radius * normals
    points[:, 2] = height.reshape(-1)
    return points, normals


def test_spheres_curve_alike_in_all_directions():
    points, normals = sphere(4000, 2.0)
    mean, half = shape_operators(points[:50], normals[:50], points, normals, [0.3, 0.5])[:, :].unbind(-1)
    torch.testing.assert_close(mean, torch.full_like(mean, 0.5), rtol=0.03, atol=0)
    assert float(half.abs().max()) < 0.03
    inside = shape_operators(points[:5], -normals[:5], points, -normals, [0.4])[..., 0]
    torch.testing.assert_close(inside, torch.full_like(inside, -0.5), rtol=0.03, atol=0)


def test_cylinders_curve_in_one_direction():
    points, normals = cylinder(0.5)
    middle = points[:, 2].abs() < 0.1
    mean, half = shape_operators(points[middle], normals[middle], points, normals, [0.2])[:, 0].unbind(-1)
    torch.testing.assert_close(mean, torch.full_like(mean, 1.0), rtol=0.05, atol=0)
    torch.testing.assert_close(half, torch.full_like(half, 1.0), rtol=0.05, atol=0)


def test_motion_changes_nothing_and_scale_divides():
    points, normals = cylinder(0.5)
    points = points + 0.02 * torch.randn(points.shape, generator=torch.Generator().manual_seed(1), dtype=F64)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0), dtype=F64))[0]
    turn = turn * torch.linalg.det(turn)
    plain = shape_operators(points[:200], normals[:200], points, normals, [0.2, 0.4])
    moved, turned = points @ turn.mT + 5, normals @ turn.mT
    torch.testing.assert_close(shape_operators(moved[:200], turned[:200], moved, turned, [0.2, 0.4]), plain)
    larger = shape_operators(3 * points[:200], normals[:200], 3 * points, normals, [0.6, 1.2])
    torch.testing.assert_close(larger, plain / 3)


def test_other_sheets_and_far_points_do_not_count():
    points, normals = sphere(500, 1.0)
    both, sides = torch.cat((points, 1.01 * points)), torch.cat((normals, -normals))
    one = shape_operators(points[:9], normals[:9], points, normals, [0.5])
    torch.testing.assert_close(shape_operators(points[:9], normals[:9], both, sides, [0.5], num_neighbors=200), one)
    alone = shape_operators(points[:1] + 10, normals[:1], points, normals, [0.5])
    assert alone.tolist() == [[[0.0, 0.0]]]


def test_features_are_bounded_angles():
    points, normals = sphere(2000, 0.5)
    features = curvature_features(points[:20], normals[:20], points, normals, (0.1, 0.2))
    assert features.shape == (20, 4)
    # Curvature 2: arctan(2 r 2) for the mean.
    expected = torch.tensor([math.atan(0.4), math.atan(0.8)], dtype=F64).expand(20, 2)
    torch.testing.assert_close(features[:, ::2], expected, rtol=0.1, atol=0)
    single = curvature_features(*(value.float() for value in (points[:20], normals[:20], points, normals)), (0.1, 0.2))
    assert single.dtype == torch.float32
    torch.testing.assert_close(single, features.float(), rtol=1e-3, atol=1e-3)


def test_gradients():
    points, normals = sphere(30, 1.0)
    here, scene = points[:3].clone().requires_grad_(), points.clone().requires_grad_()

    def function(here, scene):
        return shape_operators(here, normals[:3], scene, normals, [1.2], num_neighbors=30)

    assert torch.autograd.gradcheck(function, (here, scene), atol=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [({"radii": []}, "radii must hold"), ({"radii": [-1.0]}, "radii must be positive"),
     ({"normals": torch.zeros(4, 3)}, "normals must have shape"), ({"num_neighbors": 0}, "num_neighbors")],
)  # fmt: skip
def test_bad_input_is_named(change, message):
    points, normals = sphere(5, 1.0)
    points, normals = points.float(), normals.float()
    arguments = {"points": points, "normals": normals, "scan_points": points, "scan_normals": normals, "radii": [1.0]}
    with pytest.raises(InputError, match=message):
        shape_operators(**{**arguments, **change})
