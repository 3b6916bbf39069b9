"""First correspondences of the printed algorithm: spin images, cleaned by a rigid motion per region."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.range_scan import RangeScan
from torchreg.registration.paper.config import PaperConfig
from torchreg.registration.paper.spin_images import image_similarity, spin_images
from torchreg.solvers.ransac import ransac_rigid

# Points that spin images count are this share of a bin apart, so that both scans are sampled alike.
_SCENE_SPACING = 0.5


@dataclass(frozen=True)
class RegionMatches:
    """Correspondences of n source points, and the rigid motion of each region."""

    targets: Tensor  # (n, 3)
    normals: Tensor  # (n, 3) unit normals there
    kept: Tensor  # (n,) True for inliers of the motion of their region
    candidates: Tensor  # (n,) True for points that found any target within reach
    motions: Tensor  # (B, 4, 4); the identity where a region has too few inliers


def spin_matches(
    source: RangeScan,
    index: Tensor,
    target: RangeScan,
    regions: Tensor,
    num_regions: int,
    config: PaperConfig,
    *,
    bin_size: float,
    generator: torch.Generator,
) -> RegionMatches:
    """Return the target whose spin image is most alike for source points, where their region moves rigidly with it.

    References: Chang and Zwicker 2009, section 4.3; Johnson 1997 for the similarity; Fischler and Bolles 1981.
    """
    found, reached = _most_alike(source, index, target, config, bin_size)
    targets, normals = target.points[found], target.normals[found]
    own = [((regions == number) & reached).nonzero()[:, 0] for number in range(num_regions)]
    # One row more keeps a region without any match from being an empty group.
    rows = torch.nn.utils.rnn.pad_sequence([*own, torch.zeros(1, dtype=torch.int64)], True, padding_value=-1)[:-1]
    mask, rows = rows >= 0, rows.clamp(min=0)
    result = ransac_rigid(
        source.points[index][rows],
        targets[rows],
        threshold=config.ransac_threshold * bin_size,
        mask=mask,
        num_trials=config.ransac_trials,
        num_hypotheses=1,
        generator=generator,
    )
    kept = torch.zeros_like(reached)
    kept[rows[result.inliers[:, 0] & mask]] = True
    return RegionMatches(targets, normals, kept, reached, result.transforms[:, 0])


def _most_alike(
    source: RangeScan, index: Tensor, target: RangeScan, config: PaperConfig, bin_size: float
) -> tuple[Tensor, Tensor]:
    """Return the target point (n,) most alike within reach, and whether there is one (n,)."""
    spacing = _SCENE_SPACING * bin_size
    scenes = [scan.uniform_subsample(spacing=spacing) for scan in (source, target)]
    candidates = scenes[1][~target.boundary[scenes[1]]]
    images = [
        spin_images(
            scan.points[which],
            scan.normals[which],
            scan.points[scene],
            scan.normals[scene],
            bin_size=bin_size,
            image_size=config.image_size,
            support_angle=config.support_angle,
        )
        for scan, which, scene in zip((source, target), (index, candidates), scenes, strict=True)
    ]
    similarity = image_similarity(images[0], images[1], "overlap")
    far = torch.cdist(source.points[index], target.points[candidates]) > config.max_distance * source.spacing
    best = similarity.masked_fill(far, -torch.inf).max(1)
    return candidates[best.indices], best.values > -torch.inf
