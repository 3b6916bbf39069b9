"""Locked degrees of freedom, and priors on others, as from encoders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_shape
from torchreg.alignment.fit.objectives import GaussianPosePrior
from torchreg.alignment.fit.problem import BROAD_PRIOR, AlignProblem, errors_per_patch
from torchreg.errors import InputError, InputTypeError
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.pose_algebra import BASE_DOF_NAMES, BASE_DOFS, shifted

# Name for all six degrees of freedom of the base.
_BASE = "base"
# Standard deviation of what is held, metres and radians: far below what anything measures.
_HELD_STD = 1e-5


@dataclass(frozen=True, eq=False)
class KnownDofs:
    """Locked degrees of freedom (num_dofs,), and mean and std ((B,) num_dofs) of a prior; zero and infinite without."""

    locked: Tensor
    mean: Tensor
    std: Tensor

    @classmethod
    def of(cls, shape: ArticulatedShape, locked: Any, prior: Any) -> KnownDofs | None:
        """Parse ``locked`` and ``prior`` as given to `align`; None if there is neither."""
        held = _read_locked(shape, locked)
        if prior is None:
            return (
                cls(held, torch.zeros_like(shape.rest), torch.full_like(shape.rest, torch.inf)) if held.any() else None
            )
        if not isinstance(prior, Sequence) or isinstance(prior, str) or len(prior) != 2:
            raise InputTypeError("prior must be a pair of mean and standard deviation")
        mean, std = _read_mean(shape, prior[0]), prior[1]
        named = mean.isfinite()
        if isinstance(std, (int, float)):
            joints = torch.arange(shape.num_dofs, device=named.device) >= BASE_DOFS
            chosen = named if isinstance(prior[0], Mapping) else named & joints
            deviation = torch.where(chosen, torch.full_like(shape.rest, std), torch.inf)
        else:
            deviation = _read_values(shape, std, "the deviation of prior", torch.inf)
        deviation = torch.where(named, deviation.expand_as(mean), torch.inf)
        if not bool((deviation > 0).all()):
            raise InputError("prior must have positive standard deviations; lock what is known exactly")
        return cls(held, mean.nan_to_num(0.0), deviation)

    def holding(self, pose: Tensor) -> KnownDofs:
        """Return the same with locked degrees of freedom at their values in a pose (num_dofs,), also in a search."""
        mean = torch.where(self.locked, pose.to(self.mean), self.mean)
        return replace(self, mean=mean, std=torch.where(self.locked, _HELD_STD, self.std))

    def start(self, shape: Articulation, pose: Tensor | None = None) -> Tensor:
        """Return the prior's mean where it has one, elsewhere a given pose or the rest pose."""
        return torch.where(self.std.isfinite(), self.mean, shape.rest if pose is None else pose)

    @property
    def places_base(self) -> bool:
        """Whether the base is known without a search: held, or with a prior."""
        return bool((self.locked | self.std.isfinite())[..., :BASE_DOFS].all())

    def near(self, origin: Tensor) -> KnownDofs:
        """Return the same in coordinates that begin at an origin (3,)."""
        return replace(self, mean=torch.where(self.std.isfinite(), shifted(self.mean, -origin.to(self.mean)), 0.0))

    def with_prior(self, problem: AlignProblem, start: Tensor) -> AlignProblem:
        """Return a problem with this prior, as many times as data share an error, and limits about starts (B, D)."""
        has_prior = self.std.isfinite()
        mean = torch.where(has_prior, shifted(self.mean.expand_as(start), -problem.origin), problem.prior.mean)
        told = torch.where(has_prior, self.std, 1.0).square().reciprocal()
        factor = errors_per_patch(problem.data, problem.valid, problem.size).unsqueeze(-1)
        precision = torch.where(has_prior, told * factor, problem.prior.precision)
        lower, upper = (limit.expand_as(start) for limit in (problem.lower, problem.upper))
        return replace(
            problem,
            lower=torch.where(self.locked, start, lower),
            upper=torch.where(self.locked, start, upper),
            prior=GaussianPosePrior(mean, precision, holds_base=bool(has_prior[..., :BASE_DOFS].any())),
            prior_precision=torch.where(has_prior, told, 0.0).expand_as(start),
        )

    def substitute_prior_means(self, problem: AlignProblem, poses: Tensor) -> Tensor:
        """Return candidates (B, K, num_dofs) with the prior's mean where it says more than that a pose is plausible."""
        broad = BROAD_PRIOR.precision(problem.skin.shape, problem.size).rsqrt()
        known = (self.std < broad).expand_as(problem.prior.mean).unsqueeze(1)
        return torch.where(known, problem.prior.mean.unsqueeze(1), poses)


def _read_locked(shape: ArticulatedShape, locked: Any) -> Tensor:
    """Return the mask (num_dofs,) of what is held."""
    if isinstance(locked, Tensor):
        if locked.dtype != torch.bool or locked.shape != shape.rest.shape:
            raise InputError(f"locked must be a mask ({shape.num_dofs},) of bool, or names of degrees of freedom")
        return locked.to(shape.rest.device)
    names = (locked,) if isinstance(locked, str) else tuple(locked)
    names = tuple(name for given in names for name in (BASE_DOF_NAMES if given == _BASE else (given,)))
    _check_names(shape, names, "locked")
    return torch.tensor([name in names for name in shape.dof_names], device=shape.rest.device)


def _check_names(shape: ArticulatedShape, names: Sequence[str], argument: str) -> None:
    unknown = [name for name in names if name not in shape.dof_names]
    if unknown:
        raise InputError(
            f"{argument} names {unknown[0]!r}, which is no degree of freedom; there are {_BASE} for all six of the "
            f"base, and {', '.join(shape.dof_names)}"
        )


def _read_mean(shape: ArticulatedShape, mean: Any) -> Tensor:
    found = _read_values(shape, mean, "the mean of prior", torch.nan)
    if not isinstance(mean, Mapping) and not bool(found.isfinite().all()):
        raise InputError("the mean of prior must be finite; name what it holds for to leave others out")
    return found


def _read_values(shape: ArticulatedShape, values: Any, name: str, missing: float) -> Tensor:
    """Return values (..., num_dofs) given as a tensor or by name."""
    if isinstance(values, Mapping):
        _check_names(shape, tuple(values), name)
        row = [float(values.get(dof, missing)) for dof in shape.dof_names]
        return torch.tensor(row, dtype=shape.rest.dtype, device=shape.rest.device)
    found = as_float_tensor(values, name, like=shape.rest).detach()
    check_shape(found, name, (shape.num_dofs,), batch=True)
    return found
