"""How a tracker runs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from torchreg._checks import check_choice, check_count, check_direction, check_positive
from torchreg.alignment.config import AlignConfig
from torchreg.geometry.upright import Direction


@dataclass(frozen=True)
class TrackConfig:
    """How a tracker runs. Lengths default to shares of the model's size, so one configuration fits all shapes.

    Args:
        model_points: what the E-step registers: "seen", the sampled points of the shape that data showed in the frame
            before; "data", data near the surface in the frame before, as in the paper; "shape", all sampled points.
        num_model_points: approximate number of model points.
        prediction: "velocity", every degree of freedom goes on at its velocity, or "none", the last pose.
        em_steps: EM iterations per sigma.
        surface_steps: Levenberg-Marquardt steps at each width of the surface fit.
        prior_std: standard deviation of the joints about their prediction, radians; by default twice the running error
            of the prediction, from 0.08 to 0.3.
        inlier_distance: data nearer to the fitted surface are inliers, metres; 2 % of the model's size by default.
        recovery: what a doubtful or lost frame may cost: "full", "starts" (tens of milliseconds, around known poses),
            or "none".
        max_points: most data that a frame is aligned with; more are subsampled.
        sharpness: of the bending skin; the shape's own by default.
        debias: see `AlignConfig`.
        nan_policy: "omit" leaves out data that are not finite; "raise" refuses them.
        upright: of searches without a start, see `AlignConfig`.
        seed: of all random draws.
    """

    model_points: str = "seen"
    num_model_points: int = AlignConfig.num_model_points
    prediction: str = "velocity"
    em_steps: int = 1
    surface_steps: int = 1
    prior_std: float | None = None
    inlier_distance: float | None = None
    recovery: str = "full"
    max_points: int = 1500
    sharpness: float | None = None
    debias: float = AlignConfig.debias
    nan_policy: str = "omit"
    upright: Direction | None = None
    seed: int = AlignConfig.seed

    def __post_init__(self) -> None:
        check_choice(self.model_points, "model_points", ("seen", "data", "shape"))
        check_choice(self.prediction, "prediction", ("velocity", "none"))
        check_choice(self.recovery, "recovery", ("full", "starts", "none"))
        check_choice(self.nan_policy, "nan_policy", ("omit", "raise"))
        for name in ("num_model_points", "em_steps", "surface_steps", "max_points"):
            check_count(getattr(self, name), name, 1)
        for name in ("prior_std", "inlier_distance"):
            if getattr(self, name) is not None:
                check_positive(getattr(self, name), name)
        if self.sharpness is not None:
            check_positive(self.sharpness, "sharpness")
        check_positive(self.debias, "debias", allow_zero=True)
        if self.upright is not None:
            check_direction(self.upright, "upright")

    @classmethod
    def paper(cls, **changes: Any) -> TrackConfig:
        """Return tracking as printed, of which some fields may be changed.

        Model points are the data of the frame before that are within 5 mm of the surface, in the pose there, which is
        also where each frame starts; one EM iteration per sigma, without prior, correction of the kernel's shrinkage or
        recovery. The prior cannot be left out, but is as wide as a turn.

        Args:
            changes: fields by name.

        References: Dewaele et al. 2006, sections 3 and 5.
        """
        printed = cls(
            model_points="data",
            prediction="none",
            surface_steps=5,
            prior_std=math.tau,
            inlier_distance=0.005,
            recovery="none",
            debias=0.0,
        )
        return replace(printed, **changes)
