"""Joints between links: a weld, a hinge, a slider, two hinges in a row or none, by the criterion of Schwarz."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

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
    directions: int = 400  # of the second of two hinges in a row, 7 degrees apart
    starts: int = 6  # best of these, or widest turns of one hinge, that are refined
    universal: int = 4  # frames from which two hinges in a row are fewer parameters than free motions
    turned: float = 0.15  # radians from which a motion has an axis
    ridge: float = 1e-6  # of the curvature, for directions that move no joint, as a shift along its axis


JOINTS = JointNumbers()


@dataclass(frozen=True, eq=False)
class Candidate:
    """The best joint between two links, in the coordinates of the reference."""

    kind: str  # "fixed", "revolute", "prismatic" or "universal", two hinges in a row
    twists: Tensor  # (J, 6) of unit turns or slides, in a row; zero for a weld
    values: Tensor  # (T, J) of the joints
    length: float  # its description length minus that of a free motion: below zero, the data speak for the joint


@dataclass(frozen=True, eq=False)
class Relative:
    """Motions (T, 4, 4) of one link relative to another, in half sizes of the thing, and their weights."""

    motions: Tensor  # about the origin ``center``
    information: Tensor  # (T, 6, 6) inverse covariances of their errors, twists in the frame of the first link
    count: float  # effective number of residuals behind them
    center: Tensor  # (3,) between the two links
    unit: float  # length

    def in_space(self, axes: Tensor) -> Tensor:
        """Return axes (J, 6) in half sizes about the center in lengths about the origin."""
        shift = self.unit * axes[:, :3] + torch.linalg.cross(self.center.expand(len(axes), 3), axes[:, 3:])
        return torch.cat([shift, axes[:, 3:]], -1)


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


def from_ground(motions: Tensor, blocks: Blocks, link: int | Tensor, noise: Noise, size: float) -> Relative:
    """Return the motions of a link seen from the ground, which stands still without an error."""
    still = torch.eye(4, dtype=torch.float64).expand(len(motions), 4, 4)
    sure = torch.eye(6, dtype=torch.float64).expand(len(motions), 6, 6) / torch.finfo(torch.float64).eps
    both = Blocks(
        hessian=torch.stack([sure, blocks.hessian[:, link]], 1),
        gradient=blocks.gradient[:, [link, link]],
        centers=blocks.centers[:, [link, link]],
        count=torch.stack([torch.zeros_like(blocks.count[:, link]), blocks.count[:, link]], 1),
    )
    return relative(torch.stack([still, motions[:, link]], 1), both, (0, 1), noise, size)


def best_joint(data: Relative) -> Candidate:
    """Return the joint of least description length: squared errors in standard deviations, and parameters.

    Two hinges in a row, between which a link moves that no scan shows to turn, are tried where no single joint holds;
    so is one hinge with frames that are wrong.
    """
    frames, rate = len(data.motions), math.log(data.count)
    twists = se3_log(data.motions)
    weld = float((twists.unsqueeze(-2) @ data.information @ twists.unsqueeze(-1)).sum())
    still = torch.zeros(frames, 1, dtype=torch.float64)
    found = {
        "fixed": (weld, torch.zeros(1, 6, dtype=torch.float64), still),
        "revolute": _fitted(data, _screws(data, twists), _angles_about(twists)),
        "prismatic": _fitted(data, _slides(data, twists), lambda axes: twists[None, :, :3] @ axes[..., :3].mT),
    }
    parameters = {
        "fixed": 0,
        "revolute": frames + 4,
        "prismatic": frames + 2,
        "universal": 2 * frames + 8,
        "outlier": frames + 4,
    }

    def length(kind: str) -> float:
        return found[kind][0] + (parameters[kind] - 6 * frames) * rate

    if min(map(length, found)) > 0 and frames >= JOINTS.universal:
        found["universal"] = _fitted(data, _crosses(data), _two_angles(data))
        found["outlier"] = _shared_hinge(data)
    kind = min(found, key=length)
    (_, axes, values), size = found[kind], length(kind)
    kind = "revolute" if kind == "outlier" else kind
    if kind == "prismatic":
        return Candidate(kind, axes, data.unit * values, size)
    return Candidate(kind, data.in_space(axes), values, size)


def _shared_hinge(data: Relative) -> tuple[float, Tensor, Tensor]:
    """Return the cost of one hinge, its axis (1, 6) and values (T, 1), where motions of some frames may be wrong.

    Of the axes of single frames that which most frames agree with, fitted to the half of them that it fits best, then
    to all that it fits; a frame that is wrong costs its free motion (least trimmed squares, Rousseeuw 1984).
    """
    frames, wrong = len(data.motions), (6 - 1) * math.log(data.count)
    twists = se3_log(data.motions)
    angle = twists[:, 3:].norm(dim=-1)
    turned = (angle > JOINTS.turned).nonzero()[:, 0]
    if len(turned) == 0:
        return math.inf, torch.zeros(1, 6, dtype=torch.float64), torch.zeros(frames, 1, dtype=torch.float64)
    unit = twists[turned] / angle[turned].unsqueeze(-1)
    across = unit[:, :3] - (unit[:, :3] * unit[:, 3:]).sum(-1, keepdim=True) * unit[:, 3:]
    axes = torch.cat([across, unit[:, 3:]], -1).unsqueeze(1)
    values_of = _angles_about(twists)

    def squares(axes: Tensor) -> Tensor:
        error = se3_log(data.motions @ invert_rigid(se3_exp(values_of(axes) * axes)))
        return (error.unsqueeze(-2) @ data.information @ error.unsqueeze(-1))[..., 0, 0]

    axis = axes[squares(axes).log1p().sum(-1).argmin()]
    fitted = squares(axis[None])[0]
    for limit in (0.0, 0.0, wrong):
        kept = fitted <= max(limit, float(fitted.sort().values[min(frames - 1, frames // 2)]))
        rest = replace(data, motions=data.motions[kept], information=data.information[kept])
        axis = _fitted(rest, axis[None], _angles_about(twists[kept]))[1]
        fitted = squares(axis[None])[0]
    return float(fitted.clamp_max(wrong).sum()), axis, values_of(axis[None])[0]


def _angles_about(twists: Tensor) -> Callable[[Tensor], Tensor]:
    """Return what gives the angles (S, T, 1) of motions of twists (T, 6) about axes (S, 1, 6)."""
    return lambda axes: twists[None, :, 3:] @ axes[..., 3:].mT


def _screws(data: Relative, twists: Tensor) -> Tensor:
    """Return axes (S, 1, 6) of turns to start from: those of the widest motions, and of all together."""
    turns = twists[:, 3:]
    widest = turns[turns.norm(dim=-1).argsort(descending=True)[: JOINTS.starts]]
    directions = torch.cat([widest, _together(data.information[:, 3:, 3:], turns)])
    directions = directions / directions.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    turned = so3_exp((turns @ directions.mT).mT.unsqueeze(-1) * directions.unsqueeze(1))
    return _through(data, directions.unsqueeze(1), turned.unsqueeze(2))


def _crosses(data: Relative) -> Tensor:
    """Return pairs of axes (S, 2, 6) of turns in a row to start from.

    Of motions R = exp(x a) exp(y b) the angle between a and R b is that between a and b: for each b of many, a is the
    direction along which R b changes least.
    """
    index = torch.arange(JOINTS.directions, dtype=torch.float64) + 0.5
    height, turn = 1 - index / JOINTS.directions, index * (math.pi * (1 + 5**0.5))
    ring = (1 - height.square()).sqrt()
    second = torch.stack([ring * turn.cos(), ring * turn.sin(), height], -1)
    change = (data.motions[:, :3, :3] - torch.eye(3).double()) @ second.mT  # (T, 3, S)
    values, vectors = torch.linalg.eigh(torch.einsum("tis,tjs->sij", change, change))
    best = values[:, 0].argsort()[: JOINTS.starts]
    pairs = torch.stack([vectors[best, :, 0], second[best]], 1)
    angles = _two_angles(data)(torch.nn.functional.pad(pairs, (3, 0)))
    return _through(data, pairs, so3_exp(angles.unsqueeze(-1) * pairs.unsqueeze(1)))


def _two_angles(data: Relative) -> Callable[[Tensor], Tensor]:
    """Return what gives the angles (S, T, 2) of the motions about pairs of axes (S, 2, 6) in a row."""

    def angles(axes: Tensor) -> Tensor:
        first, second = axes[:, None, :1, 3:], axes[:, None, 1:, 3:]
        turn = data.motions[:, :3, :3]
        return torch.cat([_angle(first, second, second @ turn.mT), -_angle(second, first, first @ turn)], -1)

    return angles


def _angle(axis: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Return the angle (..., 1) about an axis (..., 1, 3) from one direction to another."""
    sine = (torch.linalg.cross(start.expand_as(end), end) * axis).sum(-1)
    cosine = (start * end).sum(-1) - (start * axis).sum(-1) * (end * axis).sum(-1)
    return torch.atan2(sine, cosine)


