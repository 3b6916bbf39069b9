"""The objectives of an alignment are the paper's: literal sums over points, differences through ``retract``."""

import pytest
import torch

import torchreg as tr
from tests.alignment.made import D
from torchreg.alignment.fit.objectives import GaussianPosePrior, distance_objective, registration_objective
from torchreg.shapes.surface import FusedSurface
from torchreg.solvers.e_step import expectation
from torchreg.solvers.levenberg_marquardt import Linearization

SIGMA = torch.tensor([0.03, 0.05], dtype=D)
WIDTHS, NOISE = torch.tensor([[0.02, 0.04], [0.004, 0.008]], dtype=D)


@pytest.fixture(scope="module")
def skin(links):
    return tr.sample_skin(links, 40)


def poses(seed=1):
    return 0.4 * torch.randn(2, 8, generator=torch.Generator().manual_seed(seed)).double()


# One precision for all problems, or one for each.
PRECISION = torch.tensor([0.0] * 6 + [3.0, 5.0], dtype=D)
PRIOR, NO_PRIOR = GaussianPosePrior(poses(7), PRECISION), GaussianPosePrior(poses(7), 0 * PRECISION)
PRIOR_OF_EACH = GaussianPosePrior(poses(7), torch.stack([PRECISION, 2 * PRECISION]))


def data_near(skin, pose, count=60):
    generator = torch.Generator().manual_seed(2)
    posed = skin(pose)[:, torch.randint(len(skin), (count,), generator=generator)]
    return posed + 0.01 * torch.randn(posed.shape, generator=generator).double()


def differences(shape, function, pose, step):
    """Return the derivatives (..., D) of a function of poses by tangent steps, from central differences."""
    columns = []
    for axis in step * torch.eye(shape.num_dofs, dtype=D):
        ahead, behind = (function(shape.retract(pose, (sign * axis).expand_as(pose))) for sign in (1, -1))
        columns.append((ahead - behind) / (2 * step))
    return torch.stack(columns, dim=-1)


@pytest.fixture(scope="module")
def matches(skin):
    return expectation(skin(poses()), data_near(skin, poses(3)), SIGMA)


@pytest.fixture(scope="module")
def registration(skin, matches):
    return registration_objective(skin, matches, SIGMA, PRIOR)


@pytest.fixture(scope="module")
def surface_fit(links, skin):
    valid = torch.arange(50) < torch.tensor([[50], [30]])
    return distance_objective(FusedSurface(links), data_near(skin, poses(), 50), valid, WIDTHS, NOISE, PRIOR)


def prior_cost(row):
    return float((PRECISION * (poses()[row] - PRIOR.mean[row]) ** 2).sum()) / 2


def test_the_registration_is_equation_20(skin, matches, registration):
    found = registration(poses())
    for row in range(2):
        residuals = (skin(poses()[row]) - matches.targets[row]).square().sum(-1)
        expected = sum(float(w * r) for w, r in zip(matches.weights[row], residuals, strict=True))
        expected = expected / (2 * float(SIGMA[row]) ** 2) + prior_cost(row)
        assert float(found.cost[row]) == pytest.approx(expected, rel=1e-10)
    jacobian = differences(skin.shape, skin, poses(), 1e-5).flatten(1, 2)
    weights = (matches.weights / SIGMA.square().unsqueeze(-1)).repeat_interleave(3, dim=-1)
    hessian = jacobian.mT @ (weights.unsqueeze(-1) * jacobian) + torch.diag(PRECISION)
    torch.testing.assert_close(found.hessian, hessian, rtol=1e-6, atol=1e-5)


def test_the_registration_gradient_is_that_of_the_data_likelihood(skin):
    """At the pose of the E-step, eq. 20 and -sum_j log(sum_i exp(-r^2 / 2 sigma^2) + c) fall alike."""
    pose, c = poses(), 3.76
    data = data_near(skin, poses(3))

    def likelihood(trial):
        squares = (skin(trial).unsqueeze(-2) - data.unsqueeze(-3)).square().sum(-1)
        kernel = (-squares / (2 * SIGMA.square())[:, None, None]).exp()
        return -(kernel.sum(-2) + c).log().sum(-1)

    objective = registration_objective(skin, expectation(skin(pose), data, SIGMA, c), SIGMA, NO_PRIOR)
    expected = differences(skin.shape, likelihood, pose, 1e-5)
    torch.testing.assert_close(objective(pose).gradient, expected, rtol=1e-6, atol=1e-6)


def test_the_surface_fit_is_equations_21_and_22(links, surface_fit):
    """As the Welsch function, whose weights are beta."""
    pose, data, found = poses(), surface_fit.terms[0].data, surface_fit(poses())
    for row, (count, sigma, noise) in enumerate(((50, 0.02, 0.004), (30, 0.04, 0.008))):
        distances = links.distance(data[row, :count], pose[row])
        expected = sum(sigma**2 * (1 - float((-(d**2) / sigma**2).exp())) / (2 * noise**2) for d in distances)
        assert float(found.cost[row]) == pytest.approx(expected + prior_cost(row), rel=1e-10)
    jacobian = differences(links, lambda trial: links.distance(data, trial), pose, 1e-6)
    beta = (-(links.distance(data, pose) / WIDTHS[:, None]).square()).exp() * surface_fit.terms[0].valid
    # The base is damped by a tenth of one datum: per metre, and per radian at a lever of one metre.
    damping = torch.cat([torch.full((6,), 0.1), torch.zeros(2)]).double() / WIDTHS.square().unsqueeze(-1)
    weights = (beta / NOISE[:, None].square()).unsqueeze(-1)
    hessian = jacobian.mT @ (weights * jacobian) + torch.diag(PRECISION) + torch.diag_embed(damping)
    torch.testing.assert_close(found.hessian, hessian, rtol=1e-5, atol=1e-2)


@pytest.mark.parametrize(("name", "step"), [("registration", 1e-5), ("surface_fit", 1e-6)])
def test_gradients_and_costs_alone_are_those_of_the_cost(links, request, name, step):
    objective, pose = request.getfixturevalue(name), poses(4)
    expected = differences(links, lambda trial: objective(trial).cost, pose, step)
    torch.testing.assert_close(objective(pose).gradient, expected, rtol=1e-5, atol=1e-4)
    torch.testing.assert_close(objective.cost(pose), objective(pose).cost, rtol=1e-12, atol=0)


@pytest.mark.parametrize("prior", [PRIOR, PRIOR_OF_EACH], ids=["all", "each"])
def test_the_prior_is_a_gaussian_on_every_problem_and_candidate(prior):
    pose, precision = poses(), prior.precision.expand(2, 8)
    ones = Linearization(torch.ones(2).double(), torch.ones(2, 8).double(), torch.ones(2, 8, 8).double())
    found, offsets = ones.plus(prior.linearized(pose)), pose - prior.mean
    torch.testing.assert_close(found.cost, 1 + (precision * offsets**2).sum(-1) / 2)
    torch.testing.assert_close(found.gradient, 1 + precision * offsets)
    torch.testing.assert_close(found.hessian, 1 + torch.diag_embed(precision))
    candidates = torch.stack([pose, poses(2)], dim=1)
    torch.testing.assert_close(prior.cost(candidates), torch.stack([prior.cost(pose), prior.cost(poses(2))], dim=1))
    torch.testing.assert_close(prior.cost(pose), found.cost - 1)
