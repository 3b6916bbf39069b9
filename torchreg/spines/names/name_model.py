"""How likely names of tips are: features that stay the same in all frames, and limbs that move little between two."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchreg.geometry.skeleton import nearest_rotation
from torchreg.spines.names.body_mirror import BodyMirror, find_mirror
from torchreg.spines.names.student_t import SHRINKAGE, TAILS, GroupedDensity, fit_groups, t_log_density
from torchreg.spines.names.tip_features import SAMPLING, TipFeatures, TipObservations


@dataclass(frozen=True)
class NamingPriors:
    """Assumptions on names before any frame; lengths in sizes of the body."""

    missing: float = -1.0  # log-probability of a tip that a frame lacks, against one that it shows
    independent_points: float = 2.0  # of a limb: the others move with these
    turn: float = 0.1  # mean of 1 - cos of the body's rotation between two frames, at first: about 26 degrees
    turn_samples: float = 2.0  # rotations that this counts for when it is learned
    min_displacement: float = 0.01  # scale of displacements that is never undercut: nodes are no nearer to each other
    noise: float = 1e-3  # of features, below which no difference counts
    background_maps: int = 40  # random names per frame that show what features look like if names are wrong


PRIORS = NamingPriors()


def relative_maps(before: Tensor, after: Tensor, num_tips: int) -> Tensor:
    """Return the tips (A, B, M) that M tips of the frame before become under names (A, K) and (B, K), -1 for none."""
    shape = (len(before), len(after), before.shape[1])
    tips = torch.full((*shape[:2], num_tips + 1), -1)
    where = torch.where(before >= 0, before, num_tips)[:, None].expand(shape)
    return tips.scatter_(2, where, after[None].expand(shape))[..., :num_tips]


@dataclass(frozen=True, eq=False)
class NameModel:
    """The probability of all frames' names: a chain.

    A frame's features are those of a mean frame up to multivariate t-distributed errors. The points of each limb stay,
    or move rigidly with the whole body, up to t-distributed displacements from the frame before. Tips without a name,
    and features and positions under wrong names, are background.
    """

    features: TipFeatures  # that are compared
    mean: Tensor  # (n,) features of a mean frame, NaN where unknown
    density: GroupedDensity  # of their errors
    background_mean: Tensor  # (n,) under random names
    background: GroupedDensity  # density of features under random names
    median_distances: Tensor  # (K (K - 1) / 2,) median distances between named tips
    displacement: Tensor  # (S,) scale of the displacements of a limb's points
    turn: float  # mean of 1 - cos of the body's rotation between two frames
    log_volume: float  # of the space that limbs move in
    weight: float = 1.0  # of features against motion: one, but before anything is known of them
    # symmetry of the body, if it has one; a limb and its mirror image then differ by the pose alone
    mirror: BodyMirror | None = None

    @classmethod
    def from_frame(cls, frames: Sequence[TipObservations], reference: int, names: Tensor) -> NameModel:
        """Return the model of which one frame's names (K,) are known, without displacements."""
        with_volumes = any(bool(frame.volumes.any()) for frame in frames)
        features = TipFeatures(len(names), frames[0].limbs.shape[1], with_volumes=with_volumes)
        center, background = _background(features, frames)
        median = features.distances(frames[reference], names[None])[0]
        median = torch.where(median.isnan(), median.nanmean().nan_to_num(), median)
        points = torch.cat([frame.curves.flatten(0, 1) for frame in frames])
        return cls(
            features=features,
            mean=features(frames[reference], names[None], median)[0],
            density=GroupedDensity(features.groups, [SHRINKAGE.variance * c for c in background.covariances]),
            background_mean=center,
            background=background,
            median_distances=median,
            displacement=torch.zeros(SAMPLING.num_points, dtype=torch.float64),
            turn=PRIORS.turn,
            log_volume=3 * math.log(float((points.amax(0) - points.amin(0)).norm().clamp_min(1e-6))),
        )

    def starting(self, displacement: float, weight: float) -> NameModel:
        """Return the model with one scale of displacements, and a weight of features."""
        return replace(self, displacement=torch.full_like(self.displacement, displacement), weight=weight)

    def mirrored(self, frames: Sequence[TipObservations], names: Tensor, reference: int) -> NameModel:
        """Return the model of a symmetric body, if frames with names (T, K) show one; else itself."""
        mirror = find_mirror(self.features, self.background, frames, names)
        if mirror is None:
            return self
        levels = mirror.levels.clamp_max(SHRINKAGE.variance)
        covariances = [level * c for level, c in zip(levels.tolist(), self.background.covariances, strict=True)]
        known = names[reference][None]
        return replace(
            self,
            mirror=mirror,
            mean=(self.mean + mirror.features(self.features, frames[reference], known, self.median_distances)[0]) / 2,
            density=GroupedDensity(self.features.groups, covariances),
        )

    def of_names(self, frame: TipObservations, maps: Tensor) -> Tensor:
        """Return the features (P, n) of a frame under mappings (P, K)."""
        return self.features(frame, maps, self.median_distances)

    def scores(self, features: Tensor) -> Tensor:
        """Return the log-probability ratios (P,) of features (P, n) of a frame to the background."""
        if self.weight == 0:
            return features.new_zeros(len(features))
        scores = self.density(features - self.mean) - self._background_scores(features)
        return self.weight * scores.sum(-1)

    def _background_scores(self, features: Tensor) -> Tensor:
        """Return the log-densities (..., G) of features (..., n) under random names, of those that the model knows."""
        return self.background(torch.where(self.mean.isnan(), torch.nan, features) - self.background_mean)

    def motion_scores(self, before: TipObservations, after: TipObservations, tips: Tensor) -> Tensor:
        """Return log-probabilities (P,) of limb positions for tips (P, M) that those before become, -1 for none."""
        found = (tips >= 0).to(before.curves)
        moved, turn = self._moved(before.curves, after.curves[tips.clamp_min(0)], found)
        still = (after.curves[tips.clamp_min(0)] - before.curves).square().sum(-1)
        rows = [t_log_density(squares, self.displacement, 3) for squares in (moved, still)]
        scores = torch.logaddexp(*rows) - math.log(2) + self.log_volume
        scores = PRIORS.independent_points * (scores.mean(-1) * found).sum(-1)
        return scores - 1.5 * (turn / self.turn + math.log(self.turn))  # of three angles, each with the same spread

    def _moved(self, source: Tensor, target: Tensor, found: Tensor) -> tuple[Tensor, Tensor]:
        """Return squared distances (P, M, S) from targets to rigidly moved points, and 1 - cos of the rotations."""
        weights = found.unsqueeze(-1) / self.displacement.square()
        total = weights.sum((1, 2)).clamp_min(1e-12)[:, None]
        start = source - (torch.einsum("pks,ksi->pi", weights, source) / total)[:, None, None]
        end = target - (torch.einsum("pks,pksi->pi", weights, target) / total)[:, None, None]
        rotation = nearest_rotation(torch.einsum("pks,pksi,pksj->pij", weights, end, start))
        squares = (end - torch.einsum("pij,pksj->pksi", rotation, start)).square().sum(-1)
        return squares, (3 - rotation.diagonal(dim1=1, dim2=2).sum(-1)) / 2

    def refitted(self, frames: Sequence[TipObservations], names: Tensor) -> NameModel:
        """Return the model that fits names (T, K) best."""
        maps = names.unsqueeze(1)
        distances = torch.cat([self.features.distances(*row) for row in zip(frames, maps, strict=True)])
        median = distances.nanmedian(0).values
        median = torch.where(median.isnan(), self.median_distances, median)
        samples = torch.cat([self.features(frame, row, median) for frame, row in zip(frames, maps, strict=True)])
        images = [] if self.mirror is None else [
            self.mirror.features(self.features, *row, median) for row in zip(frames, maps, strict=True)
        ]  # fmt: skip
        mean, density = fit_groups(torch.cat((samples, *images)), self.background)
        return replace(
            self,
            mean=mean,
            density=density,
            median_distances=median,
            weight=1.0,
            **self._motion(frames, names),
        )

    def _motion(self, frames: Sequence[TipObservations], names: Tensor) -> dict[str, Any]:
        """Return the scales of displacements and rotations under names (T, K)."""
        moved, still, turns = [], [], []
        for number in range(1, len(frames)):
            before, after = frames[number - 1], frames[number]
            tips = relative_maps(names[number - 1 : number], names[number : number + 1], len(before))[0]
            found, target = tips[0] >= 0, after.curves[tips.clamp_min(0)]
            squares, turn = self._moved(before.curves, target, found[None].to(target))
            moved.append(squares[0, found])
            still.append((target[0] - before.curves).square().sum(-1)[found])
            turns.append(float(turn))
        mean_turn = (sum(turns) + PRIORS.turn_samples * PRIORS.turn) / (len(turns) + PRIORS.turn_samples)
        squares = torch.stack((torch.cat(moved), torch.cat(still))) if moved else torch.zeros(2, 0)
        displacement = mixture_scales(squares) if squares.numel() else self.displacement
        return {"displacement": displacement, "turn": max(mean_turn, PRIORS.noise)}


