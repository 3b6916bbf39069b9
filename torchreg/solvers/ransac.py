"""RANSAC: rigid motions from matches most of which are wrong."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.budget import BUDGET
from torchreg.geometry.rigid import fit_rigid, invert_rigid, rigid_matrix


@dataclass(frozen=True)
class _Sampling:
    """Numbers of the samples and of their refinement."""

    # Change of the distance between two right matches, in thresholds: each of the two may be off by one.
    pair_slack: float = 2.0
    # Least distance between samples, in thresholds: closer ones say little about a rotation.
    min_baseline: float = 2.0
    # Least sine of the angle between the two directions that make a frame.
    min_sine: float = 0.1
    # Motions refined before distinct ones are picked, per hypothesis returned.
    spare: int = 3
    # Widths of the inlier kernel in the steps of a refinement, in thresholds.
    widths: tuple[float, ...] = (2.0, 1.5, 1.0, 1.0, 1.0)


_SAMPLING = _Sampling()


@dataclass(frozen=True)
class RansacResult:
    """Rigid motions that many matches support, best first; a batch of groups adds its dimensions in front."""

    transforms: Tensor  # (K, 4, 4), source to target; the identity if fewer than K distinct ones were found
    inliers: Tensor  # (K, N) True for matches within the threshold
    counts: Tensor  # (K,) int64 number of inliers; 0 for motions that were not found
    scores: Tensor  # (K,) weighted sum of ``1 - r^2 / threshold^2`` over the inliers, by which motions are ranked


@torch.no_grad()
def ransac_rigid(
    source: Tensor,
    target: Tensor,
    *,
    threshold: float,
    source_normals: Tensor | None = None,
    target_normals: Tensor | None = None,
    max_angle: float = 0.6,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    num_trials: int = 500,
    num_hypotheses: int = 4,
    min_difference: float = 3.0,
    generator: torch.Generator | None = None,
) -> RansacResult:
    """Return K distinct rigid motions of each group that matches (..., N, 3) support, however many of these are wrong.

    The first match of a sample is drawn by weight, each further one among those that preserve the distances (and angles
    of normals) to those before; three, or two with normals, determine a motion. The best motions are refitted to their
    inliers, and must move the points apart by ``min_difference`` thresholds (root mean square) to be distinct. Angles
    are in radians; matches of weight zero, or masked False, are no inliers (Fischler and Bolles 1981; Torr and
    Zisserman 2000 for the score).
    """
    normals = None if source_normals is None or target_normals is None else (source_normals, target_normals)
    matches = _Matches.from_rows(source, target, normals, weights, mask, threshold=threshold, max_angle=max_angle)
    groups, count = matches.weights.shape
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    # One draw for all groups alike keeps a group's samples the same whatever it is batched with.
    drawn = torch.rand(3, num_trials, generator=generator, device=generator.device, dtype=torch.float64)
    # Stratified: every match gets its share of the samples by its weight.
    drawn[0] = (drawn[0] + torch.arange(num_trials, device=drawn.device)) / num_trials
    drawn = drawn.to(matches.source)
    trials = []
    for part in drawn.split(max(1, BUDGET.table_entries // max(1, groups * count)), dim=1):
        motions, sound = _sampled_motions(matches, part)
        trials.append((motions, matches.score(motions, 1.0)[0].sum(-1).masked_fill_(~sound, 0.0)))
    transforms, scores = (torch.cat(column, dim=1) for column in zip(*trials, strict=True))
    distance = min_difference * threshold
    # Most good samples give the same motion, which must not crowd out further ones before they are refined.
    num_refined = min(_SAMPLING.spare * num_hypotheses, num_trials)
    transforms, scores = _distinct(matches, transforms, scores, num_refined, distance)
    transforms, scores = _refined(matches, transforms, scores)
    transforms, scores = _distinct(matches, transforms, scores, num_hypotheses, distance)
    found = scores > 0
    inliers = matches.score(transforms, 1.0)[1] & found.unsqueeze(-1)
    fields = {
        "transforms": matches.between_given_points(transforms, found),
        "inliers": inliers,
        "counts": inliers.sum(-1),
        "scores": scores,
    }
    batch = source.shape[:-2]
    return RansacResult(**{name: value.reshape(*batch, *value.shape[1:]) for name, value in fields.items()})


@dataclass(frozen=True)
class _Matches:
    """Matches of G groups around their centers, zero with weight zero where masked."""

    source: Tensor
    target: Tensor
    normals: tuple[Tensor, Tensor] | None
    weights: Tensor
    valid: Tensor
    source_center: Tensor
    target_center: Tensor
    threshold: float
    max_angle: float

    @classmethod
    def from_rows(
        cls,
        source: Tensor,
        target: Tensor,
        normals: tuple[Tensor, Tensor] | None,
        weights: Tensor | None,
        mask: Tensor | None,
        *,
        threshold: float,
        max_angle: float,
    ) -> _Matches:
        """Return masked and centered matches with one dimension of groups."""
        valid = torch.ones_like(source[..., 0], dtype=torch.bool) if mask is None else mask
        weights = (source.new_ones(valid.shape) if weights is None else weights.to(source)).masked_fill(~valid, 0.0)
        keep = valid.reshape(-1, valid.shape[-1], 1)
        total = keep.sum(-2, keepdim=True).clamp_min(1)

        def flat(rows: Tensor) -> Tensor:
            return rows.reshape(-1, *rows.shape[-2:]).masked_fill(~keep, 0.0)

        def center(rows: Tensor) -> Tensor:
            return flat(rows).sum(-2, keepdim=True) / total

        return cls(
            source=(flat(source) - center(source)) * keep,
            target=(flat(target) - center(target)) * keep,
            normals=None if normals is None else (flat(normals[0]), flat(normals[1])),
            weights=weights.reshape(keep.shape[:-1]),
            valid=keep.squeeze(-1) & (weights.reshape(keep.shape[:-1]) > 0),
            source_center=center(source),
            target_center=center(target),
            threshold=threshold,
            max_angle=max_angle,
        )

    def score(self, transforms: Tensor, width: float) -> tuple[Tensor, Tensor]:
        """Return weighted scores (G, C, N) of the matches under transforms (G, C, 4, 4), and the mask of inliers."""
        rotation = transforms[..., :3, :3]
        moved = (rotation.flatten(1, 2) @ self.source.mT).unflatten(1, (-1, 3)).add_(transforms[..., :3, 3:])
        square = moved.sub_(self.target.mT.unsqueeze(1)).square_().sum(2)
        share = square.mul_(-1 / (width * self.threshold) ** 2).add_(1.0)
        within = (share > 0) & self.valid.unsqueeze(1)
        if self.normals is not None:
            source_normals, target_normals = self.normals
            rotated = (rotation.flatten(1, 2) @ source_normals.mT).unflatten(1, (-1, 3))
            cosine = rotated.mul_(target_normals.mT.unsqueeze(1)).sum(2)
            within &= cosine > torch.cos(cosine.new_tensor(self.max_angle))
        return share.mul_(within).mul_(self.weights.unsqueeze(1)), within

    def between_given_points(self, transforms: Tensor, found: Tensor) -> Tensor:
        """Return transforms (G, C, 4, 4) of the points before centering, the identity where nothing was found."""
        eye = torch.eye(3, dtype=transforms.dtype, device=transforms.device)
        to_target = rigid_matrix(eye.expand(len(transforms), 1, 3, 3), self.target_center)
        to_source = rigid_matrix(eye.expand(len(transforms), 1, 3, 3), self.source_center)
        moved = to_target @ transforms @ invert_rigid(to_source)
        return torch.where(found[..., None, None], moved, torch.eye(4, dtype=moved.dtype, device=moved.device))


def _sampled_motions(matches: _Matches, drawn: Tensor) -> tuple[Tensor, Tensor]:
    """Return motions (G, C, 4, 4) of samples drawn with numbers (3, C) from 0 to 1, and a mask of sound ones."""
    first = _drawn_rows(matches.weights.unsqueeze(1).expand(-1, drawn.shape[1], -1), drawn[0])
    from_first = _compatible(matches, first)
    second = _drawn_rows(from_first, drawn[1])
    origin, across = _edge(matches.source, first, second)
    target_origin, target_across = _edge(matches.target, first, second)
    sound = from_first.gather(2, second.unsqueeze(-1)).squeeze(-1) > 0
    if matches.normals is not None:
        side, target_side = (_rows(normals, first) + _rows(normals, second) for normals in matches.normals)
    else:
        weights = _third_weights(matches, origin, across, from_first, second)
        third = _drawn_rows(weights, drawn[2])
        sound &= weights.gather(2, third.unsqueeze(-1)).squeeze(-1) > 0
        side, target_side = _rows(matches.source, third) - origin, _rows(matches.target, third) - target_origin
    frame, good = _orthonormal(across, side)
    target_frame, target_good = _orthonormal(target_across, target_side)
    rotation = target_frame @ frame.mT
    center, target_center = origin + 0.5 * across, target_origin + 0.5 * target_across
    translation = target_center - (rotation @ center.unsqueeze(-1)).squeeze(-1)
    return rigid_matrix(rotation, translation), sound & good & target_good


def _edge(points: Tensor, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Return points (G, C, 3) at the first indices, and the vectors from these to those at the second."""
    origin = _rows(points, first)
    return origin, _rows(points, second) - origin