def _through(data: Relative, directions: Tensor, turned: Tensor) -> Tensor:
    """Return axes (S, J, 6) of directions (S, J, 3) through points that turns (S, T, J, 3, 3) in a row leave in place.

    The translation of turns R1 R2 about points p and q is (1 - R1) p + R1 (1 - R2) q.
    """
    starts, frames, count = turned.shape[:3]
    before = torch.eye(3).double().expand(starts, frames, 3, 3)
    columns = []
    for joint in range(count):
        after = before @ turned[:, :, joint]
        columns.append(before - after)
        before = after
    matrix = torch.cat(columns, -1)
    normal = (matrix.mT @ matrix).sum(1) + 1e-6 * torch.eye(3 * count).double()
    points = torch.linalg.solve(normal, (matrix.mT @ data.motions[:, :3, 3:]).sum(1)).reshape(starts, count, 3)
    return torch.cat([torch.linalg.cross(points, directions), directions], -1)


def _together(information: Tensor, vectors: Tensor) -> Tensor:
    """Return the principal directions (3, 3) of vectors (T, 3), weighed by what the data hold of each."""
    weight = information.diagonal(dim1=-2, dim2=-1).mean(-1).unsqueeze(-1)
    return torch.linalg.eigh((weight * vectors).mT @ vectors).eigenvectors.mT


