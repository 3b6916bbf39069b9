"""Samples of a reference scan and the scans they are compared with: residuals, their noise, normal equations."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.geometry.graphs import component_links, connected_components
from torchreg.geometry.neighbors import NeighborTree, k_nearest_others, sampling_distance
from torchreg.registration.blend import turn_about
from torchreg.solvers.robust import geman_mcclure_loss, geman_mcclure_weight


@dataclass(frozen=True)
class SurfaceNumbers:
    """How scans are compared."""

    neighbors: int = 6  # of a sample, with which it shares a border
    roughness: float = 0.02  # least noise, in distances between a scan's points: between them it is not known
    cut: float = 3.0  # standard deviations from which a residual is an outlier's
    to_deviation: float = 1.4826  # from the median of absolute values to the standard deviation of a normal law
    patch: int = 20  # samples in a patch, over which noise is averaged to see how it is correlated
    signs: float = 0.95  # of the samples: of those whose motions are right, 97 of 100 agree where signs are right
    reach: float = 4.0  # scales of a robust kernel, beyond which no counterpart is looked for
    damping: float = 1e-2  # of the mean curvature, added where data do not hold a motion


NUMBERS = SurfaceNumbers()


class Target:
    """A scan to be compared with; where normals are estimates, whole links may have the other sign: it is not used."""

    def __init__(self, points: Tensor, normals: Tensor, *, signed: bool = True) -> None:
        self.points, self.normals, self.signed = points, normals, signed
        self.spacing = sampling_distance(points)
        self.tree = NeighborTree(points)

    def facing(self, normals: Tensor) -> Target:
        """Return the scan with other normals, whose signs are known."""
        found = copy.copy(self)
        found.normals, found.signed = normals, True
        return found

    def residuals(self, moved: Tensor, normals: Tensor, reach: float) -> tuple[Tensor, Tensor, Tensor]:
        """Return signed distances (..., K) of moved points from this scan's planes, its normals, and squared distances.

        The squared distances (..., K) are across the planes and, beyond the spacing of the scan's points, along them;
        those of points whose normals (..., K, 3) face the other way, if signs are known, or that no point of the scan
        is within reach of, are infinite.
        """
        found, distance = self.tree.nearest_within(moved.reshape(-1, 3), reach + self.spacing)
        index = found.reshape(moved.shape[:-1])
        near = distance.reshape(moved.shape[:-1]).isfinite()
        offset, facing = moved - self.points[index], self.normals[index]
        across = (offset * facing).sum(-1)
        along = (offset.square().sum(-1) - across.square()).clamp_min(0).sqrt()
        square = across.square() + (along - self.spacing).clamp_min(0).square()
        if self.signed:
            near &= (facing * normals).sum(-1) > 0
        return across, facing, torch.where(near, square, torch.inf)


@dataclass(frozen=True, eq=False)
class Noise:
    """Of residuals."""

    sigma: float  # standard deviation, unit of length
    repeats: float  # how many samples tell as much as one that erred by itself (the design effect of survey statistics)


@dataclass(frozen=True, eq=False)
class Blocks:
    """Normal equations of the motions of K parts in T frames: ``0.5 d' H d + g' d``, d the twist about the centers."""

    hessian: Tensor  # (T, K, 6, 6)
    gradient: Tensor  # (T, K, 6)
    centers: Tensor  # (T, K, 3)
    count: Tensor  # (T, K) samples that count

    @classmethod
    def of(cls, sums: Tensor, centers: Tensor) -> Blocks:
        """Return the equations of the sums (T, K, 43) of `frame_sums` in T frames about the centers (T, K, 3)."""
        return cls(sums[..., :36].unflatten(-1, (6, 6)), sums[..., 36:42], centers, sums[..., 42])

    def only(self, part: int) -> Blocks:
        """Return the equations of one part."""
        chosen = (values[:, [part]] for values in (self.hessian, self.gradient, self.centers, self.count))
        return Blocks(*chosen)

    def joined(self, owner: Tensor, centers: Tensor) -> Blocks:
        """Return the equations of links (K,), about their centers, whose pieces' these are: piece p is of owner[p]."""

        def added(values: Tensor) -> Tensor:
            size = (len(values), centers.shape[1], *values.shape[2:])
            return values.new_zeros(size).index_add(1, owner, values)

        return Blocks(added(self.hessian), added(self.gradient), centers, added(self.count))


