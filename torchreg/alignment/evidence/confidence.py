"""What data tell of poses: clusters and near outliers off the surface, limbs without data, rivals of a search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.alignment.fit.free_space_term import INTRUSION
from torchreg.alignment.fit.problem import BROAD_PRIOR, AlignProblem, soft_inliers
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, pose_covariance, surface_noise
from torchreg.geometry.budget import BUDGET
from torchreg.shapes.limbs import Limb, find_limbs
from torchreg.shapes.pose_algebra import BASE_DOFS
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.solvers.robust import welsch_weight


@dataclass(frozen=True)
class OffSurface:
    """Distance from which the surface does not explain data."""

    noises: float = 3.0  # standard deviations of the noise
    share: float = INTRUSION.tolerance  # of the model's size, at least: solids and skins are not exact

    def distance(self, noise: Tensor, size: float) -> Tensor:
        """Return the distance (...), metres, for noise (...) and a model's size in metres."""
        return (self.noises * noise).clamp_min(self.share * size)


@dataclass(frozen=True)
class ClusterThresholds:
    """Thresholds of clusters, and of the number of data in them that is worth a search."""

    neighbors: int = 5  # off the surface within the radius, at least
    radius: float = 4.0  # as a multiple of the median distance of nearest neighbors on the surface
    max_radius: float = 0.1  # as a share of the model's size
    share: float = 0.015  # of the data on the surface: more are worth a search
    min_count: int = 5  # but so many or fewer are not
    max_data: int = 2000  # per cloud, of which all pairs are compared; more are thinned


OFF_SURFACE = OffSurface()
CLUSTERS = ClusterThresholds()


def leaves_clusters(problem: AlignProblem, pose: Tensor) -> Tensor:
    """Return a mask (B,) of poses that leave unexplained clusters worth a search."""
    clustered, near = clustered_data(problem, pose)
    return clustered > (CLUSTERS.share * near).clamp_min(CLUSTERS.min_count)


def clustered_data(problem: AlignProblem, pose: Tensor) -> tuple[Tensor, Tensor]:
    """Return the numbers of data (B,) in unexplained clusters, and on the surface."""
    return clusters_beside(problem, problem.surface.distance(problem.data, pose))


