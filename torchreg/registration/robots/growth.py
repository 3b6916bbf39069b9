"""Links of a robot in clouds far apart, found one after another from the link that moved least outward."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.geometry.distance_transform import nearest_inside
from torchreg.geometry.graphs import component_links, connected_components
from torchreg.geometry.neighbors import NeighborTree, k_nearest_others
from torchreg.geometry.rigid import invert_rigid, rigid_matrix, se3_log, transform_points
from torchreg.geometry.rotation import so3_exp, spread_rotations
from torchreg.geometry.sampling import even_order
from torchreg.registration.blend import turn_about
from torchreg.registration.robots.surfaces import Surfaces, Target
from torchreg.solvers.robust import geman_mcclure_weight


@dataclass(frozen=True)
class GrowthNumbers:
    """Of the search for one link after another."""

    samples: int = 2000  # of the reference
    neighbors: int = 8  # of a sample, along which a link spreads
    reach: float = 2.5  # of a cloud's spacing: 99 of 100 points of a surface sampled anew are as near to the other sample
    rotations: int = 1500  # of a piece about its border, 20 degrees apart
    compared: int = 60  # points of a piece that are compared in a search, and so many of a cloud
    pieces: tuple[int, ...] = (40, 100, 250)  # samples of the pieces that are searched for
    kept: int = 12  # best rotations of a frame, which are refined
    distinct: int = 4  # of these that differ, whose axes are tried
    turns: int = 36  # values of a hinge that are tried
    steps: int = 10  # of a refinement
    least: int = 12  # samples of a link
    apart: float = 0.35  # radians between poses that differ


GROWTH = GrowthNumbers()


@dataclass(frozen=True, eq=False)
class Volume:
    """Nearest points of B clouds by cells about the origin."""

    cell: float
    half: int
    index: Tensor  # (B * cells,) row of points
    points: Tensor  # (N, 3) of all clouds
    normals: Tensor

    @classmethod
    def of(cls, clouds: Sequence[tuple[Tensor, Tensor]], radius: float, cell: float) -> Volume:
        half = math.ceil(radius / cell) + 1
        side = 2 * half + 1
        rows, count = [], 0
        for points, _ in clouds:
            place = _cells(points, cell, half)
            filled = torch.zeros(side**3, dtype=torch.bool)
            row = torch.zeros(side**3, dtype=torch.long)
            filled[place] = True
            row[place] = torch.arange(len(points)) + count
            rows.append(row[nearest_inside(filled.view(side, side, side)).flatten()])
            count += len(points)
        return cls(cell, half, torch.cat(rows), torch.cat([c[0] for c in clouds]), torch.cat([c[1] for c in clouds]))

    def nearest(self, points: Tensor, cloud: Tensor) -> Tensor:
        """Return rows (...) of the points nearest to (..., 3), in clouds (...)."""
        return self.index[_cells(points, self.cell, self.half) + cloud * (2 * self.half + 1) ** 3]


def _cells(points: Tensor, cell: float, half: int) -> Tensor:
    side = 2 * half + 1
    place = (points / cell + (half + 0.5)).clamp(0, side - 0.5).long()
    return (place[..., 0] * side + place[..., 1]) * side + place[..., 2]


@dataclass(frozen=True, eq=False)
class Piece:
    """Points of a piece about its border, clouds that may show it in F frames, both about the border's middle."""

    points: Tensor  # (m, 3)
    normals: Tensor
    clouds: Tensor  # (F, q, 3)
    facing: Tensor  # (F, q, 3) their normals
    valid: Tensor  # (F, q)
    whole: Volume  # of the reference
    frames: Volume  # of the F frames
    spacing: float
    radius: float

    def costs(self, motions: Tensor, width: float) -> Tensor:
        """Return costs (F, C) of motions (F, C, 4, 4), from 0 to 1, of both directions."""
        frame = torch.arange(len(motions))[:, None, None]
        turn, shift = motions[..., :3, :3], motions[..., :3, 3]
        moved = self.points @ turn.mT + shift.unsqueeze(-2)
        there = self._costs(self.frames, moved, frame, width).mean(-1)
        back = (self.clouds.unsqueeze(1) - shift.unsqueeze(-2)) @ turn
        here = self._costs(self.whole, back, torch.zeros_like(frame), width)
        valid = self.valid.unsqueeze(1).to(here)
        return 0.5 * (there + (here * valid).sum(-1) / valid.sum(-1).clamp_min(1))

    def _costs(self, volume: Volume, points: Tensor, cloud: Tensor, width: float) -> Tensor:
        offset = points - volume.points[volume.nearest(points, cloud)]
        return (offset.square().sum(-1) / width**2).clamp_max(1)

    def refined(self, motions: Tensor, widths: Sequence[float]) -> Tensor:
        """Return the motions (F, C, 4, 4) after a step of ICP in both directions at each of some kernel widths."""
        frame = torch.arange(len(motions))[:, None, None]
        center = motions.new_zeros(3)
        for width in widths:
            turn, shift = motions[..., :3, :3], motions[..., :3, 3]
            moved = self.points @ turn.mT + shift.unsqueeze(-2)
            row = self.frames.nearest(moved, frame)
            first = moved, moved - self.frames.points[row], self.frames.normals[row]
            row = self.whole.nearest((self.clouds.unsqueeze(1) - shift.unsqueeze(-2)) @ turn, torch.zeros_like(frame))
            placed = self.whole.points[row] @ turn.mT + shift.unsqueeze(-2)
            second = placed, placed - self.clouds.unsqueeze(1), self.facing.unsqueeze(1).expand_as(placed)
            arm, offset, normal = (torch.cat(pair, -2) for pair in zip(first, second, strict=True))
            valid = torch.cat([torch.ones_like(moved[..., 0]), self.valid.unsqueeze(1).expand(placed.shape[:-1])], -1)
            weight = valid * geman_mcclure_weight(offset.square().sum(-1) / width**2)
            across = (offset * normal).sum(-1)
            jacobian = torch.cat([normal, torch.linalg.cross(arm, normal)], -1)
            hessian = jacobian.mT @ (weight.unsqueeze(-1) * jacobian)
            gradient = (jacobian.mT @ (weight * across).unsqueeze(-1)).squeeze(-1)
            # Along the surface little is known: a tenth of a point's weight.
            flat = torch.zeros(*arm.shape[:-1], 3, 6, dtype=arm.dtype)
            flat[..., range(3), range(3)] = 1
            flat[..., 0, 4], flat[..., 0, 5] = arm[..., 2], -arm[..., 1]
            flat[..., 1, 3], flat[..., 1, 5] = -arm[..., 2], arm[..., 0]
            flat[..., 2, 3], flat[..., 2, 4] = arm[..., 1], -arm[..., 0]
            hessian = hessian + 0.1 * (flat.mT @ (weight[..., None, None] * flat)).sum(-3)
            gradient = gradient + 0.1 * (flat.mT @ (weight.unsqueeze(-1) * offset).unsqueeze(-1)).sum(-3).squeeze(-1)
            metric = torch.tensor([1.0] * 3 + [self.radius**2] * 3, dtype=hessian.dtype)
            hessian = hessian + torch.diag_embed(0.01 * weight.sum(-1, keepdim=True) * metric + 1e-9)
            motions = turn_about(motions, -torch.linalg.solve(hessian, gradient), center)
        return motions


