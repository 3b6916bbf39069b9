"""Fitting the shape coefficients of a rig together with its pose, to one scan or several scans of one person."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchreg.alignment.evidence.reliability import SurfaceError
from torchreg.alignment.fit.annealed_em import StageResult
from torchreg.alignment.fit.implicit_gradient import FixedPoint, attach_gradients
from torchreg.alignment.fit.objectives import GaussianPosePrior
from torchreg.alignment.fit.problem import joint_precision, masked_mean, model_size
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, surface_noise
from torchreg.alignment.search.windows import DataWindows
from torchreg.alignment.shape.clothing import ClothedSpace
from torchreg.alignment.shape.outside_term import OutsideTerm
from torchreg.alignment.shape.person_proposer import PersonProposer
from torchreg.alignment.shape.person_search import find_people
from torchreg.alignment.shape.shape_problem import ShapeProblem, noise_covariance, with_errors_of_parts
from torchreg.errors import InputError
from torchreg.geometry.facing_normals import facing_normals
from torchreg.geometry.mesh import TriangleMesh, interpolate, sample_surface
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.sampling import farthest_points
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
    num_proposed: int = 4  # starts that a network hands on: front and back, or of two limbs either
    num_found_kept: int = 3  # of those: the back of a person looks much like its front
    same_data: float = 0.95  # of what a start's fit lies on, that is on what a network proposes, if both are one person
    coarse_data: int = 1000  # of each scan, by which starts are told apart
    fine_data: int = 1500  # of each scan, before all of them count
    surface_points: int = 2000  # samples of the surface
    oversampling: int = 8  # candidates per model point
    coarse_steps: int = 3  # at each width of the surface fit
    fine_steps: int = 4
    em_steps: int = 6  # values of sigma
    num_swung: int = 2  # people with a limb swung who are fitted: the first was right in all that were looked at
    again: float = 0.06  # first sigma of the second annealing, as a share of the size


SHAPE_FIT = ShapeFit()


@dataclass(frozen=True)
class FittedShape:
    """Poses (T, D) and coefficients (K,) of a fit, with covariances (T, D + K, D + K) in tangent coordinates.

    `state` (T, D + K) solves `problem` about the scans' means; `lead` (1,) is the cost by which the best different
    state is worse in a search; `shared_noise` (T,) is that of errors which neighbors share, metres. `rig` has
    those of clothes as its last coefficients, where there may be any, lying off the skin by `clothing` (V,), metres.
    """

    poses: Tensor
    coefficients: Tensor
    covariance: Tensor
    cost: Tensor
    sigma: Tensor
    change: Tensor
    error: SurfaceError
    shared_noise: Tensor
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


def fitted_shape(problem: ShapeProblem, before: Tensor, found: StageResult, shape: ArticulatedShape) -> FittedShape:
    """Return the end of a fit, whose last step began in states (T, D + K)."""
    poses, coefficients = found.pose.tensor_split([shape.num_dofs], dim=-1)
    space, clothing = shape.coefficient_space(), None
    body = space.body if isinstance(space, ClothedSpace) else space
    if isinstance(space, ClothedSpace):
        clothing = space.clothing_offset(coefficients[0])
    known = shape.num_dofs + len(body)
    rows = problem.robust_rows(found.pose)
    covariance = noise_covariance(problem, rows)
    return FittedShape(
        poses=poses + pad(problem.origin, (0, shape.num_dofs - 3)),
        coefficients=coefficients[0, : len(body)],
        covariance=with_errors_of_parts(problem, found.pose, rows, covariance)[:, :known, :known],
        cost=problem.cost_of_people(found.pose)[0],
        sigma=found.sigma,
        change=found.change.amax(0, keepdim=True),
        error=_surface_error(problem, before, found.pose, covariance[:, :known, :known]),
        shared_noise=rows.shared,
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


def shape_problem(
    shape: ArticulatedShape,
    data: Tensor,
    valid: Tensor,
    poses: Tensor | None,
    viewpoints: Tensor | None,
    *,
    config: AlignConfig,
    generator: torch.Generator,
    proposer: PersonProposer | None = None,
) -> tuple[ShapeProblem, Tensor]:
    """Return the problem of S people in T scans, S T rows about the scans' means, and its start.

    Without poses people are found in the one scan, by a network if there is one.
    """
    if poses is None:
        rest = shape.rest_pose().unsqueeze(0)
        problem, start = shape_problem(shape, data, valid, rest, viewpoints, config=config, generator=generator)
        one = problem.rows(torch.zeros(1, dtype=torch.int64)).draw(SHAPE_FIT.coarse_data, generator)
        if proposer is not None:
            windows = DataWindows.of(one).problem
            rows = torch.arange(len(windows.data)).unsqueeze(1)
            told = (shape.file_surface(), SHAPE_FIT.num_proposed, generator, config.upright)
            states = torch.cat([proposer.propose(windows.rows(row), *told) for row in rows])
        else:
            people = start[:, shape.num_dofs :]
            states = find_people(one, shape, people, SHAPE_FIT.num_found, generator, config.upright)
        return problem.rows(torch.zeros(len(states), dtype=torch.int64)), states
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
    centered = torch.where(valid.unsqueeze(-1), data - origin.unsqueeze(1), 0.0)
    outside = OutsideTerm.of_scans(model, centered, valid, normals, size)
    factors = (outside.rows(torch.arange(scans).repeat(count)),) if bool(outside.weight.any()) else ()
    problem = ShapeProblem(
        skin=model, surface=ShapedSurface(dense, every, SURFACE_FIT.max_width * size),
        data=centered.repeat(count, 1, 1), valid=valid.repeat(count, 1), origin=origin.repeat(count, 1), size=size,
        lower=tree.lower, upper=tree.upper,
        prior=GaussianPosePrior(mean, precision), pose_atol=config.pose_atol, debias=config.debias, normals=every,
        scans=scans, factors=factors,
    )  # fmt: skip
    return problem, start


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


@dataclass(frozen=True)
class _Exactness:
    """How near to where the energy is stationary gradients are taken."""

    steps: int = 2  # of Newton's method, from a fit whose last step was as small as its tolerance


_EXACTNESS = _Exactness()


class PairedPlanes:
    """Distances of data to the tangent planes of a rig's points, one for each datum, right to first order."""

    def __init__(self, skin: ShapedSkin) -> None:
        self.skin = skin

    def distance(self, points: Tensor, pose: Tensor) -> Tensor:
        """Return the signed distances (B, M) of data (B, M, 3) in states (B, D + K), metres."""
        posed, normals = self.skin.oriented(pose)
        return ((points - posed) * normals).sum(-1)

    def distance_jacobian(self, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Return distances (B, M) and their Jacobian (B, M, D + K) in tangent coordinates."""
        posed, normals, jacobian = self.skin.normal_jacobian(pose)
        return ((points - posed) * normals).sum(-1), -jacobian


def person_with_gradients(
    shape: ArticulatedShape, fitted: FittedShape, points: Tensor, valid: Tensor
) -> tuple[Tensor, Tensor]:
    """Return pose (num_dofs,) and coefficients (K,) fitted to one scan (M, 3), with gradients in its points.

    They are those of the stationary point a few Newton steps away; correspondences and widths are held fixed, and
    variables at a limit have no gradient.
    """
    problem, state = fitted.problem, fitted.state
    with torch.no_grad():
        surface, data = problem.surface, problem.data.clone()
        distance, nearest = surface.nearest(data, state.clone())
        noise = surface_noise(distance, problem.valid, problem.size)
        tree = ShapedTree(fitted.rig, fitted.rig.coefficient_space())
        dense = surface.shaped
        index = nearest[0]
        planes = PairedPlanes(ShapedSkin(tree, dense.vertex_index(index), dense.shares[index], dense.weights[index]))
        # Data off the rim or of the other side are no evidence.
        alike = torch.isclose(planes.distance(data, state.clone()), distance, atol=noise.item(), rtol=0.0)
    fixed = FixedPoint(
        shape=tree, surface=planes, valid=problem.valid & alike, sigma=SURFACE_FIT.width_per_noise * noise,
        noise=noise, precision=problem.prior.precision.clone(), lower=tree.lower, upper=tree.upper,
    )  # fmt: skip
    origin = problem.origin.clone()
    centered = torch.where(valid.clone().unsqueeze(-1), points.to(data) - origin, 0.0).unsqueeze(0)
    start = problem.prior.mean.clone()
    exact = fixed.newton_steps(state.clone(), centered, start, _EXACTNESS.steps)
    found = (state.clone() + (attach_gradients(fixed, exact, centered, start) - exact))[0]
    pose, coefficients = found.tensor_split([shape.num_dofs])
    return torch.cat([pose[:3] + origin[0], pose[3:]]), coefficients[: len(fitted.coefficients)]