def mixture_scales(squares: Tensor) -> Tensor:
    """Return the scales (S,) of t-distributed displacements of which each has one of two squared lengths (2, n, S)."""
    scale = (squares.amin(0).median(0).values / 3).sqrt().clamp_min(PRIORS.min_displacement)
    for _ in range(TAILS.num_rounds):
        shares = t_log_density(squares, scale, 3).softmax(0)
        weights = (TAILS.displacement_dof + 3) / (TAILS.displacement_dof + squares / scale.square())
        scale = ((shares * weights * squares).sum(0).mean(0) / 3).sqrt().clamp_min(PRIORS.min_displacement)
    return scale


def _background(features: TipFeatures, frames: Sequence[TipObservations]) -> tuple[Tensor, GroupedDensity]:
    """Return the mean and the density of features under random names: alike in all directions of a group."""
    generator, rows = torch.Generator().manual_seed(0), []
    for frame in frames:
        order = torch.rand(PRIORS.background_maps, max(len(frame), features.num_names), generator=generator).argsort(1)
        maps = torch.where(order < len(frame), order, -1)[:, : features.num_names]
        pairs = torch.zeros(features.pairs.shape[1], dtype=torch.float64) + frame.geodesics.mean()
        rows.append(features(frame, maps, pairs))
    samples = torch.cat(rows)
    center = samples.nanmean(0).nan_to_num()
    residuals = (samples - center).nan_to_num()
    covariances = []
    for group in features.groups:
        values, vectors = torch.linalg.eigh(residuals[:, group.index].mT @ residuals[:, group.index] / len(samples))
        level = values[-group.rank :].mean() + PRIORS.noise**2
        covariances.append(level * vectors[:, -group.rank :] @ vectors[:, -group.rank :].mT)
    return center, GroupedDensity(features.groups, covariances)
