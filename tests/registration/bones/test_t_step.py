"""The T-step, with and without free joints: its energy against autograd, what it recovers, batches, invariances."""

import math
from dataclasses import replace

import pytest
import torch

from tests.geometry.draws import D, randn
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.blend import turn_about
from torchreg.registration.bones.joint_moments import JointMoments
from torchreg.registration.bones.motions import fit_bones
from torchreg.registration.bones.motions_and_joints import fit_bones_and_joints

# torch builds its forward-mode rules with torch.jit.script, and warns about it.
JACFWD = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
LINEARIZED = ("cost", "gradient", "hessian")


def energy(problem, model, transforms, index=()):
    """E by its definition, of one problem."""
    pairs, moments = problem.correspondences, problem.moments
    off = model(problem.points, transforms) - pairs.targets[index]
    plane = off.square().sum(-1) if pairs.normals is None else (off * pairs.normals[index]).sum(-1).square()
    squares = (1 - pairs.point_to_point) * plane + pairs.point_to_point * off.square().sum(-1)
    total = (pairs.weights[index] * squares).sum() / pairs.weights[index].sum().clamp_min(1e-300)
    difference = transforms[moments.pairs[:, 0]] - transforms[moments.pairs[:, 1]]
    turn = difference[:, :3, :3]
    gap = (turn @ moments.center.unsqueeze(-1)).squeeze(-1) + difference[:, :3, 3]
    joints = gap.square().sum(-1) + ((turn @ moments.spread) * turn).sum((-1, -2))
    joints = joints if problem.pair_weights is None else problem.pair_weights * joints
    total = total + problem.joint_weight * joints.sum()
    if problem.anchors is None:
        return total
    shares = problem.binding.weights / problem.binding.weights.sum(0)
    off = transform_points(transforms, problem.points) - transform_points(problem.anchors, problem.points)
    return total + (problem.anchor_weights * (shares.mT * off.square().sum(-1)).sum(-1)).sum()


def moved(problem, motion, size=1.0):
    """The problem with its targets and anchors moved, and all of it scaled."""
    pairs, moments, bodies = problem.correspondences, problem.moments, problem.bodies
    normals = None if pairs.normals is None else pairs.normals @ motion[:3, :3].mT
    return replace(
        problem,
        points=size * problem.points,
        correspondences=replace(pairs, targets=size * transform_points(motion, pairs.targets), normals=normals),
        moments=JointMoments(moments.pairs, size**3 * moments.mass, size * moments.center, size**2 * moments.spread),
        bodies=replace(bodies, center=size * bodies.center, spread=size**2 * bodies.spread),
        anchors=None if problem.anchors is None else placed(motion @ problem.anchors, size),
    )


def placed(motions, size):
    return torch.cat((motions[..., :3], motions[..., 3:] * torch.tensor([[size]] * 3 + [[1.0]])), dim=-1)


def at_rest(count, dtype=D):
    return torch.eye(4, dtype=dtype).repeat(count, 1, 1)


@pytest.mark.parametrize(("blend", "share"), [("linear", 0), ("linear", 0.3), ("linear", 1), ("dual_quaternion", 0.2)])
def test_the_linearization_is_that_of_the_energy(bones, blend, share):
    problem, model = bones.noisy_problem(blend, float(share))
    transforms, zero = se3_exp(0.3 * randn(2, bones.COUNT, 6, seed=5)), torch.zeros(6 * bones.COUNT, dtype=D)
    found = problem.linearize(transforms)
    torch.testing.assert_close(found.hessian, found.hessian.mT)
    for k in range(2):
        centers = problem.centers(transforms[k])

        def cost(twists, k=k, centers=centers):
            return 0.5 * energy(problem, model, turn_about(transforms[k], twists.reshape(bones.COUNT, 6), centers), k)

        torch.testing.assert_close(found.cost[k], cost(zero).detach())
        torch.testing.assert_close(found.gradient[k], torch.func.grad(cost)(zero), atol=1e-9, rtol=1e-7)
    torch.testing.assert_close(problem.energy(transforms), 2 * found.cost)


