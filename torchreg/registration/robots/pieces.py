"""Rotations about a joint by which a piece of a surface fits what each scan shows there, and hinges that all share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.distance_transform import nearest_inside
from torchreg.geometry.rigid import rigid_matrix, se3_exp, se3_log
from torchreg.geometry.rotation import skew, spread_rotations
from torchreg.geometry.sampling import even_order
from torchreg.registration.blend import turn_about
from torchreg.registration.robots.joints import JOINTS
from torchreg.solvers.robust import geman_mcclure_weight


@dataclass(frozen=True)
class PieceNumbers:
    """Of the search for a piece."""

    rotations: int = 1500  # all of them, 20 degrees apart
    compared: int = 60  # points of a piece, and so many of a scan
    kept: int = 12  # best rotations of a scan, which are refined
    axes: int = 4  # of these, whose axes are tried as hinges of all scans
    turns: int = 36  # values of a hinge that are tried
    coarse: float = 0.25  # of the radius: kernel of the first comparison
    wide: tuple[float, ...] = (0.3, 0.3, 0.2, 0.2, 0.15, 0.1, 0.1, 0.07, 0.05, 0.05)  # kernels of the refinement
    fine: float = 2.5  # distances between points: kernel of the last comparison
    least: float = 2.0  # the same: least kernel, as points of a surface sampled anew are as far apart
    tangential: float = 0.1  # weight of offsets along the surface, where planes leave a motion open
    half_turn: float = 0.02  # cost of a half turn, beside those of points: of two equal motions the smaller is likelier
    cells: int = 16  # along the radius
    damping: float = 0.01  # of a point's weight, for what a piece leaves open


PIECES = PieceNumbers()


@dataclass(frozen=True, eq=False)
class NearestPoints:
    """Points nearest to the cells of a cube about the origin, in each of B clouds."""

    cell: float
    half: int  # cells from the origin to a side
    rows: Tensor  # (B * cells,) of the points
    points: Tensor  # (N, 3) of all clouds
    normals: Tensor  # (N, 3)

    @classmethod
    def of(cls, clouds: Sequence[tuple[Tensor, Tensor]], radius: float, cell: float) -> NearestPoints:
        """Return those of clouds of points and normals within a radius."""
        half, count, rows = math.ceil(radius / cell) + 1, 0, []
        side = 2 * half + 1
        for points, _ in clouds:
            place = _cells(points, cell, half)
            own = torch.zeros(side**3, dtype=torch.long)
            own[place] = torch.arange(count, count + len(points))
            filled = torch.zeros(side**3, dtype=torch.bool)
            filled[place] = True
            rows.append(own[nearest_inside(filled.view(side, side, side)).flatten()])
            count += len(points)
        points, normals = (torch.cat(values) for values in zip(*clouds, strict=True))
        return cls(cell, half, torch.cat(rows), points, normals)

    def __call__(self, points: Tensor, cloud: Tensor) -> tuple[Tensor, Tensor]:
        """Return the points nearest to (..., 3) in clouds of numbers (...), and their normals, to a cell."""
        row = self.rows[_cells(points, self.cell, self.half) + cloud * (2 * self.half + 1) ** 3]
        return self.points[row], self.normals[row]


def _cells(points: Tensor, cell: float, half: int) -> Tensor:
    """Return the numbers (...) of the cells of points (..., 3); beyond the cube, of the nearest."""
    side = 2 * half + 1
    place = (points / cell + (half + 0.5)).clamp(0, side - 0.5).long()
    return (place[..., 0] * side + place[..., 1]) * side + place[..., 2]


@dataclass(frozen=True, eq=False)
class Piece:
    """Points of a piece, and of T scans near where it may be, about a joint's place; all float32."""

    points: Tensor  # (m, 3)
    seen: Tensor  # (T, q, 3) of the scans
    facing: Tensor  # (T, q, 3) their normals
    valid: Tensor  # (T, q) one, or zero where a scan has fewer
    reference: NearestPoints
    scans: NearestPoints
    spacing: float
    radius: float

    @classmethod
    def of(
        cls, own: tuple[Tensor, Tensor], scans: Sequence[tuple[Tensor, Tensor]], radius: float, spacing: float
    ) -> Piece:
        """Return the piece within a radius of the origin, of points and normals of the reference and of the scans."""
        wide = 1.5 * radius + 3 * spacing
        cell = max(spacing, radius / PIECES.cells)
        near = [_within(cloud, wide) for cloud in scans]
        chosen = [_thinned(_within(cloud, radius)) for cloud in near]
        count = max(1, *(len(points) for points, _ in chosen))
        seen, facing = (
            torch.stack([torch.nn.functional.pad(row, (0, 0, 0, count - len(row))) for row in rows])
            for rows in zip(*chosen, strict=True)
        )
        # A scan that shows nothing there has one point, beyond what is compared.
        far = torch.full((1, 3), wide)
        near = [cloud if len(cloud[0]) else (far, far / far.norm()) for cloud in near]
        return cls(
            points=_thinned(_within(own, radius))[0],
            seen=seen,
            facing=facing,
            valid=torch.stack([(torch.arange(count) < len(points)).float() for points, _ in chosen]),
            reference=NearestPoints.of([_within(own, wide)], wide, cell),
            scans=NearestPoints.of(near, wide, cell),
            spacing=spacing,
            radius=radius,
        )

    def costs(self, motions: Tensor, width: float) -> Tensor:
        """Return the mean squared distances (T, C), up to one kernel width, of both under motions (T, C, 4, 4)."""
        there, back = ((offset.square().sum(-1) / width**2).clamp_max(1) for _, offset, _ in self._matched(motions))
        valid = self.valid.unsqueeze(1)
        fit = 0.5 * (there.mean(-1) + (valid * back).sum(-1) / valid.sum(-1).clamp_min(1))
        # (3 - trace) / 4 is one for a half turn.
        return fit + PIECES.half_turn * (3 - motions[..., :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1)) / 4

    def _matched(self, motions: Tensor) -> tuple[tuple[Tensor, Tensor, Tensor], ...]:
        """Return moved points (T, C, ., 3), their offsets and normals: of the piece, and of what the scans show."""
        scan = torch.arange(len(motions))[:, None, None]
        turn, shift = motions[..., :3, :3], motions[..., None, :3, 3]
        moved = self.points @ turn.mT + shift
        found, normals = self.scans(moved, scan)
        seen = self.seen.unsqueeze(1)
        placed = self.reference((seen - shift) @ turn, torch.zeros_like(scan))[0] @ turn.mT + shift
        return (moved, moved - found, normals), (placed, placed - seen, self.facing.unsqueeze(1).expand_as(placed))

    def refined(self, motions: Tensor, widths: Sequence[float]) -> Tensor:
        """Return the motions (T, C, 4, 4) after a step of ICP in both directions at each of some kernel widths."""
        eye, metric = torch.eye(3), torch.tensor([1.0] * 3 + [self.radius**2] * 3)
        for width in widths:
            arm, offset, normal = (torch.cat(pair, -2) for pair in zip(*self._matched(motions), strict=True))
            valid = torch.nn.functional.pad(self.valid, (len(self.points), 0), value=1.0).unsqueeze(1)
            weight = (valid * geman_mcclure_weight(offset.square().sum(-1) / width**2))[..., None, None]
            information = weight * (normal.unsqueeze(-1) * normal.unsqueeze(-2) + PIECES.tangential * eye)
            jacobian = torch.cat([eye.expand_as(information), -skew(arm)], -1)
            hessian = (jacobian.mT @ information @ jacobian).sum(-3)
            gradient = (jacobian.mT @ information @ offset.unsqueeze(-1)).sum(-3)
            ridge = PIECES.damping * weight.sum((-3, -2)) * metric + 1e-9
            step = -torch.linalg.solve(hessian + torch.diag_embed(ridge), gradient).squeeze(-1)
            motions = turn_about(motions, step, motions.new_zeros(3))
        return motions


