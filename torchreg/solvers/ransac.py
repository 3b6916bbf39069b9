"""Rigid motions from matched points most of which are wrong, by random samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_count, check_finite, check_points, check_positive, check_same_kind
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.rigid import fit_rigid, invert_rigid, rigid_matrix

# Numbers held at once per table of trials times matches.
_CHUNK = 2**21
# Two right matches change their distance by at most twice what each may be off.
_PAIR_SLACK = 2.0
# The other way is faster and off by far more than a threshold in float32.
_EXACT = "donot_use_mm_for_euclid_dist"
# In thresholds: closer samples say little about a rotation.
_MIN_BASELINE = 2.0
_MIN_SINE = 0.1
# Refined before distinct ones are picked, per hypothesis returned.
_SPARE = 3
# Widths of the inlier kernel, in thresholds, that a refinement goes through.
_WIDTHS = (2.0, 1.5, 1.0, 1.0, 1.0)


@dataclass(frozen=True)
class RansacResult:
    """Rigid motions that many matches agree with, best first. A batch of groups adds its dimensions in front.

    Args:
        transforms: (K, 4, 4), source to target; the identity where fewer than K distinct ones were found.
        inliers: (K, N) True for matches within the threshold.
        counts: (K,) int64 number of inliers; 0 where nothing was found.
        scores: (K,) weighted sum of ``1 - r^2 / threshold^2`` over the inliers, which ranks the motions.
    """

    transforms: Tensor
    inliers: Tensor
    counts: Tensor
    scores: Tensor


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
    """Return several distinct rigid motions supported by matched points, however many matches are wrong.

    The first match of a sample is drawn by weight, evenly over the samples; each further one among those that keep
    their distances to the samples before it (and, with normals, their angles), far ones rather than near ones. Three
    matches, or two with normals, give a motion. All motions of all groups are scored together; the best are refitted to
    their inliers in turns, and then picked in the order of their scores, leaving out those that move the group's points
    nearly like one picked before.

    Args:
        source: (..., N, 3), any unit; leading dimensions are groups with motions of their own.
        target: (..., N, 3) the matches, row by row; a point may occur in several rows.
        threshold: distance below which a match is an inlier, in the unit of the points.
        source_normals: (..., N, 3) unit, oriented alike in source and target; None to do without.
        target_normals: (..., N, 3), given with ``source_normals``.
        max_angle: between a turned normal and its match's in an inlier, radians.
        weights: (..., N) not negative, of the matches; ones by default. A row of weight zero is no inlier.
        mask: (..., N) True for rows that count; rows that only fill up a group are False and may hold anything.
        num_trials: samples per group.
        num_hypotheses: K, motions returned per group.
        min_difference: root mean square distance, in thresholds, by which motions must move the points apart to be
            distinct.
        generator: draws the samples; a default one of seed 0 if none is given.

    Returns:
        a `RansacResult`; the same for the same generator state, however the groups are batched up to rounding.

    Raises:
        InputError: if shapes differ, numbers are not finite, or only one of the normals is given.
        InputTypeError: if dtypes or devices differ or ``mask`` is not Boolean.

    Differentiable: no.

    Cost: O(groups num_trials N) in time; memory in chunks of trials.

    References: Fischler and Bolles 1981; Torr and Zisserman 2000 for the score.
    """
    check_positive(threshold, "threshold")
    check_positive(max_angle, "max_angle")
    check_positive(min_difference, "min_difference", allow_zero=True)
    check_count(num_trials, "num_trials", 1)
    check_count(num_hypotheses, "num_hypotheses", 1)
    matches = _matches(source, target, source_normals, target_normals, weights, mask, threshold, max_angle)
    groups, count = matches.weights.shape
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    # One draw for all groups alike keeps a group's samples the same whatever it is batched with.
    drawn = torch.rand(3, num_trials, generator=generator, device=generator.device, dtype=torch.float64)
    # Every match, by its weight, gets its share of the samples that start with it.
    drawn[0] = (drawn[0] + torch.arange(num_trials, device=drawn.device)) / num_trials
    drawn = drawn.to(matches.source)
    trials = []
    for part in drawn.split(max(1, _CHUNK // max(1, groups * count)), dim=1):
        motions, sound = _sampled(matches, part)
        trials.append((motions, matches.score(motions, 1.0)[0].sum(-1).masked_fill_(~sound, 0.0)))
    transforms, scores = (torch.cat(column, dim=1) for column in zip(*trials, strict=True))
    apart = min_difference * threshold
    # Most good samples give the same motion, which must not crowd out the others before they are refined.
    transforms, scores = _distinct(matches, transforms, scores, min(_SPARE * num_hypotheses, num_trials), apart)
    transforms, scores = _refined(matches, transforms, scores)
    transforms, scores = _distinct(matches, transforms, scores, num_hypotheses, apart)
    found = scores > 0
    inliers = matches.score(transforms, 1.0)[1] & found.unsqueeze(-1)
    fields = (matches.in_place(transforms, found), inliers, inliers.sum(-1), scores)
    return RansacResult(*[field.reshape(*source.shape[:-2], *field.shape[1:]) for field in fields])


@dataclass(frozen=True)
class _Matches:
    """Matches of G groups around their centers, zero with weight zero where masked."""

    source: Tensor
    target: Tensor
    source_normals: Tensor | None
    target_normals: Tensor | None
    weights: Tensor
    valid: Tensor
    source_center: Tensor
    target_center: Tensor
    threshold: float
    max_angle: float

    def score(self, transforms: Tensor, width: float) -> tuple[Tensor, Tensor]:
        """Return weighted scores (G, C, N) of the matches under transforms (G, C, 4, 4), and which are within."""
        rotation = transforms[..., :3, :3]
        moved = (rotation.flatten(1, 2) @ self.source.mT).unflatten(1, (-1, 3)).add_(transforms[..., :3, 3:])
        square = moved.sub_(self.target.mT.unsqueeze(1)).square_().sum(2)
        share = square.mul_(-1 / (width * self.threshold) ** 2).add_(1.0)
        within = (share > 0) & self.valid.unsqueeze(1)
        if self.source_normals is not None and self.target_normals is not None:
            turned = (rotation.flatten(1, 2) @ self.source_normals.mT).unflatten(1, (-1, 3))
            cosine = turned.mul_(self.target_normals.mT.unsqueeze(1)).sum(2)
            within &= cosine > torch.cos(cosine.new_tensor(self.max_angle))
        return share.mul_(within).mul_(self.weights.unsqueeze(1)), within

    def in_place(self, transforms: Tensor, found: Tensor) -> Tensor:
        """Return transforms (G, C, 4, 4) between the points as given, the identity where nothing was found."""
        eye = torch.eye(3, dtype=transforms.dtype, device=transforms.device)
        there = rigid_matrix(eye.expand(len(transforms), 1, 3, 3), self.target_center)
        here = rigid_matrix(eye.expand(len(transforms), 1, 3, 3), self.source_center)
        placed = there @ transforms @ invert_rigid(here)
        return torch.where(found[..., None, None], placed, torch.eye(4, dtype=placed.dtype, device=placed.device))


def _matches(
    source: Any,
    target: Any,
    source_normals: Any,
    target_normals: Any,
    weights: Any,
    mask: Any,
    threshold: float,
    max_angle: float,
) -> _Matches:
    """Return checked, masked and centered matches with one dimension of groups."""
    source, target = as_float_tensor(source, "source"), as_float_tensor(target, "target")
    check_same_kind(target, "target", source, "source")
    valid = torch.ones(source.shape[:-1], dtype=torch.bool, device=source.device) if mask is None else mask
    if not isinstance(valid, Tensor) or valid.dtype != torch.bool:
        raise InputTypeError(f"mask must be a Boolean tensor, got {getattr(valid, 'dtype', type(valid).__name__)}")
    weights = source.new_ones(valid.shape) if weights is None else as_float_tensor(weights, "weights", like=source)
    if (source_normals is None) != (target_normals is None):
        raise InputError("source_normals and target_normals must be given together, got one of them")
    rows = {"target": target, "mask": valid.unsqueeze(-1), "weights": weights.unsqueeze(-1)}
    normals = {"source_normals": source_normals, "target_normals": target_normals} if source_normals is not None else {}
    normals = {name: as_float_tensor(value, name, like=source) for name, value in normals.items()}
    for name, value in {**rows, **normals}.items():
        if value.shape[:-1] != source.shape[:-1]:
            raise InputError(
                f"{name} must have one row per row of source {tuple(source.shape)}, got {tuple(value.shape)}"
            )
    keep = valid.unsqueeze(-1)
    given = {"source": source, "target": target, **normals}
    clean = {name: value.masked_fill(~keep, 0.0) for name, value in given.items()}
    for name, value in clean.items():
        check_points(value, name)
    weights = weights.masked_fill(~valid, 0.0)
    check_finite(weights, "weights")
    if bool((weights < 0).any()):
        raise InputError(f"weights must not be negative, got {float(weights.min())}")
    flat = {name: value.reshape(-1, *value.shape[-2:]) for name, value in clean.items()}
    keep = keep.reshape(-1, *keep.shape[-2:])
    total = keep.sum(-2, keepdim=True).clamp_min(1)
    centers = {name: flat[name].sum(-2, keepdim=True) / total for name in ("source", "target")}
    return _Matches(
        (flat["source"] - centers["source"]) * keep,
        (flat["target"] - centers["target"]) * keep,
        flat.get("source_normals"),
        flat.get("target_normals"),
        weights.reshape(keep.shape[:-1]),
        keep.squeeze(-1) & (weights.reshape(keep.shape[:-1]) > 0),
        centers["source"],
        centers["target"],
        threshold,
        max_angle,
    )


def _sampled(matches: _Matches, drawn: Tensor) -> tuple[Tensor, Tensor]:
    """Return motions (G, C, 4, 4) of samples drawn with numbers (3, C) from 0 to 1, and which are sound (G, C)."""
    first = _draw(matches.weights.unsqueeze(1).expand(-1, drawn.shape[1], -1), drawn[0])
    from_first = _compatible(matches, first)
    second = _draw(from_first, drawn[1])
    origin, there = _rows(matches.source, first), _rows(matches.target, first)
    across, across_there = _rows(matches.source, second) - origin, _rows(matches.target, second) - there
    sound = from_first.gather(2, second.unsqueeze(-1)).squeeze(-1) > 0
    if matches.source_normals is not None and matches.target_normals is not None:
        side = _rows(matches.source_normals, first) + _rows(matches.source_normals, second)
        side_there = _rows(matches.target_normals, first) + _rows(matches.target_normals, second)
    else:
        # The height of the triangle over the first two samples weighs the third.
        axis = torch.nn.functional.normalize(across, dim=-1)
        offset = matches.source.unsqueeze(1) - origin.unsqueeze(2)
        along = (offset @ axis.unsqueeze(-1)).squeeze(-1)
        height = (offset.square_().sum(-1) - along.square_()).clamp_min_(0.0).sqrt_()
        both = height * ((from_first > 0) & (_compatible(matches, second) > 0))
        both = both.masked_fill_(height < _MIN_BASELINE * matches.threshold, 0.0)
        third = _draw(both, drawn[2])
        sound &= both.gather(2, third.unsqueeze(-1)).squeeze(-1) > 0
        side, side_there = _rows(matches.source, third) - origin, _rows(matches.target, third) - there
    frame, good = _frame(across, side)
    frame_there, good_there = _frame(across_there, side_there)
    rotation = frame_there @ frame.mT
    middle, middle_there = origin + 0.5 * across, there + 0.5 * across_there
    translation = middle_there - (rotation @ middle.unsqueeze(-1)).squeeze(-1)
    return rigid_matrix(rotation, translation), sound & good & good_there


def _compatible(matches: _Matches, index: Tensor) -> Tensor:
    """Return weights (G, C, N) of matches that can lie on one rigid body with match ``index`` (G, C), else zero."""
    distance = torch.cdist(_rows(matches.source, index), matches.source, compute_mode=_EXACT)
    distance_there = torch.cdist(_rows(matches.target, index), matches.target, compute_mode=_EXACT)
    fits = (distance - distance_there).abs_() <= _PAIR_SLACK * matches.threshold
    fits &= torch.minimum(distance, distance_there) >= _MIN_BASELINE * matches.threshold
    if matches.source_normals is not None and matches.target_normals is not None:
        here = _angles(matches.source, matches.source_normals, index, distance)
        there = _angles(matches.target, matches.target_normals, index, distance_there)
        # A cosine changes by no more than its angle.
        for cosine, cosine_there in zip(here, there, strict=True):
            fits &= (cosine - cosine_there).abs_() <= _PAIR_SLACK * matches.max_angle
    return distance.mul_(fits).mul_(matches.weights.unsqueeze(1))


def _angles(points: Tensor, normals: Tensor, index: Tensor, distance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return cosines (G, C, N) between both normals, and between each and the line that joins the points."""
    own_point, own_normal = _rows(points, index), _rows(normals, index)
    length = distance.clamp_min(torch.finfo(distance.dtype).tiny)
    from_own = own_normal @ points.mT - (own_normal * own_point).sum(-1, keepdim=True)
    from_other = (normals * points).sum(-1).unsqueeze(1) - own_point @ normals.mT
    return own_normal @ normals.mT, from_own / length, from_other / length


