"""Errors of results against the truth: distances of points and keypoints, agreement of labelings."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchreg._checks import (
    as_float_tensor,
    as_tensor,
    check_finite,
    check_points,
    check_positive,
    check_same_kind,
    check_shape,
)
from torchreg.errors import InputError, InputTypeError


def endpoint_error(predicted: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean Euclidean distance between points and their true positions.

    ``mean_i |predicted_i - target_i|`` over the points that ``mask`` selects. Values outside the mask are ignored, so
    they may be NaN.

    Args:
        predicted: (..., N, 3) points.
        target: (..., N, 3) their true positions, in the same unit.
        mask: (..., N) bool, True where a point counts; all of them by default.

    Returns:
        Mean distances (...), one per batch entry, in the unit of the points.

    Raises:
        InputError: if shapes differ, values are not finite or a batch entry has no point that counts.
        InputTypeError: if an argument has the wrong type, or the two differ in dtype or device.

    Differentiable:
        In ``predicted`` and ``target``; the gradient is zero where a point meets its target exactly.
    """
    distances, mask = _paired_distances(predicted, target, mask)
    counts = mask.sum(-1)
    if bool((counts == 0).any()):
        raise InputError(
            f"mask leaves no point to average in {int((counts == 0).sum())} of {counts.numel()} batch entries"
        )
    return distances.sum(-1) / counts


def chamfer(a: Tensor, b: Tensor, *, chunk_size: int = 4096) -> Tensor:
    """Return the symmetric Chamfer distance of two clouds: the mean of plain (not squared) closest-point distances.

    ``(mean_i min_j |a_i - b_j| + mean_j min_i |a_i - b_j|) / 2``, which is the offset between two parallel copies of a
    surface.

    Args:
        a: (..., N, 3) points.
        b: (..., M, 3) points in the same unit, with the same batch dimensions.
        chunk_size: number of points of a cloud that are compared with the opposite cloud at once.

    Returns:
        Distances (...), one per batch entry, in the unit of the points.

    Raises:
        InputError: if a cloud is empty or not finite, batch dimensions differ or ``chunk_size`` is not positive.
        InputTypeError: if an argument has the wrong type, or the two differ in dtype or device.

    Differentiable:
        In ``a`` and ``b``, with the closest points held fixed.

    Cost:
        O(N M) time; O(chunk_size max(N, M)) memory per batch entry.
    """
    a, b = _same_kind(a, "a", b, "b")
    check_points(a, "a")
    check_points(b, "b")
    if a.shape[:-2] != b.shape[:-2]:
        raise InputError(f"a and b must have the same batch dimensions, got {tuple(a.shape)} and {tuple(b.shape)}")
    check_positive(chunk_size, "chunk_size")
    step = max(1, int(chunk_size))
    return (_to_closest(a, b, step).mean(-1) + _to_closest(b, a, step).mean(-1)) / 2


