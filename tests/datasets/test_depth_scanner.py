import math

import pytest
import torch

from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.solids import RoundBox, RoundCone, mesh_of
from torchreg.errors import InputError
from torchreg.geometry.mesh import interpolate

BALL = mesh_of([RoundCone((0.1, 0.05, 3), (0.1, 0.05, 3), 0.5, 0.5)], 0.05)
CLEAN = DepthScanner(noise=0.0, num_holes=0)


def scan(scanner, mesh=BALL, seed=0, dtype=torch.float64):
    view = scanner.view(mesh, 0.4)
    return scanner.scan(mesh, view, torch.Generator().manual_seed(seed), dtype)


def test_a_clean_scan_lies_exactly_where_it_says():
    found = scan(CLEAN)
    torch.testing.assert_close(found.carried(BALL.vertices, BALL.faces), found.scan.points)
    middle = torch.tensor([0.1, 0.05, 3], dtype=torch.float64)
    assert float(((found.scan.points - middle).norm(dim=-1) - 0.5).abs().max()) < 2e-3
    # The side that faces the camera, and normals that look at it.
    assert bool((((found.scan.points - middle) * found.scan.points).sum(-1) < 0).all())
    assert bool(((found.scan.normals * found.scan.points).sum(-1) < 0).all())


@pytest.mark.parametrize("count", [500, 3000])
def test_the_number_of_points_is_as_asked(count):
    found = scan(DepthScanner(num_points=count))
    assert abs(len(found.scan) / count - 1) < 0.1


def test_noise_grows_with_depth_and_lies_along_the_rays():
    near, far = (BALL, mesh_of([RoundCone((0, 0, 6), (0, 0, 6), 1.0, 1.0)], 0.1))
    spreads = []
    for mesh in (near, far):
        found = scan(DepthScanner(noise=1e-3, num_holes=0, num_points=4000), mesh)
        truth = found.carried(mesh.vertices, mesh.faces)
        error = found.scan.points - truth
        assert float(torch.linalg.cross(error, truth).norm(dim=-1).max()) < 1e-9
        spreads.append(float((error[:, 2] / truth[:, 2].square()).std()))
    assert spreads == pytest.approx([1e-3, 1e-3], rel=0.05)


def test_slanted_surfaces_and_holes_are_not_measured():
    whole = scan(DepthScanner(noise=0.0, num_holes=0, max_slant=math.pi / 2))
    cut = scan(DepthScanner(noise=0.0, num_holes=0, max_slant=math.radians(50)))
    middle = torch.tensor([0.1, 0.05, 3], dtype=torch.float64)
    for found, limit in ((whole, 85), (cut, 52)):
        out = torch.nn.functional.normalize(found.scan.points - middle, dim=-1)
        slant = torch.rad2deg(torch.acos(-(out * torch.nn.functional.normalize(found.scan.points, dim=-1)).sum(-1)))
        assert limit - 6 < float(slant.max()) < limit + 6
    holes = DepthScanner(noise=0.0, num_holes=3, hole_radius=0.05)
    assert len(scan(holes).scan) < 0.97 * len(scan(CLEAN).scan)


def test_what_stands_before_something_hides_it():
    wall, post = RoundBox((0, 0, 3), (0.8, 0.8, 0.05), 0.01), RoundBox((0, 0, 2), (0.1, 0.6, 0.05), 0.01)
    both = mesh_of([wall, post], 0.05)
    points = scan(CLEAN, both).scan.points
    behind = points[points[:, 2] > 2.5]
    assert len(behind) > 100
    shadow = (behind[:, 0] / behind[:, 2]).abs() < 0.1 / 2 - 0.01
    low = (behind[:, 1] / behind[:, 2]).abs() < 0.6 / 2 - 0.05
    assert not bool((shadow & low).any())


def test_scans_repeat_under_a_seed_in_either_precision():
    scanner = DepthScanner()
    first, again, other = scan(scanner), scan(scanner), scan(scanner, seed=1)
    assert torch.equal(first.scan.points, again.scan.points)
    assert first.scan.points.shape != other.scan.points.shape or not torch.equal(first.scan.points, other.scan.points)
    single = scan(CLEAN, dtype=torch.float32)
    assert single.scan.points.dtype == torch.float32
    truth = interpolate(BALL.vertices, BALL.faces, single.face, single.barycentric)
    torch.testing.assert_close(single.scan.points.double(), truth, atol=1e-5, rtol=0)


def test_bad_arguments_are_named():
    for name, value in (
        ("num_points", 1),
        ("noise", -1.0),
        ("max_slant", 2.0),
        ("num_holes", -1),
        ("hole_radius", -0.1),
    ):
        with pytest.raises(InputError, match=name):
            DepthScanner(**{name: value})
    behind = mesh_of([RoundCone((5, 0, 3), (5, 0, 3), 0.5, 0.5)], 0.1)
    with pytest.raises(InputError, match="sees nothing"):
        CLEAN.view(behind, 0.4)
    with pytest.raises(InputError, match="sees nothing"):
        CLEAN.scan(behind, CLEAN.view(BALL, 0.4), torch.Generator(), torch.float64)
