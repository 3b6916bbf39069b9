"""The objectives of an alignment against literal sums over points, and against differences through ``retract``."""

import pytest
import torch

from torchreg.alignment.objectives import GaussianPosePrior, RegistrationObjective, SurfaceObjective
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.rigid import rigid_matrix
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.skin import BendingSkin
from torchreg.shapes.surface import FusedSurface
from torchreg.solvers.e_step import EStep, expectation
from torchreg.solvers.levenberg_marquardt import Linearization

DOFS = 8


def offset(z):
    return rigid_matrix(torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0.0, z], dtype=torch.float64))


@pytest.fixture(scope="module")
def arm():
    """Three links of 10 cm with two hinges."""
    tree = KinematicTree((
        Joint("upper", -1, offset(0.0)),
        Joint("elbow", 0, offset(0.1), "revolute", (1.0, 0.0, 0.0), -2.0, 2.0),
        Joint("wrist", 1, offset(0.1), "revolute", (0.0, 1.0, 0.0), -2.0, 2.0),
    ))  # fmt: skip
    links = [Primitive("capsule", (0.04, 0.02), offset(0.05))] * 3
    return ArticulatedShape(tree, ["upper", "elbow", "wrist"], links, nu=0.005, dtype=torch.float64).requires_grad_(
        False
    )


@pytest.fixture(scope="module")
def skin(arm):
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(40, 3, generator=generator).double() * torch.tensor([0.04, 0.04, 0.3])
    return BendingSkin(arm, points - torch.tensor([0.02, 0.02, 0.0]), sharpness=2.0)


def poses(count=2, seed=1):
    return 0.4 * torch.randn(count, DOFS, generator=torch.Generator().manual_seed(seed)).double()


def some_prior(count=2):
    precision = torch.tensor([0.0] * 6 + [3.0, 5.0], dtype=torch.float64)
    return GaussianPosePrior(poses(count, 7), precision)


def free_prior(count=2):
    return GaussianPosePrior(torch.zeros(count, DOFS).double(), torch.zeros(DOFS).double())


def data_near(skin, pose, count=60, seed=2):
    generator = torch.Generator().manual_seed(seed)
    posed = skin(pose)[:, torch.randint(len(skin), (count,), generator=generator)]
    return posed + 0.01 * torch.randn(posed.shape, generator=generator).double()


def cost_differences(shape, cost, pose, step=1e-5):
    """Return the gradient (B, D) of a cost of poses by tangent steps, from central differences."""
    columns = []
    for axis in torch.eye(shape.num_dofs, dtype=torch.float64):
        ahead, behind = (cost(shape.retract(pose, (sign * step * axis).expand_as(pose))) for sign in (1, -1))
        columns.append((ahead - behind) / (2 * step))
    return torch.stack(columns, dim=-1)


@pytest.fixture(scope="module")
def registration(skin):
    start = poses()
    sigma = torch.tensor([0.03, 0.05], dtype=torch.float64)
    observed = expectation(skin(start), data_near(skin, poses(seed=3)), sigma)
    return start, sigma, observed


def test_registration_cost_is_equation_20(skin, registration):
    start, sigma, observed = registration
    prior = some_prior()
    found = RegistrationObjective(skin, observed, sigma, prior)(start).cost
    for row in range(2):
        posed, expected = skin(start[row]), 0.0
        for i in range(len(skin)):
            residual = posed[i] - observed.targets[row, i]
            expected += float(observed.weights[row, i] * residual @ residual) / (2 * float(sigma[row]) ** 2)
        for k in range(DOFS):
            expected += float(prior.precision[k] * (start[row, k] - prior.mean[row, k]) ** 2) / 2
        assert float(found[row]) == pytest.approx(expected, rel=1e-10)


def test_registration_gradient_matches_differences(skin, registration):
    start, sigma, observed = registration
    objective = RegistrationObjective(skin, observed, sigma, some_prior())
    pose = poses(seed=4)
    expected = cost_differences(skin.shape, lambda trial: objective(trial).cost, pose)
    torch.testing.assert_close(objective(pose).gradient, expected, rtol=1e-6, atol=1e-6)
    assert not torch.allclose(objective(pose).gradient, objective(start).gradient)