@dataclass(eq=False)
class Growth:
    """Samples of the reference, links found so far and the frames to be explained."""

    samples: Tensor  # (n, 3)
    normals: Tensor
    edges: Tensor
    targets: Sequence[Target]  # F
    spacing: float
    motions: Tensor  # (F, K, 4, 4)
    label: Tensor  # (n,), -1 where nothing explains them
    debug: bool = False

    @property
    def size(self) -> float:
        return float((self.samples.amax(0) - self.samples.amin(0)).norm())

    @property
    def limit(self) -> float:
        return GROWTH.reach * self.spacing

    def costs(self, motions: Tensor, which: Tensor | None = None) -> Tensor:
        """Return costs (n, K), from 0 to 1, of samples under motions (F, K, 4, 4), means over the frames."""
        samples = self.samples if which is None else self.samples[which]
        found = []
        for target, frame in zip(self.targets, motions, strict=True):
            moved = transform_points(frame, samples)
            index, distance = (row.reshape(moved.shape[:-1]) for row in target.tree.nearest_within(moved.reshape(-1, 3), self.limit))
            offset = moved - target.points[index]
            across = (offset * target.normals[index]).sum(-1).square()
            along = (offset.square().sum(-1) - across).clamp_min(0).sqrt()
            square = (across + (along - 2 * self.spacing).clamp_min(0).square()) / self.spacing**2
            found.append(torch.where(distance.isfinite(), square, 1.0).clamp_max(1))
        return torch.stack(found).mean(0).mT

    def settled(self, motions: Tensor, own: Tensor, scales: Sequence[float]) -> Tensor:
        """Return motions (F, 1, 4, 4) fitted to some samples (k,)."""
        surfaces = Surfaces(self.samples[own], self.normals[own], self.edges, own, tuple(self.targets), self.size)
        return surfaces.refined(motions, torch.zeros_like(own), [scale * self.spacing for scale in scales])

    def relabeled(self) -> None:
        """Label the samples by the links found so far."""
        costs = self.costs(self.motions)
        near = k_nearest_others(self.samples, GROWTH.neighbors)[0]
        costs = 0.5 * costs + 0.5 * costs[near].mean(1)  # neighbors move alike
        best, label = costs.min(-1)
        self.label = torch.where(best < EXPLAINED, label, -1)

    def free_clouds(self) -> list[tuple[Tensor, Tensor]]:
        """Return the points and normals of each frame that no link found so far explains."""
        which = (self.label >= 0).nonzero()[:, 0]
        chosen = self.motions[:, self.label[which]]
        placed = (chosen[..., :3, :3] @ self.samples[which].unsqueeze(-1)).squeeze(-1) + chosen[..., :3, 3]
        kept = [NeighborTree(own).nearest_within(target.points, 1.5 * self.limit)[1].isinf()
                for own, target in zip(placed, self.targets, strict=True)]
        return [(target.points[free], target.normals[free]) for target, free in zip(self.targets, kept, strict=True)]


