"""What scanned things stand on, at any scale and turn; flat things stand on nothing; planes through most points."""

import math

import pytest
import torch

from tests.geometry.draws import D, rand, randn, sheet_faces
from torchreg.datasets.solids import RoundBox, RoundCone, mesh_of
from torchreg.geometry.mesh import TriangleMesh, concatenate, unit_sphere
from torchreg.geometry.planes import distance_to_plane
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.geometry.support import split_support

LEGS = [RoundCone((0.5 * x, 0.1, 0.3 * z), (0.4 * x, 0.9, 0.2 * z), 0.1, 0.13) for x in (-1, 1) for z in (-1, 1)]
ANIMAL = [*LEGS, RoundCone((-0.6, 1, 0), (0.7, 1, 0), 0.25, 0.25), RoundCone((0.7, 1, 0), (1.1, 1.5, 0), 0.12, 0.15)]
TURN = se3_exp(torch.tensor([3.0, -2.0, 7.0, 0.9, -1.3, 0.6], dtype=D))


def solid(*parts):
    mesh = mesh_of(parts, 0.06, 0.03)
    return TriangleMesh(mesh.vertices.double(), mesh.faces)


@pytest.fixture(scope="module")
def animal():
    """An animal whose feet touch y = 0."""
    return solid(*ANIMAL)


def sheet(half, height=0.0, count=30):
    """A square table top as a grid of triangles."""
    steps = torch.linspace(-half, half, count, dtype=D)
    corners = torch.cartesian_prod(steps, torch.tensor([height], dtype=D), steps)
    return TriangleMesh(corners, sheet_faces(count, count))


def disc(radius, count, height=0.0):
    angle, reach = 2 * math.pi * rand(count, seed=1), radius * rand(count, seed=2).sqrt()
    return torch.stack((reach * angle.cos(), torch.full_like(reach, height), reach * angle.sin()), 1)


def noise(points, deviation):
    return points + deviation * randn(*points.shape)


def after(animal, mask):
    """Which points behind those of the animal are on the support, and the share of the animal's that are."""
    return mask[animal.num_vertices :], float(mask[: animal.num_vertices].double().mean())


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("half", [1.0, 2.0, 6.0])
@pytest.mark.parametrize("gap", [0.0, 0.05])
def test_a_table_below_a_mesh_is_found_wherever_it_is(animal, scale, half, gap):
    mesh = concatenate([animal, sheet(half, -gap)])
    moved = TriangleMesh(scale * transform_points(TURN, mesh.vertices), mesh.faces)
    found = split_support(moved)
    table, wrong = after(animal, found.mask)
    assert bool(table.all())
    assert wrong < 0.01
    up = TURN[:3, 1]
    torch.testing.assert_close(found.plane[:3], up, atol=1e-6, rtol=0)
    assert abs(float(found.plane[3] / scale + up @ TURN[:3, 3]) - gap) < 1e-6
    rest = found.rest(moved)
    assert torch.equal(rest.vertices, moved.vertices[~found.mask])
    assert abs(rest.num_faces - animal.num_faces) < 0.01 * animal.num_faces


@pytest.mark.parametrize("support", ["two triangles", "slab", "table with legs", "corners that are not shared"])
def test_tables_of_other_makes_are_found_too(animal, support):
    if support == "two triangles":
        table = sheet(2.0, count=2)
    elif support == "slab":
        table = solid(RoundBox((0, -0.13, 0), (1.0, 0.1, 1.0), 0.02))
    else:
        legs = [RoundBox((1.5 * x, -0.9, 1.5 * z), (0.1, 0.75, 0.1), 0.02) for x in (-1, 1) for z in (-1, 1)]
        table = solid(RoundBox((0, -0.1, 0), (1.8, 0.08, 1.8), 0.02), *legs)
    mesh = concatenate([animal, table])
    truth = torch.arange(mesh.num_vertices) >= animal.num_vertices
    if support == "corners that are not shared":
        truth = truth[mesh.faces].reshape(-1)
        mesh = TriangleMesh(mesh.vertices[mesh.faces].reshape(-1, 3), torch.arange(3 * mesh.num_faces).reshape(-1, 3))
    found = split_support(mesh)
    assert float((found.mask != truth).double().mean()) < 0.01


@pytest.mark.parametrize("top_only", [False, True])
def test_a_table_that_is_one_with_the_feet_is_cut_off(top_only):
    mesh = solid(*ANIMAL, RoundBox((0, -0.1, 0), (1.8, 0.1, 1.8), 0.01))
    if top_only:  # as a scanner sees it
        mesh = RangeScan(mesh.vertices, mesh.faces).subset(mesh.vertices[:, 1] > -0.01)
        mesh = TriangleMesh(mesh.points, mesh.faces)
    found = split_support(mesh)
    high = mesh.vertices[:, 1]
    assert float(found.mask[high < 1e-3].double().mean()) > 0.98  # but for the rims of the feet
    assert not bool(found.mask[high > 0.05].any())
    rest = found.rest(mesh)
    assert rest.num_vertices < 0.6 * mesh.num_vertices
    assert float(rest.vertices[rest.faces][:, :, 1].amax(1).min()) > 0


