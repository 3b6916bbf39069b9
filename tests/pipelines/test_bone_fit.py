"""The T-step: its linearization against automatic differentiation of the losses, what it recovers, and its guards."""

import math

import pytest
import torch

from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.blend import turn_about
from torchreg.geometry.rigid import rigid_matrix, se3_exp, transform_points
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.sparse_grid import SparseGrid
from torchreg.losses.grid import JointEnergy
from torchreg.losses.scan import ScanDistance
from torchreg.models.grid_lbs import GridLBS
from torchreg.pipelines.bone_fit import BoneProblem, bind, bone_bodies, bone_step, fit_bones

# torch builds its forward-mode rules with torch.jit.script, and warns about it.
JACFWD = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
BONES = 3


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def limb(count=400):
    """A bent limb of three bones, with outward normals of a tube."""
    along, around = torch.rand(2, count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    angle = 2 * math.pi * around
    ring = torch.stack([torch.zeros_like(angle), angle.cos(), 0.7 * angle.sin()], dim=-1)
    points = 0.15 * ring + torch.stack([3 * along, 0.1 * along, 0 * along], dim=-1)
    return points, torch.nn.functional.normalize(ring / torch.tensor([1.0, 1.0, 0.49]), dim=-1)


def model_of(points, blend="linear", resolution=24):
    grid = SparseGrid.from_points(points, resolution, frame="world")
    labels = grid.cell_centers()[:, 0].long().clamp(0, BONES - 1)
    return GridLBS.from_labels(grid, labels, BONES, blend=blend)


def bent(angle=0.6):
    """Motions of the limb: bent at x = 1 and x = 2."""
    motions = [torch.eye(4, dtype=torch.float64)]
    for place in (1.0, 2.0):
        pivot = torch.tensor([place, 0.05 * place, 0], dtype=torch.float64)
        turn = so3_exp(torch.tensor([0.2 * angle, 0, angle], dtype=torch.float64))
        motions.append(motions[-1] @ rigid_matrix(turn, pivot - turn @ pivot))
    return se3_exp(torch.tensor([0.1, -0.2, 0.1, 0.2, 0.1, 0], dtype=torch.float64)) @ torch.stack(motions)


def noisy_problem(blend="linear", share=0.0, batch=(2,)):
    points, _ = limb(60)
    model = model_of(points, blend, 8)
    with torch.no_grad():
        weights = model.weights_at(points)
        moments = model.joint_moments()
    normals = torch.nn.functional.normalize(draw(*batch, 60, 3, seed=1), dim=-1)
    match_weights = draw(*batch, 60, seed=2).clamp_min(0)
    targets = points + 0.1 * draw(*batch, 60, 3, seed=3)
    problem = BoneProblem(
        points,
        bind(weights),
        targets,
        normals,
        match_weights,
        point_to_point=share,
        moments=moments,
        joint_weight=0.7,
        pair_weights=torch.linspace(0.5, 1.5, len(moments.pairs)).double(),
        anchors=se3_exp(0.3 * draw(BONES, 6, seed=4)),
        anchor_weights=torch.tensor([0.1, 0.0, 0.3], dtype=torch.float64),
        blend=blend,
    )
    return problem, model


def energy(problem, model, transforms, index):
    """E from the losses, one problem."""
    moved = model(problem.points, transforms)
    matched = problem.targets[index], problem.normals[index], problem.match_weights[index]
    total = ScanDistance(problem.point_to_point)(moved, *matched)
    total = total + problem.joint_weight * JointEnergy()(transforms, problem.moments, problem.pair_weights)
    for bone in range(BONES):
        off = transform_points(transforms[bone], problem.points) - transform_points(
            problem.anchors[bone], problem.points
        )
        share = problem.binding.weights[:, bone]
        total = total + problem.anchor_weights[bone] * (share * off.square().sum(-1)).sum() / share.sum()
    return total


@pytest.mark.parametrize(("blend", "share"), [("linear", 0), ("linear", 0.3), ("linear", 1), ("dual_quaternion", 0.2)])
def test_the_linearization_is_that_of_the_losses(blend, share):
    problem, model = noisy_problem(blend, float(share))
    transforms = se3_exp(0.3 * draw(2, BONES, 6, seed=5))
    found = problem.linearize(transforms)
    assert found.hessian.shape == (2, 6 * BONES, 6 * BONES)
    torch.testing.assert_close(found.hessian, found.hessian.mT)
    for k in range(2):
        centers = problem.centers(transforms[k])

        def cost(twists, k=k, centers=centers):
            return 0.5 * energy(problem, model, turn_about(transforms[k], twists.reshape(BONES, 6), centers), k)

        zero = torch.zeros(6 * BONES, dtype=torch.float64)
        torch.testing.assert_close(found.cost[k], cost(zero).detach())
        torch.testing.assert_close(found.gradient[k], torch.func.grad(cost)(zero), atol=1e-9, rtol=1e-7)
        torch.testing.assert_close(problem.energy(transforms)[k], energy(problem, model, transforms[k], k).detach())


@JACFWD
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_without_residuals_the_hessian_is_exact(share):
    points, normals = limb(60)
    model, transforms = model_of(points, resolution=8), bent()
    with torch.no_grad():
        moved, moments = model(points, transforms), model.joint_moments()
    problem = BoneProblem(points, bind(model.weights_at(points)), moved, normals, point_to_point=share)
    together = transforms[:1].expand(BONES, 4, 4)
    joints = BoneProblem(points, problem.binding, moved, normals, torch.zeros(60).double(), moments=moments)
    for some, at in ((problem, transforms), (joints, together)):
        centers = some.centers(at)

        def cost(twists, some=some, at=at, centers=centers):
            moved_on = turn_about(at, twists.reshape(BONES, 6), centers)
            if some is joints:
                return 0.5 * JointEnergy()(moved_on, moments)
            return 0.5 * ScanDistance(share)(model(points, moved_on), some.targets, normals)

        expected = torch.func.hessian(cost)(torch.zeros(6 * BONES, dtype=torch.float64))
        torch.testing.assert_close(some.linearize(at).hessian, expected, atol=1e-10, rtol=1e-8)


@pytest.mark.parametrize("blend", ["linear", "dual_quaternion"])
def test_the_motions_behind_matches_are_found(blend):
    points, _ = limb()
    model, truth = model_of(points, blend), bent()
    with torch.no_grad():
        targets, weights = model(points, truth), model.weights_at(points)
        problem = BoneProblem(points, bind(weights), targets, point_to_point=1.0, normals=None, blend=blend)
    fit = fit_bones(problem, torch.eye(4, dtype=torch.float64).repeat(BONES, 1, 1), max_steps=30)
    assert bool(fit.converged)
    # Shares below 1e-4 are left out of the fit.
    torch.testing.assert_close(fit.transforms, truth, atol=1e-4, rtol=0)
    rotation = fit.transforms[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64).expand(BONES, 3, 3))