@JACFWD
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_without_residuals_the_hessian_is_exact(bones, share):
    points, normals = bones.limb(60)
    model, transforms = bones.model_of(points, resolution=8), bones.bent()
    with torch.no_grad():
        goal, moments, weights = model(points, transforms), model.joint_moments(), model.weights_at(points)
    together = transforms[:1].expand(bones.COUNT, 4, 4)
    for problem, start in (
        (bones.problem_of(points, weights, goal, normals, point_to_point=share), transforms),
        (bones.problem_of(points, weights, goal, normals, torch.zeros(60, dtype=D), moments=moments), together),
    ):
        centers = problem.centers(start)

        def cost(twists, problem=problem, start=start, centers=centers):
            return 0.5 * energy(problem, model, turn_about(start, twists.reshape(bones.COUNT, 6), centers))

        expected = torch.func.hessian(cost)(torch.zeros(6 * bones.COUNT, dtype=D))
        torch.testing.assert_close(problem.linearize(start).hessian, expected, atol=1e-10, rtol=1e-8)


def test_joints_may_be_elsewhere_and_weights_differ_between_problems(bones):
    problem, _ = bones.noisy_problem()
    transforms = se3_exp(0.3 * randn(2, bones.COUNT, 6, seed=5))
    joints = problem.moments.center + 0.1 * randn(len(problem.moments.pairs), 3, seed=6)
    elsewhere = replace(problem, moments=replace(problem.moments, center=joints)).linearize(transforms)
    more = {"pair_weights": 2 * problem.pair_weights, "anchor_weights": 3 * problem.anchor_weights}
    stacked = {name: torch.stack([getattr(problem, name), value]) for name, value in more.items()}
    first, second, both = (replace(problem, **change).linearize(transforms) for change in ({}, more, stacked))
    for name in LINEARIZED:
        torch.testing.assert_close(getattr(problem.linearize(transforms, joints), name), getattr(elsewhere, name))
        torch.testing.assert_close(getattr(both, name)[0], getattr(first, name)[0])
        torch.testing.assert_close(getattr(both, name)[1], getattr(second, name)[1])


def test_bodies_are_weighted_moments_and_inertia_is_the_mean_squared_shift(bones):
    points, weights = randn(20, 3), randn(20, 2, seed=1).abs()
    problem = bones.problem_of(points, torch.nn.functional.pad(weights, (0, 1)), points)
    start, twist = se3_exp(0.3 * randn(3, 6, seed=5)), 1e-4 * randn(6, seed=6)
    goal = turn_about(start, twist.expand(3, 6), problem.centers(start))
    for bone, shares in enumerate([*(weights / weights.sum(0)).mT, torch.full((20,), 1 / 20).double()]):
        torch.testing.assert_close(problem.bodies.center[bone], shares @ points)
        expected = torch.cov(points.mT, correction=0, aweights=shares)
        torch.testing.assert_close(problem.bodies.spread[bone], expected)
        shift = transform_points(goal[bone], points) - transform_points(start[bone], points)
        found = twist @ problem.inertia(start)[bone] @ twist
        torch.testing.assert_close(found, (shares * shift.square().sum(-1)).sum(), rtol=1e-3, atol=0)


@pytest.mark.parametrize("blend", ["linear", "dual_quaternion"])
def test_the_motions_behind_matches_are_found(bones, blend):
    points, _ = bones.limb()
    model, truth = bones.model_of(points, blend), bones.bent()
    with torch.no_grad():
        targets, weights = model(points, truth), model.weights_at(points)
        problem = bones.problem_of(points, weights, targets, point_to_point=1.0, blend=blend)
    fit = fit_bones(problem, at_rest(bones.COUNT), max_steps=30, rtol=1e-4)
    assert bool(fit.converged)
    # Shares below 1e-4 are left out of the fit.
    torch.testing.assert_close(fit.transforms, truth, atol=1e-4, rtol=0)
    rotation = fit.transforms[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=D).expand(bones.COUNT, 3, 3))


def test_joints_place_a_bone_without_matches(bones):
    points, normals = bones.limb()
    model, truth, start = bones.model_of(points), bones.bent(), at_rest(bones.COUNT)
    with torch.no_grad():
        targets, weights, moments = model(points, truth), model.weights_at(points), model.joint_moments()
    kept = (points[:, 0] < 1.8).double()
    problem = bones.problem_of(points, weights, targets, normals, kept, 1.0, moments=moments, joint_weight=0.01)
    fit = fit_bones(problem, start, max_steps=50, rtol=1e-4)
    elbow = torch.tensor([[2.0, 0.1, 0.0]], dtype=D)
    ends = [transform_points(motion, elbow) for motion in (fit.transforms[2], truth[1])]
    torch.testing.assert_close(*ends, atol=0.02, rtol=0)
    alone = fit_bones(replace(problem, joint_weight=0.0), start, max_steps=50)
    torch.testing.assert_close(alone.transforms[2], start[2])


