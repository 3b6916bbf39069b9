"""Joints between links: a weld, a hinge, a slider or none, by the criterion of Schwarz on what the data hold."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.rigid import adjoint, invert_rigid, rigid_matrix, se3_exp, se3_log, transform_points
from torchreg.geometry.rotation import skew, so3_exp
from torchreg.registration.robots.surfaces import Blocks, Noise
from torchreg.solvers.levenberg_marquardt import Linearization, levenberg_marquardt


@dataclass(frozen=True)
class JointNumbers:
    """Of the fits of single joints."""

    steps: int = 15  # of a fit from each start
    loose: float = 1.0  # standard deviation where data hold nothing: a radian, or half the size of the thing
    ridge: float = 1e-6  # of the curvature, for directions that move no joint, as a shift along its axis


JOINTS = JointNumbers()


@dataclass(frozen=True, eq=False)
class Candidate:
    """The best joint between two links, in the coordinates of the reference."""

    kind: str  # "fixed", "revolute" or "prismatic"
    twist: Tensor  # (6,) of a unit turn or slide; zero for a weld
    values: Tensor  # (T,) of the joint
    length: float  # its description length minus that of a free motion: below zero, the data speak for the joint


@dataclass(frozen=True, eq=False)
class Relative:
    """Motions (T, 4, 4) of one link relative to another, in half sizes of the thing, and their weights."""

    motions: Tensor  # about the origin ``center``
    information: Tensor  # (T, 6, 6) inverse covariances of their errors, twists in the frame of the first link
    count: float  # effective number of residuals behind them
    center: Tensor  # (3,) between the two links
    unit: float  # length


def relative(motions: Tensor, blocks: Blocks, pair: tuple[int, int], noise: Noise, size: float) -> Relative:
    """Return the motions of the second link seen from the first."""
    unit, (first, second) = size / 2, pair
    variance = noise.sigma**2 * noise.repeats
    covariance = torch.zeros(len(motions), 6, 6, dtype=torch.float64)
    rest = invert_rigid(motions[:, first])
    back = transform_points(rest, blocks.centers[:, list(pair)])
    center = back.mean((0, 1))
    scale = torch.ones(6, dtype=torch.float64)
    scale[3:] = 1 / unit
    for number, link in enumerate((first, second)):
        hessian = scale.unsqueeze(-1) * blocks.hessian[:, link] * scale * (unit**2 / variance)
        hessian = hessian + torch.eye(6).double() / JOINTS.loose**2
        # A twist about the link's center in world coordinates, seen from the first link about ``center``.
        turn = rest[:, :3, :3]
        arm = skew((back[:, number] - center) / unit)
        change = torch.zeros_like(hessian)
        change[:, :3, :3], change[:, 3:, 3:], change[:, :3, 3:] = turn, turn, arm @ turn
        covariance += change @ torch.linalg.inv(hessian) @ change.mT
    shift = rigid_matrix(torch.eye(3).double(), -center)
    seen = shift @ rest @ motions[:, second] @ invert_rigid(shift)
    seen = rigid_matrix(seen[:, :3, :3], seen[:, :3, 3] / unit)
    count = float(blocks.count[:, list(pair)].sum()) / noise.repeats
    return Relative(seen, torch.linalg.inv(covariance), max(2.0, count), center, unit)


def best_joint(data: Relative) -> Candidate:
    """Return the joint of least description length: squared errors in standard deviations, and parameters."""
    frames, rate = len(data.motions), math.log(data.count)
    twists = se3_log(data.motions)
    weld = float((twists.unsqueeze(-2) @ data.information @ twists.unsqueeze(-1)).sum())
    still = torch.zeros(frames, dtype=torch.float64)
    found = {
        "fixed": (weld, torch.zeros(6, dtype=torch.float64), still),
        "revolute": _fitted(data, _screws(data, twists)),
        "prismatic": _fitted(data, _slides(data, twists)),
    }
    parameters = {"fixed": 0, "revolute": frames + 4, "prismatic": frames + 2}
    lengths = {kind: fit[0] + (parameters[kind] - 6 * frames) * rate for kind, fit in found.items()}
    kind = min(lengths, key=lambda name: lengths[name])
    _, twist, values = found[kind]
    if kind == "prismatic":
        return Candidate(kind, twist, data.unit * values, lengths[kind])
    # From half sizes about a center back to lengths about the origin.
    shift = data.unit * twist[:3] + torch.linalg.cross(data.center, twist[3:])
    return Candidate(kind, torch.cat([shift, twist[3:]]), values, lengths[kind])


def _screws(data: Relative, twists: Tensor) -> Tensor:
    """Return axes (S, 6) of turns to start from: those of every frame's motion, and of all together."""
    turns = twists[:, 3:]
    directions = torch.cat([turns, _together(data.information[:, 3:, 3:], turns)])
    directions = directions / directions.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    rows = []
    for direction in directions:
        # The point that all frames' turns about this direction leave in place.
        angles = turns @ direction
        turn = so3_exp(angles.unsqueeze(-1) * direction) - torch.eye(3).double()
        normal = (turn.mT @ turn).sum(0) + 1e-6 * torch.eye(3).double()
        right = -(turn.mT @ data.motions[:, :3, 3:]).sum(0).squeeze(-1)
        point = torch.linalg.solve(normal, right)
        rows.append(torch.cat([torch.linalg.cross(point, direction), direction]))
    return torch.stack(rows)