def test_registration_gradient_is_that_of_the_data_likelihood(skin):
    """At the pose of the E-step, EM's objective and -sum_j log(sum_i exp(-r^2 / 2 sigma^2) + c) fall alike."""
    pose, sigma, c = poses(), torch.tensor([0.03, 0.05], dtype=torch.float64), 3.76
    data = data_near(skin, poses(seed=3))

    def likelihood(trial):
        squares = (skin(trial).unsqueeze(-2) - data.unsqueeze(-3)).square().sum(-1)
        kernel = (-squares / (2 * sigma.square())[:, None, None]).exp()
        return -(kernel.sum(-2) + c).log().sum(-1)

    objective = RegistrationObjective(skin, expectation(skin(pose), data, sigma, c), sigma, free_prior())
    expected = cost_differences(skin.shape, likelihood, pose)
    torch.testing.assert_close(objective(pose).gradient, expected, rtol=1e-6, atol=1e-6)


def test_registration_hessian_is_j_transposed_w_j(skin, registration):
    start, sigma, observed = registration
    found = RegistrationObjective(skin, observed, sigma, some_prior())(start).hessian
    columns = []
    for axis in 1e-5 * torch.eye(DOFS, dtype=torch.float64):
        ahead, behind = (skin(skin.shape.retract(start, (sign * axis).expand_as(start))) for sign in (1, -1))
        columns.append((ahead - behind) / 2e-5)
    jacobian = torch.stack(columns, dim=-1).flatten(1, 2)
    weights = (observed.weights / sigma.square().unsqueeze(-1)).repeat_interleave(3, dim=-1)
    expected = jacobian.mT @ (weights.unsqueeze(-1) * jacobian) + torch.diag(some_prior().precision)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-5)


def test_registration_from_given_transforms_is_the_same(skin, registration):
    start, sigma, observed = registration
    objective = RegistrationObjective(skin, observed, sigma, some_prior())
    given = objective.linearize(start, *skin.shape.transform_jacobian(start, chart="tangent"))
    for name in ("cost", "gradient", "hessian"):
        torch.testing.assert_close(getattr(given, name), getattr(objective(start), name), rtol=0, atol=0)


def test_costs_alone_are_those_of_the_linearizations(arm, skin, registration, surface_objective):
    _, sigma, observed = registration
    for objective in (RegistrationObjective(skin, observed, sigma, some_prior()), surface_objective):
        torch.testing.assert_close(objective.cost(poses(seed=6)), objective(poses(seed=6)).cost, rtol=1e-12, atol=0)


def test_the_surface_from_given_distances_is_the_same(arm, surface_objective):
    pose = poses(seed=6)
    known = arm.distance_jacobian(surface_objective.data, pose, chart="tangent")
    given, found = surface_objective.linearize(pose, *known), surface_objective(pose)
    for name in ("cost", "gradient", "hessian"):
        torch.testing.assert_close(getattr(given, name), getattr(found, name), rtol=0, atol=0)


def test_model_points_without_data_do_not_count(skin, registration):
    start, sigma, observed = registration
    weights = observed.weights.clone()
    weights[:, ::2] = 1e-13
    wild = observed.targets.clone()
    wild[:, ::2] += 1e3
    thinned = EStep(weights, wild, observed.inlier_posterior, observed.squared_error)
    calm = EStep(weights * (weights > 1e-12), observed.targets, observed.inlier_posterior, observed.squared_error)
    found, expected = (RegistrationObjective(skin, each, sigma, free_prior())(start) for each in (thinned, calm))
    torch.testing.assert_close(found.cost, expected.cost)
    torch.testing.assert_close(found.gradient, expected.gradient)


@pytest.fixture(scope="module")
def surface_objective(arm, skin):
    data = data_near(skin, poses(), 50)
    valid = torch.ones(2, 50, dtype=torch.bool)
    valid[1, 30:] = False
    sigma, noise = torch.tensor([[0.02, 0.04], [0.004, 0.008]], dtype=torch.float64)
    return SurfaceObjective(FusedSurface(arm), data, valid, sigma, noise, some_prior())