def test_fixed_bones_stay_and_anchors_hold(bones):
    problem, _ = bones.noisy_problem()
    start, fixed = se3_exp(0.1 * randn(2, bones.COUNT, 6, seed=6)), torch.tensor([True, False, True])
    fit = fit_bones(problem, start, fixed=fixed)
    torch.testing.assert_close(fit.transforms[:, fixed], start[:, fixed])
    assert bool((fit.energy < problem.energy(start)).all())
    held = fit_bones(replace(problem, joint_weight=0.0, anchor_weights=1e6), start, max_steps=30).transforms
    torch.testing.assert_close(held, problem.anchors.expand(2, bones.COUNT, 4, 4), atol=1e-4, rtol=0)


def test_batches_equal_loops_and_energy_never_rises(bones):
    problem, _ = bones.noisy_problem(batch=(2, 3))
    start = se3_exp(0.5 * randn(2, 3, bones.COUNT, 6, seed=6))
    fit = fit_bones(problem, start, max_steps=4, rtol=0.0)
    assert fit.transforms.shape == (2, 3, bones.COUNT, 4, 4)
    assert fit.num_steps == 4
    assert bool((fit.energy <= problem.energy(start)).all())
    torch.testing.assert_close(fit.energy, problem.energy(fit.transforms))
    pairs = problem.correspondences
    only = {name: getattr(pairs, name)[1, 2] for name in ("targets", "normals", "weights")}
    single = replace(problem, correspondences=replace(pairs, **only))
    torch.testing.assert_close(fit.transforms[1, 2], fit_bones(single, start[1, 2], max_steps=4, rtol=0.0).transforms)
    shared = fit_bones(problem, start[0, 0], max_steps=1).transforms
    torch.testing.assert_close(shared[1, 2], fit_bones(single, start[0, 0], max_steps=1).transforms)


@pytest.mark.parametrize("size", [1.0, 1e3])
def test_turning_and_scaling_everything_changes_nothing_else(bones, size):
    problem, _ = bones.noisy_problem(batch=())
    start = se3_exp(0.3 * randn(bones.COUNT, 6, seed=6))
    motion = se3_exp(torch.tensor([1.0, 2, 3, 1, -1, 0.5], dtype=D))
    found = fit_bones(moved(problem, motion, size), placed(motion @ start, size)).transforms
    torch.testing.assert_close(found, placed(motion @ fit_bones(problem, start).transforms, size))


@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_flat_matches_do_not_slide(bones, dtype):
    plane = torch.cat([randn(100, 2), torch.zeros(100, 1)], dim=-1).to(dtype)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=dtype).expand(100, 3)
    weights = torch.nn.functional.one_hot((plane[:, 0] > 0).long(), 2).to(dtype)
    tilted = plane + torch.tensor([0.3, 0.2, 0.1], dtype=dtype) + 0.05 * plane[:, :1] * up
    fit = fit_bones(bones.problem_of(plane, weights, tilted, up), at_rest(2, dtype), max_steps=20, rtol=0.0)
    assert float(fit.energy) < 1e-8
    assert float(fit.transforms[:, :2, 3].abs().max()) < 0.02


@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_dropped_matches_and_idle_bones_do_no_harm(bones, dtype):
    points, normals = (value.to(dtype) for value in bones.limb())
    weights = torch.nn.functional.one_hot(torch.ones(len(points)).long(), 4).to(dtype)
    kept, start = (points[:, 0] > 0.3).to(dtype), at_rest(4, dtype)
    targets = points + torch.tensor([0.0, 0.1, 0], dtype=dtype)
    targets, normals = (torch.where(kept.unsqueeze(-1) > 0, value, math.nan) for value in (targets, normals))
    fit = fit_bones(bones.problem_of(points, weights, targets, normals, kept, 0.2), start, max_steps=10)
    assert fit.transforms.dtype == dtype
    assert float(fit.energy) < 1e-9
    assert torch.equal(fit.transforms[[0, 2, 3]], start[:3])
    nothing = fit_bones(bones.problem_of(points, weights, targets, normals, torch.zeros_like(kept)), start)
    assert torch.equal(nothing.transforms, start)


PIVOTS = torch.tensor([[1.0, 0.05, 0.0], [2.0, 0.1, 0.0]], dtype=torch.float64)
SURFACE = PIVOTS + torch.tensor([0.05, 0.1, 0.1], dtype=torch.float64)
FRAMES = 4