def keypoint_error(predicted: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return each keypoint's mean distance from its true position, over all frames in which it counts.

    ``.nanmean()`` of the result is the mean per-keypoint position error (MPJPE if every keypoint always counts).

    Args:
        predicted: (..., K, 3) keypoints; every leading dimension counts as frames.
        target: (..., K, 3) their true positions, in the same unit.
        mask: (..., K) bool, True where a keypoint counts, for example where it is seen; all of them by default.

    Returns:
        Mean distances (K,), in the unit of the keypoints; NaN for a keypoint that never counts.

    Raises:
        InputError: if shapes differ or values that count are not finite.
        InputTypeError: if an argument has the wrong type, or the two differ in dtype or device.

    Differentiable:
        In ``predicted`` and ``target``.
    """
    distances, mask = _paired_distances(predicted, target, mask)
    frames = tuple(range(distances.ndim - 1))
    if not frames:
        return torch.where(mask, distances, torch.nan)
    counts = mask.sum(frames)
    means = distances.sum(frames) / counts.clamp(min=1)
    return torch.where(counts > 0, means, torch.nan)


def pck(predicted: Tensor, target: Tensor, threshold: float, mask: Tensor | None = None) -> Tensor:
    """Return the fraction of correct keypoints (PCK), those within ``threshold`` of the truth.

    Args:
        predicted: (..., K, 3) keypoints.
        target: (..., K, 3) their true positions, in the same unit.
        threshold: largest distance of a correct keypoint, in the unit of the keypoints.
        mask: (..., K) bool, True where a keypoint counts; all of them by default.

    Returns:
        Fractions (...) from 0 to 1, one per batch entry.

    Raises:
        InputError: if shapes differ, values that count are not finite, ``threshold`` is not positive or a batch entry
            has no keypoint that counts.
        InputTypeError: if an argument has the wrong type, or the two differ in dtype or device.

    Differentiable:
        No, it counts.
    """
    check_positive(threshold, "threshold")
    distances, mask = _paired_distances(predicted, target, mask)
    counts = mask.sum(-1)
    if bool((counts == 0).any()):
        raise InputError(
            f"mask leaves no keypoint to count in {int((counts == 0).sum())} of {counts.numel()} batch entries"
        )
    correct = (distances <= threshold) & mask
    return correct.sum(-1).to(distances.dtype) / counts


def adjusted_rand(labels_a: Tensor, labels_b: Tensor) -> float:
    """Return the adjusted Rand index of two labelings: 1 if they are the same up to names, about 0 by chance.

    With n_ij points labeled i by the first and j by the second, row and column sums a_i and b_j, C(n) = n (n - 1) / 2:
    ``(sum_ij C(n_ij) - E) / ((sum_i C(a_i) + sum_j C(b_j)) / 2 - E)``, ``E = sum_i C(a_i) sum_j C(b_j) / C(n)``.

    Args:
        labels_a: (N,) integers.
        labels_b: (N,) integers; the names of the two labelings may differ.

    Returns:
        A number of at most 1, negative if the labelings agree less than by chance. Two labelings agree with 1 if both
        have a single class, or both a class per point.

    Raises:
        InputError: if the labels are empty, not one-dimensional or of different lengths.
        InputTypeError: if the labels are not integers.

    References:
        Hubert and Arabie, Comparing partitions, Journal of Classification 2, 1985.
    """
    first, second = _as_labels(labels_a, "labels_a"), _as_labels(labels_b, "labels_b")
    if first.shape != second.shape:
        raise InputError(f"labels_a and labels_b must have the same length, got {len(first)} and {len(second)}")
    names_a, index_a, counts_a = first.unique(return_inverse=True, return_counts=True)
    names_b, index_b, counts_b = second.to(first.device).unique(return_inverse=True, return_counts=True)
    joint = (index_a * len(names_b) + index_b).unique(return_counts=True)[1]
    if len(joint) == len(names_a) == len(names_b):
        return 1.0  # the same partition; this is also where the formula may be 0 / 0
    together, in_a, in_b, total = (
        _num_pairs(counts) for counts in (joint, counts_a, counts_b, first.new_tensor([len(first)]))
    )
    chance = in_a * in_b / total
    return (together - chance) / ((in_a + in_b) / 2 - chance)


def _same_kind(first: Any, first_name: str, second: Any, second_name: str) -> tuple[Tensor, Tensor]:
    """Return two arguments as floating-point tensors; an array takes dtype and device of the tensor beside it."""
    if isinstance(first, Tensor) and isinstance(second, Tensor):
        first, second = as_float_tensor(first, first_name), as_float_tensor(second, second_name)
        check_same_kind(first, first_name, second, second_name)
        return first, second
    if isinstance(second, Tensor):
        second = as_float_tensor(second, second_name)
        return as_float_tensor(first, first_name, like=second), second
    first = as_float_tensor(first, first_name)
    return first, as_float_tensor(second, second_name, like=first)


def _paired_distances(predicted: Tensor, target: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return checked (..., N) distances, zero where the mask is False, and the (..., N) mask."""
    predicted, target = _same_kind(predicted, "predicted", target, "target")
    check_shape(predicted, "predicted", ("N", 3), batch=True)
    if predicted.shape != target.shape:
        raise InputError(
            f"predicted and target must have the same shape, got {tuple(predicted.shape)} and {tuple(target.shape)}"
        )
    if predicted.shape[-2] == 0:
        raise InputError("predicted must hold at least 1 point, got 0")
    if mask is None:
        mask = predicted.new_ones(predicted.shape[:-1], dtype=torch.bool)
    if not isinstance(mask, Tensor) or mask.dtype != torch.bool:
        kind = f"dtype {mask.dtype}" if isinstance(mask, Tensor) else type(mask).__name__
        raise InputTypeError(f"mask must be a bool tensor, got {kind}; compare with a threshold to make one")
    check_shape(mask, "mask", predicted.shape[:-1])
    mask = mask.to(predicted.device)
    hint = "leave those points out with mask"
    check_finite(predicted[mask], "predicted", hint)
    check_finite(target[mask], "target", hint)
    # Masked before the subtraction: NaN times a zero gradient would still be NaN.
    keep = mask.unsqueeze(-1)
    return torch.linalg.vector_norm(predicted.where(keep, 0) - target.where(keep, 0), dim=-1), mask


def _to_closest(source: Tensor, target: Tensor, step: int) -> Tensor:
    """Return the (..., N) distance from each source point to the closest target point."""
    with torch.no_grad():
        # Exact differences: the matrix product of cdist's default mode loses float32 digits away from the origin.
        closest = [
            torch.cdist(chunk, target, compute_mode="donot_use_mm_for_euclid_dist").argmin(-1)
            for chunk in source.split(step, dim=-2)
        ]
    index = torch.cat(closest, dim=-1).unsqueeze(-1).expand(*source.shape)
    return torch.linalg.vector_norm(source - target.gather(-2, index), dim=-1)


def _as_labels(value: Any, name: str) -> Tensor:
    value = as_tensor(value, name, "integers")
    if value.is_floating_point() or value.is_complex():
        raise InputTypeError(f"{name} must hold integer labels, got dtype {value.dtype}")
    check_shape(value, name, ("N",))
    if not len(value):
        raise InputError(f"{name} must hold at least 1 label, got 0")
    return value


def _num_pairs(counts: Tensor) -> float:
    """Return sum of n (n - 1) / 2, in float64 because products of it exceed int64."""
    counts = counts.to(device="cpu", dtype=torch.float64)
    return float((counts * (counts - 1) / 2).sum())
