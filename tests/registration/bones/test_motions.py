"""The T-step: what it recovers, what holds bones, batches, invariances and guards."""

import math

import pytest
import torch

from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.blend import turn_about
from torchreg.registration.bones.joint_moments import JointMoments
from torchreg.registration.bones.motion_problem import BoneProblem, bind
from torchreg.registration.bones.motions import fit_bones

# torch builds its forward-mode rules with torch.jit.script, and warns about it.
JACFWD = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")


@pytest.mark.parametrize("blend", ["linear", "dual_quaternion"])
def test_the_motions_behind_matches_are_found(bones, blend):
    points, _ = bones.limb()
    model, truth = bones.model_of(points, blend), bones.bent()
    with torch.no_grad():
        targets, weights = model(points, truth), model.weights_at(points)
        problem = BoneProblem(points, bind(weights), targets, point_to_point=1.0, normals=None, blend=blend)
    fit = fit_bones(problem, torch.eye(4, dtype=torch.float64).repeat(bones.COUNT, 1, 1), max_steps=30)
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
    problem = BoneProblem(points, bind(weights), targets, normals, seen, **held)
    fit = fit_bones(problem, start, max_steps=50)
    elbow = torch.tensor([[2.0, 0.1, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(
        transform_points(fit.transforms[2], elbow), transform_points(truth[1], elbow), atol=0.02, rtol=0
    )
    alone = fit_bones(
        BoneProblem(points, bind(weights), targets, normals, seen, moments=moments, joint_weight=0.0),
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
    strong = BoneProblem(
        problem.points, problem.binding, problem.targets, problem.normals, anchors=problem.anchors, anchor_weights=1e6
    )
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
    single = BoneProblem(
        **{
            **{name: getattr(problem, name) for name in problem.__dataclass_fields__},
            "targets": problem.targets[1, 2],
            "normals": problem.normals[1, 2],
            "match_weights": problem.match_weights[1, 2],
        }
    )
    alone = fit_bones(single, start[1, 2], max_steps=4, rtol=0.0)
    torch.testing.assert_close(fit.transforms[1, 2], alone.transforms)
    shared = fit_bones(problem, start[0, 0], max_steps=1).transforms
    assert shared.shape == (2, 3, bones.COUNT, 4, 4)
    torch.testing.assert_close(shared[1, 2], fit_bones(single, start[0, 0], max_steps=1).transforms)


def test_one_step_is_newtons_near_the_solution(bones):
    points, normals = bones.limb()
    model, truth = bones.model_of(points), bones.bent()
    with torch.no_grad():
        problem = BoneProblem(points, bind(model.weights_at(points)), model(points, truth), normals, point_to_point=0.5)
    near = turn_about(truth, 1e-3 * bones.draw(bones.COUNT, 6), problem.centers(truth))
    after = fit_bones(problem, near, damping=1e-10, max_steps=1).transforms
    assert float(problem.energy(after)) < 1e-4 * float(problem.energy(near))


def test_turning_and_scaling_everything_changes_nothing_else(bones):
    problem, _ = bones.noisy_problem(batch=())
    start = se3_exp(0.3 * bones.draw(bones.COUNT, 6, seed=6))
    motion = se3_exp(torch.tensor([1.0, 2, 3, 1, -1, 0.5], dtype=torch.float64))
    found = fit_bones(problem, start)
    values = {name: getattr(problem, name) for name in problem.__dataclass_fields__}
    turned = BoneProblem(
        **{
            **values,
            "targets": transform_points(motion, problem.targets),
            "normals": problem.normals @ motion[:3, :3].mT,
            "anchors": motion @ problem.anchors,
        }
    )
    torch.testing.assert_close(fit_bones(turned, motion @ start).transforms, motion @ found.transforms)
    size = 1e3
    moments = problem.moments
    wide_moments = JointMoments(moments.pairs, size**3 * moments.mass, size * moments.center, size**2 * moments.spread)
    wide = BoneProblem(
        **{
            **values,
            "points": size * problem.points,
            "targets": size * problem.targets,
            "moments": wide_moments,
            "bodies": None,
            "anchors": scaled(problem.anchors, size),
        }
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
    fit = fit_bones(BoneProblem(plane, bind(weights), tilted, up), start, max_steps=20, rtol=0.0)
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
    problem = BoneProblem(points, bind(weights), targets, normals, seen, point_to_point=0.2)
    fit = fit_bones(problem, start, max_steps=10)
    assert fit.transforms.dtype == dtype
    assert float(fit.energy) < 1e-9
    assert torch.equal(fit.transforms[[0, 2, 3]], start[:3])
    nothing = fit_bones(BoneProblem(points, bind(weights), targets, normals, torch.zeros_like(seen)), start)
    assert torch.equal(nothing.transforms, start)
