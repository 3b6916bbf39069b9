"""The printed constants that the default registration has no use for."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchreg._checks import check_choice, check_count, check_positive


@dataclass(frozen=True)
class PaperConfig:
    """Settings of the printed algorithm that `BoneConfig` does not hold already.

    Args:
        max_distance: largest distance of a correspondence, in sampling distances of the source; 20 to 40 in table 1.
        first_matches: "spin_images", cleaned per region, or "closest" points, for scans that are near to begin with, as
            of the paper's hand.
        annealing_rounds: rounds over which stiffness of joints and largest angle fall from their first to their last
            values.
        max_rounds: most rounds of T-step and W-step; the paper's stopping criteria are not printed.
        rtol: relative change of the energy over a round below which rounds end, once the annealing is over.
        image_size: rows and columns of a spin image, whose bins are as wide as grid cells.
        support_angle: of the spin images, radians.
        ransac_threshold: distance of an inlier of a region's rigid motion, in grid cells; the paper gives none.
        ransac_trials: samples per region.
        reuse_error: distance below which a region is not split for unused labels, in sampling distances.

    References: Chang and Zwicker 2009, sections 4.2, 4.3 and 5, table 1.
    """

    max_distance: float = 20.0
    first_matches: str = "spin_images"
    annealing_rounds: int = 5
    max_rounds: int = 15
    rtol: float = 0.02
    image_size: int = 15
    support_angle: float = math.pi / 2
    ransac_threshold: float = 1.0
    ransac_trials: int = 500
    reuse_error: float = 0.1

    def __post_init__(self) -> None:
        check_choice(self.first_matches, "first_matches", ("spin_images", "closest"))
        for name in ("annealing_rounds", "max_rounds", "image_size", "ransac_trials"):
            check_count(getattr(self, name), name, 1)
        for name in ("max_distance", "support_angle", "ransac_threshold"):
            check_positive(getattr(self, name), name)
        for name in ("rtol", "reuse_error"):
            check_positive(getattr(self, name), name, allow_zero=True)
