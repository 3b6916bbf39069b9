import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.geometry.draws import D, rand, randn
from torchreg.errors import InputError
from torchreg.geometry import visibility, z_buffer
from torchreg.geometry.mesh import TriangleMesh, concatenate, interpolate, unit_sphere
from torchreg.geometry.visibility import aim, rasterize, sample_visible, view_rotation, visible_points

CAMERA = torch.tensor([0.0, 0.0, -3.0])


def quad(z, half=1.0):
    """A square at depth z that looks back along -z."""
    corners = [[-half, -half, z], [-half, half, z], [half, half, z], [half, -half, z]]
    return TriangleMesh(torch.tensor(corners, dtype=D), torch.tensor([[0, 1, 2], [0, 2, 3]]))


def cast_rays(mesh, origins, directions):
    """Nearest hit (distance along each ray, face), triangle by triangle with Cramer's rule."""
    best = torch.full((len(origins),), math.inf, dtype=D)
    face_of = torch.full((len(origins),), -1)
    for index, (a, b, c) in enumerate(mesh.vertices[mesh.faces]):
        system = torch.stack(torch.broadcast_tensors(b - a, c - a, -directions), dim=-1)
        u, v, t = torch.linalg.solve(system, origins - a).unbind(-1)
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t < best) & (t > 0)
        best[hit], face_of[hit] = t[hit], index
    return best, face_of


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_view_rotation_looks_at_the_target_with_up_upwards(seed):
    camera, target, up = randn(3, 3, seed=seed)
    rotation = view_rotation(camera, target, up)
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=D))
    assert float(rotation.det()) == pytest.approx(1.0)
    seen, upright = rotation @ (target - camera), rotation @ up
    torch.testing.assert_close(seen[:2], torch.zeros(2, dtype=D), atol=1e-12, rtol=0)
    assert seen[2] > 0
    assert abs(float(upright[0])) < 1e-12
    assert upright[1] < 0


@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize("size", [64, (40, 90)])
def test_aim_frames_every_point(parallel, size):
    points = randn(50, 3, seed=1)
    view = aim(points, torch.tensor([2.0, -9.0, 4.0]), parallel=parallel, size=size, margin=0.05)
    pixels, depth = view.project(points)
    limit = torch.tensor([view.width, view.height])
    assert bool((pixels > 0.045 * limit).all() & (pixels < 0.955 * limit).all())
    assert float(((pixels - limit / 2).abs() / limit).max()) == pytest.approx(0.45, abs=0.01)
    assert max(view.width, view.height) == (64 if size == 64 else 90)
    expected = view.pitch if parallel else view.pitch * depth
    torch.testing.assert_close(view.footprint(depth), torch.as_tensor(expected, dtype=D).expand(50))


@pytest.mark.parametrize("parallel", [False, True])
def test_rasterize_agrees_with_rays_cast_at_every_triangle(parallel):
    vertices, camera = randn(60, 3, seed=3), torch.tensor([1.0, 2.0, -8.0], dtype=D)
    mesh = TriangleMesh(vertices, torch.arange(60).reshape(20, 3))
    view = aim(vertices, camera, parallel=parallel, size=24)
    raster = rasterize(mesh, view)
    rows, columns = torch.meshgrid(torch.arange(view.height), torch.arange(view.width), indexing="ij")
    plane = torch.stack((columns, rows), dim=-1).reshape(-1, 2).double() + 0.5
    plane = plane * view.pitch + view.corner
    one = torch.ones_like(plane[:, :1])
    if parallel:
        directions = view.rotation[2].expand(len(plane), 3)
        origins = view.position + torch.cat([plane, -20 * one], dim=-1) @ view.rotation
    else:
        directions = torch.cat([plane, one], dim=-1) @ view.rotation
        origins = camera.expand(len(plane), 3)
    distance, face = cast_rays(mesh, origins, directions)
    torch.testing.assert_close(raster.face_index.reshape(-1), face)
    torch.testing.assert_close(raster.depth.reshape(-1), distance - (20 if parallel else 0))
    hit = face >= 0
    assert 0.2 < float(hit.double().mean()) < 1
    there = interpolate(vertices, mesh.faces, face[hit], raster.barycentric.reshape(-1, 3)[hit])
    torch.testing.assert_close(there, (origins + distance.unsqueeze(-1) * directions)[hit])


def test_rasterizing_in_chunks_changes_nothing(monkeypatch):
    mesh = concatenate([unit_sphere(2, dtype=D), quad(-1.2, 0.5)])
    view = aim(mesh.vertices, CAMERA, size=40)
    whole = rasterize(mesh, view)
    monkeypatch.setattr(z_buffer, "BUDGET", replace(z_buffer.BUDGET, raster_pixels=100))
    parts = rasterize(mesh, view)
    for name in ("face_index", "barycentric", "depth"):
        torch.testing.assert_close(getattr(parts, name), getattr(whole, name))


