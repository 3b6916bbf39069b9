"""Gradients of a fitted person's pose and coefficients in the data, by the implicit function."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.alignment.fit.implicit_gradient import FixedPoint, attach_gradients
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, surface_noise
from torchreg.alignment.shape.shape_fit import FittedShape
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.shaped import ShapedSkin, ShapedTree


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