ROOT = (8.0, 6.0, 4.0, 3.0, 2.0, 1.0, 1.0)
FINE = (2.0, 1.0, 1.0)
EXPLAINED = 0.45  # of the cost of an outlier: the middle between those of right points, .15, and of wrong ones, .8


def grown(points: Tensor, normals: Tensor, targets: Sequence[Target], start: Tensor, debug: bool = False) -> tuple[Tensor, Tensor, Tensor]:
    """Return samples' order, motions (F, K, 4, 4) and labels (n,)."""
    order = even_order(points, min(len(points), GROWTH.samples))
    samples = points[order]
    near = k_nearest_others(samples, GROWTH.neighbors)[0]
    edges = torch.stack([torch.arange(len(samples)).unsqueeze(1).expand_as(near), near], -1).reshape(-1, 2)
    links = component_links(samples, connected_components(edges, len(samples)))[0]
    edges = torch.cat([edges, links])
    spacing = sum(target.spacing for target in targets) / len(targets)
    growth = Growth(samples, normals[order], edges, targets, spacing, start[:, :0], torch.full((len(samples),), -1), debug)
    roots = torch.cat([growth.settled(start[:, k : k + 1], torch.arange(len(samples)), ROOT) for k in range(start.shape[1])], 1)
    root = int((growth.costs(roots) < EXPLAINED).sum(0).argmax())
    growth.motions = roots[:, root : root + 1]
    growth.relabeled()
    failed: set[tuple[int, tuple[int, ...]]] = set()
    while True:
        fronts = growth_fronts(growth)
        fronts = [front for front in fronts if front.key not in failed]
        if not fronts:
            break
        free = growth.free_clouds()
        found = [(gain, motion, front) for front in fronts for gain, motion in [searched(growth, front, free)]]
        accepted = False
        for gain, motion, front in sorted(found, key=lambda row: -row[0]):
            if debug:
                print(f"  front link {front.link} border {len(front.border)} comp {len(front.component)} gain {gain:.1f}", flush=True)
            if motion is None:
                failed.add(front.key)
                continue
            growth.motions = torch.cat([growth.motions, motion.unsqueeze(1)], 1)
            before = growth.label
            growth.relabeled()
            own = (growth.label == growth.motions.shape[1] - 1).nonzero()[:, 0]
            if len(own) >= GROWTH.least:
                growth.motions[:, -1:] = growth.settled(motion.unsqueeze(1), own, FINE)
                growth.relabeled()
            new = int((growth.label == growth.motions.shape[1] - 1).sum())
            if new < GROWTH.least:
                growth.motions, growth.label = growth.motions[:, :-1], before
                failed.add(front.key)
                continue
            accepted = True
            break  # free clouds changed
        if not accepted:
            break
    return order, growth.motions, growth.label