def test_culling_drops_faces_seen_from_behind():
    sheet = quad(0.0)
    behind = TriangleMesh(sheet.vertices, sheet.faces.flip(1))
    view = aim(sheet.vertices, CAMERA, size=8)
    assert bool((rasterize(sheet, view, cull_back=True).face_index >= 0).all())
    assert bool((rasterize(behind, view).face_index >= 0).all())
    empty = rasterize(behind, view, cull_back=True)
    assert bool((empty.face_index == -1).all())
    assert bool(empty.depth.isinf().all())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_sphere_hides_its_far_side(dtype):
    mesh = unit_sphere(4, dtype=dtype)
    direction = torch.tensor([0.6, -0.64, 0.48])
    facing = mesh.vertices.float() @ direction - 1 / 3
    seen = visible_points(mesh, mesh.vertices, 3 * direction)
    assert bool(seen[facing > 0.03].all())
    assert not bool(seen[facing < -0.1].any())


def test_points_before_beside_behind_and_behind_the_camera():
    points = torch.tensor([[0.0, 0, -1], [5.0, 0, 1], [0.0, 0, 1], [0.0, 0, -4], [0.0, 0, 0.04]])
    assert visible_points(quad(0.0), points, CAMERA, tolerance=0.05).tolist() == [True, True, False, False, True]
    assert not bool(visible_points(quad(0.0), points[4:], CAMERA, tolerance=0.01).any())
    assert visible_points(quad(0.0), points[:0], CAMERA).shape == (0,)


def test_a_slanted_surface_does_not_hide_itself():
    tilt = math.radians(84)
    turn = torch.tensor([[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]]).double()
    slanted = TriangleMesh(quad(0.0).vertices @ turn.mT, quad(0.0).faces)
    points = torch.nn.functional.pad(rand(200, 2) * 1.9 - 0.95, (0, 1)) @ turn.mT
    assert bool(visible_points(slanted, points, CAMERA, tolerance=1e-6).all())


def test_samples_by_area_fill_the_cap_that_a_pinhole_sees():
    mesh = unit_sphere(4)
    points, face, weights = sample_visible(mesh, CAMERA, 20_000)
    assert points.shape == (20_000, 3)
    torch.testing.assert_close(interpolate(mesh.vertices, mesh.faces, face, weights), points)
    # On a sphere the coordinate along the view is uniform (Archimedes): from the rim at 1/3 to 1.
    height = -points[:, 2]
    assert float(height.mean()) == pytest.approx(2 / 3, abs=0.006)
    assert float(height.std()) == pytest.approx((2 / 3) / math.sqrt(12), abs=0.004)


def test_samples_by_pixel_fill_the_picture():
    points, _, _ = sample_visible(unit_sphere(4), CAMERA, 20_000, density="pixel")
    plane = points[:, :2] / (points[:, 2:] + 3)
    # Uniform in a disk whose radius is the tangent of the sphere's half angle, 1 / sqrt(8): mean square radius R^2 / 2.
    assert float(plane.square().sum(-1).mean()) == pytest.approx(1 / 16, rel=0.02)
    torch.testing.assert_close(plane.mean(0), torch.zeros(2), atol=0.004, rtol=0)


def test_hidden_parts_give_no_samples():
    mesh = concatenate([quad(0.0), quad(2.0, 3.0)])
    for density in ("area", "pixel"):
        points, face, _ = sample_visible(mesh, CAMERA, 2_000, density=density)
        back = face >= 2
        assert 0.1 < float(back.double().mean()) < 0.95
        # The near square's shadow at depth 5 is 5/3 wide.
        assert float(points[back][:, :2].abs().amax(-1).min()) > 1.63


def test_samples_are_differentiable_in_the_vertices():
    sphere = unit_sphere(1, dtype=D)
    vertices = sphere.vertices.clone().requires_grad_()
    points, face, weights = sample_visible(TriangleMesh(vertices, sphere.faces), CAMERA, 10)
    points.sum().backward()
    corners = sphere.faces[face].reshape(-1)
    expected = torch.zeros(len(vertices), dtype=D).index_add(0, corners, weights.reshape(-1))
    torch.testing.assert_close(vertices.grad, expected[:, None].expand(-1, 3))


def test_a_surface_that_is_all_but_hidden_is_refused(monkeypatch):
    monkeypatch.setattr(visibility, "_VISIBILITY", replace(visibility._VISIBILITY, max_rounds=1))
    mesh = concatenate([quad(0.0), quad(2.0, 1.0)])
    with pytest.raises(InputError, match="camera must see the mesh"):
        sample_visible(mesh, CAMERA, 100, density="area")
