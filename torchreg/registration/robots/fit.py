"""All joints and all frames of a robot fitted to the scans together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.geometry.rigid import adjoint, se3_exp
from torchreg.geometry.rotation import skew
from torchreg.registration.robots.fusion import FusedScans
from torchreg.registration.robots.surfaces import Blocks, Noise, Surfaces
from torchreg.solvers.levenberg_marquardt import shared_information


@dataclass(frozen=True)
class FitNumbers:
    """Of the fit of all joints."""

    scales: tuple[float, ...] = (6.0, 5.0, 4.0, 3.0, 3.0, 3.0)  # of robust kernels, step by step, standard deviations
    wide: tuple[float, ...] = (0.04, 0.03, 0.02, 0.01)  # of the thing's size: steps from a neighboring frame's pose
    left: float = 2.0  # last steps of an axis that it is from its end: each is about two thirds of the one before
    damping: float = 1e-3  # of the mean curvature of a part's motion, for what the data do not hold
    rounding: float = 1e-8  # the same for covariances: damping is no datum, and against rounding alone this is enough


FIT = FitNumbers()


# What is fitted: samples to scans, or scans to each other.
Data = Surfaces | FusedScans


@dataclass(frozen=True, eq=False)
class Mechanism:
    """Links on a tree of joints, and their values in T frames, in the coordinates of the reference."""

    parents: Sequence[int]  # (K,) of each link; -1 for the root, which comes first; parents come before children
    axes: Tensor  # (K, 6) twists of the joints about which links move, unit turns or slides; zero for the root
    base: Tensor  # (T, 4, 4) motions of the root
    values: Tensor  # (T, K), radians or lengths; zero for the root
    held: bool = False  # whether the root stays where it is

    def motions(self) -> Tensor:
        """Return the motions (T, K, 4, 4) of all links."""
        turns = se3_exp(self.values.unsqueeze(-1) * self.axes)
        found: list[Tensor] = []
        for link, parent in enumerate(self.parents):
            found.append(self.base if parent < 0 else found[parent] @ turns[:, link])
        return torch.stack(found, 1)

    def with_frame(self, frame: int) -> Mechanism:
        """Return the mechanism in one more frame, that in whose coordinates it is."""
        base, values = (
            torch.cat([rows[:frame], new.unsqueeze(0), rows[frame:]])
            for rows, new in ((self.base, torch.eye(4).double()), (self.values, torch.zeros_like(self.axes[:, 0])))
        )
        return replace(self, base=base, values=values)

    def without_frame(self, frame: int) -> Mechanism:
        """Return the mechanism in one frame less."""
        kept = torch.arange(len(self.values)) != frame
        return replace(self, base=self.base[kept], values=self.values[kept])

    def steps_from(self, before: Mechanism) -> Tensor:
        """Return the twists (K, 6) that took the joints' axes from where they were before, at most across them."""
        along, turn = self.axes[:, 3:], torch.linalg.cross(before.axes[:, 3:], self.axes[:, 3:])
        shift = self.axes[:, :3] - before.axes[:, :3] - torch.linalg.cross(turn, before.axes[:, :3])
        return torch.cat([torch.linalg.cross(along, shift), turn], -1)

    def stepped(self, base: Tensor, values: Tensor, axes: Tensor) -> Mechanism:
        """Return the mechanism after steps of the base (T, 6), the values (T, K) and the axes, twists (K, 6)."""
        moved = (adjoint(se3_exp(axes)) @ self.axes.unsqueeze(-1)).squeeze(-1)
        return replace(self, base=se3_exp(base) @ self.base, values=self.values + values, axes=moved)

    def jacobians(self, motions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the links' twists by the joint values (T, K, 6, K) and by steps of the axes (T, K, 6, K, 6)."""
        frames, size = self.values.shape
        by_value = torch.zeros(frames, size, 6, size, dtype=torch.float64)
        by_axis = torch.zeros(frames, size, 6, size, 6, dtype=torch.float64)
        eye = torch.eye(6).double()
        for link, parent in enumerate(self.parents):
            if parent < 0:
                continue
            by_value[:, link], by_axis[:, link] = by_value[:, parent], by_axis[:, parent]
            seen = adjoint(motions[:, parent])
            turn = se3_exp(self.values[:, link].unsqueeze(-1) * self.axes[link])
            by_value[:, link, :, link] = seen @ self.axes[link]
            by_axis[:, link, :, link] = seen @ (eye - adjoint(turn))
        return by_value, by_axis


def fitted(
    surfaces: Data, mechanism: Mechanism, label: Tensor, scales: Sequence[float], *, axes: bool = True
) -> Mechanism:
    """Return the mechanism after a Gauss-Newton step of point-to-plane residuals at each of some robust scales."""
    for scale in scales:
        mechanism = _step(surfaces, mechanism, label, scale, axes)
    return mechanism


@dataclass(frozen=True, eq=False)
class _System:
    """Gauss-Newton system of all frames: steps of each frame, D = 6 + K numbers, then the S of what all frames share.

    These are steps of the axes, 6 K, in scans that are compared with each other then those of the parts, made of all.
    """

    by_step: Tensor  # (T, K, 7, D + S + 1) the parts' twists by steps; the last row and column are the gradient's
    sums: Tensor  # (T, D + S + 1, D + S + 1) the Hessian, and the gradient as its last row and column
    own: int  # D
    hold: Tensor  # (S,)

    @classmethod
    def of(cls, data: Data, mechanism: Mechanism, label: Tensor, scale: float, damping: float) -> _System:
        """Return the system of the normal equations of all parts at a robust scale, damped by a share of curvature."""
        motions, (frames, size) = mechanism.motions(), mechanism.values.shape
        blocks = data.blocks(motions, label, scale)
        by_value, by_axis = mechanism.jacobians(motions)
        # Twists about the origin move a part's center c by v + w x c.
        change = torch.eye(6).double().repeat(frames, size, 1, 1)
        change[..., :3, 3:] = -skew(blocks.centers)
        by_base = torch.eye(6).double() * (not mechanism.held)
        own = change @ torch.cat([by_base.expand(frames, size, 6, 6), by_value], -1)
        shared = change @ by_axis.flatten(-2)
        if data.reference is not None:
            # Parts stay where the other scans put them only until these move: without that, steps are far too short.
            own[data.reference] = 0
            parts = torch.zeros(frames, size, 6, size, 6, dtype=torch.float64)
            parts[:, range(size), :, range(size)] = (change @ adjoint(motions)).transpose(0, 1)
            shared = torch.cat([shared, parts.flatten(-2)], -1)
        metric = torch.tensor([1.0] * 3 + [(0.5 * data.size) ** 2] * 3, dtype=torch.float64)
        weight = blocks.hessian.diagonal(dim1=-2, dim2=-1)[..., :3].mean(-1)
        held = blocks.hessian + torch.diag_embed(damping * weight.mean() * metric.expand(frames, size, 6))
        by_step = torch.nn.functional.pad(torch.cat([own, shared], -1), (0, 1, 0, 1))
        by_step[..., -1, -1] = 1
        sums = _summed(by_step, replace(blocks, hessian=held))
        local = sums.diagonal(dim1=-2, dim2=-1)[:, : own.shape[-1]]
        local += 1e-9 * (local + weight.mean())
        hold = damping * weight.mean() * metric.repeat(shared.shape[-1] // 6) + 1e-9
        return cls(by_step, sums, own.shape[-1], hold)

    def shared(self, sums: Tensor) -> tuple[Tensor, Tensor]:
        """Return what sums of frames tell of what these share: matrices (T, S, S) and gradients (T, S)."""
        found = shared_information(sums, self.own)
        return found[..., :-1, :-1], found[..., :-1, -1]

    def shared_steps(self) -> Tensor:
        """Return the steps (S,) of what all frames share."""
        matrices, gradients = self.shared(self.sums)
        return -torch.linalg.solve(matrices.sum(0) + torch.diag(self.hold), gradients.sum(0))

    def own_steps(self, step: Tensor) -> Tensor:
        """Return the best steps (T, D) of the frames beside one (S,) of what they share."""
        local, (mixed, gradient) = self.sums[:, : self.own], (slice(self.own, -1), -1)
        return -torch.linalg.solve(local[..., : self.own], local[..., gradient] + local[..., mixed] @ step)

    def axes_covariance(self, variance: float, pieces: Blocks, owner: Tensor) -> Tensor:
        """Return the covariance (S, S) of the axes: of errors of a variance, and of what differs between clusters.

        What the points of a frame share, or those of a piece (P,) of a link in all frames, the noise of their residuals
        does not show; it shows in how far the axes move when one is left out, here by one step each (the cluster
        jackknife of survey statistics, in two directions: Cameron, Gelbach and Miller 2011).
        """
        hold, (matrices, gradients) = torch.diag(self.hold), self.shared(self.sums)
        everything, gradient = matrices.sum(0) + hold, gradients.sum(0)
        frames = _spread([(everything - own, gradient - part) for own, part in zip(matrices, gradients, strict=True)])
        without = []
        for number, link in enumerate(owner.tolist()):
            matrices, gradients = self.shared(self.sums - _summed(self.by_step[:, [link]], pieces.only(number)))
            without.append((matrices.sum(0) + hold, gradients.sum(0)))
        return variance * torch.linalg.pinv(everything, hermitian=True) + frames + _spread(without)


def _summed(by_step: Tensor, blocks: Blocks) -> Tensor:
    """Return the sums (T, N, N) over parts (T, K) that steps move by (T, K, 7, N) of Hessians bordered by gradients."""
    bordered = torch.nn.functional.pad(blocks.hessian, (0, 1, 0, 1))
    bordered[..., :6, 6] = bordered[..., 6, :6] = blocks.gradient
    return by_step.flatten(1, 2).mT @ (bordered @ by_step).flatten(1, 2)


def _spread(systems: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
    """Return the jackknife covariance (D, D) of the solutions of systems that lack a cluster each; of two, zero."""
    matrices, gradients = (torch.stack(values) for values in zip(*systems, strict=True))
    moved = torch.linalg.solve(matrices, gradients.unsqueeze(-1)).squeeze(-1)
    count, moved = len(moved), moved - moved.mean(0)
    return (count - 1) / count * moved.mT @ moved * (count >= 3)


def _step(surfaces: Data, mechanism: Mechanism, label: Tensor, scale: float, axes: bool) -> Mechanism:
    size = mechanism.values.shape[1]
    system = _System.of(surfaces, mechanism, label, scale, FIT.damping)
    step = system.shared_steps() if axes else torch.zeros_like(system.hold)
    own = system.own_steps(step)
    return mechanism.stepped(own[:, :6], own[:, 6:], step[: 6 * size].reshape(size, 6))


def axis_stds(
    surfaces: Data, mechanism: Mechanism, noise: Noise, steps: Tensor, label: Tensor, points: Tensor
) -> tuple[Tensor, Tensor]:
    """Return standard deviations (K,) of the joints' directions, radians, and of their axes at points (K, 3).

    ``steps``: (K, 6) last steps of the axes, which are not at their end.
    """
    motions, scale, size = mechanism.motions(), FIT.scales[-1] * noise.sigma, len(points)
    system = _System.of(surfaces, mechanism, label, scale, FIT.rounding)
    everything = system.axes_covariance(noise.sigma**2 * noise.repeats, *surfaces.piecewise(motions, label, scale))
    own = everything[: 6 * size, : 6 * size].reshape(size, 6, size, 6)[range(size), :, range(size)]
    own = own + FIT.left**2 * steps.unsqueeze(-1) * steps.unsqueeze(-2)
    turns = mechanism.axes[:, 3:].any(-1)
    directions = torch.where(turns.unsqueeze(-1), mechanism.axes[:, 3:], mechanism.axes[:, :3])
    # A twist (v, w) turns a direction a by w x a, and moves a point p of the axis by v + w x p, what counts across it.
    turned = torch.cat([torch.zeros(size, 3, 3).double(), -skew(directions)], -1)
    across = torch.eye(3).double() - directions.unsqueeze(-1) * directions.unsqueeze(-2)
    moved = across @ torch.cat([torch.eye(3).double().expand(size, 3, 3), -skew(points)], -1)
    direction, place = (torch.linalg.eigvalsh(by @ own @ by.mT)[:, -1].clamp_min(0).sqrt() for by in (turned, moved))
    return direction, torch.where(turns, place, 0.0)


def settled(surfaces: Surfaces, mechanism: Mechanism, label: Tensor, noise: Noise) -> Mechanism:
    """Return the mechanism fitted to all scans, also in frames that registration got wrong."""
    scales = [scale * noise.sigma for scale in FIT.scales]
    mechanism = _from_neighbors(surfaces, fitted(surfaces, mechanism, label, scales), label, noise)
    return fitted(surfaces, mechanism, label, scales)


def _from_neighbors(surfaces: Surfaces, mechanism: Mechanism, label: Tensor, noise: Noise) -> Mechanism:
    """Return the mechanism with each frame's pose that of least cost: its own, or one found from a frame beside it."""
    scales = [share * surfaces.size for share in FIT.wide] + [scale * noise.sigma for scale in FIT.scales[2:]]
    kernel = FIT.scales[0] * noise.sigma
    best, cost = mechanism, surfaces.cost(mechanism.motions(), label, kernel).sum(-1)
    for shift in (1, -1):
        order = (torch.arange(len(mechanism.values)) + shift).clamp(0, len(mechanism.values) - 1)
        start = replace(best, base=best.base[order], values=best.values[order])
        found = fitted(surfaces, start, label, scales, axes=False)
        new = surfaces.cost(found.motions(), label, kernel).sum(-1)
        better = new < cost
        base = torch.where(better[:, None, None], found.base, best.base)
        best = replace(best, base=base, values=torch.where(better[:, None], found.values, best.values))
        cost = torch.minimum(cost, new)
    return best
