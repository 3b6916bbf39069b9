"""Clothes of a body: a smooth offset of its skin as further coefficients, and the evidence that it wears any."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from torchreg.alignment.evidence.curvature import correlated_count, neighbor_correlation
from torchreg.alignment.fit.surface_fit import surface_noise
from torchreg.alignment.shape.shape_problem import ShapeProblem, noise_covariance
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.sampling import farthest_points
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.shape_space import CoefficientPrior, ShapeSpace


@dataclass(frozen=True)
class Cover:
    """How far clothes lie off the skin of a region, metres: mean, and standard deviations of garments and of folds."""

    mean: float
    garment: float
    local: float
    parts: tuple[str, ...]  # what the names of the region's parts begin with


# From nine dressed men of one set of rigs and the skin of a tenth, in trunks; widened by hand for looser clothes.
COVERS = (
    Cover(0.015, 0.015, 0.010, ("pelvis", "spine", "clavicle", "shoulder", "breast")),
    Cover(0.010, 0.012, 0.007, ("upperarm",)),
    Cover(0.006, 0.010, 0.006, ("lowerarm",)),
    Cover(0.010, 0.012, 0.008, ("upperleg",)),
    Cover(0.010, 0.012, 0.008, ("lowerleg",)),
    Cover(0.002, 0.003, 0.003, ("foot", "toe")),
    Cover(0.003, 0.004, 0.006, ("neck", "head", "eye")),  # hair
    Cover(0.0, 0.0, 0.0, ("wrist", "finger", "metacarpal")),
)


@dataclass(frozen=True)
class ClothModel:
    """Numbers of the model of clothes."""

    length: float = 0.15  # over which folds and cuts of a garment are alike, metres
    num_points: int = 400  # of the skin, on which the modes are computed
    num_modes: int = 24  # of the offset: four fifths of its variance
    reach: float = 5.0  # limits of the modes, in standard deviations


CLOTH = ClothModel()


class ClothedSpace(ShapeSpace):
    """Rest states of a body whose skin is offset by clothes: zero for the skin, by default the mean clothes.

    Args:
        body: its own space.
        normals: (V, 3) of the skin at rest.
        modes: (V, M) by which the offset varies along them, metres, of a standard deviation of one.
        worn: (M,) coefficients of the mean clothes.
    """

    normals: Tensor
    modes: Tensor

    def __init__(self, body: ShapeSpace, normals: Tensor, modes: Tensor, worn: Tensor) -> None:
        prior, one = body.prior, torch.ones_like(worn)
        reach = CLOTH.reach * one + worn.abs()
        super().__init__(CoefficientPrior(
            names=(*prior.names, *(f"cloth_{number}" for number in range(len(worn)))),
            mean=torch.cat([prior.mean, worn]), std=torch.cat([prior.std, one]),
            lower=torch.cat([prior.lower, -reach]), upper=torch.cat([prior.upper, reach]),
        ))  # fmt: skip
        self.body = body
        self.register_buffer("normals", normals, persistent=False)
        self.register_buffer("modes", modes, persistent=False)

    @property
    def worn(self) -> Tensor:
        """Coefficients (M,) of the mean clothes."""
        return self.mean[len(self.body) :]

    def rest(self, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rest state for coefficients, see `ShapeSpace.rest`."""
        vertices, frames = self.body.rest(coefficients[..., : len(self.body)])
        return vertices + self._offset(coefficients).unsqueeze(-1) * self.normals, frames

    def rest_jacobian(self, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Return the derivatives of the rest state, see `ShapeSpace.rest_jacobian`."""
        by_vertex, by_frame = self.body.rest_jacobian(coefficients[:, : len(self.body)])
        modes = (self.normals.unsqueeze(-1) * self.modes.unsqueeze(-2)).expand(len(by_vertex), -1, -1, -1)
        still = by_frame.new_zeros(*by_frame.shape[:-1], modes.shape[-1])
        return torch.cat([by_vertex, modes], dim=-1), torch.cat([by_frame, still], dim=-1)

    def restricted(self, index: Tensor) -> ClothedSpace:
        """Return the space with some of the vertices only, by index (U,)."""
        return ClothedSpace(self.body.restricted(index), self.normals[index], self.modes[index], self.worn)

    def clothing_offset(self, coefficients: Tensor) -> Tensor:
        """Return how far clothes lie off the skin (..., V), metres; they are nowhere inside it."""
        return self._offset(coefficients).clamp_min(0)

    def _offset(self, coefficients: Tensor) -> Tensor:
        return coefficients[..., len(self.body) :] @ self.modes.mT


def may_be_clothed(shape: ArticulatedShape, clothed: bool | str, fit_shape: bool | str) -> bool | str:
    """Return whether clothes are fitted to a shape: True, "auto", or False where it is no body that can wear any."""
    if clothed not in (True, False, "auto"):
        raise InputError(f"clothed must be 'auto', True or False, got {clothed!r}")
    known = tuple(begin for cover in COVERS for begin in cover.parts)
    is_body = fit_shape is True and all(name.lower().startswith(known) for name in shape.part_names)
    if clothed is True and not is_body:
        raise InputError("clothed=True needs fit_shape=True and a body whose parts are named as anny's")
    return clothed if is_body else False


def clothed_rig(shape: ArticulatedShape) -> ArticulatedShape:
    """Return a body with clothes: the leading modes of a Gaussian process on its skin as further coefficients."""
    surface, space = shape.file_surface(), shape.coefficient_space()
    region = torch.tensor([
        next(number for number, cover in enumerate(COVERS) if name.lower().startswith(cover.parts))
        for name in shape.part_names
    ])  # fmt: skip
    by_region = surface.weights.double().cpu() @ one_hot(region, len(COVERS)).double()
    table = torch.tensor([[cover.mean, cover.garment, cover.local] for cover in COVERS], dtype=torch.float64)
    mean, _, local = (by_region @ table).unbind(-1)
    points = space.rest(space.mean)[0].double().cpu()
    chosen = farthest_points(points, CLOTH.num_points)

    def covariance(rows: Tensor) -> Tensor:
        near = (-torch.cdist(points[rows], points[chosen]).square() / (2 * CLOTH.length**2)).exp()
        whole = (by_region[rows] * table[:, 1]) @ (by_region[chosen] * table[:, 1]).mT
        return whole + local[rows, None] * local[chosen] * near

    values, vectors = torch.linalg.eigh(covariance(chosen))
    values, vectors = values[-CLOTH.num_modes :], vectors[:, -CLOTH.num_modes :]
    # Nystrom's extension to all vertices.
    modes = covariance(torch.arange(len(points))) @ vectors / values.sqrt()
    worn = vectors.mT @ mean[chosen] / values.sqrt()
    normals = TriangleMesh(points, surface.faces.cpu()).vertex_normals()
    other = copy.deepcopy(shape)
    cloth = (value.to(space.mean) for value in (normals, modes, worn))
    other.space = ClothedSpace(space, *cloth)
    return other


Fit = Callable[[ShapeProblem, Tensor], Tensor]


@dataclass(frozen=True)
class _Mixture:
    """Numbers of the mixture of data on the surface, normally distributed, and of others, evenly distributed."""

    reach: float = 0.1  # of the others, to both sides, as a share of the size
    steps: int = 20  # of EM, which hardly changes the likelihood further
    bare_std: float = 0.2  # of the modes of clothes on bare skin: errors of a body's model, 2 to 3 mm


_MIXTURE = _Mixture()


def are_clothes_likelier(problem: ShapeProblem, state: Tensor, fit: Fit) -> bool:
    """Return whether the data are likelier with clothes, whose coefficients are the last of states (T, D + K).

    Both hypotheses are fitted from the states, those of a bare person in mean clothes: the skin of a bare person is off
    the model by as much as bodies are. Evidence by Laplace's approximation (MacKay 1992): data that err together under
    either count once, and a hypothesis pays for the volume of its prior that the data exclude.
    """
    bare, naked = _bare(problem), state.clone()
    naked[:, -CLOTH.num_modes :] = 0
    naked, state = fit(bare, naked), fit(problem, state)
    likelihoods, shared = zip(*(_likelihood(problem, each) for each in (naked, state)), strict=True)
    gained = float(likelihoods[1] - likelihoods[0]) / max(shared)
    return gained + _prior_evidence(problem, state) - _prior_evidence(bare, naked) > 0


def _bare(problem: ShapeProblem) -> ShapeProblem:
    """Return the problem of a bare person."""
    prior = problem.prior
    worn = torch.arange(prior.precision.shape[-1]) >= prior.precision.shape[-1] - CLOTH.num_modes
    skin = replace(
        prior, mean=torch.where(worn, 0.0, prior.mean),
        precision=torch.where(worn, _MIXTURE.bare_std**-2, prior.precision),
    )  # fmt: skip
    return replace(problem, prior=skin)


def _prior_evidence(problem: ShapeProblem, state: Tensor) -> float:
    """Return the prior's density at states (T, D + K) times the posterior's volume of clothes, as a logarithm."""
    worn = slice(-CLOTH.num_modes, None)
    posterior = noise_covariance(problem, problem.robust_rows(state))[0].double()
    precision = problem.prior.precision[..., worn].double()
    volume = torch.linalg.slogdet(posterior[worn, worn]).logabsdet + precision.log().sum()
    return 0.5 * float(volume) - float(problem.prior.cost(state).sum())


def _likelihood(problem: ShapeProblem, state: Tensor) -> tuple[Tensor, float]:
    """Return the log-likelihood () of data about the surface in states, and how many of them err as one."""
    distance = problem.surface.distance(problem.data, state)
    noise = surface_noise(distance, problem.valid, problem.size).unsqueeze(-1)
    share, elsewhere = torch.full_like(noise, 0.5), 1 / (2 * _MIXTURE.reach * problem.size)
    squares = distance.square()
    for _ in range(_MIXTURE.steps):
        on = share * (-0.5 * squares / noise.square()).exp() / (math.sqrt(2 * math.pi) * noise)
        total = on + (1 - share) * elsewhere
        posterior = on / total * problem.valid
        count = posterior.sum(-1, keepdim=True).clamp_min(1)
        share = count / problem.valid.sum(-1, keepdim=True)
        noise = ((posterior * torch.where(posterior > 0, squares, 0.0)).sum(-1, keepdim=True) / count).sqrt()
    shared = correlated_count(neighbor_correlation(problem.data, distance, posterior))
    return (total.log() * problem.valid).sum(), float(shared.mean())
