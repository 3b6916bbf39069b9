"""How an alignment runs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from torchreg._checks import check_choice, check_count, check_direction, check_positive
from torchreg.alignment.fit.annealed_em import CORRESPONDENCES, SigmaSchedule
from torchreg.geometry.upright import Direction


@dataclass(frozen=True)
class AlignConfig:
    """Settings of an alignment. Lengths default to shares of the model's size, so one configuration fits all shapes.

    Args:
        schedule: sigma over the EM steps; by default geometric from 8 % to 2 % of the model's size in five steps.
        em_steps: EM iterations per sigma, at most.
        m_steps: Levenberg-Marquardt steps per M-step.
        surface_steps: Levenberg-Marquardt steps at each width of the surface fit; 0 leaves the surface fit out.
        search: look for better poses around the start: "always", "never", or "auto": when the descent
            went far from its start or leaves a dense cluster of data unexplained. But for "never", a result in doubt,
            or turned far from its start, is searched for everywhere, unless degrees of freedom are locked or have a
            prior.
        num_candidates: poses that a search starts from.
        search_rounds: rounds of the search's last stage, which places every limb thoroughly.
        inlier_distance: data nearer to the fitted surface are inliers, metres; 2 % of the model's size by default.
        correspondence: rule that matches model points and data: "em", the posterior; for comparison "softassign", one
            to one, or "closest", the closest point as in ICP, trimmed at 1.5 sigma.
        outlier: "limit" for c = 3 sqrt(pi / 2), "volume" for eq. 18 with the working volume, or a positive c itself.
        debias: share of the shrinkage of the model by a wide kernel alone that is taken out of the EM's targets; 0 is
            the paper's EM, which shrinks the model while sigma is wide.
        prior_std: standard deviation of a weak prior that holds joints near the initial pose, radians (of the whole
            rotation of a ball joint; sliding joints: as a share of the model's size); None for no prior.
        num_model_points: points sampled on the shape when none are given.
        sharpness: of the bending skin; the shape's own by default.
        pose_atol: a pose that changes by no more than this is final, radians (metres: as a share of the model's size).
        nan_policy: "raise", or "omit" to leave out non-finite data.
        upright: (3,) direction of the data in which what is upright in the shape (`ArticulatedShape.up`) points, about:
            without a start only turns about it are searched (see `UprightRotations`); None for any rotation.
        seed: of the search.
    """

    schedule: SigmaSchedule | None = None
    em_steps: int = 2
    m_steps: int = 1
    surface_steps: int = 2
    search: str = "auto"
    num_candidates: int = 32
    search_rounds: int = 2
    inlier_distance: float | None = None
    correspondence: str = "em"
    outlier: str | float = "limit"
    debias: float = 0.8
    prior_std: float | None = 0.3
    num_model_points: int = 500
    sharpness: float | None = None
    pose_atol: float = 3e-3
    nan_policy: str = "raise"
    upright: Direction | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        check_choice(self.search, "search", ("auto", "always", "never"))
        check_choice(self.correspondence, "correspondence", tuple(CORRESPONDENCES))
        if isinstance(self.outlier, str):
            check_choice(self.outlier, "outlier", ("limit", "volume"))
        else:
            check_positive(self.outlier, "outlier")
        check_choice(self.nan_policy, "nan_policy", ("raise", "omit"))
        if self.upright is not None:
            check_direction(self.upright, "upright")
        for name in ("em_steps", "m_steps", "num_candidates", "search_rounds", "num_model_points"):
            check_count(getattr(self, name), name, 1)
        check_count(self.surface_steps, "surface_steps", 0)
        if self.sharpness is not None:
            check_positive(self.sharpness, "sharpness")
        check_positive(self.pose_atol, "pose_atol", allow_zero=True)
        check_positive(self.debias, "debias", allow_zero=True)
        for name in ("inlier_distance", "prior_std"):
            if getattr(self, name) is not None:
                check_positive(getattr(self, name), name)

    @classmethod
    def paper(cls, **changes: Any) -> AlignConfig:
        """Return the alignment as printed, of which some fields may be changed.

        One EM iteration per sigma with its M-step solved, no correction of the kernel's shrinkage, no prior and no
        search, then the surface fit; data within 5 mm are inliers, as of a hand. Start from the pose of the frame
        before, as the paper does.

        Args:
            changes: fields by name.

        References: Dewaele et al. 2006, section 3.
        """
        printed = cls(
            em_steps=1, m_steps=10, surface_steps=5, search="never", inlier_distance=0.005, debias=0.0, prior_std=None
        )
        return replace(printed, **changes)
