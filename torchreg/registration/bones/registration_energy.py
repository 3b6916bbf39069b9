"""The energy of scan registration, a sum of terms by name, as a module that tells how well bones fit matches."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchreg._checks import as_float_tensor, check_finite, check_positive, check_same_kind, check_shape
from torchreg.errors import InputError, InputTypeError
from torchreg.registration.bones.correspondences import Correspondences, ScanDistance, check_share
from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.registration.bones.grid_losses import (
    JointEnergy,
    closeness_energy,
    normalization_energy,
    smoothness_energy,
)
from torchreg.registration.bones.joint_moments import JointMoments


@dataclass(frozen=True, eq=False)
class EnergyState:
    """The variables of the terms of the energy: points (..., N, 3) before they are moved, and the model's state."""

    model: GridLBS
    transforms: Tensor
    points: Tensor
    correspondences: Correspondences
    edges: Tensor  # (E, 2) corners that an edge of a cell joins
    label_weights: Tensor  # (K, B) of the labels
    known_moments: JointMoments | None = None  # of what bones share, where they are known already

    @cached_property
    def moved(self) -> Tensor:
        """The moved points (..., N, 3)."""
        return self.model(self.points, self.transforms)

    @cached_property
    def moments(self) -> JointMoments:
        """Of what bones share."""
        if self.known_moments is not None:
            return self.known_moments
        with torch.no_grad():
            found = self.model.joint_moments()
        # With the pairs known, the gradient is right at weights of zero too.
        return self.model.joint_moments(pairs=found.pairs) if torch.is_grad_enabled() else found

    @property
    def squared_spacing(self) -> float:
        """The square of the edge length of a cell."""
        return self.model.grid.spacing**2


def _distance(state: EnergyState) -> Tensor:
    """Return the mean squared residual (...) in cells, for each cell: the matches count as if there were one a cell."""
    pairs = state.correspondences
    mean = ScanDistance(pairs.point_to_point)(state.moved, pairs.targets, pairs.normals, pairs.weights)
    return len(state.model.grid_cells) / state.squared_spacing * mean


class EnergyTerm(NamedTuple):
    """A term of the energy: its value (...) of a state, () where motions do not matter, and the paper's weight."""

    value: Callable[[EnergyState], Tensor]
    weight: float


# A new term is a function of the state, and a row here.
TERMS = {
    "distance": EnergyTerm(_distance, 1.0),
    "joint": EnergyTerm(lambda s: JointEnergy()(s.transforms, s.moments) / s.squared_spacing, 0.05),
    "smoothness": EnergyTerm(lambda s: smoothness_energy(s.model.weights, s.edges), 0.5),
    "norm": EnergyTerm(lambda s: normalization_energy(s.model.weights), 1.0),
    "discontinuity": EnergyTerm(lambda s: closeness_energy(s.model.weights, s.label_weights), 0.0),
}


def term_weights(**given: float) -> dict[str, float]:
    """Return the weights of all terms by name: those given, and the defaults of all others."""
    if unknown := [name for name in given if name not in TERMS]:
        raise InputError(f"there is no energy term {unknown[0]!r}; known: {', '.join(TERMS)}")
    for name, weight in given.items():
        check_positive(weight, name, allow_zero=True)
    return {name: float(given.get(name, term.weight)) for name, term in TERMS.items()}


def energy_terms(state: EnergyState, weights: Mapping[str, float]) -> dict[str, Tensor]:
    """Return what each term adds to the energy of a state, by name, for the weights of all terms."""
    zero = state.points.new_zeros(())
    return {name: weights[name] * term.value(state) if weights[name] > 0 else zero for name, term in TERMS.items()}


