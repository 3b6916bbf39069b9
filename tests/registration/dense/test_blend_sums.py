"""Normal equations of points that follow several motions, against dense Jacobians by autograd."""

import pytest
import torch

from torchreg.errors import InputError
from torchreg.geometry.rigid import se3_exp
from torchreg.registration.dense.blend_sums import BlendSums, upper_triangles


def draw(*shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(sum(shape)), dtype=torch.float64)


NEAREST = torch.tensor([[0, 1, 2], [1, 3, 0], [2, 0, 3], [3, 1, 2], [0, 3, 1], [2, 1, 0]])


@pytest.fixture(scope="module")
def sums():
    weights = draw(6, 3)
    weights[1, 1] = 0  # of no node
    return BlendSums(draw(6, 3), NEAREST, weights, 4), draw(6, 3), weights


def test_points_and_normal_equations_are_those_of_dense_sums(sums):
    blended, points, weights = sums
    transforms, middles, residuals = se3_exp(0.7 * draw(4, 6)), draw(4, 3), draw(6, 3)
    normals = torch.nn.functional.normalize(draw(6, 3), dim=-1)
    scales, tangential = draw(6).abs(), torch.tensor(0.3, dtype=torch.float64)
    metrics = scales[:, None, None] * (normals[:, :, None] * normals[:, None] + tangential * torch.eye(3).double())

    moved = (transforms[:, None, :3, :3] @ points.unsqueeze(-1)).squeeze(-1) + transforms[:, None, :3, 3]
    own = weights.unsqueeze(-1) * moved[NEAREST, torch.arange(6).unsqueeze(1)]
    torch.testing.assert_close(blended.places(transforms), own.sum(1))

    def shifted(twists):
        arms = moved - middles.unsqueeze(1)
        shift = twists[:, None, :3] + torch.linalg.cross(twists[:, None, 3:].expand_as(arms), arms)
        return (weights.unsqueeze(-1) * shift[NEAREST, torch.arange(6).unsqueeze(1)]).sum(1)

    jacobian = torch.autograd.functional.jacobian(shifted, torch.zeros(4, 6, dtype=torch.float64)).flatten(2)
    weighted = (metrics @ residuals.unsqueeze(-1)).squeeze(-1)
    triangles = upper_triangles(scales, normals, tangential)
    gradient, hessian = blended.normal_equations(transforms, middles, triangles, weighted)
    torch.testing.assert_close(gradient.flatten(), torch.einsum("nid,ni->d", jacobian, weighted))
    expected = torch.einsum("nid,nij,nje->de", jacobian, metrics, jacobian)
    torch.testing.assert_close(hessian.tril(), expected.tril())


def test_nodes_that_do_not_exist_are_refused():
    with pytest.raises(InputError, match="nearest must hold nodes from 0 to 2"):
        BlendSums(draw(6, 3), NEAREST, draw(6, 3), 3)
