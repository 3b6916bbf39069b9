"""Parts that a motion can tell apart: those that moved rigidly together share a label."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg._checks import check_positive
from torchreg.datasets.scan_sequences import ScanPair, ScanSequence
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import invert_rigid, transform_points
from torchreg.solvers.rigid_groups import merge_alike


def moving_labels(pair: ScanPair, tolerance: float = 0.01) -> Tensor:
    """Return labels (N,) of a pair's source in which parts that moved rigidly together share a label.

    Of adjacent parts those with the most similar motions are merged first, and move as the part with more scanned
    points afterwards, as long as the mean distance between the points moved by either motion is at most ``tolerance``.
    `ScanRegistration.parts` merges bones alike.

    Args:
        pair: two scans with the truth.
        tolerance: share of the source's diagonal.
    """
    return _merged(pair.source, pair.labels, pair.joint_parts, pair.transforms.unsqueeze(0), tolerance)


def moving_labels_over_time(sequence: ScanSequence, frame: int, tolerance: float = 0.01) -> Tensor:
    """Return labels (N,) of a frame's points in which parts that move rigidly together in all frames share a label."""
    motions = (sequence.transforms @ invert_rigid(sequence.transforms[frame])).to(sequence.dtype)
    return _merged(sequence[frame], sequence.labels(frame), sequence.joint_parts, motions, tolerance)


def _merged(scan: RangeScan, labels: Tensor, joint_parts: Tensor, transforms: Tensor, tolerance: float) -> Tensor:
    """Return labels (N,) in which parts that move rigidly together in all motions (T, P, 4, 4) share a label."""
    check_positive(tolerance, "tolerance", allow_zero=True)
    counts = torch.bincount(labels, minlength=transforms.shape[1])
    apart = torch.zeros(len(transforms), len(counts), len(counts), dtype=scan.points.dtype, device=labels.device)
    for part in counts.nonzero()[:, 0]:
        points = scan.points[labels == part]
        relative = invert_rigid(transforms[:, part]).unsqueeze(1) @ transforms
        apart[:, :, part] = (transform_points(relative, points) - points).norm(dim=-1).sum(-1) / scan.diagonal
    meet = torch.zeros(len(counts), len(counts), dtype=torch.bool, device=labels.device)
    meet[joint_parts[:, 0], joint_parts[:, 1]] = meet[joint_parts[:, 1], joint_parts[:, 0]] = True
    for hidden in (counts == 0).nonzero()[:, 0]:
        # The neighbors of a part that is not seen count as adjacent.
        meet |= meet[hidden].unsqueeze(1) & meet[hidden]
    return merge_alike(apart, counts, meet, tolerance)[labels]
