import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchreg.errors import InputError
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.blend import turn_about
from torchreg.registration.dense.blend_sums import BlendSums, upper_triangles

F64 = torch.float64


def problem(seed=0, count=30, few=3, nodes=5, distinct=True):
    """Return points, nodes, weights and motions, all at random."""
    generator = torch.Generator().manual_seed(seed)

    def random(*size):
        return torch.randn(*size, generator=generator, dtype=F64)

    nearest = random(count, nodes).argsort(1)[:, :few]
    if not distinct:
        nearest = torch.randint(nodes, (count, few), generator=generator)
    return random(count, 3), nearest, random(count, few), se3_exp(0.4 * random(nodes, 6)), random(nodes, 3)


def blended(points, nearest, weights, transforms):
    """Return where the points go, one node at a time."""
    ends = transform_points(transforms[nearest], points.unsqueeze(1).unsqueeze(1)).squeeze(2)
    return (weights.unsqueeze(-1) * ends).sum(1)


def dense(points, nearest, weights, transforms, middles):
    """Return derivatives (R, 3, 6 J) of the places by twists, entry by entry."""
    arms = transform_points(transforms[nearest], points[:, None, None]).squeeze(2) - middles[nearest]
    axes = torch.eye(3, dtype=F64)
    turns = torch.linalg.cross(axes.expand(*arms.shape, 3), arms.unsqueeze(-2).expand(*arms.shape, 3), dim=-1).mT
    blocks = weights[..., None, None] * torch.cat((axes.expand_as(turns), turns), dim=-1)
    slope = torch.zeros(len(points), len(transforms), 3, 6, dtype=F64)
    rows = torch.arange(len(points)).unsqueeze(1).expand_as(nearest)
    slope.index_put_((rows, nearest), blocks, accumulate=True)
    return slope.transpose(1, 2).flatten(2)


def test_derivatives_are_those_of_turning_about_the_middles():
    points, nearest, weights, transforms, middles = problem(few=2, count=6)

    def places(twists):
        return blended(points, nearest, weights, turn_about(transforms, twists.view(-1, 6), middles))

    expected = torch.autograd.functional.jacobian(places, torch.zeros(30, dtype=F64))
    torch.testing.assert_close(dense(points, nearest, weights, transforms, middles), expected)


@pytest.mark.parametrize("distinct", [True, False])
def test_places_are_blends(distinct):
    points, nearest, weights, transforms, _ = problem(distinct=distinct)
    sums = BlendSums(points, nearest, weights, len(transforms))
    assert len(sums) == 30
    torch.testing.assert_close(sums.places(transforms), blended(points, nearest, weights, transforms))


@given(st.integers(0, 10_000), st.booleans(), st.integers(1, 4))
def test_normal_equations_are_those_of_the_jacobian(seed, distinct, few):
    points, nearest, weights, transforms, middles = problem(seed, 12, few, 4, distinct)
    weights = weights * (torch.arange(12) % 5 > 0).unsqueeze(1)  # some points follow nothing
    normals = torch.nn.functional.normalize(points.flip(0), dim=-1)
    scales, slides = torch.linspace(0, 2, 12, dtype=F64), torch.linspace(0.1, 1, 12, dtype=F64)
    metric = normals.unsqueeze(2) * normals.unsqueeze(1) + slides[:, None, None] * torch.eye(3, dtype=F64)
    metric = scales[:, None, None] * metric
    pulls = (metric @ points.unsqueeze(-1)).squeeze(-1)
    slope = dense(points, nearest, weights, transforms, middles)
    gradient, hessian = BlendSums(points, nearest, weights, 4).normal_equations(
        transforms, middles, upper_triangles(scales, normals, slides), pulls
    )
    torch.testing.assert_close(gradient.flatten(), torch.einsum("rpt,rp->t", slope, pulls))
    expected = torch.einsum("rps,rpq,rqt->st", slope, metric, slope)
    torch.testing.assert_close(hessian.tril(), expected.tril())


def test_metrics_without_normals_are_round():
    scales = torch.tensor([1.0, 3.0], dtype=F64)
    triangles = upper_triangles(scales, None, 0.5)
    assert triangles.tolist() == [[0.5, 0, 0, 0.5, 0, 0.5], [1.5, 0, 0, 1.5, 0, 1.5]]


def test_bad_input_is_named():
    points, nearest, weights, _, _ = problem()
    with pytest.raises(InputError, match=r"nearest must hold nodes from 0 to 3, got"):
        BlendSums(points, nearest, weights, 4)
    with pytest.raises(InputError, match=r"nearest must have shape \(30, K\)"):
        BlendSums(points, nearest[:5], weights, 5)
    with pytest.raises(InputError, match=r"weights must have shape \(30, 3\)"):
        BlendSums(points, nearest, weights[:, :2], 5)
