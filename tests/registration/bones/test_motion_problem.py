"""The energy of the T-step: its linearization against automatic differentiation of the losses, and its parts."""

from dataclasses import replace

import pytest
import torch

from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.blend import turn_about
from torchreg.registration.bones.distance_loss import ScanDistance
from torchreg.registration.bones.grid_losses import JointEnergy
from torchreg.registration.bones.motion_problem import BoneProblem, bind, bone_bodies
from torchreg.registration.bones.motions import fit_bones

# torch builds its forward-mode rules with torch.jit.script, and warns about it.
JACFWD = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")


def energy(bones, problem, model, transforms, index):
    """E from the losses, one problem."""
    moved = model(problem.points, transforms)
    matched = problem.targets[index], problem.normals[index], problem.match_weights[index]
    total = ScanDistance(problem.point_to_point)(moved, *matched)
    total = total + problem.joint_weight * JointEnergy()(transforms, problem.moments, problem.pair_weights)
    for bone in range(bones.COUNT):
        off = transform_points(transforms[bone], problem.points) - transform_points(
            problem.anchors[bone], problem.points
        )
        share = problem.binding.weights[:, bone]
        total = total + problem.anchor_weights[bone] * (share * off.square().sum(-1)).sum() / share.sum()
    return total


@pytest.mark.parametrize(("blend", "share"), [("linear", 0), ("linear", 0.3), ("linear", 1), ("dual_quaternion", 0.2)])
def test_the_linearization_is_that_of_the_losses(bones, blend, share):
    problem, model = bones.noisy_problem(blend, float(share))
    transforms = se3_exp(0.3 * bones.draw(2, bones.COUNT, 6, seed=5))
    found = problem.linearize(transforms)
    assert found.hessian.shape == (2, 6 * bones.COUNT, 6 * bones.COUNT)
    torch.testing.assert_close(found.hessian, found.hessian.mT)
    for k in range(2):
        centers = problem.centers(transforms[k])

        def cost(twists, k=k, centers=centers):
            return 0.5 * energy(
                bones, problem, model, turn_about(transforms[k], twists.reshape(bones.COUNT, 6), centers), k
            )

        zero = torch.zeros(6 * bones.COUNT, dtype=torch.float64)
        torch.testing.assert_close(found.cost[k], cost(zero).detach())
        torch.testing.assert_close(found.gradient[k], torch.func.grad(cost)(zero), atol=1e-9, rtol=1e-7)
        torch.testing.assert_close(
            problem.energy(transforms)[k], energy(bones, problem, model, transforms[k], k).detach()
        )


@JACFWD
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_without_residuals_the_hessian_is_exact(bones, share):
    points, normals = bones.limb(60)
    model, transforms = bones.model_of(points, resolution=8), bones.bent()
    with torch.no_grad():
        moved, moments = model(points, transforms), model.joint_moments()
    problem = BoneProblem(points, bind(model.weights_at(points)), moved, normals, point_to_point=share)
    together = transforms[:1].expand(bones.COUNT, 4, 4)
    joints = BoneProblem(points, problem.binding, moved, normals, torch.zeros(60).double(), moments=moments)
    for some, at in ((problem, transforms), (joints, together)):
        centers = some.centers(at)

        def cost(twists, some=some, at=at, centers=centers):
            moved_on = turn_about(at, twists.reshape(bones.COUNT, 6), centers)
            if some is joints:
                return 0.5 * JointEnergy()(moved_on, moments)
            return 0.5 * ScanDistance(share)(model(points, moved_on), some.targets, normals)

        expected = torch.func.hessian(cost)(torch.zeros(6 * bones.COUNT, dtype=torch.float64))
        torch.testing.assert_close(some.linearize(at).hessian, expected, atol=1e-10, rtol=1e-8)


def test_joints_may_be_elsewhere(bones):
    problem, _ = bones.noisy_problem()
    transforms = se3_exp(0.3 * bones.draw(2, bones.COUNT, 6, seed=5))
    joints = problem.moments.center + 0.1 * bones.draw(len(problem.moments.pairs), 3, seed=6)
    moved = replace(problem, moments=replace(problem.moments, center=joints))
    found, expected = problem.linearize(transforms, joints), moved.linearize(transforms)
    for name in ("cost", "gradient", "hessian"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name))
    torch.testing.assert_close(problem.linearize(transforms).cost, problem.energy(transforms) / 2)


def test_bindings_list_every_pair_once(bones):
    weights = torch.tensor([[0.5, 0.0, 0.5], [0.0, 1.0, 0.0], [0.2, 0.3, 0.5], [1.0, 1e-6, 0.0]])
    found = bind(weights)
    assert found.point.tolist() == [0, 0, 1, 2, 2, 2, 3]
    assert found.bone.tolist() == [0, 2, 1, 0, 1, 2, 0]
    pairs = [(0, 0), (0, 1), (1, 1), (2, 2), (3, 3), (3, 4), (3, 5), (4, 4), (4, 5), (5, 5), (6, 6)]
    assert list(zip(found.first.tolist(), found.second.tolist(), strict=True)) == pairs
    assert found.slot.tolist()[:3] == [0, 2, 8]
    assert found.num_bones == 3


