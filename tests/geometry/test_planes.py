import pytest
import torch

from torchreg.geometry.planes import distance_to_plane


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
