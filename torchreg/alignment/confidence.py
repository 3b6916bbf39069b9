"""How surely poses that were found without a start are right: rivals, data left beside the surface, limbs not shown."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.alignment.annealed_em import SIGMA_PER_NOISE, pose_covariance, surface_noise
from torchreg.alignment.local_search import clustered_data
from torchreg.alignment.problem import INLIER_SHARE, AlignProblem
from torchreg.shapes.limbs import Limb, find_limbs
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.solvers.robust import welsch_weight

# A pose is right if the ends of its limbs lie within this share of the size of where they are, on average.
_TOLERANCE = 0.04
# A lead of this many data over a different pose makes sure; data left beside this share of those on the surface do not.
_SURE_LEAD, _DOUBTFUL_SHARE = 4.0, 0.1
# A limb stands where it does, and not somewhere else, by this many data that nothing else explains.
_SURE_DATA = 4.0
# Data beside the surface are off it by more than the first share of the size, and less than the second; more than the
# last share of all are too many. Where the noise counts, they are also off by so many of its deviations.
_BESIDE, _MANY_BESIDE, _BESIDE_NOISES = (0.012, 0.05), 0.025, 3.0
# What is known of a pose without data: joints in radians, slides and the base's place in shares of the size.
_TURN_STD, _SHIFT_STD = 1.0, 0.5
# More data show no more limbs.
_SHOWN_DATA = 2000


def pose_confidence(problem: AlignProblem, pose: Tensor, lead: Tensor) -> Tensor:
    """Return how surely poses are right, (B,) from 0 to 1.

    A pose is doubtful if a different one explains nearly as many data, if it leaves data over beside the surface or in
    dense clusters, or if the data leave open where some of its limbs end.

    Args:
        problem: the batch; its prior says what is known of joints that no data show.
        pose: (B, num_dofs), fitted.
        lead: (B,) by how many data more than the best of different poses it explains.
    """
    clustered, near = clustered_data(problem, pose)
    left_over = clustered / near.clamp_min(1) + beside_share(problem, pose)
    known = known_ends(problem, pose)
    return (1 - (-lead.clamp_min(0) / _SURE_LEAD).exp()) * (-left_over / _DOUBTFUL_SHARE).exp() * known


def is_misfit(problem: AlignProblem, pose: Tensor) -> Tensor:
    """Return which poses (B,) leave too many data beside the surface: outliers are spread far more thinly.

    The noise is left out, since a wrong pose makes it look larger than it is: noisy data are misfits, too.
    """
    return beside_share(problem, pose, noises=0.0) > _MANY_BESIDE


def beside_share(problem: AlignProblem, pose: Tensor, *, noises: float = _BESIDE_NOISES) -> Tensor:
    """Return the share (B,) of the data that lie beside the surface: off it, by so many deviations, but not far."""
    distance = problem.surface.distance(problem.data, pose)
    noise = surface_noise(distance, problem.valid, problem.size)
    least, most = (share * problem.size for share in _BESIDE)
    beyond = (noises * noise).clamp_min(least).unsqueeze(-1)
    beside = (distance.abs() > beyond) & (distance.abs() < most) & problem.valid
    return beside.sum(-1) / problem.valid.sum(-1).clamp_min(1)


def known_ends(problem: AlignProblem, pose: Tensor) -> Tensor:
    """Return how probably the limbs end where poses (B, num_dofs) have them, (B,).

    About its place an end spreads by the covariance of the pose, given the data near the surface and the prior; a limb
    without data of its own spreads by the prior alone. The mean of the spreads is taken for that of a Rayleigh
    distribution's squares, of which a share lies within the tolerance.
    """
    if problem.data.shape[-2] > _SHOWN_DATA:
        problem = problem.draw(_SHOWN_DATA, torch.Generator().manual_seed(0))
    ends = limb_ends(problem.skin)
    _, derivative = problem.skin.shape.transform_jacobian(pose, chart="tangent")
    moves = (problem.skin.basis[ends] @ derivative.flatten(-2)).unflatten(-1, (3, -1))
    prior = _precision(problem)
    joints = prior.reciprocal()
    joints[..., :6] = 0
    loose = (moves.square() * joints[..., None, None, :]).sum((-2, -1))
    covariance = _covariance(problem, pose, prior)
    fitted = ((moves.flatten(-3, -2) @ covariance).unflatten(-2, moves.shape[-3:-1]) * moves).sum((-2, -1)).clamp_min(0)
    alone = (-_own_data(problem, pose) / _SURE_DATA).exp()
    spread = (fitted + alone * (loose - fitted).clamp_min(0)).clamp_min(torch.finfo(pose.dtype).tiny).sqrt().mean(-1)
    return 1 - (-(_TOLERANCE * problem.size / spread).square()).exp()


def limb_ends(skin: LinearBlendSkin) -> Tensor:
    """Return the indices (L,) of the skin points farthest out on each limb; of all points without limbs."""
    transforms = skin.shape.part_transforms(skin.reference_pose)
    ends = []
    for limb, own in _limb_points(skin):
        root = transforms[limb.bodies[0].parts[0], :3, 3]
        ends.append(own[(skin.points[own] - root).norm(dim=-1).argmax()])
    return torch.stack(ends) if ends else torch.arange(len(skin), device=skin.points.device)


def _limb_points(skin: LinearBlendSkin) -> list[tuple[Limb, Tensor]]:
    """Return the limbs that have skin points, with the indices of those."""
    part = skin.weights.argmax(-1)
    points = [
        (limb, torch.isin(part, part.new_tensor(limb.parts)).nonzero()[:, 0]) for limb in find_limbs(skin.shape)[0]
    ]
    return [(limb, own) for limb, own in points if len(own)]


def _precision(problem: AlignProblem) -> Tensor:
    """Return how precisely poses are known without data, 1 / std^2, (num_dofs,) or (B, num_dofs); none is zero."""
    shape = problem.skin.shape
    least = torch.full_like(shape.rest, _TURN_STD**-2)
    least = torch.where(shape.is_sliding, (_SHIFT_STD * problem.size) ** -2, least)
    return torch.maximum(problem.prior.precision, least)


def _covariance(problem: AlignProblem, pose: Tensor, prior: Tensor) -> Tensor:
    """Return (B, num_dofs, num_dofs): how poses spread, given the data near the surface and the prior's precision."""
    distance, jacobian = problem.surface.distance_jacobian(problem.data, pose)
    noise = surface_noise(distance, problem.valid, problem.size)
    near = welsch_weight((distance / (SIGMA_PER_NOISE * noise).unsqueeze(-1)).square()) * problem.valid
    return pose_covariance(jacobian, near, noise, prior)


def _own_data(problem: AlignProblem, pose: Tensor) -> Tensor:
    """Return how many data (B, L) nothing explains but one limb, for each limb; infinity for a shape without limbs."""
    shape = problem.skin.shape
    whole = _explained(problem, shape.distance(problem.data, pose))
    own = []
    for limb, _ in _limb_points(problem.skin):
        rest = [number for number in range(shape.num_parts) if number not in limb.parts]
        others = _explained(problem, shape.distance(problem.data, pose, parts=rest)) if rest else 0.0
        own.append((whole - others).clamp_min(0).sum(-1))
    return torch.stack(own, dim=-1) if own else torch.full_like(whole[:, :1], torch.inf)


def _explained(problem: AlignProblem, distance: Tensor) -> Tensor:
    return welsch_weight((distance / (INLIER_SHARE * problem.size)).square()) * problem.valid