def _within(cloud: tuple[Tensor, Tensor], radius: float) -> tuple[Tensor, Tensor]:
    near = cloud[0].norm(dim=-1) < radius
    return cloud[0][near], cloud[1][near]


def _thinned(cloud: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    if len(cloud[0]) <= PIECES.compared:
        return cloud
    order = even_order(cloud[0], PIECES.compared)
    return cloud[0][order], cloud[1][order]


def rotations_and_hinge(piece: Piece) -> list[Tensor]:
    """Return motions (T, 4, 4) of a piece: those of the best hinge that all scans share, and the best of each alone.

    All rotations about the place are compared, the best refined; hinges have the axes of those of single scans.
    """
    turns, count = spread_rotations(PIECES.rotations).float(), len(piece.seen)
    least = PIECES.least * piece.spacing
    widths = [max(share * piece.radius, least) for share in PIECES.wide]
    start = rigid_matrix(turns, torch.zeros(len(turns), 3)).expand(count, -1, 4, 4)
    coarse = max(PIECES.coarse * piece.radius, least)
    costs = torch.cat([piece.costs(part, coarse) for part in start.split(500, 1)], 1)
    start = _best(start, costs, PIECES.kept)
    motions = piece.refined(torch.cat([start, torch.eye(4).expand(count, 1, 4, 4)], 1), widths)
    motions = _best(motions, piece.costs(motions, PIECES.fine * piece.spacing), PIECES.axes)
    twists = se3_log(motions.double()).reshape(-1, 6)
    angle = twists[:, 3:].norm(dim=-1, keepdim=True)
    twists = (twists / angle)[angle[:, 0] > JOINTS.turned]
    if len(twists) == 0:
        return [motions[:, 0]]
    point = torch.linalg.cross(twists[:, 3:], twists[:, :3])
    hinges = torch.cat([torch.linalg.cross(point, twists[:, 3:]), twists[:, 3:]], -1)
    return [piece.refined(_turned(piece, hinges).unsqueeze(1), widths[-4:])[:, 0], motions[:, 0]]


def _best(motions: Tensor, costs: Tensor, count: int) -> Tensor:
    """Return the motions (T, count, 4, 4) of least costs (T, C)."""
    best = costs.topk(count, largest=False).indices
    return motions.gather(1, best[..., None, None].expand(-1, -1, 4, 4))


def _turned(piece: Piece, hinges: Tensor) -> Tensor:
    """Return the motions (T, 4, 4) about that of the hinges (S, 6) which fits best at the best values in all scans."""
    values = torch.arange(PIECES.turns) * (math.tau / PIECES.turns)
    turned = se3_exp(values[:, None] * hinges[:, None]).float()
    width, count = 1.5 * PIECES.fine * piece.spacing, len(piece.seen)
    found = [piece.costs(rows.expand(count, -1, 4, 4), width).min(-1) for rows in turned]
    best = int(torch.stack([least.values.sum() for least in found]).argmin())
    return turned[best, found[best].indices]
