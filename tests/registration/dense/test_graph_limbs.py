import math

import pytest
import torch

from torchreg.geometry.geodesics import GeodesicGraph
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.dense.deformation_graph import DeformationGraph
from torchreg.registration.dense.graph_limbs import LONGEST, Limbs, finite_ways, shift_onto
from torchreg.registration.dense.node_graph import build_node_graph

F64 = torch.float64
NUM_ARMS = 5
WHOLE = se3_exp(torch.tensor([0.3, -0.2, 0.1, 0.5, 0.4, -0.6], dtype=F64))


def arms():
    """Return points (5, 40, 5, 3) of flat arms of length one that meet at the origin, from there outwards."""
    angle = torch.arange(NUM_ARMS, dtype=F64) * 2 * math.pi / NUM_ARMS
    out = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), dim=1)
    side = torch.stack((-angle.sin(), angle.cos(), torch.zeros_like(angle)), dim=1)
    along = torch.linspace(0.025, 1, 40, dtype=F64)[:, None, None]
    across = torch.linspace(-0.05, 0.05, 5, dtype=F64)[:, None]
    return along * out[:, None, None] + across * side[:, None, None]


@pytest.fixture(scope="module")
def graph():
    points = arms().reshape(-1, 3)
    normals = torch.tensor([0.0, 0, 1], dtype=F64).expand_as(points)
    return DeformationGraph(points, normals, build_node_graph(GeodesicGraph.from_points(points, 12), 0, 40, 3))


def test_tips_are_the_ends_of_the_arms(graph):
    limbs = Limbs.of(graph)
    assert len(limbs.tips) == NUM_ARMS
    ends = arms()[:, -1, 2]
    apart = torch.cdist(limbs.places(graph.rest()), ends)
    assert float(apart.amin(0).max()) < 0.12
    # From one end to another the way leads through the middle.
    others = limbs.between[~torch.eye(NUM_ARMS, dtype=torch.bool)]
    assert 1.7 < float(others.min()) <= float(others.max()) < 2.2
    assert float(limbs.between.diagonal().max()) == 0
    own = limbs.levels[apart.argmin(0)].reshape(NUM_ARMS, NUM_ARMS, 40, 5)
    for arm in range(NUM_ARMS):
        # Samples are as far from the tip as the nodes they hang on: half a node's distance more or less.
        expected = (1 - torch.linspace(0.025, 1, 40, dtype=F64)).unsqueeze(1).expand(40, 5)
        torch.testing.assert_close(own[arm, arm], expected, rtol=0, atol=0.2)


def test_tips_follow_motions(graph):
    limbs = Limbs.of(graph)
    rest = graph.rest()
    torch.testing.assert_close(limbs.places(WHOLE @ rest), transform_points(WHOLE, limbs.places(rest)))


def test_samples_are_laid_roughly_where_they_should_be(graph):
    places = graph.points + torch.tensor([0.0, 0.3, 0.1], dtype=F64) * graph.points[:, :1].clamp(min=0)
    laid = Limbs.of(graph).laid(graph.rest(), places)
    assert float((graph(laid) - places).norm(dim=1).max()) < 0.2 * float((graph.points - places).norm(dim=1).max())


def test_a_limb_is_shifted_by_what_lies_between_the_levels():
    here = arms()[0].reshape(-1, 3)
    levels = 1 - here[:, 0]
    apart = torch.tensor([0.1, -0.4, 0.2], dtype=F64)
    # The other limb has other points, in another order.
    order = torch.randperm(len(here), generator=torch.Generator().manual_seed(0))
    shift = shift_onto(here, levels, here[order] + apart, levels[order], 0.5)
    share = (1 - levels / 0.5).clamp(min=0).sqrt().unsqueeze(1)
    torch.testing.assert_close(shift, share * apart)
    assert float(shift[levels >= 0.5].abs().max()) == 0


def test_shifts_turn_with_everything():
    one, other = (limb.reshape(-1, 3) for limb in arms()[:2])
    levels = 1 - one.norm(dim=1)
    shift = shift_onto(one, levels, other, levels, LONGEST)
    turned = shift_onto(transform_points(WHOLE, one), levels, transform_points(WHOLE, other), levels, LONGEST)
    torch.testing.assert_close(turned, shift @ WHOLE[:3, :3].mT)
    assert float((one + shift - other)[levels < 0.05].norm(dim=1).max()) < 0.15


@pytest.mark.parametrize("which", [0, 1])
def test_too_little_of_a_limb_is_not_shifted(which):
    limb = arms()[0].reshape(-1, 3)
    levels = [1 - limb[:, 0], 1 - limb[:, 0]]
    assert shift_onto(limb, levels[0], limb, levels[1], 0.2) is not None
    levels[which] = levels[which] + 0.19
    assert shift_onto(limb, levels[0], limb, levels[1], 0.2) is None


def test_pieces_are_twice_the_longest_way_apart():
    ways = torch.tensor([[0.0, 3.0, math.inf], [3.0, 0.0, math.inf], [math.inf, math.inf, 0.0]])
    expected = torch.tensor([[0.0, 3.0, 6.0], [3.0, 0.0, 6.0], [6.0, 6.0, 0.0]])
    torch.testing.assert_close(finite_ways(ways), expected)