def test_surface_cost_is_the_literal_welsch_function(arm, surface_objective):
    pose = poses()
    found, prior = surface_objective(pose).cost, some_prior()
    for row, (count, sigma, noise) in enumerate(((50, 0.02, 0.004), (30, 0.04, 0.008))):
        distances = arm.distance(surface_objective.data[row, :count], pose[row])
        expected = sum(sigma**2 * (1 - float((-(d**2) / sigma**2).exp())) / (2 * noise**2) for d in distances)
        expected += float((prior.precision * (pose[row] - prior.mean[row]) ** 2).sum()) / 2
        assert float(found[row]) == pytest.approx(expected, rel=1e-10)


def test_surface_gradient_is_that_of_its_cost(arm, surface_objective):
    pose = poses(seed=5)
    expected = cost_differences(arm, lambda trial: surface_objective(trial).cost, pose, 1e-6)
    torch.testing.assert_close(surface_objective(pose).gradient, expected, rtol=1e-5, atol=1e-4)


def test_surface_hessian_is_j_transposed_beta_j(arm, surface_objective):
    pose, objective = poses(), surface_objective
    columns = []
    for axis in 1e-6 * torch.eye(DOFS, dtype=torch.float64):
        ahead, behind = (
            arm.distance(objective.data, arm.retract(pose, (sign * axis).expand_as(pose))) for sign in (1, -1)
        )
        columns.append((ahead - behind) / 2e-6)
    jacobian = torch.stack(columns, dim=-1)
    sigma, noise = torch.tensor([[[0.02], [0.04]], [[0.004], [0.008]]], dtype=torch.float64)
    beta = (-(arm.distance(objective.data, pose) / sigma).square()).exp() * objective.valid / noise.square()
    # The base is held by a tenth of one datum: per metre, and per radian at the lever of one metre.
    anchor = (
        torch.cat([torch.full((6,), 0.1), torch.zeros(DOFS - 6)]).double() / sigma[..., 0].flatten()[:2, None].square()
    )
    expected = jacobian.mT @ (beta.unsqueeze(-1) * jacobian) + torch.diag(some_prior().precision)
    expected = expected + torch.diag_embed(anchor)
    torch.testing.assert_close(objective(pose).hessian, expected, rtol=1e-5, atol=1e-2)


def test_padding_does_not_count(arm, surface_objective):
    moved = surface_objective.data.clone()
    moved[1, 30:] += 5.0
    sigma, noise = torch.tensor([[0.02, 0.04], [0.004, 0.008]], dtype=torch.float64)
    other = SurfaceObjective(FusedSurface(arm), moved, surface_objective.valid, sigma, noise, some_prior())
    for name in ("cost", "gradient", "hessian"):
        torch.testing.assert_close(getattr(other(poses()), name), getattr(surface_objective(poses()), name))


@pytest.mark.parametrize("own", [False, True])
def test_prior_is_a_gaussian_on_every_problem(own):
    """One precision for all problems, or each its own."""
    prior, pose = some_prior(), poses()
    if own:
        prior = GaussianPosePrior(prior.mean, torch.stack([prior.precision, 2 * prior.precision]))
    nothing = Linearization(torch.ones(2).double(), torch.ones(2, DOFS).double(), torch.ones(2, DOFS, DOFS).double())
    found = prior.add_to(nothing, pose)
    weights = prior.precision.expand(2, DOFS)
    offsets = pose - prior.mean
    expected = [1 + sum(float(w * o**2) / 2 for w, o in zip(weights[r], offsets[r], strict=True)) for r in range(2)]
    torch.testing.assert_close(found.cost, torch.tensor(expected, dtype=torch.float64))
    torch.testing.assert_close(found.gradient, 1 + weights * offsets)
    for row in range(2):
        torch.testing.assert_close(found.hessian[row], 1 + torch.diag(weights[row]))
    if not own:
        torch.testing.assert_close(prior.cost(pose), found.cost - 1)


def test_prior_cost_of_candidates_is_that_of_each():
    prior = some_prior()
    candidates = torch.stack([poses(seed=seed) for seed in range(3)], dim=1)
    found = prior.cost(candidates)
    assert found.shape == (2, 3)
    for column in range(3):
        torch.testing.assert_close(found[:, column], prior.cost(candidates[:, column]))