def _slides(data: Relative, twists: Tensor) -> Tensor:
    """Return axes (3, 1, 6) of slides to start from."""
    return torch.nn.functional.pad(_together(data.information[:, :3, :3], twists[:, :3]), (0, 3)).unsqueeze(1)


def _fitted(data: Relative, axes: Tensor, values_of: Callable[[Tensor], Tensor]) -> tuple[float, Tensor, Tensor]:
    """Return the least cost over starts (S, J, 6) of J joints in a row, their axes (J, 6) and values (T, J)."""
    frames, (starts, count) = len(data.motions), axes.shape[:2]
    own = torch.arange(frames)
    state = torch.cat([axes.flatten(1), values_of(axes).flatten(1)], -1)

    def parts(state: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        axes = state[:, None, : 6 * count].unflatten(-1, (count, 6))
        turns = se3_exp(state[:, 6 * count :].unflatten(-1, (frames, count)).unsqueeze(-1) * axes)
        before = [torch.eye(4).double().expand(starts, frames, 4, 4)]
        for joint in range(count):
            before.append(before[-1] @ turns[:, :, joint])
        seen = adjoint(torch.stack(before[:-1], 2))
        return axes, turns, seen, se3_log(data.motions @ invert_rigid(before[-1]))

    def linearize(state: Tensor) -> Linearization:
        axes, turns, seen, error = parts(state)
        by_axis = -seen @ (torch.eye(6).double() - adjoint(turns))  # (S, T, J, 6, 6)
        by_value = torch.zeros(starts, frames, 6, frames, count, dtype=torch.float64)
        by_value[:, own, :, own] = -(seen @ axes.unsqueeze(-1)).squeeze(-1).mT.transpose(0, 1)
        jacobian = torch.cat([by_axis.transpose(2, 3).flatten(-2), by_value.flatten(-2)], -1)
        weighed = data.information @ jacobian
        hessian = (jacobian.mT @ weighed).sum(1)
        ridge = JOINTS.ridge * hessian.diagonal(dim1=-2, dim2=-1).mean(-1) + 1e-12
        hessian = hessian + ridge[:, None, None] * torch.eye(hessian.shape[-1]).double()
        gradient = (weighed.mT @ error.unsqueeze(-1)).sum(1).squeeze(-1)
        cost = 0.5 * (error.unsqueeze(-2) @ data.information @ error.unsqueeze(-1)).sum((1, 2, 3))
        return Linearization(cost, gradient, hessian)

    def retract(state: Tensor, step: Tensor) -> Tensor:
        old, change = (values[:, : 6 * count].unflatten(-1, (count, 6)) for values in (state, step))
        axes = (adjoint(se3_exp(change)) @ old.unsqueeze(-1)).squeeze(-1)
        return torch.cat([axes.flatten(1), state[:, 6 * count :] + step[:, 6 * count :]], -1)

    found = levenberg_marquardt(linearize, state, retract=retract, max_steps=JOINTS.steps)
    best = int(found.cost.argmin())
    axes, values = found.state[best].split((6 * count, frames * count))
    return 2 * float(found.cost[best]), axes.reshape(count, 6), values.reshape(frames, count)
