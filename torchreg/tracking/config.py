"""How a tracker runs, and what it knows of a frame before and after the frame is fitted."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_choice, check_count, check_positive
from torchreg.alignment.problem import AlignProblem, shifted
from torchreg.shapes.skin import stacked_rows

MODEL_POINTS = ("seen", "data", "shape")


@dataclass(frozen=True)
class TrackConfig:
    """How a tracker runs. Lengths default to shares of the model's size, so one configuration fits all shapes.

    Args:
        model_points: what the E-step registers: "seen", the shape's own sampled points that data showed in the frame
            before; "data", data near the surface in the frame before, as in the paper; "shape", all sampled points.
        num_model_points: of them, about.
        prediction: "velocity", every degree of freedom goes on as it went, or "none".
        em_steps: EM iterations per sigma.
        surface_steps: Levenberg-Marquardt steps at each width of the surface fit.
        prior_std: standard deviation of the joints about their prediction, radians; by default twice the running error
            of the prediction, from 0.08 to 0.3.
        inlier_distance: data nearer to the fitted surface are inliers, metres; 2 % of the model's size by default.
        recovery: what a doubtful or lost frame may cost: "full", "starts" (tens of milliseconds, around poses known),
            or "none".
        max_points: data near the shape that a frame is aligned with; drawn from more.
        sharpness: of the bending skin.
        debias: see `AlignConfig`.
        nan_policy: "omit" leaves out data that are not finite; "raise" refuses them.
        seed: of all that is drawn.
    """

    model_points: str = "seen"
    num_model_points: int = 500
    prediction: str = "velocity"
    em_steps: int = 1
    surface_steps: int = 1
    prior_std: float | None = None
    inlier_distance: float | None = None
    recovery: str = "full"
    max_points: int = 1500
    sharpness: float = 2.0
    debias: float = 0.8
    nan_policy: str = "omit"
    seed: int = 0

    def __post_init__(self) -> None:
        check_choice(self.model_points, "model_points", MODEL_POINTS)
        check_choice(self.prediction, "prediction", ("velocity", "none"))
        check_choice(self.recovery, "recovery", ("full", "starts", "none"))
        check_choice(self.nan_policy, "nan_policy", ("omit", "raise"))
        for name in ("num_model_points", "em_steps", "surface_steps", "max_points"):
            check_count(getattr(self, name), name, 1)
        for name in ("prior_std", "inlier_distance"):
            if getattr(self, name) is not None:
                check_positive(getattr(self, name), name)
        check_positive(self.sharpness, "sharpness")
        check_positive(self.debias, "debias", allow_zero=True)


@dataclass(frozen=True)
class Frame:
    """What is known of a frame before it is aligned.

    Args:
        cloud: (M, 3), metres.
        finite: (M,) which points are finite.
        gap: intervals since the frame before.
    """

    cloud: Tensor
    finite: Tensor
    gap: float

    @property
    def data(self) -> Tensor:
        """The finite points (F, 3)."""
        return self.cloud[self.finite]


@dataclass(frozen=True)
class FrameView:
    """A frame seen from a pose: the alignment of the data in reach, in coordinates around the pose's base.

    Args:
        problem: one alignment; its prior's mean is the pose.
        origin: (3,) of its coordinates.
        rows: (4 P, 3) the prior's mean as skins place their points with, see `LinearBlendSkin.place`.
        near: (M,) which points of the cloud are in reach; the problem may hold a part of them.
    """

    problem: AlignProblem
    origin: Tensor
    rows: Tensor
    near: Tensor

    def local(self, poses: Tensor) -> Tensor:
        """Return poses (S, num_dofs) of the world within the limits, as (1, S, num_dofs) in these coordinates."""
        return self.problem.clamp(shifted(poses, -self.origin)).unsqueeze(0)


@dataclass(frozen=True)
class FrameFit:
    """A pose fitted to a frame, in the coordinates of its view, and the evidence for it.

    Args:
        view: of the frame.
        pose: (1, num_dofs).
        distance: (1, M) of the data.
        jacobian: (1, M, num_dofs) of the distances.
        transforms: (P, 4, 4) of the parts.
        noise: () standard deviation of the data near the surface, metres.
        change: of the last step.
        cost: that ranks fits to a frame.
        inliers: how many data lie near the surface.
        strays: (K, 3) data that lie off it as densely as others on it.
        novel: how many of them lie within reach of a limb, and elsewhere on the shape than in the frame before.
        held: share of the joints that lie at a limit.
        jump: how far from the prediction most model points are, metres.
        how: what led to it.
    """

    view: FrameView
    pose: Tensor
    distance: Tensor
    jacobian: Tensor
    transforms: Tensor
    noise: Tensor
    change: float
    cost: float
    inliers: int
    strays: Tensor
    novel: int
    held: float
    jump: float
    how: str

    @property
    def ratio(self) -> float:
        """Inliers as a share of the data in reach."""
        return self.inliers / max(1, self.distance.shape[-1])

    @property
    def explained(self) -> float:
        """How many data in reach lie on the surface, softly counted, less the prior's cost."""
        return (1 - self.cost / max(1, self.distance.shape[-1])) * int(self.view.near.sum())

    @property
    def rows(self) -> Tensor:
        """The transforms (4 P, 3) as skins place their points with, see `LinearBlendSkin.place`."""
        return stacked_rows(self.transforms)

    @property
    def world(self) -> Tensor:
        """The pose (num_dofs,) in the coordinates of the cloud."""
        return shifted(self.pose[0], self.view.origin)


def thinned(data: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return at most ``count`` of the data (M, 3), drawn at random."""
    return data if len(data) <= count else data[torch.randperm(len(data), generator=generator)[:count].to(data.device)]