@dataclass(frozen=True, eq=False)
class Front:
    link: int
    border: Tensor
    component: Tensor

    @property
    def key(self) -> tuple[int, tuple[int, ...]]:
        return self.link, tuple(self.component[:5].tolist())


def growth_fronts(growth: Growth) -> list[Front]:
    label, edges = growth.label, growth.edges
    free = label < 0
    inner = edges[free[edges].all(1)]
    component = connected_components(torch.cat([inner, inner.flip(1)]), len(label))
    fronts = []
    for number in component[free].unique().tolist():
        own = (component == number) & free
        if int(own.sum()) < GROWTH.least:
            continue
        ends = torch.cat([edges, edges.flip(1)])
        ends = ends[own[ends[:, 0]] & ~own[ends[:, 1]]]
        for link in label[ends[:, 1]].unique().tolist():
            if link < 0:
                continue
            rows = ends[label[ends[:, 1]] == link]
            fronts.append(Front(link, rows.flatten().unique(), own.nonzero()[:, 0]))
    return fronts


def searched(growth: Growth, front: Front, free: list[tuple[Tensor, Tensor]]) -> tuple[float, Tensor | None]:
    """Return how many samples a new link explains, and its motions (F, 4, 4)."""
    center = growth.samples[front.border].mean(0)
    own = growth.samples[front.component]
    distance = (own - center).norm(dim=-1)
    parent = growth.motions[:, front.link]
    best: tuple[float, Tensor | None] = (float(GROWTH.least), None)
    for size in GROWTH.pieces:
        radius = float(distance.sort().values[min(size, len(own)) - 1]) + growth.spacing
        piece = piece_about(growth, front, free, center, radius)
        for local in candidates(piece, growth.spacing):
            shift = torch.eye(4, dtype=torch.float64)
            shift[:3, 3] = center
            motion = parent @ shift @ local.double() @ invert_rigid(shift)
            costs = growth.costs(motion.unsqueeze(1), front.component)[:, 0]
            gain = float((EXPLAINED - costs).clamp_min(0).sum() / EXPLAINED)
            if growth.debug:
                print(f"     size {size} r {radius:.3f} gain {gain:.1f} explained {int((costs < EXPLAINED).sum())}")
            if gain > best[0]:
                best = gain, motion
        if size >= len(own) or best[0] > 0.8 * len(own):
            break
    return best


