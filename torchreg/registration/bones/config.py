"""Settings of the bones fitted to scans. Lengths are shares of the source's diagonal, unless said otherwise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from torchreg._checks import check_choice, check_count, check_positive
from torchreg.errors import InputError
from torchreg.registration.annealing import check_ends, geometric_at
from torchreg.registration.blend import BLENDS
from torchreg.registration.bones.correspondences import check_share
from torchreg.registration.bones.weights import WeightsConfig
from torchreg.registration.results import RegisterRecord

OnRegisterStep = Callable[[RegisterRecord], None]


def _refinement() -> WeightsConfig:
    """Return the refinement of weights: where limbs bend, the surface stretches over several cells."""
    return WeightsConfig(smoothness=0.05, closeness=0.02, reach=4)


@dataclass(frozen=True)
class BoneConfig:
    """Settings by which bones, labels and weights are fitted to an alignment of a source with one scan or more.

    Pairs of numbers are a first and a last value, between which a setting runs in even ratios. The paper's values:
    Chang and Zwicker 2009, section 5.

    Args:
        num_samples: source points that are matched, evenly spread.
        label_steps: most rounds of T-steps, correspondences and W-step.
        match_steps: T-steps, each followed by new correspondences, before a W-step.
        refine_steps: rounds of refining weights, T-step and correspondences.
        motion_steps: most linear systems of a T-step.
        smoothness: mu of the W-step, the cost of neighboring cells with different labels, in squared cells.
        seam: cost of neighboring cells with different labels per cell of the gap that these tear open between them, of
            one cell at most, so that what merely touches can part.
        label_cost: root of the mean squared distance that a label must save to be used; ``num_bones`` is a cap, and
            `ScanRegistration.parts` joins bones that moved as one.
        joint_weight: beta, the weight of the joints against the mean squared distance, over the rounds of labels; zeros
            leave out joints and the costs of turns. The paper's (1, 0.05) hold bones together where matches do not,
            which the dense alignment does here, so that wrong joints need not resist.
        turn_weight: cost per squared radian by which bones that share weight turn against each other, so that the twist
            of a round limb, which scans do not observe, stays as it was.
        turn_scale: robust scale of those turns, radians.
        hinge_weight: cost per squared radian of turns about other axes than the one about which two bones mostly turn,
            where three frames or more determine it, since most joints are hinges.
        max_distance: largest distance of a match, never below two sampling distances of the target; and the robust
            scale of the gaps that motions tear open at joints, since not all that meets is joined.
        max_angle: largest angle between the normals of a match, radians.
        normal_scale: distance that counts as much as normals 60 degrees apart.
        point_to_point: weight of the distance to where the dense alignment moves a sample, against that along the
            normal.
        min_matched: share of samples with a match below which the scans count as not registered.
        rtol: relative change of the energy over a round below which rounds end.
        refine: refinement of the weights.
        blend: of the bones, see `GridLBS`; weights are refined as if it were linear.
    """

    num_samples: int = 4000
    label_steps: int = 4
    match_steps: int = 1
    refine_steps: int = 1
    motion_steps: int = 5
    smoothness: float = 0.01
    seam: float = 0.1
    label_cost: float = 0.0003
    joint_weight: tuple[float, float] = (0.01, 0.001)
    turn_weight: float = 6e-7
    turn_scale: float = 0.1
    hinge_weight: float = 1e-5
    max_distance: tuple[float, float] = (0.03, 0.01)
    max_angle: tuple[float, float] = (1.05, 0.52)
    normal_scale: float = 0.025
    point_to_point: float = 0.003
    min_matched: float = 0.1
    rtol: float = 0.2
    refine: WeightsConfig = field(default_factory=_refinement)
    blend: str = "linear"

    def __post_init__(self) -> None:
        for name in ("num_samples", "label_steps", "match_steps", "motion_steps"):
            check_count(getattr(self, name), name, 1)
        check_count(self.refine_steps, "refine_steps", 0)
        for name in ("turn_scale",):
            check_positive(getattr(self, name), name)
        for name in ("smoothness", "seam", "label_cost", "turn_weight", "hinge_weight", "normal_scale", "rtol"):
            check_positive(getattr(self, name), name, allow_zero=True)
        for name in ("point_to_point", "min_matched"):
            check_share(getattr(self, name), name)
        if self.point_to_point == 0:
            raise InputError("point_to_point must be positive: along flat parts nothing else holds samples")
        for name in ("max_distance", "max_angle"):
            check_ends(getattr(self, name), name)
        check_ends(self.joint_weight, "joint_weight", allow_zero=True)
        if min(self.joint_weight) == 0 < max(self.joint_weight):
            raise InputError(f"joint_weight must be positive first and last, or zero, got {self.joint_weight}")
        if max(self.max_angle) > 3.1416:
            raise InputError(f"max_angle must be at most pi radians, got {max(self.max_angle)}")
        check_choice(self.blend, "blend", tuple(BLENDS))

    def joint_weight_at(self, progress: float) -> float:
        """Return beta at a progress from 0 to 1 through the rounds of labels, and its last value after."""
        return geometric_at(self.joint_weight, progress) if self.joint_weight[0] > 0 else 0.0