@pytest.fixture(scope="module")
def frames(bones):
    """Motions (F, 3, 4, 4) of the limb, bent about changing axes, its problem with joints at the surface, and rest."""
    vectors, motions = 0.5 * randn(FRAMES, 2, 3, seed=7), [at_rest(FRAMES)]
    for joint, pivot in enumerate(PIVOTS):
        motions.append(motions[-1] @ torch.stack([bones.turned_about(pivot, each) for each in vectors[:, joint]]))
    truth = se3_exp(0.2 * randn(FRAMES, 1, 6, seed=8)) @ torch.stack(motions, dim=1)
    points, normals = bones.limb()
    model = bones.model_of(points)
    with torch.no_grad():
        targets, weights = model(points, truth), model.weights_at(points)
    directions = torch.einsum("nb,fbij,nj->fni", weights, truth[..., :3, :3], normals)
    directions = torch.nn.functional.normalize(directions, dim=-1)
    pairs = torch.tensor([[0, 1], [1, 2]])
    moments = JointMoments(pairs, torch.ones(2).double(), SURFACE, torch.zeros(2, 3, 3).double())

    def problem(noise=0.0, share=1.0):
        noisy, terms = targets + noise * randn(*targets.shape, seed=9), {"moments": moments, "joint_weight": 1.0}
        return bones.problem_of(points, weights, noisy, directions, None, share, **terms)

    return truth, problem, torch.eye(4, dtype=D).repeat(FRAMES, bones.COUNT, 1, 1)


def test_nothing_near_has_less_energy(frames, bones):
    _, problem, rest = frames
    problem = replace(problem(0.02, 0.3), pair_weights=torch.tensor([0.5, 2.0]).double(), joint_weight=0.1)
    fit = fit_bones_and_joints(problem, rest, SURFACE, regularization=0.05, max_steps=60, rtol=0.0)
    middles, model = problem.centers(fit.transforms), bones.model_of(problem.points)

    def total(twists, centers):
        motions = turn_about(fit.transforms, twists, middles)
        placed = replace(problem, moments=replace(problem.moments, center=centers))
        away = FRAMES * problem.joint_weight * 0.05 * (centers - SURFACE).square().sum()
        return away + sum(energy(placed, model, motions[frame], frame) for frame in range(FRAMES))

    zero = torch.zeros(FRAMES, bones.COUNT, 6, dtype=torch.float64)
    for slope in torch.func.grad(total, argnums=(0, 1))(zero, fit.centers):
        torch.testing.assert_close(slope, torch.zeros_like(slope), atol=2e-6, rtol=0)
    away = FRAMES * problem.joint_weight * 0.05 * (fit.centers - SURFACE).square().sum()
    torch.testing.assert_close(fit.energy.sum() + away, total(zero, fit.centers).detach())


def test_a_motion_of_everything_changes_no_joint(frames):
    _, problem, rest = frames
    problem, motion = problem(0.02, 0.2), se3_exp(randn(6, seed=10))
    alone = fit_bones_and_joints(problem, rest, SURFACE)
    turned = fit_bones_and_joints(moved(problem, motion), motion @ rest, SURFACE)
    torch.testing.assert_close(turned.centers, alone.centers)
    torch.testing.assert_close(turned.transforms, motion @ alone.transforms)


@pytest.mark.parametrize("reach", [9.0, 1.8])
def test_joints_behind_motions_are_found_and_bones_without_matches_follow_them(frames, reach):
    truth, problem, rest = frames
    problem = problem()
    kept = (problem.points[:, 0] < reach).double().expand(FRAMES, -1)
    problem = replace(problem, correspondences=replace(problem.correspondences, weights=kept))
    fit = fit_bones_and_joints(problem, rest, SURFACE, regularization=1e-9, max_steps=40, rtol=1e-9)
    ends = [transform_points(fit.transforms[:, bone], fit.centers[1:]) for bone in (1, 2)]
    torch.testing.assert_close(*ends, atol=1e-3, rtol=0)
    torch.testing.assert_close(fit.transforms[:, :2], truth[:, :2], atol=1e-3, rtol=0)
    if reach == 9.0:
        torch.testing.assert_close(fit.centers, PIVOTS, atol=1e-3, rtol=0)
        torch.testing.assert_close(fit.transforms, truth, atol=1e-3, rtol=0)
