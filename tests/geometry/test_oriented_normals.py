"""Normals of point sets: exact on planes, close on spheres, on one side wherever the camera stood."""

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.geometry.draws import D, directions, rand, seeded
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


def cap(count, seed=0):
    return directions(count, seed) * torch.tensor([1.0, 1.0, 0.0]) + directions(count, seed).abs() * torch.tensor(
        [0, 0, 1]
    )


def cosines(first, second):
    return (first * second).sum(-1)


def test_normals_of_a_plane_are_exact_and_look_to_the_origin():
    points = torch.cat((rand(200, 2), torch.full((200, 1), 3.0)), dim=-1)
    down = torch.tensor([[0.0, 0, -1]], dtype=D).expand(200, 3)
    torch.testing.assert_close(estimate_normals(points), down)
    torch.testing.assert_close(estimate_normals(-points), -down)
    torch.testing.assert_close(estimate_normals(points, viewpoint=torch.tensor([0.5, 0.5, 9.0])), -down)


def test_the_least_spread_of_an_independent_decomposition():
    points = directions(300) * torch.tensor([1.0, 2.0, 0.5], dtype=D)
    index, distance = k_nearest_others(points, 16)
    normals = estimate_normals(points)
    for row in range(0, 300, 37):
        around = points[[row, *index[row].tolist()]].numpy()
        weights = 1.001 - (np.array([0, *distance[row].tolist()]) / float(distance[row, -1])) ** 2
        centered = around - np.average(around, axis=0, weights=weights)
        _, _, axes = np.linalg.svd(np.sqrt(weights)[:, None] * centered)
        assert abs(float(normals[row] @ torch.from_numpy(axes[2]))) > 1 - 1e-9
    few = torch.tensor([3, 50, 299])
    torch.testing.assert_close(cosines(fit_normals_at(points, few), normals[few]).abs(), torch.ones(3, dtype=D))


@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_a_hollow_is_seen_from_within_only_if_the_viewpoint_says_so_also_far_away(dtype):
    points = cap(2000).to(dtype)
    normals = estimate_normals(points + 300)
    assert normals.dtype == dtype
    assert float(cosines(normals, points).min()) > 0.9
    assert float(cosines(estimate_normals(points, viewpoint=torch.zeros(3)), points).max()) < -0.9


def test_parts_look_the_same_way_though_one_is_hollow_and_closed_bodies_outward():
    dent = cap(300, 1) * torch.tensor([0.4, 0.4, -0.4]) + torch.tensor([6.0, 0, 0])
    normals = estimate_normals(torch.cat((cap(2000) * 2, dent)))
    assert float(normals[:2000, 2].mean()) > 0.4
    assert float(normals[2000:, 2].mean()) > 0.4
    large, small = directions(1500), directions(400, 1)
    normals = estimate_normals(torch.cat((large * 2, small * 0.7 + torch.tensor([5.0, 0, 0]))))
    assert float(cosines(normals, torch.cat((large, small))).min()) > 0


@settings(max_examples=15, deadline=None)
@given(
    turn=st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    scale=st.sampled_from([1e-6, 1e-3, 1.0, 1e3, 1e6]),
    shift=st.floats(-5, 5),
    seed=st.integers(0, 1000),
)
def test_normals_turn_with_the_points(turn, scale, shift, seed):
    points, order = cap(250) * torch.tensor([1.0, 1.4, 0.8], dtype=D), torch.randperm(250, generator=seeded(seed))
    rotation = so3_exp(torch.tensor(turn, dtype=D))
    moved = estimate_normals((scale * (points @ rotation.mT + shift))[order])
    torch.testing.assert_close(moved, (estimate_normals(points) @ rotation.mT)[order], atol=1e-6, rtol=0)


def test_random_signs_are_turned_back():
    points = directions(1500)
    given = torch.where(rand(1500, 1) < 0.5, -points, points)
    assert 0.4 < neighbors_disagree(given, k_nearest_others(points, 1)[0]) < 0.6
    torch.testing.assert_close(orient_normals(points, given), points)
    torch.testing.assert_close(orient_normals(points, given, viewpoint=torch.zeros(3))[:, 0], -points[:, 0])


def test_points_at_one_place_share_a_normal():
    points = cap(400)
    double = torch.cat((points, points[:50]))
    expected = estimate_normals(points)
    torch.testing.assert_close(estimate_normals(double), torch.cat((expected, expected[:50])))
    torch.testing.assert_close(orient_normals(double, torch.cat((points, -points[:50])))[:400], points)


def test_faces_wound_alike_keep_their_winding_and_most_decide():
    mesh = unit_sphere(2, dtype=D)
    wanted = torch.tensor(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).vertex_normals.copy())
    assert float(cosines(face_vertex_normals(mesh.vertices, mesh.faces), wanted).min()) > 0.999
    inward = mesh.faces.flip(-1).clone()
    inward[:5] = mesh.faces[:5]
    for faces in (inward, mesh.faces.flip(-1)):
        torch.testing.assert_close(face_vertex_normals(mesh.vertices, faces), -mesh.vertex_normals())


@pytest.mark.parametrize("share", [0.03, 0.5])
def test_faces_wound_at_random_are_turned(share):
    mesh = unit_sphere(3, dtype=D)
    faces = torch.where(rand(mesh.num_faces, 1) < share, mesh.faces.flip(-1), mesh.faces)
    torch.testing.assert_close(face_vertex_normals(mesh.vertices, faces), mesh.vertex_normals())
    inward = face_vertex_normals(mesh.vertices, faces, torch.zeros(3, dtype=D))
    torch.testing.assert_close(inward, -mesh.vertex_normals())