def test_joints_place_a_bone_without_matches():
    points, normals = limb()
    model, truth = model_of(points), bent()
    with torch.no_grad():
        targets, weights, moments = model(points, truth), model.weights_at(points), model.joint_moments()
    seen = (points[:, 0] < 1.8).double()
    start = torch.eye(4, dtype=torch.float64).repeat(BONES, 1, 1)
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


def test_fixed_bones_stay_and_anchors_hold():
    problem, _ = noisy_problem()
    start = se3_exp(0.1 * draw(2, BONES, 6, seed=6))
    fixed = torch.tensor([True, False, True])
    fit = fit_bones(problem, start, fixed=fixed)
    torch.testing.assert_close(fit.transforms[:, fixed], start[:, fixed])
    assert bool((fit.energy < problem.energy(start)).all())
    strong = BoneProblem(
        problem.points, problem.binding, problem.targets, problem.normals, anchors=problem.anchors, anchor_weights=1e6
    )
    held = fit_bones(strong, start, max_steps=30).transforms
    torch.testing.assert_close(held, problem.anchors.expand(2, BONES, 4, 4), atol=1e-4, rtol=0)


def test_batches_equal_loops_and_energy_never_rises():
    problem, _ = noisy_problem(batch=(2, 3))
    start = se3_exp(0.5 * draw(2, 3, BONES, 6, seed=6))
    fit = fit_bones(problem, start, max_steps=4, rtol=0.0)
    assert fit.transforms.shape == (2, 3, BONES, 4, 4)
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
    shared = bone_step(problem, start[0, 0])
    assert shared.shape == (2, 3, BONES, 4, 4)
    torch.testing.assert_close(shared[1, 2], bone_step(single, start[0, 0]))


def test_one_step_is_newtons_near_the_solution():
    points, normals = limb()
    model, truth = model_of(points), bent()
    with torch.no_grad():
        problem = BoneProblem(points, bind(model.weights_at(points)), model(points, truth), normals, point_to_point=0.5)
    near = turn_about(truth, 1e-3 * draw(BONES, 6), problem.centers(truth))
    after = bone_step(problem, near, damping=1e-10)
    assert float(problem.energy(after)) < 1e-4 * float(problem.energy(near))


def test_turning_and_scaling_everything_changes_nothing_else():
    problem, _ = noisy_problem(batch=())
    start = se3_exp(0.3 * draw(BONES, 6, seed=6))
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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dropped_matches_and_idle_bones_do_no_harm(dtype):
    points, normals = (value.to(dtype) for value in limb())
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


def test_bindings_list_every_pair_once():
    weights = torch.tensor([[0.5, 0.0, 0.5], [0.0, 1.0, 0.0], [0.2, 0.3, 0.5], [1.0, 1e-6, 0.0]])
    found = bind(weights)
    assert found.point.tolist() == [0, 0, 1, 2, 2, 2, 3]
    assert found.bone.tolist() == [0, 2, 1, 0, 1, 2, 0]
    pairs = [(0, 0), (0, 1), (1, 1), (2, 2), (3, 3), (3, 4), (3, 5), (4, 4), (4, 5), (5, 5), (6, 6)]
    assert list(zip(found.first.tolist(), found.second.tolist(), strict=True)) == pairs
    assert found.slot.tolist()[:3] == [0, 2, 8]
    assert found.num_bones == 3


def test_bodies_are_weighted_moments():
    points, weights = draw(20, 3), draw(20, 2, seed=1).abs()
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


def test_bad_input_is_named():
    points, normals = limb(10)
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
    problem = BoneProblem(points, binding, points, normals)
    with pytest.raises(InputError, match="transforms must have shape"):
        fit_bones(problem, torch.eye(4).double().repeat(2, 1, 1))
    with pytest.raises(InputError, match="fixed must have shape"):
        bone_step(problem, torch.eye(4).double()[None], fixed=torch.ones(2).bool())
    with pytest.raises(InputError, match="max_steps must be at least 1"):
        fit_bones(problem, torch.eye(4).double()[None], max_steps=0)
