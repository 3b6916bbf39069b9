"""Clothes of a body as further coefficients: a smooth offset of its skin whose distribution is known by region."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import one_hot

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