def test_bodies_are_weighted_moments(bones):
    points, weights = bones.draw(20, 3), bones.draw(20, 2, seed=1).abs()
    weights = torch.cat([weights, torch.zeros(20, 1).double()], dim=1)
    bodies = bone_bodies(points, weights)
    for bone in range(2):
        share = weights[:, bone] / weights[:, bone].sum()
        middle = (share[:, None] * points).sum(0)
        torch.testing.assert_close(bodies.middle[bone], middle)
        expected = torch.cov(points.mT, correction=0, aweights=share)
        torch.testing.assert_close(bodies.spread[bone], expected)
    torch.testing.assert_close(bodies.middle[2], points.mean(0))
    torch.testing.assert_close(bodies.spread[2], torch.cov(points.mT, correction=0))


def test_bad_input_is_named(bones):
    points, normals = bones.limb(10)
    binding = bind(torch.ones(10, 1).double())
    with pytest.raises(InputError, match="normals are needed"):
        BoneProblem(points, binding, points)
    with pytest.raises(InputError, match="targets must have shape"):
        BoneProblem(points, binding, points[1:], normals)
    with pytest.raises(InputError, match="point_to_point must be"):
        BoneProblem(points, binding, points, normals, point_to_point=2.0)
    with pytest.raises(InputError, match="joint_weight must be"):
        BoneProblem(points, binding, points, normals, joint_weight=-1.0)
    with pytest.raises(InputError, match="blend must be one of"):
        BoneProblem(points, binding, points, normals, blend="none")
    with pytest.raises(InputError, match="pair_weights must have shape"):
        BoneProblem(points, binding, points, normals, pair_weights=torch.ones(3))
    with pytest.raises(InputError, match="anchors must have shape"):
        BoneProblem(points, binding, points, normals, anchors=torch.eye(4))
    with pytest.raises(InputError, match="match_weights must have shape"):
        BoneProblem(points, binding, points, normals, torch.ones(3))
    with pytest.raises(InputTypeError, match="targets is"):
        BoneProblem(points, binding, points.float(), normals)
    with pytest.raises(InputError, match="weights must have shape"):
        bind(torch.ones(3))
    with pytest.raises(InputError, match="match_weights must not be negative, got -1"):
        BoneProblem(points, binding, points, normals, -torch.ones(10))
    with pytest.raises(InputError, match="anchor_weights must not be negative"):
        BoneProblem(points, binding, points, normals, anchors=torch.eye(4)[None], anchor_weights=-0.5)
    problem = BoneProblem(points, binding, points, normals)
    with pytest.raises(InputError, match="transforms must have shape"):
        fit_bones(problem, torch.eye(4).double().repeat(2, 1, 1))
    with pytest.raises(InputError, match="fixed must have shape"):
        fit_bones(problem, torch.eye(4).double()[None], fixed=torch.ones(2).bool())
    with pytest.raises(InputError, match="max_steps must be at least 1"):
        fit_bones(problem, torch.eye(4).double()[None], max_steps=0)


def test_weights_of_joints_and_anchors_differ_between_problems(bones):
    problem, _ = bones.noisy_problem()
    transforms = se3_exp(0.3 * bones.draw(2, bones.COUNT, 6, seed=5))
    values = {name: getattr(problem, name) for name in problem.__dataclass_fields__}
    pairs, anchors = problem.pair_weights, problem.anchor_weights
    both = BoneProblem(
        **{
            **values,
            "pair_weights": torch.stack([pairs, 2 * pairs]),
            "anchor_weights": torch.stack([anchors, 3 * anchors]),
        }
    ).linearize(transforms)
    other = BoneProblem(**{**values, "pair_weights": 2 * pairs, "anchor_weights": 3 * anchors}).linearize(transforms)
    first = problem.linearize(transforms)
    for name in ("cost", "gradient", "hessian"):
        found = getattr(both, name)
        torch.testing.assert_close(found[0], getattr(first, name)[0])
        torch.testing.assert_close(found[1], getattr(other, name)[1])


def test_the_inertia_is_the_mean_squared_shift(bones):
    problem, _ = bones.noisy_problem()
    start, twists = se3_exp(0.3 * bones.draw(bones.COUNT, 6, seed=5)), 1e-4 * bones.draw(bones.COUNT, 6, seed=6)
    moved = turn_about(start, twists, problem.centers(start))
    shares = problem.binding.weights / problem.binding.weights.sum(0)
    for bone in range(bones.COUNT):
        shift = transform_points(moved[bone], problem.points) - transform_points(start[bone], problem.points)
        expected = (shares[:, bone] * shift.square().sum(-1)).sum()
        found = twists[bone] @ problem.inertia(start)[bone] @ twists[bone]
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=0)
