"""Matches of descriptors: the most similar ones, kept if they are mutual, clear of the next best, and near enough."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_choice, check_count, check_points, check_positive
from torchreg.errors import InputError
from torchreg.registration.dense.spin_images import SIMILARITIES, image_similarity

# Similarities held at a time.
_CHUNK_ENTRIES = 4_000_000


@dataclass(frozen=True)
class DescriptorMatches:
    """The best candidates of every source descriptor.

    Args:
        index: (Q, k) int64 targets, best first, -1 where there is none.
        score: (Q, k) their similarities, minus infinity where there is none.
    """

    index: Tensor
    score: Tensor

    @property
    def valid(self) -> Tensor:
        """Which candidates exist, (Q, k) bool."""
        return self.index >= 0

    def pairs(self) -> tuple[Tensor, Tensor]:
        """Return all candidates as pairs: indices (L,) of sources and (L,) of targets, in the order of the sources."""
        source, column = self.valid.nonzero(as_tuple=True)
        return source, self.index[source, column]


def match_descriptors(
    source: Tensor,
    target: Tensor,
    *,
    num_candidates: int = 1,
    similarity: str = "correlation",
    mutual: bool = False,
    max_ratio: float | None = None,
    source_points: Tensor | None = None,
    target_points: Tensor | None = None,
    max_distance: float | None = None,
    separation: float = 0.0,
) -> DescriptorMatches:
    """Return for every source descriptor the targets that are most similar.

    Args:
        source: (Q, ...) descriptors, such as `spin_images`.
        target: (K, ...) of the same size, dtype and device.
        num_candidates: k, how many for each.
        similarity: see `image_similarity`.
        mutual: keep a candidate only if the source is, of all sources allowed, the most similar to it too.
        max_ratio: keep candidates only where the dissimilarity of the best one is at most this multiple of that of the
            best other target: ``1 - r``, the distance, or ``exp(-C)``.
        source_points: (Q, 3) places of the descriptors; needed with ``max_distance``.
        target_points: (K, 3); needed with ``max_distance`` or ``separation``.
        max_distance: targets farther away than this are no candidates, in the unit of the points.
        separation: targets nearer than this to the best one are not other ones in the sense of ``max_ratio``.

    Returns:
        `DescriptorMatches`.

    Raises:
        InputError: if a size does not fit, a number is out of range or points are missing.
        InputTypeError: if dtypes or devices differ.

    Differentiable: no.

    Cost: O(Q K) time, bounded memory.

    References: Chang and Zwicker 2009, section 5, on the maximum distance; Lowe 2004 on the ratio.
    """
    source, target = as_float_tensor(source, "source"), as_float_tensor(target, "target")
    check_count(num_candidates, "num_candidates", 1)
    check_choice(similarity, "similarity", SIMILARITIES)
    if max_ratio is not None:
        check_positive(max_ratio, "max_ratio")
    if max_distance is not None:
        check_positive(max_distance, "max_distance")
    check_positive(separation, "separation", allow_zero=True)
    here = _places(source_points, "source_points", len(source), needed=max_distance is not None)
    there = _places(target_points, "target_points", len(target), needed=max_distance is not None or separation > 0)

    def chunks() -> Iterator[Tensor]:
        step = max(1, _CHUNK_ENTRIES // max(1, len(target)))
        for start in range(0, len(source), step):
            scores = image_similarity(source[start : start + step], target, similarity)
            if max_distance is not None and here is not None and there is not None:
                scores = scores.masked_fill(_distances(here[start : start + step], there) > max_distance, -math.inf)
            yield scores

    with torch.no_grad():
        best_of_target = source.new_full((len(target),), -math.inf)
        parts = []
        for scores in chunks():
            score, index = scores.topk(min(num_candidates, len(target)), dim=1)
            if max_ratio is not None:
                clear = _clear(scores, score[:, :1], index[:, :1], similarity, max_ratio, there, separation)
                score = torch.where(clear, score, -math.inf)
            parts.append((index, score))
            if mutual and len(scores):
                best_of_target = torch.maximum(best_of_target, scores.amax(0))
        index, score = (torch.cat(column) for column in zip(*parts, strict=True)) if parts else _none(source)
        keep = score > -math.inf
        if mutual:
            keep &= score >= best_of_target[index]
        index, score = torch.where(keep, index, -1), torch.where(keep, score, -math.inf)
        if mutual:  # the best first again
            order = (index < 0).long().argsort(dim=1, stable=True)
            index, score = index.gather(1, order), score.gather(1, order)
        return DescriptorMatches(index, score)


def _places(points: Tensor | None, name: str, count: int, *, needed: bool) -> Tensor | None:
    if points is None:
        if needed:
            raise InputError(f"{name} must be given with max_distance or separation, got None")
        return None
    points = as_float_tensor(points, name)
    check_points(points, name, min_count=0, batch=False)
    if len(points) != count:
        raise InputError(f"{name} must hold one point per descriptor ({count}), got {len(points)}")
    return points


def _distances(first: Tensor, second: Tensor) -> Tensor:
    return torch.cdist(first, second, compute_mode="donot_use_mm_for_euclid_dist")


def _clear(
    scores: Tensor,
    best: Tensor,
    index: Tensor,
    similarity: str,
    max_ratio: float,
    places: Tensor | None,
    separation: float,
) -> Tensor:
    """Return where (Q, 1) the best score stands out from all targets but those beside the best one."""
    others = scores.scatter(1, index, -math.inf)
    if separation > 0 and places is not None:
        others = others.masked_fill(_distances(places[index[:, 0]], places) < separation, -math.inf)
    dissimilar = {
        "correlation": lambda value: 1 - value,
        "l2": torch.neg,
        "distance": torch.neg,
        "overlap": lambda value: torch.exp(-value),
    }
    return dissimilar[similarity](best) <= max_ratio * dissimilar[similarity](others.amax(1, keepdim=True))


def _none(like: Tensor) -> tuple[Tensor, Tensor]:
    return torch.zeros(0, 1, dtype=torch.int64, device=like.device), like.new_zeros(0, 1)