def piece_about(growth: Growth, front: Front, free: list[tuple[Tensor, Tensor]], center: Tensor, radius: float) -> Piece:
    own = growth.samples[front.component] - center
    normals = growth.normals[front.component]
    near = own.norm(dim=-1) < radius
    chosen = near.nonzero()[:, 0]
    chosen = chosen[even_order(own[chosen], min(len(chosen), GROWTH.compared))]
    wide = 1.5 * radius + 3 * growth.spacing
    back = invert_rigid(growth.motions[:, front.link])
    clouds, frames = [], []
    for (points, facing), motion in zip(free, back, strict=True):
        local = transform_points(motion, points) - center
        turned = facing @ motion[:3, :3].mT
        far = local.norm(dim=-1)
        kept = far < wide
        if not bool(kept.any()):
            local, turned, kept = torch.full((1, 3), wide).double(), torch.tensor([[0.0, 0, 1]]).double(), torch.tensor([True])
            far = local.norm(dim=-1)
        frames.append((local[kept].float(), turned[kept].float()))
        inside = far < radius
        thin = inside.nonzero()[:, 0]
        if len(thin) > GROWTH.compared:
            thin = thin[even_order(local[thin], GROWTH.compared)]
        clouds.append((local[thin].float(), turned[thin].float()))
    q = max(1, max(len(c[0]) for c in clouds))
    pad = lambda x: torch.nn.functional.pad(x, (0, 0, 0, q - len(x)))
    valid = torch.stack([(torch.arange(q) < len(c[0])).float() for c in clouds])
    cell = max(growth.spacing, radius / 24)
    return Piece(
        points=own[chosen].float(), normals=normals[chosen].float(),
        clouds=torch.stack([pad(c[0]) for c in clouds]), facing=torch.stack([pad(c[1]) for c in clouds]), valid=valid,
        whole=Volume.of([(own[own.norm(dim=-1) < wide].float(), normals[own.norm(dim=-1) < wide].float())], wide, cell),
        frames=Volume.of(frames, wide, cell), spacing=growth.spacing, radius=radius)


def candidates(piece: Piece, spacing: float) -> list[Tensor]:
    """Return motions (F, 4, 4) about the border: those of each frame alone, and of the best hinges."""
    turns = spread_rotations(GROWTH.rotations).float()
    frames = len(piece.clouds)
    widths = [max(w * piece.radius, 2 * spacing) for w in (0.3, 0.3, 0.2, 0.2, 0.15, 0.1, 0.1, 0.07, 0.05, 0.05)]
    fine = GROWTH.reach * spacing
    coarse = torch.zeros(frames, len(turns), dtype=torch.float32)
    start = rigid_matrix(turns, torch.zeros(len(turns), 3)).expand(frames, -1, 4, 4)
    for part in torch.arange(len(turns)).split(500):
        coarse[:, part] = piece.costs(start[:, part], max(0.25 * piece.radius, 2 * spacing))
    best = coarse.topk(GROWTH.kept, largest=False).indices
    motions = start.gather(1, best[..., None, None].expand(-1, -1, 4, 4))
    motions = piece.refined(torch.cat([motions, torch.eye(4).expand(frames, 1, 4, 4)], 1), widths)
    costs = piece.costs(motions, fine)
    order = costs.argsort(-1)
    motions = motions.gather(1, order[..., None, None].expand(-1, -1, 4, 4))
    costs = costs.gather(1, order)
    free = motions[:, 0]
    twists = se3_log(motions[:, : GROWTH.distinct].double()).reshape(-1, 6)
    twists = twists[twists[:, 3:].norm(dim=-1) > 0.15]
    hinges = [best_hinge(piece, twists, fine, widths)] if len(twists) else []
    return [free, *hinges]


def best_hinge(piece: Piece, twists: Tensor, fine: float, widths: Sequence[float]) -> Tensor:
    angle = twists[:, 3:].norm(dim=-1, keepdim=True)
    axes = twists[:, 3:] / angle
    # The point of the axis nearest to the border's middle; the motion's pitch is left out.
    point = torch.linalg.cross(axes, twists[:, :3] / angle)
    screws = torch.cat([torch.linalg.cross(point, axes), axes], -1)
    found = scanned(piece, screws, fine)
    return piece.refined(found.unsqueeze(1), widths[-4:])[:, 0]


def scanned(piece: Piece, screws: Tensor, width: float) -> Tensor:
    values = torch.arange(GROWTH.turns) * (2 * math.pi / GROWTH.turns)
    from torchreg.geometry.rigid import se3_exp
    turned = se3_exp(values[:, None] * screws[:, None]).float()  # (S, V, 4, 4)
    frames, count = len(piece.clouds), len(values)
    costs = torch.stack([piece.costs(rows.expand(frames, -1, 4, 4), 1.5 * width) for rows in turned], 1)  # (F, S, V)
    least = costs.min(-1)
    axis = int(least.values.sum(0).argmin())
    return turned[axis][least.indices[:, axis]]
