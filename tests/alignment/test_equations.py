"""The objectives of an alignment are the paper's: literal sums over points, differences through ``retract``."""

import pytest
import torch

import torchreg as tr
from torchreg.alignment.fit.objectives import GaussianPosePrior, distance_objective, registration_objective
from torchreg.shapes.surface import FusedSurface
from torchreg.solvers.e_step import EStep, expectation
from torchreg.solvers.levenberg_marquardt import Linearization

DOFS = 8
D = torch.float64
SIGMA = torch.tensor([0.03, 0.05], dtype=D)
WIDTHS, NOISE = torch.tensor([[0.02, 0.04], [0.004, 0.008]], dtype=D)


@pytest.fixture(scope="module")
def skin(links):
    return tr.sample_skin(links, 40)


def poses(seed=1):
    return 0.4 * torch.randn(2, DOFS, generator=torch.Generator().manual_seed(seed)).double()


def prior_of(elbow, wrist):
    return GaussianPosePrior(poses(7), torch.tensor([0.0] * 6 + [elbow, wrist], dtype=D))


PRIOR, NO_PRIOR = prior_of(3.0, 5.0), prior_of(0.0, 0.0)


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


def test_the_registration_cost_is_equation_20(skin, matches, registration):
    found = registration(poses()).cost
    for row in range(2):
        posed, expected = skin(poses()[row]), 0.0
        for i in range(len(skin)):
            residual = posed[i] - matches.targets[row, i]
            expected += float(matches.weights[row, i] * residual @ residual) / (2 * float(SIGMA[row]) ** 2)
        for k in range(DOFS):
            expected += float(PRIOR.precision[k] * (poses()[row, k] - PRIOR.mean[row, k]) ** 2) / 2
        assert float(found[row]) == pytest.approx(expected, rel=1e-10)


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


def test_the_registration_hessian_is_j_transposed_w_j(skin, matches, registration):
    jacobian = differences(skin.shape, skin, poses(), 1e-5).flatten(1, 2)
    weights = (matches.weights / SIGMA.square().unsqueeze(-1)).repeat_interleave(3, dim=-1)
    expected = jacobian.mT @ (weights.unsqueeze(-1) * jacobian) + torch.diag(PRIOR.precision)
    torch.testing.assert_close(registration(poses()).hessian, expected, rtol=1e-6, atol=1e-5)


def test_the_surface_cost_is_equations_21_and_22(links, surface_fit):
    """As the Welsch function, whose weights are beta."""
    pose, found = poses(), surface_fit(poses()).cost
    for row, (count, sigma, noise) in enumerate(((50, 0.02, 0.004), (30, 0.04, 0.008))):
        distances = links.distance(surface_fit.data.data[row, :count], pose[row])
        expected = sum(sigma**2 * (1 - float((-(d**2) / sigma**2).exp())) / (2 * noise**2) for d in distances)
        expected += float((PRIOR.precision * (pose[row] - PRIOR.mean[row]) ** 2).sum()) / 2
        assert float(found[row]) == pytest.approx(expected, rel=1e-10)


def test_the_surface_hessian_is_j_transposed_beta_j(links, surface_fit):
    pose, data = poses(), surface_fit.data.data
    jacobian = differences(links, lambda trial: links.distance(data, trial), pose, 1e-6)
    beta = (-(links.distance(data, pose) / WIDTHS[:, None]).square()).exp() * surface_fit.data.valid
    # The base is damped by a tenth of one datum: per metre, and per radian at a lever of one metre.
    damping = torch.cat([torch.full((6,), 0.1), torch.zeros(2)]).double() / WIDTHS.square().unsqueeze(-1)
    weights = (beta / NOISE[:, None].square()).unsqueeze(-1)
    expected = jacobian.mT @ (weights * jacobian) + torch.diag(PRIOR.precision) + torch.diag_embed(damping)
    torch.testing.assert_close(surface_fit(pose).hessian, expected, rtol=1e-5, atol=1e-2)


@pytest.mark.parametrize(("name", "step"), [("registration", 1e-5), ("surface_fit", 1e-6)])
def test_gradients_and_costs_alone_are_those_of_the_cost(links, request, name, step):
    objective, pose = request.getfixturevalue(name), poses(4)
    expected = differences(links, lambda trial: objective(trial).cost, pose, step)
    torch.testing.assert_close(objective(pose).gradient, expected, rtol=1e-5, atol=1e-4)
    torch.testing.assert_close(objective.cost(pose), objective(pose).cost, rtol=1e-12, atol=0)


def test_model_points_without_data_and_padding_do_not_count(skin, matches, surface_fit):
    weights, targets = matches.weights.clone(), matches.targets.clone()
    weights[:, ::2], targets[:, ::2] = 1e-13, 1e3
    few = EStep(weights, targets, matches.inlier_posterior, matches.squared_error)
    none = EStep(weights * (weights > 1e-12), matches.targets, matches.inlier_posterior, matches.squared_error)
    moved = surface_fit.data.data.clone()
    moved[1, 30:] += 5.0
    padded = distance_objective(surface_fit.data.surface, moved, surface_fit.data.valid, WIDTHS, NOISE, PRIOR)
    pairs = (
        (registration_objective(skin, few, SIGMA, NO_PRIOR), registration_objective(skin, none, SIGMA, NO_PRIOR)),
        (padded, surface_fit),
    )
    for changed, plain in pairs:
        torch.testing.assert_close(changed(poses()), plain(poses()))


@pytest.mark.parametrize("each", [False, True])
def test_the_prior_is_a_gaussian_on_every_problem(each):
    """One precision for all problems, or one for each."""
    pose, prior = poses(), PRIOR
    if each:
        prior = GaussianPosePrior(prior.mean, torch.stack([prior.precision, 2 * prior.precision]))
    ones = Linearization(torch.ones(2).double(), torch.ones(2, DOFS).double(), torch.ones(2, DOFS, DOFS).double())
    found, weights, offsets = prior.add_to(ones, pose), prior.precision.expand(2, DOFS), pose - prior.mean
    expected = [1 + sum(float(w * o**2) / 2 for w, o in zip(weights[r], offsets[r], strict=True)) for r in range(2)]
    torch.testing.assert_close(found.cost, torch.tensor(expected, dtype=D))
    torch.testing.assert_close(found.gradient, 1 + weights * offsets)
    torch.testing.assert_close(found.hessian, 1 + torch.diag_embed(weights))
    torch.testing.assert_close(prior.cost(pose), found.cost - 1)


def test_the_prior_of_candidates_is_that_of_each():
    candidates = torch.stack([poses(seed) for seed in range(3)], dim=1)
    found = PRIOR.cost(candidates)
    for column in range(3):
        torch.testing.assert_close(found[:, column], PRIOR.cost(candidates[:, column]))