def _frame(across: Tensor, side: Tensor) -> tuple[Tensor, Tensor]:
    """Return orthonormal columns (..., 3, 3), the first along ``across``, the second near ``side``, and whether so."""
    first = torch.nn.functional.normalize(across, dim=-1)
    rest = side - (side * first).sum(-1, keepdim=True) * first
    good = rest.norm(dim=-1) > _MIN_SINE * side.norm(dim=-1)
    second = torch.nn.functional.normalize(rest, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1), good


def _draw(weights: Tensor, drawn: Tensor) -> Tensor:
    """Return one index (G, C) per row of weights (G, C, N), drawn by weight with numbers (C,) from 0 to 1."""
    cumulated = weights.cumsum(-1)
    # Short of the end even after rounding, so that no row of weight zero is met there.
    goal = cumulated[..., -1:] * drawn[:, None] * (1 - 4 * torch.finfo(weights.dtype).eps)
    index = torch.searchsorted(cumulated, goal, right=True).squeeze(-1)
    return index.clamp_max_(weights.shape[-1] - 1)


def _rows(table: Tensor, index: Tensor) -> Tensor:
    """Return rows ``index`` (G, C) of a table (G, N, 3)."""
    return table.gather(1, index.unsqueeze(-1).expand(*index.shape, table.shape[-1]))


def _refined(matches: _Matches, transforms: Tensor, scores: Tensor) -> tuple[Tensor, Tensor]:
    """Return transforms (G, C, 4, 4) fitted to their inliers where that raised their scores."""
    source, target = matches.source.unsqueeze(1), matches.target.unsqueeze(1)
    for width in _WIDTHS:
        weights, _ = matches.score(transforms, width)
        trial = fit_rigid(source, target, weights)
        trial_scores = matches.score(trial, 1.0)[0].sum(-1)
        # What was never sound stays without a score.
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
        apart = transforms[..., :3, :] - transforms[groups, best][:, None, :3, :]
        square = ((apart @ moments.unsqueeze(1)) * apart).sum((-2, -1))
        alive = alive.masked_fill(square < distance**2, 0.0)
        alive[groups, best] = 0.0
    return torch.stack([item[0] for item in chosen], 1), torch.stack([item[1] for item in chosen], 1)
