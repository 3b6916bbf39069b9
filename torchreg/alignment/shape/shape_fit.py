"""Fitting the shape coefficients of a rig together with its pose, to one scan or several scans of one person."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchreg.alignment.evidence.clusters import leaves_clusters
from torchreg.alignment.evidence.confidence import EVIDENCE
from torchreg.alignment.evidence.reliability import SurfaceError
from torchreg.alignment.fit.annealed_em import ANNEALING, OnStep, StageResult, anneal
from torchreg.alignment.fit.objectives import GaussianPosePrior
from torchreg.alignment.fit.problem import joint_precision, masked_mean, model_size
from torchreg.alignment.fit.sigma_schedule import SigmaSchedule
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, fit_surface
from torchreg.alignment.results import AlignRecord
from torchreg.alignment.shape.clothing import ClothedSpace
from torchreg.alignment.shape.clothing_evidence import bare_where_likelier
from torchreg.alignment.shape.person_covariance import noise_covariance, shared_covariance, with_errors_of_parts
from torchreg.alignment.shape.person_search import find_people, lead_over_rivals, limb_restarts, rotation_restarts
from torchreg.alignment.shape.shape_problem import ShapeProblem
from torchreg.errors import InputError
from torchreg.geometry.facing_normals import facing_normals
from torchreg.geometry.mesh import TriangleMesh, interpolate, sample_surface
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.sampling import farthest_points
from torchreg.geometry.upright import Direction
from torchreg.result import normal_copy
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.shape_space import ShapeSpace
from torchreg.shapes.shaped import ShapedSkin, ShapedTree
from torchreg.shapes.shaped_surface import ShapedSurface
from torchreg.shapes.spec import RigSurface

if TYPE_CHECKING:
    from torchreg.alignment.config import AlignConfig


@dataclass(frozen=True)
class ShapeFit:
    """Numbers of a fit of pose and shape."""

    num_draws: int = 200  # of the coefficients' prior, from which starts of different sizes are taken
    num_starts: int = 6  # sizes of a body are an octave apart, and the annealed EM finds its way over a tenth
    num_kept: int = 2  # starts that are still fitted to the surface
    num_found: int = 8  # starts that a search without a given one hands on: sizes and turned people
    num_found_kept: int = 3  # of those: the back of a person looks much like its front
    coarse_data: int = 1000  # of each scan, by which starts are told apart
    fine_data: int = 1500  # of each scan, before all of them count
    surface_points: int = 2000  # samples of the surface
    oversampling: int = 8  # candidates per model point
    coarse_steps: int = 3  # at each width of the surface fit
    fine_steps: int = 4
    em_steps: int = 6  # values of sigma
    spread_steps: int = 4  # after which a learned deviation of coefficients hardly changes
    num_swung: int = 2  # people with a limb swung who are fitted: the first was right in all that were looked at
    again: float = 0.06  # first sigma of the second annealing, as a share of the size


SHAPE_FIT = ShapeFit()


@dataclass(frozen=True)
class FittedShape:
    """Poses (T, D) and coefficients (K,) of a fit, with covariances (T, D + K, D + K) in tangent coordinates.

    `state` (T, D + K) solves `problem` about the scans' means; `lead` (1,) is the cost by which the best different
    state is worse in a search. `rig` has those of clothes as its last coefficients, where there may be any, of which
    those lie off the skin by `clothing` (V,), metres.
    """

    poses: Tensor
    coefficients: Tensor
    covariance: Tensor
    cost: Tensor
    sigma: Tensor
    change: Tensor
    error: SurfaceError
    problem: ShapeProblem
    state: Tensor
    rig: ArticulatedShape
    clothing: Tensor | None = None
    lead: Tensor | None = None

    @property
    def person(self) -> ArticulatedShape:
        """The rig of the person, whose surface is that of the clothes."""
        return self.rig.with_coefficients(self.state[0, self.rig.num_dofs :].clone())


def fitted_rig(shape: ArticulatedShape, fit_shape: bool | str, *, plain: bool = True) -> ArticulatedShape:
    """Return the rig whose coefficients are to be fitted; not ``plain`` is what has other options as well."""
    if fit_shape is not True and fit_shape != "bones":
        raise InputError(f"fit_shape must be True, False or 'bones', got {fit_shape!r}")
    if not plain:
        raise InputError("fit_shape goes without model_points, keypoints, locked and prior; leave them out")
    shape.file_surface()
    if fit_shape == "bones":
        return shape.with_bone_coefficients()
    shape.coefficient_space()
    return shape


@torch.inference_mode()
def fit_coefficients(
    shape: ArticulatedShape,
    data: Tensor,
    valid: Tensor,
    poses: Tensor | None,
    *,
    config: AlignConfig,
    viewpoints: Tensor | None = None,
    on_step: OnStep | None = None,
) -> FittedShape:
    """Return the poses of T scans (T, M, 3) of one shape and the coefficients that they share.

    Annealed EM, with normals, registers shapes of different sizes; the best are fitted to the surface, coefficients as
    further columns of the normal equations. Poses (T, num_dofs) are at the mean coefficients; None searches one scan's.
    """
    generator = torch.Generator().manual_seed(config.seed)
    problem, start = _problem(shape, data, valid, poses, viewpoints, config=config, generator=generator)
    if on_step is not None:
        on_step = partial(_tell, on_step, problem, shape.num_dofs)
    coarse = problem.sample(SHAPE_FIT.coarse_data, generator)
    widths = config.schedule or ANNEALING.schedule(problem.size, SHAPE_FIT.em_steps)
    found = anneal(coarse, start, widths, em_steps=config.em_steps, m_steps=config.m_steps, on_step=on_step)
    sigma = found.sigma[:1]
    num_kept = SHAPE_FIT.num_kept if poses is not None else SHAPE_FIT.num_found_kept
    kept = problem.people(coarse.cost_of_people(found.pose).argsort()[:num_kept])
    coarse, state = coarse.rows(kept), found.pose[kept]
    state = fit_surface(coarse, state, steps=SHAPE_FIT.coarse_steps, on_step=on_step).pose
    descend = _Descent(config, on_step)
    state = _placed_again(coarse, state, descend)
    if problem.scans == 1:
        state = _explained_anew(coarse, state, descend, generator, searched=poses is None)
    costs = coarse.cost_of_people(state)
    lead = lead_over_rivals(coarse, state, costs) if poses is None else None
    best = problem.people(costs.argmin().unsqueeze(0))
    problem, state = problem.rows(kept[best]), state[best]
    fine = problem.sample(SHAPE_FIT.fine_data, generator)
    state = fit_surface(fine, state, steps=SHAPE_FIT.fine_steps, on_step=on_step).pose
    alike = shape.coefficient_space().alike
    if alike is not None:
        fine, state = _with_learned_spread(fine, state, alike, on_step)
        problem = replace(problem, prior=replace(problem.prior, precision=fine.prior.precision))
    space = shape.coefficient_space()
    if isinstance(space, ClothedSpace) and not space.surely:
        count = len(space) - len(space.body)
        fine, state = bare_where_likelier(fine, state, count, _fit_closely, noise_covariance)
        problem = replace(problem, prior=fine.prior)
    finish = partial(fit_surface, problem, widths=SURFACE_FIT.widths[-1:], on_step=on_step)
    before = finish(state, steps=SHAPE_FIT.fine_steps).pose
    last = replace(finish(before, steps=1), sigma=sigma)
    return replace(_fitted(problem, before, last, shape), lead=lead)


def _fit_closely(problem: ShapeProblem, state: Tensor) -> Tensor:
    """Return states (T, D + K) fitted from nearly right ones."""
    return fit_surface(problem, state, steps=SHAPE_FIT.fine_steps, widths=SURFACE_FIT.widths[-1:]).pose


def _placed_again(problem: ShapeProblem, state: Tensor, descend: _Descent) -> Tensor:
    """Return states (B, D + K) after another, narrower annealing, where that explains more of the data."""
    found = descend(problem, state, _narrow(problem))
    better = problem.cost_of_people(found) < problem.cost_of_people(state)
    return torch.where(better.repeat_interleave(problem.scans).unsqueeze(-1), found, state)


def _explained_anew(
    problem: ShapeProblem, state: Tensor, descend: _Descent, generator: torch.Generator, *, searched: bool
) -> Tensor:
    """Return states (B, D + K) in one scan, the best with one limb re-initialized where clusters are left over."""
    costs = problem.cost_of_people(state)
    best = costs.argmin().unsqueeze(0)
    one = problem.rows(best)
    if not bool(leaves_clusters(one, state[best])):
        return state
    others = [(limb_restarts(one, state[best[0]], SHAPE_FIT.num_swung, generator), _narrow(problem))]
    if searched:
        others.append((rotation_restarts(one, state[best[0]]), ANNEALING.schedule(problem.size, SHAPE_FIT.em_steps)))
    # A chain without branches has no limb to swing.
    others = [(start, widths) for start, widths in others if len(start)]
    if not others:
        return state
    found = torch.cat([descend(problem.rows(best.expand(len(start))), start, widths) for start, widths in others])
    again, choice = problem.rows(best.expand(len(found))).cost_of_people(found).min(0)
    # A smaller lead is no evidence.
    better = float(again) < float(costs[best]) - EVIDENCE.lead
    return state.index_copy(0, best, found[choice].unsqueeze(0)) if better else state


def _narrow(problem: ShapeProblem) -> SigmaSchedule:
    """Return the schedule of people whose size and trunk are right."""
    return SigmaSchedule.geometric(SHAPE_FIT.again * problem.size, ANNEALING.stop * problem.size, SHAPE_FIT.em_steps)


@dataclass(frozen=True)
class _Descent:
    """Annealed EM, then a coarse fit to the surface."""

    config: AlignConfig
    on_step: OnStep | None

    def __call__(self, problem: ShapeProblem, state: Tensor, widths: SigmaSchedule) -> Tensor:
        """Return states (B, D + K) at the end of a descent from others."""
        steps = {"em_steps": self.config.em_steps, "m_steps": self.config.m_steps}
        found = anneal(problem, state, widths, **steps, on_step=self.on_step).pose
        return fit_surface(problem, found, steps=SHAPE_FIT.coarse_steps, on_step=self.on_step).pose


def _with_learned_spread(
    problem: ShapeProblem, state: Tensor, alike: Tensor, on_step: OnStep | None
) -> tuple[ShapeProblem, Tensor]:
    """Return the problem with the deviations of alike coefficients learned, and states (T, D + K) fitted.

    The deviation of greatest evidence is ``s^2 = sum_k (c_k - m_k)^2 / sum_k g_k``, ``g_k = 1 - C_kk / s^2`` with the
    covariance C (MacKay 1992, eq. 4.9); the prior's guess counts as one more coefficient.
    """
    space, dofs = problem.skin.shape.space, problem.skin.shape.rig.num_dofs
    member = alike.unsqueeze(-1) == alike.clamp_min(0).unique()
    group = member.to(state)
    for _ in range(SHAPE_FIT.spread_steps):
        precision = problem.prior.precision[dofs:] * problem.scans
        covariance = shared_covariance(noise_covariance(problem, state), dofs)
        told = (1 - covariance.diagonal() * precision).clamp(0, 1)
        squares = (state[0, dofs:] - space.mean).square() @ group + (space.std.square() @ group) / group.sum(0)
        variance = squares / (told @ group + 1)
        learned = torch.where(member.any(-1), (group @ variance.reciprocal()), precision) / problem.scans
        joined = torch.cat([problem.prior.precision[:dofs], learned])
        problem = replace(problem, prior=replace(problem.prior, precision=joined))
        widths = SURFACE_FIT.widths[-1:]
        state = fit_surface(problem, state, steps=SHAPE_FIT.fine_steps, widths=widths, on_step=on_step).pose
    return problem, state


def _tell(on_step: OnStep, problem: ShapeProblem, num_dofs: int, record: AlignRecord) -> None:
    """Pass on a record with the poses alone, in the coordinates of the data."""
    scans = len(record.pose) // problem.scans
    origin = pad(problem.origin[: problem.scans].repeat(scans, 1), (0, num_dofs - 3))
    on_step(normal_copy(replace(record, pose=record.pose[:, :num_dofs] + origin)))


def _fitted(problem: ShapeProblem, before: Tensor, found: StageResult, shape: ArticulatedShape) -> FittedShape:
    """Return the end of a fit, whose last step began in states (T, D + K)."""
    poses, coefficients = found.pose.tensor_split([shape.num_dofs], dim=-1)
    space, clothing = shape.coefficient_space(), None
    body = space.body if isinstance(space, ClothedSpace) else space
    if isinstance(space, ClothedSpace) and bool((problem.prior.mean[0, shape.num_dofs + len(body) :] != 0).any()):
        clothing = space.clothing_offset(coefficients[0])
    known = shape.num_dofs + len(body)
    covariance = noise_covariance(problem, found.pose)
    return FittedShape(
        poses=poses + pad(problem.origin, (0, shape.num_dofs - 3)),
        coefficients=coefficients[0, : len(body)],
        covariance=with_errors_of_parts(problem, found.pose, covariance)[:, :known, :known],
        cost=problem.cost_of_people(found.pose)[0],
        sigma=found.sigma,
        change=found.change.amax(0, keepdim=True),
        error=_surface_error(problem, before, found.pose, covariance[:, :known, :known]),
        problem=problem,
        state=found.pose,
        rig=shape,
        clothing=clothing,
    )


def _surface_error(problem: ShapeProblem, before: Tensor, state: Tensor, covariance: Tensor) -> SurfaceError:
    """Return the standard errors of the surface in states (T, D + K), by their covariance, and their last step."""
    rows, moves = problem.skin.row_jacobian(state)
    moved = (problem.skin.place(rows) - problem.skin(before)).square().sum(-1).mean(-1).sqrt()
    return SurfaceError.of(problem.skin, moves[..., : covariance.shape[-1]], covariance, moved)


def different_people(space: ShapeSpace, generator: torch.Generator) -> Tensor:
    """Return coefficients (S, K) of evenly spread sizes, of each size the most plausible of many drawn."""
    count = SHAPE_FIT.num_draws - SHAPE_FIT.num_draws % SHAPE_FIT.num_starts
    noise = torch.randn(count, len(space), generator=generator, dtype=torch.float64).to(space.mean)
    drawn = torch.minimum(torch.maximum(space.mean + noise * space.std, space.lower), space.upper)
    frames = space.rest(drawn)[1]
    size = (frames.amax(-2) - frames.amin(-2)).norm(dim=-1)
    groups = size.argsort().unflatten(0, (SHAPE_FIT.num_starts, -1))
    unlikely = ((drawn - space.mean) / space.std).square().sum(-1)
    return drawn[groups.gather(1, unlikely[groups].argmin(1, keepdim=True))[:, 0]]


def _problem(
    shape: ArticulatedShape,
    data: Tensor,
    valid: Tensor,
    poses: Tensor | None,
    viewpoints: Tensor | None,
    *,
    config: AlignConfig,
    generator: torch.Generator,
) -> tuple[ShapeProblem, Tensor]:
    """Return the problem of S people in T scans, S T rows about the scans' means, and its start."""
    if poses is None:
        rest = shape.rest_pose().unsqueeze(0)
        problem, start = _problem(shape, data, valid, rest, viewpoints, config=config, generator=generator)
        return _found(problem, shape, start[:, shape.num_dofs :], generator, config.upright)
    space, surface = shape.coefficient_space(), shape.file_surface()
    people = different_people(space.body if isinstance(space, ClothedSpace) else space, generator)
    people = torch.cat([people, space.mean[people.shape[-1] :].expand(len(people), -1)], dim=-1)
    tree = ShapedTree(shape, space)
    normals = torch.stack([
        scan_normals(points, told, None if viewpoints is None else viewpoints[number])
        for number, (points, told) in enumerate(zip(data, valid, strict=True))
    ])  # fmt: skip
    model, dense = surface_skins(tree, surface, config.num_model_points, generator)
    size, count, scans = model_size(model), len(people), len(data)
    origin = masked_mean(data, valid)
    middle = space.rest(torch.cat([space.mean[None], people]))[0].mean(-2)
    start = _start(poses - pad(origin, (0, shape.num_dofs - 3)), people, middle[0] - middle[1:])
    mean = torch.cat([start[:, : shape.num_dofs], space.mean.expand(len(start), -1)], dim=-1)
    precision = torch.cat([joint_precision(shape, size, config.prior_std), space.std.square().reciprocal() / scans])
    every = normals.repeat(count, 1, 1)
    problem = ShapeProblem(
        skin=model, surface=ShapedSurface(dense, every, SURFACE_FIT.max_width * size),
        data=torch.where(valid.unsqueeze(-1), data - origin.unsqueeze(1), 0.0).repeat(count, 1, 1),
        valid=valid.repeat(count, 1), origin=origin.repeat(count, 1), size=size, lower=tree.lower, upper=tree.upper,
        prior=GaussianPosePrior(mean, precision), pose_atol=config.pose_atol, debias=config.debias, normals=every,
        scans=scans,
    )  # fmt: skip
    return problem, start