def _together(information: Tensor, vectors: Tensor) -> Tensor:
    """Return the principal directions (3, 3) of vectors (T, 3), weighed by what the data hold of each."""
    weight = information.diagonal(dim1=-2, dim2=-1).mean(-1).unsqueeze(-1)
    return torch.linalg.eigh((weight * vectors).mT @ vectors).eigenvectors.mT


def _slides(data: Relative, twists: Tensor) -> Tensor:
    """Return axes (3, 6) of slides to start from."""
    return torch.nn.functional.pad(_together(data.information[:, :3, :3], twists[:, :3]), (0, 3))


def _fitted(data: Relative, axes: Tensor) -> tuple[float, Tensor, Tensor]:
    """Return the least cost over starts (S, 6), the axis (6,) there, and the values (T,)."""
    frames, starts = len(data.motions), len(axes)
    sliding = bool((axes[:, 3:] == 0).all())
    twists = se3_log(data.motions)
    along = slice(0, 3) if sliding else slice(3, 6)
    values = (twists[None, :, along] * axes[:, None, along]).sum(-1)
    state = torch.cat([axes, values], -1)

    def parts(state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        axis, values = state[:, None, :6], state[:, 6:]
        moved = se3_exp(values.unsqueeze(-1) * axis)
        return axis, moved, se3_log(data.motions @ invert_rigid(moved))

    def linearize(state: Tensor) -> Linearization:
        axis, moved, error = parts(state)
        by_axis = adjoint(moved) - torch.eye(6).double()
        by_value = torch.zeros(starts, frames, 6, frames, dtype=torch.float64)
        by_value[:, range(frames), :, range(frames)] = -axis.expand(starts, frames, 6).transpose(0, 1)
        jacobian = torch.cat([by_axis, by_value], -1)
        weighed = data.information @ jacobian
        hessian = (jacobian.mT @ weighed).sum(1)
        ridge = JOINTS.ridge * hessian.diagonal(dim1=-2, dim2=-1).mean(-1) + 1e-12
        hessian = hessian + ridge[:, None, None] * torch.eye(6 + frames).double()
        gradient = (weighed.mT @ error.unsqueeze(-1)).sum(1).squeeze(-1)
        cost = 0.5 * (error.unsqueeze(-2) @ data.information @ error.unsqueeze(-1)).sum((1, 2, 3))
        return Linearization(cost, gradient, hessian)

    def retract(state: Tensor, step: Tensor) -> Tensor:
        axis = (adjoint(se3_exp(step[:, :6])) @ state[:, :6].unsqueeze(-1)).squeeze(-1)
        return torch.cat([axis, state[:, 6:] + step[:, 6:]], -1)

    found = levenberg_marquardt(linearize, state, retract=retract, max_steps=JOINTS.steps)
    best = int(found.cost.argmin())
    return 2 * float(found.cost[best]), found.state[best, :6], found.state[best, 6:]
