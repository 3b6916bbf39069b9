"""Normals of point sets: exact on planes, close on spheres, on one side wherever the camera stood."""

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from torchreg.geometry.mesh import unit_sphere
from torchreg.geometry.neighbors import k_nearest_others
from torchreg.geometry.normals import (
    estimate_normals,
    face_vertex_normals,
    fit_normals_at,
    neighbors_disagree,
    orient_normals,
)
from torchreg.geometry.rotation import so3_exp


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def sphere_points(count, seed=0):
    points = torch.randn(count, 3, generator=seeded(seed), dtype=torch.float64)
    return points / points.norm(dim=-1, keepdim=True)


def cap(count, seed=0):
    points = sphere_points(count, seed)
    return torch.cat((points[:, :2], points[:, 2:].abs()), dim=-1)


def cosines(first, second):
    return (first * second).sum(-1)


def test_normals_of_a_plane_are_exact_and_look_to_the_origin():
    flat = torch.rand(200, 2, generator=seeded(), dtype=torch.float64)
    points = torch.cat((flat, torch.full((200, 1), 3.0)), dim=-1)
    torch.testing.assert_close(estimate_normals(points), torch.tensor([[0.0, 0, -1]]).double().expand(200, 3))
    torch.testing.assert_close(estimate_normals(-points), torch.tensor([[0.0, 0, 1]]).double().expand(200, 3))
    eye = torch.tensor([0.5, 0.5, 9.0])
    assert bool((estimate_normals(points, viewpoint=eye)[:, 2] > 0.999).all())


def test_the_least_spread_of_an_independent_decomposition():
    points = sphere_points(300) * torch.tensor([1.0, 2.0, 0.5], dtype=torch.float64)
    index, distance = k_nearest_others(points, 16)
    normals = estimate_normals(points)
    for row in range(0, 300, 37):
        around = points[[row, *index[row].tolist()]].numpy()
        weights = 1.001 - (np.array([0, *distance[row].tolist()]) / float(distance[row, -1])) ** 2
        centered = around - np.average(around, axis=0, weights=weights)
        _, _, axes = np.linalg.svd(np.sqrt(weights)[:, None] * centered)
        assert abs(float(normals[row] @ torch.from_numpy(axes[2]))) > 1 - 1e-9
    few = torch.tensor([3, 50, 299])
    torch.testing.assert_close(cosines(fit_normals_at(points, few), normals[few]).abs(), torch.ones(3).double())


def test_a_hollow_is_seen_from_within_only_if_the_viewpoint_says_so():
    points = cap(2000)
    assert float(cosines(estimate_normals(points), points).min()) > 0.9
    inside = estimate_normals(points, viewpoint=torch.zeros(3))
    assert float(cosines(inside, points).max()) < -0.9


def test_parts_look_the_same_way_though_one_is_hollow():
    """A large bulging part beside a small dent, both seen from above."""
    dent = cap(300, 1) * 0.4
    dent[:, 2] = -dent[:, 2]
    points = torch.cat((cap(2000) * 2, dent + torch.tensor([6.0, 0, 0])))
    normals = estimate_normals(points)
    assert float(normals[:2000, 2].mean()) > 0.4
    assert float(normals[2000:, 2].mean()) > 0.4


def test_separate_closed_bodies_all_look_outward():
    small = sphere_points(400, 1)
    points = torch.cat((sphere_points(1500) * 2, small * 0.7 + torch.tensor([5.0, 0, 0])))
    normals = estimate_normals(points)
    assert float(cosines(normals[:1500], points[:1500]).min()) > 0
    assert float(cosines(normals[1500:], small).min()) > 0


@settings(max_examples=15, deadline=None)
@given(
    turn=st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    scale=st.sampled_from([1e-6, 1e-3, 1.0, 1e3, 1e6]),
    shift=st.floats(-5, 5),
    seed=st.integers(0, 1000),
)
def test_normals_turn_with_the_points(turn, scale, shift, seed):
    points = cap(250) * torch.tensor([1.0, 1.4, 0.8], dtype=torch.float64)
    order = torch.randperm(250, generator=seeded(seed))
    rotation = so3_exp(torch.tensor(turn, dtype=torch.float64))
    moved = scale * (points @ rotation.mT + shift)
    torch.testing.assert_close(
        estimate_normals(moved[order]), (estimate_normals(points) @ rotation.mT)[order], atol=1e-6, rtol=0
    )


def test_random_signs_are_turned_back():
    points = sphere_points(1500)
    signs = torch.where(torch.rand(1500, 1, generator=seeded()) < 0.5, -1.0, 1.0).double()
    assert 0.4 < neighbors_disagree(points * signs, k_nearest_others(points, 1)[0]) < 0.6
    torch.testing.assert_close(orient_normals(points, points * signs), points)
    torch.testing.assert_close(orient_normals(points, points * signs, viewpoint=torch.zeros(3))[:, 0], -points[:, 0])


def test_points_at_one_place_share_a_normal():
    points = cap(400)
    double = torch.cat((points, points[:50]))
    normals = estimate_normals(double)
    torch.testing.assert_close(normals[400:], normals[:50])
    torch.testing.assert_close(normals[:400], estimate_normals(points))
    given = torch.cat((points, -points[:50]))
    torch.testing.assert_close(orient_normals(double, given)[:400], points)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_is_kept_and_far_coordinates_do_no_harm(dtype):
    points = cap(1000).to(dtype) + 300
    normals = estimate_normals(points)
    assert normals.dtype == dtype
    assert float(cosines(normals, cap(1000).to(dtype)).min()) > 0.9


def test_faces_wound_alike_keep_their_winding():
    mesh = unit_sphere(2, dtype=torch.float64)
    wanted = torch.tensor(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).vertex_normals.copy())
    assert float(cosines(face_vertex_normals(mesh.vertices, mesh.faces), wanted).min()) > 0.999
    torch.testing.assert_close(
        face_vertex_normals(mesh.vertices, mesh.faces.flip(-1)), -face_vertex_normals(mesh.vertices, mesh.faces)
    )


@pytest.mark.parametrize("share", [0.03, 0.5])
def test_faces_wound_at_random_are_turned(share):
    mesh = unit_sphere(3, dtype=torch.float64)
    turn = torch.rand(mesh.num_faces, 1, generator=seeded()) < share
    faces = torch.where(turn, mesh.faces.flip(-1), mesh.faces)
    torch.testing.assert_close(face_vertex_normals(mesh.vertices, faces), mesh.vertex_normals())
    inward = face_vertex_normals(mesh.vertices, faces, torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(inward, -mesh.vertex_normals())


def test_a_mostly_inward_winding_wins_without_a_viewpoint():
    mesh = unit_sphere(2, dtype=torch.float64)
    faces = mesh.faces.flip(-1).clone()
    faces[:5] = mesh.faces[:5]
    torch.testing.assert_close(face_vertex_normals(mesh.vertices, faces), -mesh.vertex_normals())