@pytest.mark.parametrize("deviation", [0.0, 0.005, 0.015])
@pytest.mark.parametrize(("radius", "count"), [(1.0, 2000), (1.5, 20_000), (5.0, 4000)])
def test_a_turntable_in_a_cloud_is_found_through_noise(animal, deviation, radius, count):
    points = noise(torch.cat((animal.vertices, disc(radius, count))), deviation)
    found = split_support(transform_points(TURN, points).float())
    table, wrong = after(animal, found.mask)
    assert float(table.double().mean()) > 0.998
    assert wrong < 0.05  # soles lie on the plane
    assert float(found.plane[:3] @ TURN[:3, 1]) > 0.9998


def star(points, arms=5):
    angle = torch.atan2(points[:, 2], points[:, 0])
    return points * torch.stack((reach := 1 + 0.6 * (arms * angle).cos(), torch.ones_like(reach), reach), 1)


FLAT = [[0.4, 0.08, 0.45], *[[0.07, 0.06, 0.45]] * 4]
HAND = [
    RoundBox((x, 0, z), tuple(half), 0.05)
    for half, x, z in zip(FLAT, (0, -0.33, -0.11, 0.11, 0.33), (0, 0.85, 0.85, 0.85, 0.85), strict=True)
]
THUMB = RoundCone((0.45, 0, 0), (0.7, 0.6, 0.1), 0.09, 0.07)
ALONE = {
    "disc": lambda: disc(1.0, 4000),
    "noisy disc": lambda: noise(disc(1.0, 4000), 0.01),
    "bowl": lambda: disc(1.0, 4000) + 0.3 * disc(1.0, 4000).square().sum(1, keepdim=True) * torch.eye(3).double()[1],
    "plate with five arms": lambda: noise(star(disc(1.0, 6000)), 0.003),
    "thick plate": lambda: torch.cat((star(disc(1.0, 3000)), star(disc(1.0, 3000, 0.1)))),
    "box": lambda: solid(RoundBox((0, 0, 0), (0.5, 0.15, 0.3), 0.01)),
    "box seen from one side": lambda: (v := ALONE["box"]().vertices)[(v[:, 1] > 0.13) | (v[:, 0] > 0.48)],
    "flat hand": lambda: solid(*HAND),
    "flat hand, thumb up": lambda: solid(*HAND, THUMB),
    "sole": lambda: solid(RoundBox((0, 0, 0), (1, 0.1, 0.1), 0.02), RoundBox((0, 0, 0), (0.1, 0.1, 1), 0.02)),
    "ball": lambda: unit_sphere(4),
    "animal": lambda: solid(*ANIMAL),
    "three points": lambda: torch.eye(3),
    "line": lambda: torch.linspace(0, 1, 500)[:, None].expand(500, 3),
    "one place": lambda: torch.ones(500, 3),
}  # fmt: skip


@pytest.mark.parametrize("name", ALONE)
def test_what_stands_on_nothing_is_kept(name):
    data = ALONE[name]()
    for shown in (data, getattr(data, "vertices", data)):
        found = split_support(shown)
        assert found.plane is None
        assert not bool(found.mask.any())
    if isinstance(data, TriangleMesh):
        assert found.rest(data) is data


def cloud(generator):
    """Two clouds of 300 points: two thirds on a plane through the origin, one of them tilted, the others anywhere."""
    plane = torch.rand(2, 200, 3, generator=generator, dtype=torch.float64) - 0.5
    plane[..., 2] = 0.3 * plane[..., 0] * torch.tensor([[0.0], [1.0]])
    return torch.cat([plane, torch.rand(2, 100, 3, generator=generator, dtype=torch.float64) - 0.5], dim=1)


def test_distances_are_those_from_the_plane_with_most_points():
    points = cloud(torch.Generator().manual_seed(0))
    found = distance_to_plane(points, torch.ones(2, 300, dtype=torch.bool), 0.01, torch.Generator().manual_seed(1))
    normals = torch.tensor([[0.0, 0.0, 1.0], [-0.3, 0.0, 1.0]], dtype=torch.float64)
    expected = (points * torch.nn.functional.normalize(normals, dim=-1)[:, None]).sum(-1).abs()
    torch.testing.assert_close(found, expected, atol=1e-3, rtol=0)


def test_points_that_do_not_count_draw_no_plane_and_moved_points_the_same_one():
    points = cloud(torch.Generator().manual_seed(2))
    counts = torch.ones(2, 300, dtype=torch.bool)
    counts[:, :190] = False
    points[:, 200:260, 0] = 0.2  # now most of those that count
    found = distance_to_plane(points, counts, 0.01, torch.Generator().manual_seed(1))
    assert float(found[:, 200:260].max()) < 0.01
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64))[0]
    moved = distance_to_plane(points @ turn.mT + 5.0, counts, 0.01, torch.Generator().manual_seed(1))
    torch.testing.assert_close(moved, found, atol=1e-8, rtol=0)


@pytest.mark.parametrize("points", [torch.zeros(1, 5, 3), torch.arange(15.0).reshape(1, 5, 3)])
def test_points_of_one_place_or_line_lie_on_their_plane(points):
    found = distance_to_plane(points, torch.ones(1, 5, dtype=torch.bool), 0.1, torch.Generator().manual_seed(0))
    assert float(found.max()) < 1e-3
