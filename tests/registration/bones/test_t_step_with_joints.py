"""The T-step with free joints: what it finds, that nothing is lower, invariances."""

from dataclasses import replace

import torch

from torchreg.geometry.rigid import rigid_matrix, se3_exp, transform_points
from torchreg.geometry.rotation import so3_exp
from torchreg.registration.blend import turn_about
from torchreg.registration.bones.correspondences import ScanDistance
from torchreg.registration.bones.joint_moments import JointMoments
from torchreg.registration.bones.joints import find_joints
from torchreg.registration.bones.motions import fit_bones
from torchreg.registration.bones.motions_and_joints import fit_bones_and_joints

PIVOTS = torch.tensor([[1.0, 0.05, 0.0], [2.0, 0.1, 0.0]], dtype=torch.float64)
SURFACE = PIVOTS + torch.tensor([0.05, 0.1, 0.1], dtype=torch.float64)
FRAMES = 4


def poses(bones, angle=0.5):
    """Motions (F, 3, 4, 4) of the limb, bent about changing axes."""
    turns = so3_exp(angle * bones.draw(FRAMES, 2, 3, seed=7))
    motions = [torch.eye(4, dtype=torch.float64).repeat(FRAMES, 1, 1)]
    for joint, pivot in enumerate(PIVOTS):
        turn = turns[:, joint]
        motions.append(motions[-1] @ rigid_matrix(turn, pivot - turn @ pivot))
    return se3_exp(0.2 * bones.draw(FRAMES, 1, 6, seed=8)) @ torch.stack(motions, dim=1)


def problem_of(bones, noise=0.0, share=1.0, joint_weight=1.0):
    """Matches of the limb in four frames, its joints put at the surface."""
    points, normals = bones.limb()
    model, truth = bones.model_of(points), poses(bones)
    with torch.no_grad():
        targets, weights = model(points, truth), model.weights_at(points)
    targets = targets + noise * bones.draw(*targets.shape, seed=9)
    turned = torch.einsum("nb,fbij,nj->fni", weights, truth[..., :3, :3], normals)
    pairs = torch.tensor([[0, 1], [1, 2]])
    moments = JointMoments(pairs, torch.ones(2).double(), SURFACE, torch.zeros(2, 3, 3).double())
    return bones.problem_of(
        points, weights, targets, torch.nn.functional.normalize(turned, dim=-1), point_to_point=share,
        moments=moments, joint_weight=joint_weight,
    )  # fmt: skip


def start(bones):
    """Motions (F, 3, 4, 4) of the limb at rest, and its joints at the surface."""
    return torch.eye(4, dtype=torch.float64).repeat(FRAMES, bones.COUNT, 1, 1), SURFACE


def test_joints_behind_motions_are_found(bones):
    problem = problem_of(bones)
    fit = fit_bones_and_joints(problem, *start(bones), regularization=1e-9, max_steps=40, rtol=1e-9)
    torch.testing.assert_close(fit.centers, PIVOTS, atol=1e-3, rtol=0)
    torch.testing.assert_close(fit.transforms, poses(bones), atol=1e-3, rtol=0)
    assert bool((fit.energy < 1e-6).all())


def test_nothing_near_has_less_energy(bones):
    problem = replace(problem_of(bones, 0.02, 0.3), pair_weights=torch.tensor([0.5, 2.0]).double(), joint_weight=0.1)
    fit = fit_bones_and_joints(problem, *start(bones), regularization=0.05, max_steps=60, rtol=0.0)
    middles = problem.centers(fit.transforms)

    def energy(twists, centers):
        motions = turn_about(fit.transforms, twists, middles)
        moved = torch.einsum("nb,fnbi->fni", problem.binding.weights, images(motions, problem.points))
        pairs = problem.correspondences
        total = ScanDistance(pairs.point_to_point)(moved, pairs.targets, pairs.normals).sum()
        gaps = [transform_points(motions[:, bones], centers.unsqueeze(-2)) for bones in problem.moments.pairs.mT]
        total = (
            total
            + problem.joint_weight * (problem.pair_weights * (gaps[0] - gaps[1]).squeeze(-2).square().sum(-1)).sum()
        )
        away = (centers - problem.moments.center).square().sum()
        return total + FRAMES * problem.joint_weight * 0.05 * away

    zero = torch.zeros(FRAMES, bones.COUNT, 6, dtype=torch.float64)
    slopes = torch.func.grad(energy, argnums=(0, 1))(zero, fit.centers)
    for slope in slopes:
        torch.testing.assert_close(slope, torch.zeros_like(slope), atol=2e-6, rtol=0)
    away = (fit.centers - problem.moments.center).square().sum()
    total = fit.energy.sum() + FRAMES * problem.joint_weight * 0.05 * away
    torch.testing.assert_close(total, energy(zero, fit.centers))


def images(motions, points):
    """Places (F, N, B, 3) of points under every motion."""
    return transform_points(motions, points).transpose(-2, -3)


def test_taking_turns_is_slower_where_joints_are_stiff(bones):
    problem, (first, centers) = problem_of(bones, noise=0.01, joint_weight=1.0), start(bones)
    best = fit_bones_and_joints(problem, first, centers, max_steps=60, rtol=0.0)
    together = fit_bones_and_joints(problem, first, centers, max_steps=8, rtol=0.0)
    transforms, moments = first, problem.moments
    for _ in range(8):
        transforms = fit_bones(replace(problem, moments=moments), transforms, max_steps=1).transforms
        moments = replace(moments, center=find_joints(problem.moments, transforms, regularization=1e-3).centers)
    errors = [(found - best.centers).norm(dim=-1).max() for found in (together.centers, moments.center)]
    assert errors[0] < 1e-3 * errors[1]


def test_a_motion_of_everything_changes_nothing(bones):
    problem, motion = problem_of(bones, 0.02, 0.2), se3_exp(bones.draw(6, seed=10))
    (rest, centers), pairs = start(bones), problem.correspondences
    alone = fit_bones_and_joints(problem, rest, centers)
    targets, normals = transform_points(motion, pairs.targets), pairs.normals @ motion[:3, :3].mT
    turned = replace(problem, correspondences=replace(pairs, targets=targets, normals=normals))
    moved = fit_bones_and_joints(turned, motion @ rest, centers)
    torch.testing.assert_close(moved.centers, alone.centers)
    torch.testing.assert_close(moved.transforms, motion @ alone.transforms)


def test_energy_falls_from_any_start_and_few_steps_are_enough(bones):
    problem = problem_of(bones, 0.02, 0.2)
    first = se3_exp(0.3 * bones.draw(FRAMES, bones.COUNT, 6, seed=11))
    energies = [fit_bones_and_joints(problem, first, PIVOTS, max_steps=steps, rtol=0.0).energy for steps in (1, 3, 9)]
    assert energies[0].sum() > energies[1].sum() > energies[2].sum()
    done = fit_bones_and_joints(problem, first, PIVOTS, max_steps=100)
    torch.testing.assert_close(done.energy.sum(), energies[2].sum(), rtol=0.01, atol=0)


def test_bones_without_matches_follow_their_joints(bones):
    problem = problem_of(bones)
    seen = (problem.points[:, 0] < 1.8).double().expand(FRAMES, -1)
    seen = replace(problem, correspondences=replace(problem.correspondences, weights=seen))
    fit = fit_bones_and_joints(seen, start(bones)[0], PIVOTS, max_steps=40, rtol=1e-9)
    ends = [transform_points(fit.transforms[:, bone], fit.centers[1:]) for bone in (1, 2)]
    torch.testing.assert_close(*ends, atol=1e-3, rtol=0)
