"""Settings of scan registration: of the dense alignment and of the bones fitted to it, or of the printed algorithm."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

from torchreg.registration.bones.config import BoneConfig
from torchreg.registration.bones.weights import WeightsConfig
from torchreg.registration.dense.config import ScanAlignConfig
from torchreg.registration.paper.config import PaperConfig


@dataclass(frozen=True)
class RegisterConfig(BoneConfig):
    """Settings by which a reduced deformable model is fitted to two scans or more.

    Args:
        align: the dense alignment from which parts are found; all others as in `BoneConfig`.
        printed: of the algorithm as printed, which then replaces the default one, see `paper`; None for the default.

    Raises:
        InputError: if a value is out of range.
    """

    align: ScanAlignConfig = field(default_factory=ScanAlignConfig)
    printed: PaperConfig | None = None

    @classmethod
    def paper(cls, **changes: Any) -> RegisterConfig:
        """Return the printed algorithm with the printed constants, of which some fields may be changed.

        A random segmentation by best-candidate seeds instead of parts that move as one; spin images (a bin is as wide
        as a grid cell) and a rigid motion by RANSAC per region instead of the dense alignment; the integral of eq. 4
        from stiff joints to loose ones (1 to 0.05 in five rounds), angles between normals from 80 to 20 degrees,
        correspondences up to 20 sampling distances long; unused labels for random halves of the worst regions; and
        continuous weights last, unless ``refine_steps`` is zero. Of `BoneConfig` it also uses ``num_samples``,
        ``motion_steps``, ``smoothness``, ``joint_weight``, ``max_angle``, ``normal_scale``, ``min_matched``
        and ``refine``.

        Read into the text: the distance is a sum over correspondences and every cell has a joint term of its own, as
        "specify the joint constraint separately for each cell" says; mu is 0.5 in squared cells.

        Args:
            changes: fields by name.

        References: Chang and Zwicker 2009, section 5; table 1 for the numbers of bones, samples and cells.
        """
        config = cls(
            num_samples=1000,
            smoothness=0.5,
            joint_weight=(1.0, 0.05),
            max_angle=(math.radians(80), math.radians(20)),
            refine=WeightsConfig(smoothness=0.5, normalization=1.0, closeness=0.2),
            printed=PaperConfig(),
        )
        return replace(config, **changes)
