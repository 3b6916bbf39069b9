"""The T-step: its energy against automatic differentiation of the losses, what it recovers, batches, invariances."""

import math
from dataclasses import replace

import pytest
import torch

from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.blend import turn_about
from torchreg.registration.bones.correspondences import Correspondences, ScanDistance
from torchreg.registration.bones.grid_losses import JointEnergy
from torchreg.registration.bones.joint_moments import JointMoments
from torchreg.registration.bones.motion_problem import Binding, BoneBodies
from torchreg.registration.bones.motions import fit_bones

# torch builds its forward-mode rules with torch.jit.script, and warns about it.
JACFWD = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")


def energy(bones, problem, model, transforms, index):
    """E from the losses, one problem."""
    moved = model(problem.points, transforms)
    pairs = problem.correspondences
    matched = pairs.targets[index], pairs.normals[index], pairs.weights[index]
    total = ScanDistance(pairs.point_to_point)(moved, *matched)
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
    weights = model.weights_at(points)
    problem = bones.problem_of(points, weights, moved, normals, point_to_point=share)
    together = transforms[:1].expand(bones.COUNT, 4, 4)
    joints = bones.problem_of(points, weights, moved, normals, torch.zeros(60).double(), moments=moments)
    for some, at in ((problem, transforms), (joints, together)):
        centers = some.centers(at)

        def cost(twists, some=some, at=at, centers=centers):
            moved_on = turn_about(at, twists.reshape(bones.COUNT, 6), centers)
            if some is joints:
                return 0.5 * JointEnergy()(moved_on, moments)
            return 0.5 * ScanDistance(share)(model(points, moved_on), moved, normals)

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
    found = Binding.from_weights(weights)
    assert found.point.tolist() == [0, 0, 1, 2, 2, 2, 3]
    assert found.bone.tolist() == [0, 2, 1, 0, 1, 2, 0]
    pairs = [(0, 0), (0, 1), (1, 1), (2, 2), (3, 3), (3, 4), (3, 5), (4, 4), (4, 5), (5, 5), (6, 6)]
    assert list(zip(found.first.tolist(), found.second.tolist(), strict=True)) == pairs
    assert found.block.tolist()[:3] == [0, 2, 8]
    assert found.num_bones == 3


def test_bodies_are_weighted_moments(bones):
    points, weights = bones.draw(20, 3), bones.draw(20, 2, seed=1).abs()
    weights = torch.cat([weights, torch.zeros(20, 1).double()], dim=1)
    bodies = BoneBodies.from_weights(points, weights)
    for bone in range(2):
        share = weights[:, bone] / weights[:, bone].sum()
        middle = (share[:, None] * points).sum(0)
        torch.testing.assert_close(bodies.center[bone], middle)
        expected = torch.cov(points.mT, correction=0, aweights=share)
        torch.testing.assert_close(bodies.spread[bone], expected)
    torch.testing.assert_close(bodies.center[2], points.mean(0))
    torch.testing.assert_close(bodies.spread[2], torch.cov(points.mT, correction=0))


def test_weights_of_joints_and_anchors_differ_between_problems(bones):
    problem, _ = bones.noisy_problem()
    transforms = se3_exp(0.3 * bones.draw(2, bones.COUNT, 6, seed=5))
    pairs, anchors = problem.pair_weights, problem.anchor_weights
    both = replace(
        problem,
        pair_weights=torch.stack([pairs, 2 * pairs]),
        anchor_weights=torch.stack([anchors, 3 * anchors]),
    ).linearize(transforms)
    other = replace(problem, pair_weights=2 * pairs, anchor_weights=3 * anchors).linearize(transforms)
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


@pytest.mark.parametrize("blend", ["linear", "dual_quaternion"])
def test_the_motions_behind_matches_are_found(bones, blend):
    points, _ = bones.limb()
    model, truth = bones.model_of(points, blend), bones.bent()
    with torch.no_grad():
        targets, weights = model(points, truth), model.weights_at(points)
        problem = bones.problem_of(points, weights, targets, point_to_point=1.0, blend=blend)
    fit = fit_bones(problem, torch.eye(4, dtype=torch.float64).repeat(bones.COUNT, 1, 1), max_steps=30, rtol=1e-4)
    assert bool(fit.converged)
    # Shares below 1e-4 are left out of the fit.
    torch.testing.assert_close(fit.transforms, truth, atol=1e-4, rtol=0)
    rotation = fit.transforms[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64).expand(bones.COUNT, 3, 3))


