import math

import pytest
import torch

from torchreg.datasets.solids import RoundBox, RoundCone, mesh_of, union_distance
from torchreg.errors import InputError

BALL = RoundCone((0.1, 0.2, 0.3), (0.1, 0.2, 0.3), 0.5, 0.5)


def test_a_cone_without_length_is_a_ball():
    points = torch.randn(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = (points - points.new_tensor([0.1, 0.2, 0.3])).norm(dim=-1) - 0.5
    torch.testing.assert_close(BALL.distance(points), expected)


def test_a_cone_of_one_radius_is_a_capsule():
    solid = RoundCone((0, 0, 0), (0, 0, 2), 0.3, 0.3)
    points = torch.tensor([[1.0, 0, 1], [0, 0, 3], [0, 0.1, 0.5]])
    torch.testing.assert_close(solid.distance(points), torch.tensor([0.7, 0.7, -0.2]))


def test_box_distances_beside_an_edge_and_inside():
    box = RoundBox((1, 0, 0), (0.5, 0.4, 0.3), 0.1)
    points = torch.tensor([[1.0, 0, 0], [2.0, 0, 0], [1.8, 0.7, 0]])
    rounded = math.hypot(0.4, 0.4) - 0.1
    torch.testing.assert_close(box.distance(points), torch.tensor([-0.3, 0.5, rounded]))


@pytest.mark.parametrize(
    "solid", [RoundCone((0, 0, 0), (0.2, 0.5, -0.1), 0.2, 0.1), RoundBox((0, 1, 2), (1, 2, 3), 0.2)]
)
def test_solids_lie_in_their_bounds(solid):
    lower, upper = (torch.tensor(corner) for corner in solid.bounds())
    draws = torch.rand(4000, 3, generator=torch.Generator().manual_seed(1))
    points = lower - 1 + draws * (upper - lower + 2)
    inside = points[solid.distance(points) <= 0]
    assert len(inside) > 10
    assert bool(((inside >= lower - 1e-6) & (inside <= upper + 1e-6)).all())


def test_a_blended_union_rounds_the_seam_and_leaves_the_rest():
    cones = [RoundCone((0, 0, 0), (1, 0, 0), 0.2, 0.2), RoundCone((1, 0, 0), (1, 1, 0), 0.2, 0.2)]
    points = torch.tensor([[0.8, 0.2, 0.0], [-0.2, 0.0, 0.0]], dtype=torch.float64)
    sharp, smooth = union_distance(cones, points, 0.0), union_distance(cones, points, 0.02)
    torch.testing.assert_close(sharp[0] - smooth[0], torch.tensor(0.02 * math.log(2), dtype=torch.float64))
    torch.testing.assert_close(sharp[1], smooth[1], atol=1e-6, rtol=0)


def test_meshes_are_closed_and_lie_on_the_surface():
    mesh = mesh_of([BALL], 0.1)
    sides = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).sort(dim=-1).values
    assert set(sides.unique(dim=0, return_counts=True)[1].tolist()) == {2}
    assert float(BALL.distance(mesh.vertices).abs().max()) < 0.01
    outwards = mesh.vertices[mesh.faces].mean(1) - mesh.vertices.new_tensor([0.1, 0.2, 0.3])
    assert bool(((outwards * mesh.face_normals()).sum(-1) > 0).all())


def test_bad_numbers_are_named():
    with pytest.raises(InputError, match="end_radius"):
        RoundCone((0, 0, 0), (0, 0, 1), 0.1, 0.0)
    with pytest.raises(InputError, match="at most the shortest half side"):
        RoundBox((0, 0, 0), (1, 1, 0.1), 0.2)
    with pytest.raises(InputError, match="at least one solid"):
        mesh_of([], 0.1)
    with pytest.raises(InputError, match="spacing"):
        mesh_of([BALL], 0.0)
