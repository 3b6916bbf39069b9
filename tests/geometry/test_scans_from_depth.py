"""Depth images: pinhole points, triangles on one surface, cuts where the depth jumps."""

import pytest
import torch

from torchreg.geometry.depth_image import unproject
from torchreg.geometry.mesh import TriangleMesh

PINHOLE = (100.0, 90.0, 20.0, 15.0)


def rays(height=31, width=41):
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    ones = torch.ones(height, width, dtype=torch.float64)
    return torch.stack(((column - 20.0) / 100, (row - 15.0) / 90, ones), dim=-1)


def plane_depth(normal, offset):
    """Depth of the plane normal . x = offset."""
    return offset / (rays() @ torch.tensor(normal, dtype=torch.float64))


def test_points_lie_where_their_rays_meet_the_plane():
    normal = (0.3, -0.4, 1.0)
    points, faces = unproject(plane_depth(normal, 2.0), PINHOLE, 3.0)
    assert len(points) == 31 * 41
    assert len(faces) == 2 * 30 * 40
    torch.testing.assert_close(points @ torch.tensor(normal, dtype=torch.float64), torch.full((1271,), 2.0).double())
    torch.testing.assert_close(points / points[:, 2:], rays().reshape(-1, 3))
    facing = TriangleMesh(points, faces).face_normals()
    assert float((facing * -points[faces[:, 0]]).sum(-1).min()) > 0
    assert int(faces.reshape(-1).bincount().max()) <= 8


@pytest.mark.parametrize("slope", [0.0, 2.0, -3.0])
def test_slanted_planes_hold_together_and_steps_do_not(slope):
    depth = plane_depth((slope, 0.0, 1.0), 10.0)
    assert len(unproject(depth, PINHOLE, 3.0)[1]) == 2 * 30 * 40
    depth[:, 25:] += 1.0 + 0.6 * abs(slope)
    points, faces = unproject(depth, PINHOLE, 3.0)
    assert len(faces) == 2 * 30 * 39
    columns = (points[:, 0] / points[:, 2] * 100 + 20).round()[faces]
    assert not bool(((columns < 24.5).any(-1) & (columns > 24.5).any(-1)).any())


def test_what_flies_between_two_surfaces_is_left_out():
    depth = torch.tensor([1.0] * 10 + [2.0] + [3.0] * 9).double().expand(20, 20)
    points, faces = unproject(depth, (100, 100, 10, 10), 3.0)
    assert set(points[:, 2].tolist()) == {1.0, 3.0}
    assert len(faces) == 2 * 19 * (9 + 8)


def test_holes_leave_out_their_pixels_and_corners_keep_their_triangle():
    depth = torch.ones(4, 4)
    for value in (0.0, -1.0, torch.nan, torch.inf):
        depth[0, 0] = value
        assert list(map(len, unproject(depth, (10, 10, 2, 2), 3.0))) == [15, 17]
    depth[1, 1] = 0.0
    assert len(unproject(depth, (10, 10, 2, 2), 3.0)[1]) == 5 * 2 + 3


def test_the_flatter_of_two_splits():
    depth = torch.tensor([[1.0, 1.1], [1.1, 1.4]])
    for shown, expected in ((depth, [[0, 1, 2], [1, 2, 3]]), (depth.flip(0), [[0, 1, 3], [0, 2, 3]])):
        assert sorted(map(sorted, unproject(shown, (5, 5, 0, 0), 3.0)[1].tolist())) == expected


def test_units_do_not_matter():
    depth = plane_depth((1.0, 0.5, 1.0), 2.0)
    depth[10:20, 10:20] -= 0.4
    points, faces = unproject(depth, PINHOLE, 3.0)
    for scale in (1e-3, 1e3):
        scaled, same = unproject(depth * scale, PINHOLE, 3.0)
        assert torch.equal(same, faces)
        torch.testing.assert_close(scaled, points * scale)