class RegistrationEnergy(nn.Module):
    """The energy of bones on a grid that take points to matches: eq. 2, and with ``discontinuity`` eqs. 8 and 13.

    ``E = alpha C mean_k r_k^2 + beta sum_{i<j} tau_ij int w_i w_j |T_i x - T_j x|^2 dx + mu sum_{(c,d)} |v_c - v_d|^2
    + nu sum_c (1 - sum_j v_cj)^2 + lambda sum_c |v_c - v*_c|^2``: residuals r of the matches, see `ScanDistance`; the
    joint energy, see `JointEnergy`; weights v at the corners that vary little along the edges, add up to one and are
    near those of labels, v*. Lengths count in cells, so that the unit of the scans does not matter, and matches as if
    there were one in each of the C cells, about as many as in the paper.

    Parameters are those of the model. To move its weights, call `GridLBS.project_` after every step.

    Args:
        model: the bones and their weights, a submodule.
        label_weights: (K, B) v*, such as the weights of `GridLBS.from_labels`; those of the model now by default.
        point_to_point: s, see `ScanDistance`.
        weights: of the terms by name: alpha as ``distance``, beta as ``joint``, mu as ``smoothness``, nu as ``norm``
            and lambda as ``discontinuity``; by default 1, 0.05, 0.5, 1 and, for eq. 2, 0. The paper lets beta fall
            from 1 to 0.05, and has 0.1 to 0.5 for lambda.

    Raises:
        InputError: if there is no term of a name, a weight is negative or a shape does not fit.
        InputTypeError: if the model is no `GridLBS`.

    References: Chang and Zwicker 2009, eqs. 2, 4, 6 to 8 and 13, section 5 for the weights.
    """

    label_weights: Tensor
    edges: Tensor

    def __init__(
        self, model: GridLBS, *, label_weights: Tensor | None = None, point_to_point: float = 0.0, **weights: float
    ) -> None:
        super().__init__()
        if not isinstance(model, GridLBS):
            raise InputTypeError(f"model must be a GridLBS, got {type(model).__name__}")
        check_share(point_to_point, "point_to_point")
        if label_weights is None:
            label_weights = model.corner_weights()
        # A copy: those of the model may be learnt.
        label_weights = as_float_tensor(label_weights, "label_weights", like=model.weights).detach().clone()
        check_shape(label_weights, "label_weights", tuple(model.weights.shape))
        check_finite(label_weights, "label_weights")
        self.model = model
        self.point_to_point = float(point_to_point)
        self.term_weights = term_weights(**weights)
        self.register_buffer("label_weights", label_weights)
        self.register_buffer("edges", model.grid.edges(), persistent=False)

    def extra_repr(self) -> str:
        """Return the settings for the module's printed form."""
        weights = ", ".join(f"{name}={weight:g}" for name, weight in self.term_weights.items())
        return f"{weights}, point_to_point={self.point_to_point:g}"

    def forward(
        self,
        points: Tensor,
        targets: Tensor,
        normals: Tensor | None = None,
        match_weights: Tensor | None = None,
        transforms: Tensor | None = None,
    ) -> Tensor:
        """Return E (...) of every pose of the batch, without unit.

        Args:
            points: (..., N, 3) before they are moved, in the dtype of the model.
            targets: (..., N, 3) the points of the other scan that they correspond to.
            normals: (..., N, 3) unit normals at the targets; not needed for point to point alone.
            match_weights: (..., N) not negative, zero for a match that was dropped; ones by default.
            transforms: (..., B, 4, 4) poses to use instead of the model's own.

        Raises:
            InputError: if a shape does not fit, or normals are missing.
            InputTypeError: if dtypes or devices differ.

        Differentiable: in ``points``, ``targets``, ``transforms``, and the weights and twists of the model.

        Cost: 10 ms for 1,000 cells, 10 bones and 1,500 matches on one core, forward and backward; with the joint term
            40 ms, and 0.3 s where all bones have weight everywhere.

        References: Chang and Zwicker 2009, eq. 2.
        """
        first, *others = self.terms(points, targets, normals, match_weights, transforms).values()
        return sum(others, first)

    def terms(
        self,
        points: Tensor,
        targets: Tensor,
        normals: Tensor | None = None,
        match_weights: Tensor | None = None,
        transforms: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Return what each term adds to E, by name, its weight included: (...), or () where motions do not matter.

        Arguments, errors and gradients as of `forward`. Terms of weight zero are not computed.
        """
        check_shape(points, "points", ("N", 3), batch=True)
        check_same_kind(points, "points", self.model.weights, "model")
        if match_weights is None:
            match_weights = torch.ones_like(points[..., 0])
        state = EnergyState(
            model=self.model,
            transforms=self.model.pose(transforms),
            points=points,
            correspondences=Correspondences(targets, normals, match_weights, self.point_to_point),
            edges=self.edges,
            label_weights=self.label_weights,
        )
        return energy_terms(state, self.term_weights)