def _found(
    problem: ShapeProblem, rig: ArticulatedShape, people: Tensor, generator: torch.Generator, upright: Direction | None
) -> tuple[ShapeProblem, Tensor]:
    """Return the problem of one scan in rows for those of people (S, K) who are found in it, and their states."""
    one = problem.rows(torch.zeros(1, dtype=torch.int64)).sample(SHAPE_FIT.coarse_data, generator)
    states = find_people(one, rig, people, SHAPE_FIT.num_found, generator, upright)
    return problem.rows(torch.zeros(len(states), dtype=torch.int64)), states


def _start(poses: Tensor, people: Tensor, offsets: Tensor) -> Tensor:
    """Return states (S T, D + K) of coefficients (S, K) in poses (T, D), with their middle where the mean's is."""
    moved = (so3_exp(poses[:, 3:6]) @ offsets[:, None, :, None]).squeeze(-1)
    placed = poses + pad(moved, (0, poses.shape[-1] - 3))
    shared = people.unsqueeze(1).expand(-1, len(poses), -1)
    return torch.cat([placed, shared], dim=-1).flatten(0, 1)


def scan_normals(points: Tensor, valid: Tensor, viewpoint: Tensor | None) -> Tensor:
    """Return the normals (M, 3) of a scan, zero where a point is padding."""
    normals = torch.zeros_like(points)
    normals[valid] = facing_normals(points[valid], viewpoint).to(points)
    return normals


def surface_skins(
    tree: ShapedTree, surface: RigSurface, count: int, generator: torch.Generator
) -> tuple[ShapedSkin, ShapedSkin]:
    """Return model points that cover the surface evenly, and denser ones to measure distances from."""
    mean = TriangleMesh(tree.space.rest(tree.space.mean)[0].cpu(), surface.faces.cpu())
    weights = surface.weights.cpu().to(mean.vertices)

    def skin(face: Tensor, shares: Tensor) -> ShapedSkin:
        carried = interpolate(weights, mean.faces, face, shares)
        return ShapedSkin(tree, *(value.to(tree.rest.device) for value in (mean.faces[face], shares, carried)))

    points, face, shares = sample_surface(mean, SHAPE_FIT.oversampling * count, generator=generator)
    chosen = farthest_points(points, count)
    _, dense_face, dense_shares = sample_surface(mean, SHAPE_FIT.surface_points, generator=generator)
    return skin(face[chosen], shares[chosen]), skin(dense_face, dense_shares)
