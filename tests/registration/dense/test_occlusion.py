import pytest
import torch

from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.dense.occlusion import likely_viewpoint, occlusion_edges

F64 = torch.float64
EYE = torch.zeros(3, dtype=F64)


def square(size, depth, step=0.05):
    """Return points (N, 3) of a square that faces the camera at the origin, and which lie on its rim."""
    line = torch.arange(-size, size + 0.5 * step, step, dtype=F64)
    flat = torch.cartesian_prod(line, line)
    return torch.cat([flat, torch.full_like(flat[:, :1], depth)], dim=1), flat.abs().amax(1) > size - 0.5 * step


@pytest.fixture
def scene():
    """A wall, a small square before it, and the hole that its shadow leaves in the wall; edges and what cuts them."""
    front, front_rim = square(0.4, 2.0)
    wall, wall_rim = square(1.5, 3.0)
    # Seen from the origin, the shadow is half as large again.
    aside = wall[:, :2].abs().amax(1)
    kept, beside = aside > 0.62, (aside > 0.62) & (aside < 0.68)
    surface = torch.cat([front, wall[kept]])
    boundary = torch.cat([front_rim, (wall_rim | beside)[kept]])
    cut = torch.cat([torch.zeros_like(front_rim), beside[kept]])
    return surface, surface[boundary], cut[boundary]


def test_only_the_rim_of_a_shadow_is_cut(scene):
    surface, edges, cut = scene
    assert 0 < int(cut.sum()) < len(cut)
    assert torch.equal(occlusion_edges(edges, surface, EYE, 0.3), cut)
    # What is farther away than the other by less than the depth is no occluder.
    assert not occlusion_edges(edges, surface, EYE, 1.2).any()


def test_motion_scale_and_order_change_nothing(scene):
    surface, edges, cut = scene
    motion = se3_exp(torch.tensor([0.3, 2.0, -1.0, 0.5, 1.0, 2.0], dtype=F64))
    moved = [7 * transform_points(motion, points) for points in (edges, surface.flip(0), EYE[None])]
    assert torch.equal(occlusion_edges(moved[0], moved[1], moved[2][0], 7 * 0.3), cut)


def test_nothing_cuts_nothing(scene):
    surface, edges, _ = scene
    assert occlusion_edges(edges[:0], surface, EYE, 0.3).shape == (0,)
    assert not occlusion_edges(edges, surface[:1], EYE, 0.3).any()
    assert not occlusion_edges(edges, surface, surface.mean(0), 0.3).any()
    # A camera among the points sees some of them behind its back.
    assert occlusion_edges(edges, surface, torch.tensor([0.0, 0.0, 2.5], dtype=F64), 0.3).shape == (len(edges),)


def test_the_camera_stands_where_the_normals_look():
    generator = torch.Generator().manual_seed(0)
    ball = torch.nn.functional.normalize(torch.randn(4000, 3, generator=generator, dtype=F64), dim=-1)
    half = ball[ball[:, 2] < 0]
    found = likely_viewpoint(half + 5, half)
    assert found is not None
    away = torch.nn.functional.normalize(found - (half + 5).mean(0), dim=0)
    assert float(away @ torch.tensor([0.0, 0.0, -1.0], dtype=F64)) > 0.999
    assert float((found - (half + 5).mean(0)).norm()) > 5
    assert likely_viewpoint(ball, ball) is None
    assert likely_viewpoint(ball[:0], ball[:0]) is None


def test_the_camera_is_found_though_most_of_what_it_sees_is_turned_aside():
    generator = torch.Generator().manual_seed(0)
    ball = torch.nn.functional.normalize(torch.randn(4000, 3, generator=generator, dtype=F64), dim=-1)
    half = ball[ball[:, 2] < -0.2]
    slope = torch.nn.functional.normalize(torch.tensor([0.6, 0.3, -0.7], dtype=F64), dim=0)
    plane = torch.randn(2000, 3, generator=generator, dtype=F64)
    plane = plane - (plane @ slope).unsqueeze(1) * slope
    points, normals = torch.cat([half, plane]), torch.cat([half, slope.expand_as(plane)])
    mean = torch.nn.functional.normalize(normals.mean(0), dim=0)
    found = likely_viewpoint(points, normals)
    away = torch.nn.functional.normalize(found - points.mean(0), dim=0)
    straight = torch.tensor([0.0, 0.0, -1.0], dtype=F64)
    assert float(mean @ straight) < 0.95
    assert float(away @ straight) > 0.995


def test_bad_input_is_named(scene):
    surface, edges, _ = scene
    with pytest.raises(InputError, match="edges must have shape"):
        occlusion_edges(edges[0], surface, EYE, 0.3)
    with pytest.raises(InputError, match="viewpoint must have shape"):
        occlusion_edges(edges, surface, EYE[:2], 0.3)
    with pytest.raises(InputError, match="depth must be"):
        occlusion_edges(edges, surface, EYE, 0.0)
    with pytest.raises(InputTypeError, match=r"edges is torch.float32"):
        occlusion_edges(edges.float(), surface, EYE, 0.3)
    with pytest.raises(InputError, match="normals must have shape"):
        likely_viewpoint(surface, edges[:3])