def clusters_beside(problem: AlignProblem, distance: Tensor) -> tuple[Tensor, Tensor]:
    """Return the same for data at distances (B, M) from the surface."""
    stride = -(-problem.data.shape[-2] // CLUSTERS.max_data)
    if stride > 1:
        problem = problem.with_data(problem.data[:, ::stride], problem.valid[:, ::stride])
    distance = distance[:, ::stride].abs()
    limit = OFF_SURFACE.distance(surface_noise(distance, problem.valid, problem.size), problem.size)
    far = (distance > limit.unsqueeze(-1)) & problem.valid
    near = ~far & problem.valid
    clustered = far & (_far_neighbors(problem, near, far) >= CLUSTERS.neighbors)
    return clustered.sum(-1), near.sum(-1)


@torch.no_grad()
def _far_neighbors(problem: AlignProblem, near: Tensor, far: Tensor) -> Tensor:
    """Return the number of data (B, M) off the surface within the radius of clusters about each datum."""
    data, counts = problem.data, torch.zeros_like(problem.data[..., 0])
    rows = max(1, BUDGET.table_entries // data.shape[1] ** 2)
    for start in range(0, len(data), rows):
        part = slice(start, start + rows)
        squares = _squared_distances(data[part], problem.valid[part])
        squares.diagonal(dim1=-2, dim2=-1).fill_(torch.inf)
        spacing = torch.where(near[part], squares.amin(-1), torch.nan).nanmedian(-1).values.clamp_min(0).sqrt()
        radius = torch.nan_to_num(CLUSTERS.radius * spacing, nan=0.0).clamp_max(CLUSTERS.max_radius * problem.size)
        within = squares.lt_(radius.square()[:, None, None])
        torch.matmul(within, far[part].to(data).unsqueeze(-1), out=counts[part].unsqueeze(-1))
    return counts


def _squared_distances(data: Tensor, valid: Tensor) -> Tensor:
    """Return the squared distances (B, M, M) of data by one product, infinite from padding."""
    norms = data.square().sum(-1).masked_fill(~valid, torch.inf).unsqueeze(-1)
    ones = torch.ones_like(norms)
    return torch.cat([data, norms, ones], dim=-1) @ torch.cat([-2 * data, ones, norms], dim=-1).mT


@dataclass(frozen=True)
class Evidence:
    """Scales of the evidence for a pose, at which its factor of the confidence is 1 / e, or 1 - 1 / e."""

    tolerance: float = 0.04  # of the ends of limbs: their mean distance from the true ones, as a share of the size
    lead: float = 4.0  # over a different pose, in data that it explains more
    left_over: float = 0.1  # data beside the surface or in clusters, as a share of those on it
    limb_data: float = 4.0  # data that nothing but one limb explains
    num_data: int = 2000  # that are looked at: more show no more limbs


@dataclass(frozen=True)
class _Misfit:
    """Thresholds of a misfit: too many near outliers."""

    reach: float = 0.05  # of data beside the surface, at most, as a share of the model's size
    share: float = 0.025  # of the data: more are a misfit


EVIDENCE = Evidence()
_MISFIT = _Misfit()


@dataclass(frozen=True, eq=False)
class SurfaceResiduals:
    """Distances (B, M) of data from the surface in some poses, metres, their Jacobian, and `limb_data` (B, L).

    `contradicted` (B, L) is the probability by a picture that a limb is elsewhere, as far as it counts.
    """

    distance: Tensor
    jacobian: Tensor
    limb_data: Tensor
    contradicted: Tensor | float = 0.0

    @classmethod
    def of(cls, problem: AlignProblem, pose: Tensor) -> SurfaceResiduals:
        """Return how the data of a batch lie in poses (B, num_dofs)."""
        return cls(*problem.surface.distance_jacobian(problem.data, pose), limb_data(problem, pose))

    def misplaced(self, count: float) -> Tensor:
        """Return the probability (B, L) that a limb is anywhere, 1 / e without a picture if ``count`` data show it."""
        return 1 - (1 - (-self.limb_data / count).exp()) * (1 - self.contradicted)


def is_misfit(problem: AlignProblem, pose: Tensor) -> Tensor:
    """Return a mask (B,) of poses that leave too many data near the surface; outliers are spread more thinly."""
    return (
        near_outlier_share(problem, problem.surface.distance(problem.data, pose), OffSurface(noises=0.0))
        > _MISFIT.share
    )


def near_outlier_share(problem: AlignProblem, distance: Tensor, off: OffSurface = OFF_SURFACE) -> Tensor:
    """Return the share (B,) of data at distances (B, M) that lie off the surface, but not far."""
    noise = surface_noise(distance, problem.valid, problem.size)
    beyond = off.distance(noise, problem.size).unsqueeze(-1)
    beside = (distance.abs() > beyond) & (distance.abs() < _MISFIT.reach * problem.size) & problem.valid
    return beside.sum(-1).to(problem.data) / problem.valid.sum(-1).clamp_min(1)


def end_spreads(problem: AlignProblem, pose: Tensor, residuals: SurfaceResiduals | None = None) -> Tensor:
    """Return the deviations (B, L) of the limbs' ends, metres; joints of limbs without data spread by the prior."""
    if problem.data.shape[-2] > EVIDENCE.num_data:
        problem, residuals = problem.draw(EVIDENCE.num_data, torch.Generator().manual_seed(0)), None
    residuals = residuals or SurfaceResiduals.of(problem, pose)
    moves = end_motions(problem.skin, pose, limb_ends(problem.skin))
    # What the prior leaves free is plausible, at least.
    prior = torch.maximum(problem.prior.precision, BROAD_PRIOR.precision(problem.skin.shape, problem.size))
    variances = prior.reciprocal()
    variances[..., :BASE_DOFS] = 0
    covariance = _covariance(problem, pose, residuals, prior)
    fitted = end_variances(moves, covariance)
    # A limb may be anywhere, by its own joints, where neither data of it nor of what hangs on it show where it is.
    limbs, misplaced = [limb for limb, _ in limb_points(problem.skin)], residuals.misplaced(EVIDENCE.limb_data)
    if not limbs:
        return fitted.clamp_min(torch.finfo(pose.dtype).tiny).sqrt()
    squares = moves.square().sum(-2) * variances.unsqueeze(-2)
    loose = torch.stack([squares[..., limb.dofs].sum(-1) for limb in limbs], -1)
    hidden = torch.stack([misplaced[..., hanging].prod(-1) for hanging in _hanging(limbs)], -1)
    left = (loose @ hidden.unsqueeze(-1)).squeeze(-1)
    return (fitted + (left - fitted * misplaced).clamp_min(0)).clamp_min(torch.finfo(pose.dtype).tiny).sqrt()


def _hanging(limbs: Sequence[Limb]) -> list[list[int]]:
    """Return for each limb the numbers of those that hang on it, and its own."""
    owner = {part: number for number, limb in enumerate(limbs) for part in limb.parts}
    above = [owner.get(limb.bodies[0].parent, -1) for limb in limbs]
    hanging: list[list[int]] = [[] for _ in limbs]
    for number in range(len(limbs)):
        each = number
        while each >= 0:
            hanging[each].append(number)
            each = above[each]
    return hanging


def end_motions(skin: LinearBlendSkin, pose: Tensor, ends: Tensor) -> Tensor:
    """Return the derivatives (B, L, 3, num_dofs) of some points (L,) of a skin in poses, in tangent coordinates."""
    _, derivative = skin.shape.transform_jacobian(pose, chart="tangent")
    return (skin.basis[ends] @ derivative.flatten(-2)).unflatten(-1, (3, -1))


def end_variances(moves: Tensor, covariance: Tensor) -> Tensor:
    """Return the variances (B, L) of points with derivatives (B, L, 3, num_dofs), all coordinates together."""
    spread = (moves.flatten(-3, -2) @ covariance).unflatten(-2, moves.shape[-3:-1])
    return (spread * moves).sum((-2, -1)).clamp_min(0)


def limb_ends(skin: LinearBlendSkin) -> Tensor:
    """Return the indices (L,) of the skin points farthest out on each limb; of all points without limbs."""
    transforms = skin.shape.part_transforms(skin.reference_pose)
    ends = []
    for limb, index in limb_points(skin):
        root = transforms[limb.bodies[0].parts[0], :3, 3]
        ends.append(index[(skin.points[index] - root).norm(dim=-1).argmax()])
    return torch.stack(ends) if ends else torch.arange(len(skin), device=skin.points.device)


def limb_points(skin: LinearBlendSkin) -> list[tuple[Limb, Tensor]]:
    """Return the limbs that have skin points, with the indices of those."""
    part = skin.weights.argmax(-1)
    points = [
        (limb, torch.isin(part, part.new_tensor(limb.parts)).nonzero()[:, 0]) for limb in find_limbs(skin.shape)[0]
    ]
    return [(limb, index) for limb, index in points if len(index)]


def _covariance(problem: AlignProblem, pose: Tensor, residuals: SurfaceResiduals, precision: Tensor) -> Tensor:
    """Return the covariance (B, num_dofs, num_dofs) of poses, given near data and a prior's precision."""
    noise = surface_noise(residuals.distance, problem.valid, problem.size)
    width = SURFACE_FIT.width_per_noise * noise
    near = welsch_weight((residuals.distance / width.unsqueeze(-1)).square()) * problem.valid
    return problem.informed(pose_covariance(residuals.jacobian, near, noise, precision), pose)


def limb_data(problem: AlignProblem, pose: Tensor) -> Tensor:
    """Return the number of data (B, L) that only one limb explains, for each limb; infinity without limbs."""
    limbs = [limb.parts for limb, _ in limb_points(problem.skin)]
    return explained_alone(problem, pose, limbs) if limbs else torch.full_like(pose[:, :1], torch.inf)


def explained_alone(problem: AlignProblem, pose: Tensor, groups: Sequence[Sequence[int]]) -> Tensor:
    """Return the number of data (B, L), softly counted, that only one of L groups of parts explains, for each."""
    return _alone(problem, pose, groups).sum(-1).mT


def overlap(problem: AlignProblem, pose: Tensor, at_rest: Tensor | None = None) -> Tensor:
    """Return the share (B, L) of each limb's skin that lies on other parts in poses, but does not at rest.

    Where two limbs lie in each other, both explain the data of one. ``at_rest`` (1, L) are the `own_shares` there.
    """
    at_rest = own_shares(problem, problem.skin.shape.rest_pose()[None]) if at_rest is None else at_rest
    return (at_rest - own_shares(problem, pose)).clamp_min(0)


def own_shares(problem: AlignProblem, pose: Tensor) -> Tensor:
    """Return the share (B, L) of each limb's skin that no other part explains; one without limbs."""
    limbs, points = limb_points(problem.skin), problem.skin(pose)
    if not limbs:
        return torch.ones_like(pose[:, :1])
    on_skin = replace(problem, data=points, valid=torch.ones_like(points[..., 0], dtype=torch.bool))
    tables = _alone(on_skin, pose, [limb.parts for limb, _ in limbs])
    return torch.stack([table[:, index].mean(-1) for table, (_, index) in zip(tables, limbs, strict=True)], -1)


def doubled_data(problem: AlignProblem, pose: Tensor) -> Tensor:
    """Return how many data (B,) two limbs explain that lie in each other, of which one would have its own elsewhere."""
    limbs = limb_points(problem.skin)
    if not limbs:
        return torch.zeros_like(pose[:, 0])
    count = soft_inliers(problem, problem.surface.distance(problem.data, pose)).sum(-1)
    shares = pose.new_tensor([len(index) / len(problem.skin) for _, index in limbs])
    return count * (overlap(problem, pose) * shares).sum(-1) / 2


def _alone(problem: AlignProblem, pose: Tensor, groups: Sequence[Sequence[int]]) -> Tensor:
    """Return the degree (L, B, M) to which only one of L groups of parts explains data."""
    distances = problem.skin.shape.distances_without(problem.data, pose, [(), *groups])
    explained = soft_inliers(problem, distances)
    return (explained[:1] - explained[1:]).clamp_min(0)