def test_joints_place_a_bone_without_matches(bones):
    points, normals = bones.limb()
    model, truth = bones.model_of(points), bones.bent()
    with torch.no_grad():
        targets, weights, moments = model(points, truth), model.weights_at(points), model.joint_moments()
    seen = (points[:, 0] < 1.8).double()
    start = torch.eye(4, dtype=torch.float64).repeat(bones.COUNT, 1, 1)
    held = {"point_to_point": 1.0, "moments": moments, "joint_weight": 0.01}
    problem = bones.problem_of(points, weights, targets, normals, seen, **held)
    fit = fit_bones(problem, start, max_steps=50, rtol=1e-4)
    elbow = torch.tensor([[2.0, 0.1, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(
        transform_points(fit.transforms[2], elbow), transform_points(truth[1], elbow), atol=0.02, rtol=0
    )
    alone = fit_bones(
        bones.problem_of(points, weights, targets, normals, seen, moments=moments, joint_weight=0.0),
        start,
        max_steps=50,
    )
    torch.testing.assert_close(alone.transforms[2], start[2])


def test_fixed_bones_stay_and_anchors_hold(bones):
    problem, _ = bones.noisy_problem()
    start = se3_exp(0.1 * bones.draw(2, bones.COUNT, 6, seed=6))
    fixed = torch.tensor([True, False, True])
    fit = fit_bones(problem, start, fixed=fixed)
    torch.testing.assert_close(fit.transforms[:, fixed], start[:, fixed])
    assert bool((fit.energy < problem.energy(start)).all())
    strong = replace(problem, joint_weight=0.0, anchor_weights=1e6)
    held = fit_bones(strong, start, max_steps=30).transforms
    torch.testing.assert_close(held, problem.anchors.expand(2, bones.COUNT, 4, 4), atol=1e-4, rtol=0)


def test_batches_equal_loops_and_energy_never_rises(bones):
    problem, _ = bones.noisy_problem(batch=(2, 3))
    start = se3_exp(0.5 * bones.draw(2, 3, bones.COUNT, 6, seed=6))
    fit = fit_bones(problem, start, max_steps=4, rtol=0.0)
    assert fit.transforms.shape == (2, 3, bones.COUNT, 4, 4)
    assert fit.num_steps == 4
    assert bool((fit.energy <= problem.energy(start)).all())
    torch.testing.assert_close(fit.energy, problem.energy(fit.transforms))
    pairs = problem.correspondences
    of_one = Correspondences(pairs.targets[1, 2], pairs.normals[1, 2], pairs.weights[1, 2], pairs.point_to_point)
    single = replace(problem, correspondences=of_one)
    alone = fit_bones(single, start[1, 2], max_steps=4, rtol=0.0)
    torch.testing.assert_close(fit.transforms[1, 2], alone.transforms)
    shared = fit_bones(problem, start[0, 0], max_steps=1).transforms
    assert shared.shape == (2, 3, bones.COUNT, 4, 4)
    torch.testing.assert_close(shared[1, 2], fit_bones(single, start[0, 0], max_steps=1).transforms)


def test_one_step_is_newtons_near_the_solution(bones):
    points, normals = bones.limb()
    model, truth = bones.model_of(points), bones.bent()
    with torch.no_grad():
        problem = bones.problem_of(points, model.weights_at(points), model(points, truth), normals, point_to_point=0.5)
    near = turn_about(truth, 1e-3 * bones.draw(bones.COUNT, 6), problem.centers(truth))
    after = fit_bones(problem, near, damping=1e-10, max_steps=1).transforms
    assert float(problem.energy(after)) < 1e-4 * float(problem.energy(near))


def test_turning_and_scaling_everything_changes_nothing_else(bones):
    problem, _ = bones.noisy_problem(batch=())
    start = se3_exp(0.3 * bones.draw(bones.COUNT, 6, seed=6))
    motion = se3_exp(torch.tensor([1.0, 2, 3, 1, -1, 0.5], dtype=torch.float64))
    found = fit_bones(problem, start)
    pairs = problem.correspondences
    targets, normals = transform_points(motion, pairs.targets), pairs.normals @ motion[:3, :3].mT
    turned = replace(
        problem, correspondences=replace(pairs, targets=targets, normals=normals), anchors=motion @ problem.anchors
    )
    torch.testing.assert_close(fit_bones(turned, motion @ start).transforms, motion @ found.transforms)
    size = 1e3
    moments = problem.moments
    wide_moments = JointMoments(moments.pairs, size**3 * moments.mass, size * moments.center, size**2 * moments.spread)
    wide = replace(
        problem,
        points=size * problem.points,
        correspondences=replace(pairs, targets=size * pairs.targets),
        moments=wide_moments,
        bodies=BoneBodies(size * problem.bodies.center, size**2 * problem.bodies.spread),
        anchors=scaled(problem.anchors, size),
    )
    torch.testing.assert_close(fit_bones(wide, scaled(start, size)).transforms, scaled(found.transforms, size))


def scaled(motions, size):
    motions = motions.clone()
    motions[..., :3, 3] *= size
    return motions


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_flat_matches_do_not_slide(bones, dtype):
    plane = torch.cat([bones.draw(100, 2), torch.zeros(100, 1)], dim=-1).to(dtype)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=dtype).expand(100, 3)
    weights = torch.nn.functional.one_hot((plane[:, 0] > 0).long(), 2).to(dtype)
    start = torch.eye(4, dtype=dtype).repeat(2, 1, 1)
    tilted = plane + torch.tensor([0.3, 0.2, 0.1], dtype=dtype) + 0.05 * plane[:, :1] * up
    fit = fit_bones(bones.problem_of(plane, weights, tilted, up), start, max_steps=20, rtol=0.0)
    assert float(fit.energy) < 1e-8
    assert float(fit.transforms[:, :2, 3].abs().max()) < 0.02


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dropped_matches_and_idle_bones_do_no_harm(bones, dtype):
    points, normals = (value.to(dtype) for value in bones.limb())
    weights = torch.zeros(len(points), 4, dtype=dtype)
    weights[:, 1] = 1
    targets = points + torch.tensor([0.0, 0.1, 0], dtype=dtype)
    seen = (points[:, 0] > 0.3).to(dtype)
    targets = torch.where(seen.unsqueeze(-1) > 0, targets, math.nan)
    normals = torch.where(seen.unsqueeze(-1) > 0, normals, math.nan)
    start = torch.eye(4, dtype=dtype).repeat(4, 1, 1)
    problem = bones.problem_of(points, weights, targets, normals, seen, point_to_point=0.2)
    fit = fit_bones(problem, start, max_steps=10)
    assert fit.transforms.dtype == dtype
    assert float(fit.energy) < 1e-9
    assert torch.equal(fit.transforms[[0, 2, 3]], start[:3])
    nothing = fit_bones(bones.problem_of(points, weights, targets, normals, torch.zeros_like(seen)), start)
    assert torch.equal(nothing.transforms, start)