def _third_weights(matches: _Matches, origin: Tensor, across: Tensor, from_first: Tensor, second: Tensor) -> Tensor:
    """Return the weights (G, C, N) of a third match: the height of its triangle over the first two."""
    axis = torch.nn.functional.normalize(across, dim=-1)
    offset = matches.source.unsqueeze(1) - origin.unsqueeze(2)
    along = (offset @ axis.unsqueeze(-1)).squeeze(-1)
    height = (offset.square_().sum(-1) - along.square_()).clamp_min_(0.0).sqrt_()
    weights = height * ((from_first > 0) & (_compatible(matches, second) > 0))
    return weights.masked_fill_(height < _SAMPLING.min_baseline * matches.threshold, 0.0)


def _compatible(matches: _Matches, index: Tensor) -> Tensor:
    """Return weights (G, C, N) of matches that can lie on one rigid body with match ``index`` (G, C), else zero."""
    source, target = _exact_distances(matches.source, index), _exact_distances(matches.target, index)
    fits = (source - target).abs_() <= _SAMPLING.pair_slack * matches.threshold
    fits &= torch.minimum(source, target) >= _SAMPLING.min_baseline * matches.threshold
    if matches.normals is not None:
        source_cosines = _cosines(matches.source, matches.normals[0], index, source)
        target_cosines = _cosines(matches.target, matches.normals[1], index, target)
        # A cosine changes by no more than its angle.
        for source_cosine, target_cosine in zip(source_cosines, target_cosines, strict=True):
            fits &= (source_cosine - target_cosine).abs_() <= _SAMPLING.pair_slack * matches.max_angle
    return source.mul_(fits).mul_(matches.weights.unsqueeze(1))


