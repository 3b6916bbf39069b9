"""The rest state of a rig as a function of shape coefficients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

RestFunction = Callable[[Tensor], tuple[Tensor, Tensor]]


@dataclass(frozen=True, eq=False)
class CoefficientPrior:
    """A prior on K shape coefficients: mean, standard deviations and limits.

    Coefficients of one number in ``alike`` (K,) share an unknown deviation, of which ``std`` is a guess; -1: others.
    """

    names: tuple[str, ...]
    mean: Tensor
    std: Tensor
    lower: Tensor
    upper: Tensor
    alike: Tensor | None = None

    @classmethod
    def normal(cls, names: Sequence[str], std: Tensor | float = 1.0, limit: float = 5.0) -> CoefficientPrior:
        """Return the prior of coefficients about zero, which lie within so many standard deviations."""
        deviations = torch.as_tensor(std, dtype=torch.float64).expand(len(names)).clone()
        return cls(
            names=tuple(names), mean=torch.zeros_like(deviations), std=deviations, lower=-limit * deviations,
            upper=limit * deviations,
        )  # fmt: skip


class ShapeSpace(nn.Module):
    """Rest vertices and rest frames of a rig that depend on K coefficients."""

    mean: Tensor
    std: Tensor
    lower: Tensor
    upper: Tensor
    alike: Tensor | None

    def __init__(self, prior: CoefficientPrior) -> None:
        super().__init__()
        self.names = prior.names
        for name in ("mean", "std", "lower", "upper", "alike"):
            value = getattr(prior, name)
            self.register_buffer(name, None if value is None else value.detach().clone(), persistent=False)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def prior(self) -> CoefficientPrior:
        """What is known of the coefficients before any data."""
        return CoefficientPrior(
            self.names, mean=self.mean, std=self.std, lower=self.lower, upper=self.upper, alike=self.alike
        )  # fmt: skip

    def rest(self, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Return rest vertices (..., V, 3) and positions of the tree's frames (..., F, 3) for coefficients (..., K)."""
        raise NotImplementedError

    def rest_jacobian(self, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Return the derivatives (B, V, 3, K) and (B, F, 3, K) of the rest state by coefficients (B, K)."""
        by_vertex, by_frame = _row_jacobians(self.rest, coefficients)
        return by_vertex, by_frame

    def restricted(self, index: Tensor) -> ShapeSpace:
        """Return the space with some of the vertices only, by index (U,)."""
        raise NotImplementedError


class Features(nn.Module):
    """Functions of the coefficients, of which rest states are linear."""

    def jacobian(self, coefficients: Tensor) -> Tensor:
        """Return the derivatives (..., L, K) of the features (..., L) by coefficients (..., K)."""
        raise NotImplementedError


class LinearSpace(ShapeSpace):
    """Rest states linear in features of the coefficients, ``vertices + vertex_dirs @ features(c)``; None: in them."""

    vertices: Tensor
    vertex_dirs: Tensor
    frames: Tensor
    frame_dirs: Tensor

    def __init__(
        self,
        vertices: Tensor,
        vertex_dirs: Tensor,
        frames: Tensor,
        frame_dirs: Tensor,
        prior: CoefficientPrior,
        features: Features | None = None,
    ) -> None:
        super().__init__(prior)
        self.features = features
        arrays = {"vertices": vertices, "vertex_dirs": vertex_dirs, "frames": frames, "frame_dirs": frame_dirs}
        for name, value in arrays.items():
            self.register_buffer(name, value, persistent=False)

    def rest(self, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rest state for coefficients, see `ShapeSpace.rest`."""
        values = coefficients if self.features is None else self.features(coefficients)
        return self.vertices + _along(self.vertex_dirs, values), self.frames + _along(self.frame_dirs, values)

    def rest_jacobian(self, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Return the derivatives of the rest state, see `ShapeSpace.rest_jacobian`."""
        batch = len(coefficients)
        if self.features is None:
            return self.vertex_dirs.expand(batch, -1, -1, -1), self.frame_dirs.expand(batch, -1, -1, -1)
        slopes = self.features.jacobian(coefficients)
        # One product for the whole batch: the directions, which are many, are read once.
        slopes = slopes.movedim(0, 1).flatten(1)
        by_vertex, by_frame = (
            (directions @ slopes).unflatten(-1, (batch, -1)).movedim(-2, 0)
            for directions in (self.vertex_dirs, self.frame_dirs)
        )
        return by_vertex, by_frame

    def restricted(self, index: Tensor) -> LinearSpace:
        """Return the space with some of the vertices only, by index (U,)."""
        return LinearSpace(
            self.vertices[index], self.vertex_dirs[index], self.frames, self.frame_dirs, self.prior, self.features
        )


class FunctionSpace(ShapeSpace):
    """Rest states of any function of coefficients (..., K), twice differentiable row by row.

    It gives vertices (..., V, 3) and joints (..., J, 3), metres; ``owners`` (F,) are the joints of the frames of the
    tree, ``index`` (U,) the vertices that count.
    """

    owners: Tensor

    def __init__(
        self, function: RestFunction, owners: Tensor, prior: CoefficientPrior, index: Tensor | None = None
    ) -> None:
        super().__init__(prior)
        self.function, self.index = function, index
        self.register_buffer("owners", owners, persistent=False)

    def rest(self, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rest state for coefficients, see `ShapeSpace.rest`."""
        vertices, joints = self.function(coefficients)
        vertices = vertices if self.index is None else vertices.index_select(-2, self.index)
        return vertices, joints.index_select(-2, self.owners)

    def restricted(self, index: Tensor) -> FunctionSpace:
        """Return the space with some of the vertices only, by index (U,)."""
        chosen = index if self.index is None else self.index[index]
        return FunctionSpace(self.function, self.owners, self.prior, chosen)


def _along(directions: Tensor, values: Tensor) -> Tensor:
    """Return the sums (..., V, 3) of directions (V, 3, L) times values (..., L)."""
    return (values @ directions.flatten(0, 1).mT).unflatten(-1, (-1, 3))


def _row_jacobians(function: Callable[[Tensor], tuple[Tensor, ...]], inputs: Tensor) -> list[Tensor]:
    """Return the derivatives (B, ..., K) of each value (B, ...) of a function of rows (B, K), each by its own row."""
    with torch.inference_mode(False), torch.enable_grad():
        rows = inputs.detach().clone().requires_grad_()
        values = function(rows)
        jacobians = []
        for value in values:
            probe = torch.zeros_like(value, requires_grad=True)
            (product,) = torch.autograd.grad(value, rows, probe, create_graph=True)
            columns = [
                torch.autograd.grad(product[:, k].sum(), probe, retain_graph=True)[0] for k in range(rows.shape[-1])
            ]
            jacobians.append(torch.stack(columns, dim=-1))
    return jacobians