def frame_sums(arms: Tensor, facing: Tensor, across: Tensor, square: Tensor, label: Tensor, size: int) -> Tensor:
    """Return the robustly weighted sums (K, 43) of a frame: of outer products of the Jacobian, its residuals, counts.

    ``arms`` (n, 3) from the centers of the parts (n,) to their points, ``facing`` normals (n, 3), residuals ``across``
    them (n,), and the squares (n,) that weigh them, in squared kernel widths.
    """
    jacobian = torch.cat([facing, torch.linalg.cross(arms, facing)], -1)
    outer = (jacobian.unsqueeze(-1) * jacobian.unsqueeze(-2)).flatten(-2)
    values = torch.cat([outer, jacobian * across.unsqueeze(-1), torch.ones_like(across).unsqueeze(-1)], -1)
    weight = geman_mcclure_weight(square).unsqueeze(-1)
    return values.new_zeros(size, values.shape[-1]).index_add(0, label, weight * values)


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Samples of the reference, and the scans of the other frames."""

    samples: Tensor  # (n, 3), every beginning of which covers the surface evenly
    normals: Tensor  # (n, 3)
    edges: Tensor  # (E, 2) pairs of neighbors, which connect all samples
    patch: Tensor  # (n,) patch of each sample
    targets: tuple[Target, ...]  # T scans
    size: float  # diagonal of the samples
    reference: None = None  # no frame: the samples stay

    @classmethod
    def of(cls, samples: Tensor, normals: Tensor, targets: Sequence[Target]) -> Surfaces:
        """Return the samples with their neighbors and patches."""
        near = k_nearest_others(samples, NUMBERS.neighbors)[0]
        start = torch.arange(len(samples)).unsqueeze(1).expand_as(near)
        edges = torch.stack([start, near], -1).reshape(-1, 2).sort(-1).values.unique(dim=0)
        links = component_links(samples, connected_components(edges, len(samples)))[0]
        edges = torch.cat([edges, links]).unique(dim=0)
        seeds = samples[: max(1, len(samples) // NUMBERS.patch)]
        patch = NeighborTree(seeds).nearest(samples)[0]
        size = float((samples.amax(0) - samples.amin(0)).norm())
        return cls(samples, normals, edges, patch, tuple(targets), size)

    @property
    def spacing(self) -> float:
        """Mean distance between points of a scan."""
        return sum(target.spacing for target in self.targets) / len(self.targets)

    def with_signs(self, motions: Tensor, label: Tensor) -> Surfaces:
        """Return the samples, and the scans: signs of normals are used in those where nearly all are the samples'."""
        targets = []
        for target, frame in zip(self.targets, motions, strict=True):
            points, normals = self.moved(frame[label])
            _, facing, square = target.residuals(points, normals, target.spacing)
            same = ((facing * normals).sum(-1) > 0)[square.isfinite()]
            targets.append(target.facing(target.normals) if float(same.double().mean()) > NUMBERS.signs else target)
        return replace(self, targets=tuple(targets))

    def moved(self, transforms: Tensor) -> tuple[Tensor, Tensor]:
        """Return samples and normals (..., n, 3) under motions (..., n, 4, 4)."""
        turn = transforms[..., :3, :3]
        points = (turn @ self.samples.unsqueeze(-1)).squeeze(-1) + transforms[..., :3, 3]
        return points, (turn @ self.normals.unsqueeze(-1)).squeeze(-1)

    def squares(self, motions: Tensor, reach: float, asked: Tensor) -> Tensor:
        """Return squared distances (T, n, K) of the samples from the scans, under K motions (T, K, 4, 4).

        Those that are not ``asked`` for (n, K) are infinite.
        """
        which, number = asked.nonzero().unbind(1)
        own = replace(self, samples=self.samples[which], normals=self.normals[which])
        squares = torch.full((len(motions), *asked.shape), torch.inf, dtype=torch.float64)
        for row, target, frame in zip(squares, self.targets, motions, strict=True):
            row[which, number] = target.residuals(*own.moved(frame[number]), reach)[2]
        return squares

    def noise(self, motions: Tensor, label: Tensor) -> Noise:
        """Return the noise of the samples' residuals under the motions (T, K, 4, 4) of their parts (n,)."""
        moved = [self.moved(frame[label]) for frame in motions]
        found = [t.residuals(*m, self.size) for t, m in zip(self.targets, moved, strict=True)]
        across, square = torch.stack([f[0] for f in found]), torch.stack([f[2] for f in found])
        near = square.isfinite()
        typical = float(square[near].sqrt().median()) if bool(near.any()) else 0.0
        sigma = max(NUMBERS.to_deviation * typical, NUMBERS.roughness * self.spacing)
        inlier = square < (NUMBERS.cut * sigma) ** 2
        return Noise(sigma, self._repeats(torch.where(inlier, across, 0.0), inlier, label))

    def _repeats(self, across: Tensor, inlier: Tensor, label: Tensor) -> float:
        """Return the growth of the variance of means over patches, beyond that of independent residuals (T, n)."""
        key = self.pieces(label)[0]
        blank = across.new_zeros(len(across), int(key.max()) + 1)
        count = blank.index_add(1, key, inlier.to(across))
        sums = blank.index_add(1, key, across)
        variance = across.square().sum() / inlier.sum().clamp_min(1)
        return max(1.0, float(sums.square().sum() / (variance * count.sum()).clamp_min(1e-300)))

    def pieces(self, label: Tensor) -> tuple[Tensor, Tensor]:
        """Return the piece (n,) of each sample, what a link has of a patch, and the link (P,) of each piece."""
        count = int(label.max()) + 1
        key, piece = (self.patch * count + label).unique(return_inverse=True)
        return piece, key % count

    def blocks(self, motions: Tensor, label: Tensor, scale: float) -> Blocks:
        """Return the normal equations of robust squared residuals at the motions (T, K, 4, 4) of parts (n,)."""
        return self._summed(motions, label, scale, label, torch.arange(motions.shape[1]))

    def piecewise(self, motions: Tensor, label: Tensor, scale: float) -> tuple[Blocks, Tensor]:
        """Return the normal equations of pieces of links, about the links' centers, and the link (P,) of each."""
        piece, owner = self.pieces(label)
        return self._summed(motions, label, scale, piece, owner), owner

    def _summed(self, motions: Tensor, label: Tensor, scale: float, piece: Tensor, owner: Tensor) -> Blocks:
        member = torch.nn.functional.one_hot(label, motions.shape[1]).to(self.samples)
        middle = (member.mT @ self.samples) / member.sum(0).clamp_min(1).unsqueeze(-1)
        centers = (motions[..., :3, :3] @ middle.unsqueeze(-1)).squeeze(-1) + motions[..., :3, 3]
        rows = []
        for target, frame, center in zip(self.targets, motions, centers, strict=True):
            points, normals = self.moved(frame[label])
            across, facing, square = target.residuals(points, normals, NUMBERS.reach * scale)
            rows.append(frame_sums(points - center[label], facing, across, square / scale**2, piece, len(owner)))
        return Blocks.of(torch.stack(rows), centers[:, owner])

    def cost(self, motions: Tensor, label: Tensor, scale: float) -> Tensor:
        """Return the robust costs (T, K) of the parts' squared residuals, in squared scales."""
        rows = []
        for target, frame in zip(self.targets, motions, strict=True):
            square = target.residuals(*self.moved(frame[label]), NUMBERS.reach * scale)[2]
            loss = geman_mcclure_loss((square / scale**2).clamp_max(1e12))
            rows.append(loss.new_zeros(motions.shape[1]).index_add(0, label, loss))
        return torch.stack(rows)

    def travel(self, motions: Tensor, label: Tensor) -> Tensor:
        """Return how far the samples of each part (K,) are from the reference, on average over samples and frames."""
        moved = torch.stack([self.moved(frame[label])[0] for frame in motions])
        paths = (moved - self.samples).norm(dim=-1).mean(0)
        member = torch.nn.functional.one_hot(label, motions.shape[1]).to(paths)
        return (paths @ member) / member.sum(0).clamp_min(1)

    def distances(self, motions: Tensor, label: Tensor) -> Tensor:
        """Return the median distances (T,) of the samples from the scans."""
        found = [
            target.residuals(*self.moved(frame[label]), self.size)[2].sqrt().median()
            for target, frame in zip(self.targets, motions, strict=True)
        ]
        return torch.stack(found)

    def refined(self, motions: Tensor, label: Tensor, scales: Sequence[float]) -> Tensor:
        """Return the motions (T, K, 4, 4) of all parts after a step of point-to-plane ICP at each of some scales."""
        for scale in scales:
            blocks = self.blocks(motions, label, scale)
            motions = turn_about(motions, solved(blocks, self.size), blocks.centers)
        return motions


def solved(blocks: Blocks, size: float) -> Tensor:
    """Return the twists (T, K, 6) of least quadratic cost; directions that the data do not hold stay."""
    unit = torch.ones(6, dtype=torch.float64)
    unit[3:] = 2 / size
    hessian = unit.unsqueeze(-1) * blocks.hessian * unit
    ridge = NUMBERS.damping * hessian.diagonal(dim1=-2, dim2=-1).mean(-1) + 1e-9
    hessian = hessian + ridge[..., None, None] * torch.eye(6).double()
    return -unit * torch.linalg.solve(hessian, unit * blocks.gradient)
