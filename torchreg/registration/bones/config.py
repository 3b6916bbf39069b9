"""What decides how scans are registered. Lengths are shares of the source's diagonal, unless said otherwise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from torchreg._checks import check_choice, check_count, check_positive
from torchreg.errors import InputError
from torchreg.registration.annealing import check_ends, geometric_at
from torchreg.registration.bones.distance_loss import check_share
from torchreg.registration.bones.grid_lbs import BLENDS
from torchreg.registration.bones.weights import RefineConfig
from torchreg.registration.results import RegisterRecord

OnRegisterStep = Callable[[RegisterRecord], None]


def _refinement() -> RefineConfig:
    """Return the refinement of weights: where limbs bend, the surface stretches over several cells."""
    return RefineConfig(smoothness=0.05, closeness=0.02, reach=4)


@dataclass(frozen=True)
class BoneConfig:
    """How bones, labels and weights are fitted to where points of a source go in one scan or more.

    Args:
        num_samples: source points that are matched, evenly spread.
        num_patches: of the grid, from which parts are merged.
        label_steps: most rounds of T-steps, correspondences and W-step.
        match_steps: T-steps, each followed by new correspondences, before a W-step.
        refine_steps: rounds of refining weights, T-step and correspondences.
        settle_steps: rounds of T-step and correspondences after it.
        motion_steps: most linear systems of a T-step.
        smoothness: mu of the W-step: of neighboring cells with different labels, in squared cells.
        seam: what it costs there that these labels take the side between the cells apart, per cell,
        seam_cap: up to this many cells: parts meet in joints, but what merely touches must be able to part.
        label_cost: of each label in use: its square is what it must take from the mean squared distance. ``num_bones``
            is a cap. Many small bones miss fewer joints; see `ScanRegistration.parts` for what moved as one.
        truncation: samples are never farther off in the W-step, in cells.
        reuse: give labels that lost all their cells to the regions that fit worst.
        joint_weight: beta, of the joints against the mean squared distance, in the first and the last round of labels
            and after it, in even ratios between; (1, 0.05) in the paper. It holds bones together where matches do not;
            the dense alignment does so already, and joints that are no points, or wrong, resist more of it. Zeros leave
            it out, and what turns cost.
        joint_scale: bones whose motions take their joint apart by more than this hold each other ever less: not all
            that meets is joined. First and last like ``joint_weight``: labels are coarse first, and tear joints.
        turn_weight: what it costs that bones that meet turn against each other, per squared radian: what scans do not
            tell, such as the twist of a round limb, stays as it was.
        turn_scale: bones that turned against each other by more than this many radians hold each other ever less.
        hinge_weight: what it costs, where three frames or more tell the axis, that bones that meet turn against each
            other about another axis than they mostly do, per squared radian: most joints are hinges.
        hinge_scale: bones that turn about other axes by more than this many radians hold each other ever less.
        max_distance: of a match, first and last; never below two sampling distances of the target.
        max_angle: between normals of a match, first and last, radians.
        normal_scale: distance that counts as much as normals 60 degrees apart.
        point_to_point: share of the distance to where the dense alignment takes a sample, in that along the normal.
        unmatched: how much samples without a match count, which stay with the dense alignment.
        min_matched: with a smaller share of matches the scans count as not registered.
        rtol: steps end when a round lowers the energy by less than this share.
        refine: the weights' refinement; its point-to-point share is this one's.
        blend: of the bones, see `GridLBS`. Weights are refined as if it were linear.

    Raises:
        InputError: if a value is out of range.

    References: Chang and Zwicker 2009, section 5, for the paper's values.
    """

    num_samples: int = 4000
    num_patches: int = 100
    label_steps: int = 4
    match_steps: int = 1
    refine_steps: int = 1
    settle_steps: int = 2
    motion_steps: int = 5
    smoothness: float = 0.01
    seam: float = 0.2
    seam_cap: float = 0.5
    label_cost: float = 0.0003
    truncation: float = 4.0
    reuse: bool = True
    joint_weight: tuple[float, float] = (0.01, 0.001)
    joint_scale: tuple[float, float] = (0.01, 0.005)
    turn_weight: float = 6e-7
    turn_scale: float = 0.1
    hinge_weight: float = 1e-5
    hinge_scale: float = 0.2
    max_distance: tuple[float, float] = (0.03, 0.01)
    max_angle: tuple[float, float] = (1.05, 0.52)
    normal_scale: float = 0.025
    point_to_point: float = 0.003
    unmatched: float = 0.3
    min_matched: float = 0.1
    rtol: float = 0.2
    refine: RefineConfig = field(default_factory=_refinement)
    blend: str = "linear"

    def __post_init__(self) -> None:
        for name in ("num_samples", "num_patches", "label_steps", "match_steps", "motion_steps"):
            check_count(getattr(self, name), name, 1)
        for name in ("refine_steps", "settle_steps"):
            check_count(getattr(self, name), name, 0)
        for name in ("truncation", "unmatched", "seam_cap", "turn_scale", "hinge_scale"):
            check_positive(getattr(self, name), name)
        for name in ("smoothness", "seam", "label_cost", "turn_weight", "hinge_weight", "normal_scale", "rtol"):
            check_positive(getattr(self, name), name, allow_zero=True)
        for name in ("point_to_point", "min_matched"):
            check_share(getattr(self, name), name)
        if self.point_to_point == 0:
            raise InputError("point_to_point must be positive: along flat parts nothing else holds samples")
        for name in ("joint_scale", "max_distance", "max_angle"):
            check_ends(getattr(self, name), name)
        check_ends(self.joint_weight, "joint_weight", allow_zero=True)
        if min(self.joint_weight) == 0 < max(self.joint_weight):
            raise InputError(f"joint_weight must be positive first and last, or zero, got {self.joint_weight}")
        if max(self.max_angle) > 3.1416:
            raise InputError(f"max_angle must be at most pi radians, got {max(self.max_angle)}")
        check_choice(self.blend, "blend", BLENDS)

    def joint_weight_at(self, progress: float) -> float:
        """Return beta a share of the way through the rounds of labels."""
        return geometric_at(self.joint_weight, progress) if self.joint_weight[0] > 0 else 0.0
