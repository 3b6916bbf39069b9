import pytest
import torch

from torchreg.errors import InputError
from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.mesh import concatenate, unit_sphere
from torchreg.spines.protrusions import average_geodesic_distance, find_protrusions


def brute_heights(graph, values):
    """Return the height of every maximum by flooding one place at a time."""
    starts, ends = graph.starts.tolist(), graph.ends.tolist()
    order = sorted(range(len(values)), key=lambda place: (-values[place], -place))
    rank = {place: number for number, place in enumerate(order)}
    owner, heights = {}, {}
    for place in order:
        tops = set()
        for other in ends[starts[place] : starts[place + 1]]:
            while other in owner and owner[other] != other:
                other = owner[other]
            tops |= {other} & owner.keys()
        owner[place] = place
        for number, top in enumerate(sorted(tops, key=rank.get)):
            if number == 0:
                owner[place] = top
            else:
                heights[top] = values[top] - values[place]
                owner[top] = owner[place]
    heights[order[0]] = values[order[0]] - min(values)
    return {place: height for place, height in heights.items() if height > 0}


@pytest.mark.parametrize("seed", range(3))
def test_heights_are_those_of_a_flood(seed):
    graph = GeodesicGraph.from_mesh(unit_sphere(2, dtype=torch.float64))
    values = torch.randn(162, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    if seed == 2:
        values = (2 * values).round()
    found = find_protrusions(graph, values, 1e-9)
    expected = brute_heights(graph, values.tolist())
    assert found.heights.tolist() == pytest.approx(sorted(expected.values(), reverse=True))
    if seed < 2:
        assert dict(zip(found.tips.tolist(), found.heights.tolist(), strict=True)) == pytest.approx(expected)


def test_low_maxima_are_noise_and_the_highest_place_is_always_found():
    mesh = unit_sphere(3, dtype=torch.float64)
    graph = GeodesicGraph.from_mesh(mesh)
    noise = 0.1 * torch.rand(mesh.num_vertices, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = find_protrusions(graph, mesh.vertices[:, 2].abs() + noise, 0.2)
    assert len(found.tips) == 2
    assert mesh.vertices[found.tips, 2].abs().min() > 0.85
    assert bool(((found.confidence > 0.9) & (found.confidence < 1)).all())
    assert len(find_protrusions(graph, torch.zeros(mesh.num_vertices), 0.2).tips) == 1


def test_confidence_is_a_half_at_the_threshold():
    graph = GeodesicGraph.from_points(torch.arange(9.0)[:, None] * torch.tensor([1.0, 0, 0]), 2)
    values = torch.tensor([0.0, 1, 2, 3, 1.5, 3, 4, 5, 6], dtype=torch.float64)
    assert find_protrusions(graph, values, 2.0).tips.tolist() == [8]
    assert find_protrusions(graph, values, 0.5).heights.tolist() == [6.0, 1.5]
    found = find_protrusions(graph, values, 5.999)
    assert float(found.confidence[0]) == pytest.approx(0.5, abs=1e-3)


def test_average_distance_on_a_long_body_is_that_of_an_interval():
    # Averaged over [0, 1] the distance from x is x^2 - x + 1/2; vertices are three times as dense on the left.
    places = torch.cat((torch.linspace(0, 0.5, 301)[:-1], torch.linspace(0.5, 1, 101))).double()
    points = torch.stack((places, 0 * places, 0 * places), dim=1)
    graph = GeodesicGraph.from_points(points, 2)
    gaps = torch.cat((places[1:] - places[:-1], torch.zeros(1)))
    areas = 0.5 * (gaps + gaps.roll(1))
    average = average_geodesic_distance(graph, areas, 40)
    assert torch.allclose(average.values, places**2 - places + 0.5, atol=5e-3)
    assert average.size == pytest.approx(1.0)
    assert len(average.base) == 40


def test_surfaces_in_pieces_or_without_area_are_refused():
    ball = unit_sphere(1, dtype=torch.float64)
    graph = GeodesicGraph.from_mesh(concatenate([ball, ball]))
    with pytest.raises(InputError, match="graph must be in one piece"):
        average_geodesic_distance(graph, torch.ones(84))
    graph = GeodesicGraph.from_mesh(ball)
    with pytest.raises(InputError, match="areas must not all be zero"):
        average_geodesic_distance(graph, torch.zeros(42))
    with pytest.raises(InputError, match="areas must have shape"):
        average_geodesic_distance(graph, torch.ones(3))
    with pytest.raises(InputError, match="least_height must be positive"):
        find_protrusions(graph, torch.zeros(42), 0.0)
