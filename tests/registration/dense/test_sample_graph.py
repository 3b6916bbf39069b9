"""Graphs of samples: along the surface, around valleys, across gaps."""

import math

import pytest
import torch

import torchreg as tr
from torchreg.registration.dense.sample_graph import sample_graph


def sheet(count, spacing=1.0):
    """Return the points and triangles of a flat square grid."""
    line = torch.arange(count, dtype=torch.float64) * spacing
    points = torch.stack((*torch.meshgrid(line, line, indexing="ij"), torch.zeros(count, count)), dim=-1).reshape(-1, 3)
    corner = torch.arange(count * count).reshape(count, count)
    a, b, c, d = (part.reshape(-1) for part in (corner[:-1, :-1], corner[1:, :-1], corner[:-1, 1:], corner[1:, 1:]))
    return points, torch.cat((torch.stack((a, b, c), 1), torch.stack((b, d, c), 1)))


def loop():
    """Return points and inner normals of a band along half a lemniscate, and their number along it: its ends meet."""
    turn = torch.linspace(-1.53, 1.53, 121, dtype=torch.float64)
    across = turn.sin()
    curve = (turn.cos() / (1 + across.square())).unsqueeze(1) * torch.stack((torch.ones_like(turn), across), dim=-1)
    angle = 3 * across.atan()
    normals = -torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), dim=-1)
    width = 0.02 * torch.arange(5, dtype=torch.float64).repeat_interleave(len(turn))
    return torch.cat((curve.repeat(5, 1), width.unsqueeze(1)), dim=1), normals.repeat(5, 1), len(turn)


def test_surfaces_that_face_each_other_do_not_meet():
    points, normals, length = loop()
    near, around = (
        float(sample_graph(points, torch.arange(length), **given).distances(torch.tensor([0]))[0, -1])
        for given in ({}, {"normals": normals, "normal_scale": 0.03})
    )
    assert near < 0.1
    # The loop is 2.622 long, and begins and ends 0.04 from the middle.
    assert around == pytest.approx(2.622 - 0.08, rel=0.01)


def test_where_nothing_leads_around_parts_hang_together_across_a_valley():
    line = torch.arange(11, dtype=torch.float64) * 0.1
    floor = torch.stack((*torch.meshgrid(line, line, indexing="ij"), torch.zeros(11, 11)), dim=-1).reshape(-1, 3)
    wall = floor[:, [2, 1, 0]] + torch.tensor([0.0, 0.0, 0.05])
    points = torch.cat((floor, wall))
    normals = torch.eye(3, dtype=torch.float64)[[2] * len(floor) + [0] * len(wall)]
    samples = torch.arange(len(points))
    plain = sample_graph(points, samples, bridge=None)
    facing = sample_graph(points, samples, normals=normals, normal_scale=0.03, bridge=None)
    torch.testing.assert_close(facing.distances(), plain.distances())


def test_a_smooth_surface_is_joined_as_without_normals():
    generator = torch.Generator().manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(800, 3, generator=generator, dtype=torch.float64), dim=1)
    samples = torch.arange(150)
    plain = sample_graph(points, samples)
    for side in (1.0, -1.0):
        facing = sample_graph(points, samples, normals=side * points)
        assert torch.equal(facing.edges()[0], plain.edges()[0])


def test_steps_join_neighbors_alone():
    points, faces = sheet(9)
    samples = torch.arange(81).reshape(9, 9)[::2, ::2].reshape(-1)
    graph = sample_graph(points, samples, faces)
    edges, lengths = graph.edges()
    length = (points[samples][edges[:, 0]] - points[samples][edges[:, 1]]).norm(dim=-1)
    torch.testing.assert_close(lengths, length)
    assert float(length.max()) < 3
    geodesics = graph.distances()
    straight = torch.cdist(points[samples], points[samples])
    assert bool((geodesics >= straight - 1e-9).all())
    assert bool((geodesics <= 1.45 * straight + 1e-9).all())
    torch.testing.assert_close(geodesics, geodesics.mT)


def test_all_points_as_samples_give_the_edges_of_the_mesh_and_limits_leave_far_ones_out():
    points, faces = sheet(5)
    graph = sample_graph(points, torch.arange(25), faces)
    sides = torch.cat((faces[:, :2], faces[:, 1:], faces[:, ::2])).sort(dim=1).values.unique(dim=0)
    assert torch.equal(graph.edges()[0], sides)
    ends = torch.tensor([0, 24])
    near, full = graph.distances(ends, limit=1.5), graph.distances(ends)
    assert torch.equal(near.isfinite(), full <= 1.5)
    alone = sample_graph(points, torch.tensor([4]), faces)
    assert alone.edges()[0].shape == (0, 2)
    assert alone.distances().tolist() == [[0.0]]


def test_parts_are_bridged_where_they_are_nearest():
    points, faces = sheet(4)
    far = points + torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64)
    both, triangles = torch.cat((points, far)), torch.cat((faces, faces + 16))
    apart = sample_graph(both, torch.arange(32), triangles, bridge=None)
    assert not bool(apart.distances(torch.tensor([0]))[0, 16:].isfinite().any())
    joined = sample_graph(both, torch.arange(32), triangles, bridge=3.0)
    assert len(joined.edges()[0]) == len(apart.edges()[0]) + 3
    assert float(joined.distances(torch.tensor([0]))[0, 16]) >= 15
    assert bool(joined.distances().isfinite().all())


def test_points_without_faces_are_joined_to_neighbors():
    points, _ = sheet(6)
    twice = torch.cat((points, points[:7]))
    graph = sample_graph(twice, torch.arange(36), None)
    geodesics = graph.distances()
    assert bool(geodesics.isfinite().all())
    assert float(geodesics[0, 35]) == pytest.approx(5 * 2**0.5, rel=0.2)


def test_motion_and_order_change_nothing():
    points, faces = sheet(5)
    # No point is equally near to two samples.
    points = points + 0.2 * torch.rand(points.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64))[0]
    samples = torch.tensor([0, 4, 12, 20, 24, 7])
    normals = torch.nn.functional.normalize(points - points.mean(0), dim=-1)
    graph = sample_graph(points, samples, faces, normals=normals, normal_scale=0.1)
    other = sample_graph(points @ turn.mT + 3, samples.flip(0), faces, normals=normals @ turn.mT, normal_scale=0.1)
    torch.testing.assert_close(other.distances().flip(0, 1), graph.distances())


@pytest.mark.parametrize(
    ("change", "message"),
    [({"samples": torch.zeros(0, dtype=torch.long)}, "samples must be"), ({"bridge": 0.0}, "bridge must be"),
     ({"num_neighbors": 0}, "num_neighbors must be"), ({"normals": torch.zeros(8, 3)}, "normals must have shape"),
     ({"normals": torch.full((9, 3), math.nan)}, "normals must"), ({"normal_scale": -1.0}, "normal_scale must be"),
     ({"points": torch.zeros(3, 2)}, "points must have shape")],
)  # fmt: skip
def test_bad_input_is_named(change, message):
    points, faces = sheet(3)
    arguments = {"points": points, "samples": torch.arange(9), "faces": faces, **change}
    with pytest.raises(tr.errors.InputError, match=message):
        sample_graph(**arguments)
