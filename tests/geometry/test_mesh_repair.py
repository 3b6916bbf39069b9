import math

import pytest
import torch

from tests.geometry.draws import D, box_mesh
from torchreg.errors import InputError
from torchreg.geometry.creases import welded
from torchreg.geometry.graphs import connected_components
from torchreg.geometry.mesh import TriangleMesh, concatenate, unit_sphere
from torchreg.geometry.surface_graph import close_holes, coarsened, one_piece, unique_edges


def ball(subdivisions=2, radius=1.0, at=(0.0, 0.0, 0.0)):
    mesh = unit_sphere(subdivisions, dtype=D)
    return TriangleMesh(radius * mesh.vertices + torch.tensor(at, dtype=D), mesh.faces)


def soup(mesh):
    return mesh.vertices[mesh.faces].reshape(-1, 3), torch.arange(mesh.faces.numel()).reshape(-1, 3)


def euler_number(mesh):
    return mesh.num_vertices - len(unique_edges(mesh.faces)[0]) + mesh.num_faces


def test_edges_of_a_tetrahedron():
    faces = torch.tensor([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    edges, which = unique_edges(faces)
    assert edges.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]
    assert edges[which[1]].tolist() == [[0, 3], [1, 3], [0, 1]]
    assert unique_edges(torch.zeros(0, 3, dtype=torch.int64))[0].shape == (0, 2)


def test_separate_triangles_are_welded_and_repeated_ones_dropped():
    vertices, faces = soup(ball())
    again = TriangleMesh(vertices, torch.cat((faces, faces[:7].flip(1), faces[:3, [0, 0, 1]])))
    whole = one_piece(again)
    assert (whole.mesh.num_vertices, whole.mesh.num_faces) == (162, 320)
    assert torch.equal(whole.mesh.vertices, again.vertices[whole.vertex])


def test_welded_spheres_are_smooth_and_edges_of_cubes_stay_sharp():
    for mesh, count in ((unit_sphere(3, dtype=D), 642), (box_mesh(), 24)):  # a cube's corner has three normals
        vertices, faces = soup(mesh)
        kept, indexed, normals = welded(vertices, faces)
        assert len(kept) == count
        torch.testing.assert_close(vertices[kept][indexed], vertices[faces])
        smooth = float((normals.double() * vertices[kept]).sum(-1).min()) > 0.995
        assert smooth if count == 642 else bool((normals.abs().amax(-1) == 1).all())


def test_pieces_by_policy():
    mesh = concatenate([ball(1, 0.5, (2.0, 0, 0)), ball(), ball(1, 0.25, (0, 0, 3.0))])
    kept = one_piece(mesh)
    assert kept.mesh.num_faces == 320
    assert kept.vertex.tolist() == list(range(42, 204))
    assert kept.notes == ("2 fragment(s) left out, 33.33% of the faces",)
    bridged = one_piece(mesh, "bridge")
    assert bridged.mesh.num_faces == mesh.num_faces
    ends = mesh.vertices[bridged.vertex[bridged.bridges]]
    apart = (ends[:, 0] - ends[:, 1]).norm(dim=-1).sort().values
    table = torch.cdist(mesh.vertices[42:204], mesh.vertices)
    assert apart.tolist() == pytest.approx([float(table[:, :42].min()), float(table[:, 204:].min())])
    with pytest.raises(InputError, match="mesh must be one piece, got 3"):
        one_piece(mesh, "error")


def test_dust_is_no_reason_for_an_error():
    mesh = concatenate([ball(4), TriangleMesh(torch.eye(3, dtype=D) + 5, torch.tensor([[0, 1, 2]]))])
    assert one_piece(mesh, "error").mesh.num_faces == 5120
    assert one_piece(mesh, "bridge").bridges.shape == (0, 2)


def test_holes_are_closed_whatever_the_winding():
    mesh = ball(3)
    upper = mesh.vertices[mesh.faces].mean(1)[:, 2]
    whole = one_piece(TriangleMesh(mesh.vertices, mesh.faces[upper.abs() < 0.7]))
    assert whole.notes == ("2 hole(s) closed",)
    assert euler_number(whole.mesh) == 2
    middles = whole.mesh.vertices[whole.vertex < 0]
    assert middles[:, :2].abs().max() < 0.05
    assert sorted(middles[:, 2].sign().tolist()) == [-1, 1]
    flipped = torch.where(torch.arange(mesh.num_faces)[:, None] % 3 == 0, mesh.faces.flip(1), mesh.faces)
    for faces in (mesh.faces, flipped):
        vertices, _, count = close_holes(mesh.vertices, faces)
        assert (count, close_holes(mesh.vertices, faces[1:])[2]) == (0, 1)
        assert vertices is mesh.vertices


def test_coarse_surfaces_keep_place_and_topology():
    mesh = ball(5)
    few = coarsened(mesh, 1000)
    assert 500 < few.num_vertices <= 1200
    assert few.vertices.norm(dim=1).min() > 0.99
    assert abs(float(few.face_areas().sum()) / (4 * math.pi) - 1) < 0.03
    assert euler_number(one_piece(few).mesh) == 2
    assert coarsened(mesh, 20_000) is mesh


def test_sheets_closer_than_a_cell_stay_apart_and_thin_tubes_stay_tubes():
    turn, height = torch.arange(8, dtype=D) * math.pi / 4, torch.linspace(0, 4, 400, dtype=D)
    ring = 0.002 * torch.stack((turn.cos(), turn.sin()), dim=1)
    tube = torch.cat((ring.repeat(400, 1), height.repeat_interleave(8)[:, None]), dim=1)
    row = torch.arange(399).repeat_interleave(8) * 8
    start, end = torch.arange(8).repeat(399), (torch.arange(8).repeat(399) + 1) % 8
    lower = torch.stack((row + start, row + end, row + 8 + start), 1)
    faces = torch.cat((lower, torch.stack((row + end, row + 8 + end, row + 8 + start), 1)))
    few = coarsened(concatenate([ball(5), ball(5, 0.999), TriangleMesh(tube + 3, faces)]), 3000)
    labels = connected_components(torch.cat((few.faces[:, :2], few.faces[:, 1:])), few.num_vertices)
    assert len(labels.unique()) == 3
    assert few.vertices[:, 2].max() == pytest.approx(7.0, abs=0.06)