def _exact_distances(points: Tensor, index: Tensor) -> Tensor:
    # The matrix product of the default mode is off by far more than a threshold in float32.
    return torch.cdist(_rows(points, index), points, compute_mode="donot_use_mm_for_euclid_dist")


def _cosines(points: Tensor, normals: Tensor, index: Tensor, distance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return cosines (G, C, N) between the normals of two points, and between each and the line through the points."""
    start, start_normal = _rows(points, index), _rows(normals, index)
    length = distance.clamp_min(torch.finfo(distance.dtype).tiny)
    along_start = start_normal @ points.mT - (start_normal * start).sum(-1, keepdim=True)
    along_end = (normals * points).sum(-1).unsqueeze(1) - start @ normals.mT
    return start_normal @ normals.mT, along_start / length, along_end / length


def _orthonormal(across: Tensor, side: Tensor) -> tuple[Tensor, Tensor]:
    """Return orthonormal columns (..., 3, 3), the first along ``across``, the second near ``side``, and their mask."""
    first = torch.nn.functional.normalize(across, dim=-1)
    rest = side - (side * first).sum(-1, keepdim=True) * first
    good = rest.norm(dim=-1) > _SAMPLING.min_sine * side.norm(dim=-1)
    second = torch.nn.functional.normalize(rest, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1), good


def _drawn_rows(weights: Tensor, drawn: Tensor) -> Tensor:
    """Return an index (G, C) per row of weights (G, C, N), drawn by weight with numbers (C,) from 0 to 1."""
    cumulated = weights.cumsum(-1)
    # Short of the end even after rounding, so that no row of weight zero is drawn there.
    goal = cumulated[..., -1:] * drawn[:, None] * (1 - 4 * torch.finfo(weights.dtype).eps)
    index = torch.searchsorted(cumulated, goal, right=True).squeeze(-1)
    return index.clamp_max_(weights.shape[-1] - 1)


def _rows(table: Tensor, index: Tensor) -> Tensor:
    """Return rows ``index`` (G, C) of a table (G, N, 3)."""
    return table.gather(1, index.unsqueeze(-1).expand(*index.shape, table.shape[-1]))


def _refined(matches: _Matches, transforms: Tensor, scores: Tensor) -> tuple[Tensor, Tensor]:
    """Return transforms (G, C, 4, 4) fitted to their inliers where that raised their scores."""
    source, target = matches.source.unsqueeze(1), matches.target.unsqueeze(1)
    for width in _SAMPLING.widths:
        weights, _ = matches.score(transforms, width)
        trial = fit_rigid(source, target, weights)
        trial_scores = matches.score(trial, 1.0)[0].sum(-1)
        # Unsound motions keep the score zero.
        better = (trial_scores > scores) & (scores > 0)
        transforms = torch.where(better[..., None, None], trial, transforms)
        scores = torch.where(better, trial_scores, scores)
    return transforms, scores


def _distinct(
    matches: _Matches, transforms: Tensor, scores: Tensor, count: int, distance: float
) -> tuple[Tensor, Tensor]:
    """Return the best ``count`` transforms per group that move the points apart by at least ``distance``."""
    points = torch.nn.functional.pad(matches.source, (0, 1), value=1.0) * matches.valid.unsqueeze(-1)
    moments = points.mT @ points / matches.valid.sum(-1).clamp_min(1)[:, None, None]
    groups = torch.arange(len(scores), device=scores.device)
    alive, chosen = scores.clone(), []
    for _ in range(count):
        best = alive.argmax(1)
        chosen.append((transforms[groups, best], alive[groups, best]))
        difference = transforms[..., :3, :] - transforms[groups, best][:, None, :3, :]
        square = ((difference @ moments.unsqueeze(1)) * difference).sum((-2, -1))
        alive = alive.masked_fill(square < distance**2, 0.0)
        alive[groups, best] = 0.0
    return torch.stack([item[0] for item in chosen], 1), torch.stack([item[1] for item in chosen], 1)
