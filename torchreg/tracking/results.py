"""What tracking a shape through a sequence returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar

from torch import Tensor

from torchreg.alignment.results import AlignResult
from torchreg.result import Result, Status, formerly, stored_as
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.pose_algebra import shifted
from torchreg.shapes.posed_tree import named_pose
from torchreg.shapes.record import build_kept_shape, record_kept_shape
from torchreg.tracking.person_filter import KnownPerson


@dataclass(frozen=True, kw_only=True)
class FrameResult(AlignResult):
    """One frame of a tracked sequence.

    Distances of points out of the shape's reach are infinite; ``sigma``, ``cost``, covariance and residual of a frame
    that was not fitted are NaN, as is everything before the shape was first found. Where a tracker fits coefficients
    too, they are what is known after the frame, and ``shape`` the rig that was followed in it: of these coefficients,
    or of earlier ones that the surface hardly differs from.

    Args:
        covariance: (num_dofs, num_dofs) of the pose in tangent coordinates (base: translation, then a rotation composed
            from the left), from the normal equations and the prior.
        acquired: what led to the pose: "tracked", or where that was in doubt "surface", "starts" or "search"; "found"
            anywhere; "lost" and "held" rest on the frames before alone.
        frame: number of the frame.
        time: of the frame, in the caller's unit.
        inlier_ratio: inliers as a share of the finite data.
        residual: robust standard deviation of the distances near the surface, metres.
    """

    shapes: ClassVar[Mapping[str, str]] = {**AlignResult.shapes, "covariance": "D D"}

    covariance: Tensor
    acquired: str
    frame: int
    time: float
    inlier_ratio: float
    residual: float


@dataclass(frozen=True)
class TrackResult(Result):
    """A tracked sequence of T frames.

    Args:
        poses: (T, num_dofs), metres and radians; NaN before the shape was first found.
        std: (T, num_dofs) standard deviations, see `FrameResult`; NaN where a frame was not fitted.
        keypoints: (T, K, 3), metres.
        inlier_ratios: (T,) inliers as a share of the data.
        residuals: (T,) robust standard deviation of the distances near the surface, metres.
        times: (T,) of the frames.
        seconds: (T,) that each frame took.
        statuses: how each frame ended.
        acquired: what led to each pose, see `FrameResult`.
        origin: see `AlignResult`.
        shape: that was followed, see `AlignResult`; where coefficients were fitted, that of the last frame.
        up: see `AlignResult`.
        coefficients: (C,) of the person tracked, where they were fitted, as known after the last frame.
        coefficient_covariance: (C, C) of them.
    """

    shapes: ClassVar[Mapping[str, str]] = {
        "poses": "T D", "std": "T D", "keypoints": "T K 3", "inlier_ratios": "T", "residuals": "T", "times": "T",
        "seconds": "T", "statuses": "T", "acquired": "T", "coefficients": "C", "coefficient_covariance": "C C",
    }  # fmt: skip

    poses: Tensor
    std: Tensor
    keypoints: Tensor
    inlier_ratios: Tensor
    residuals: Tensor
    times: Tensor
    seconds: Tensor
    statuses: tuple[Status, ...]
    acquired: tuple[str, ...]
    origin: Tensor | None = None
    shape: ArticulatedShape | None = field(default=None, metadata=stored_as(record_kept_shape, build_kept_shape))
    up: tuple[float, float, float] | None = None
    coefficients: Tensor | None = None
    coefficient_covariance: Tensor | None = None

    @property
    def named_poses(self) -> dict[str, Tensor]:
        """The poses by name of degree of freedom, (T,) each, metres and radians."""
        return named_pose(self.shape, self.poses)

    def moved(self, origin: Tensor) -> TrackResult:
        """Return the result, whose coordinates begin at an origin (3,), in those in which the origin is given."""
        poses, keypoints = shifted(self.poses.double(), origin), self.keypoints.double() + origin
        return replace(self, poses=poses, keypoints=keypoints, origin=origin)


@dataclass(frozen=True)
class TrackState(Result):
    """All that the next frame of a tracker depends on. Means and largest values are running ones over half a second.

    Args:
        frame: number of frames so far.
        time: of the last one.
        interval: shortest time between two frames so far; zero before the second.
        pose: (num_dofs,) of the last frame, fitted or predicted; NaN before the shape was first found.
        velocity: (num_dofs,) tangent, per unit of time.
        points: (N, 3) model points for the next frame, metres.
        weights: (N, P) their skinning weights.
        reference_pose: (num_dofs,) the pose that the points are given in.
        keyframes: (K, num_dofs) poses of the last few of every tenth frame, from which a lost shape is searched.
        unexplained: (S, 3) clusters of data off the surface, in the frame of the first part, metres.
        prediction_error: largest distance of most model points from their prediction, metres.
        innovation: (3,) largest deviations of the pose from its prediction: base position, metres, base rotation and
            joints, radians.
        num_data: mean number of data.
        num_inliers: mean number of inliers; zero before the first fit.
        ratio_in_reach: mean inlier ratio of the data in reach of the shape.
        residual: mean residual, see `FrameResult`, metres.
        limit_share: mean share of the joints at a limit.
        lost: frames since the last fit.
        cool_down: frames before the next search.
        failed_searches: searches in a row after which the fit was still doubtful.
        pending_checks: how often a pose found by a search everywhere is still to be compared with another search.
        seed: of all random draws.
        origin: (3,) float64 about which all this is, where clouds lie far from that of coordinates; None elsewhere.
        coefficients: (C,) of the person tracked, where they are fitted and a frame showed any.
        person_covariance: (D + C, D + C) of pose and coefficients, in tangent coordinates, by the noise of the frames;
            (C, C) of coefficients alone before the first fit that was usable and after one that was not.
        person_sensitivity: (D + C, P) or (C, P) how they move by errors of the model's parts, which frames share.
        person: (C,) coefficients of the rig that is followed; another one is made when its surface is off.
        sure: whether the fit to any frame was usable.
        searched: (F, 3) some data of the last frame that was searched, before the shape was first found; then None.
    """

    shapes: ClassVar[Mapping[str, str]] = {
        "pose": "D", "velocity": "D", "points": "N 3", "weights": "N P", "reference_pose": "D", "keyframes": "K D",
        "unexplained": "S 3", "innovation": "3", "coefficients": "C", "person": "C", "person_covariance": "J J",
        "person_sensitivity": "J Q", "searched": "F 3",
    }  # fmt: skip

    frame: int
    time: float
    interval: float
    pose: Tensor
    velocity: Tensor
    points: Tensor
    weights: Tensor
    reference_pose: Tensor
    keyframes: Tensor = field(metadata=formerly("previous"))
    unexplained: Tensor = field(metadata=formerly("strays"))
    prediction_error: float = field(metadata=formerly("error"))
    innovation: Tensor = field(metadata=formerly("surprise"))
    num_data: float = field(metadata=formerly("total"))
    num_inliers: float = field(metadata=formerly("inliers"))
    ratio_in_reach: float = field(metadata=formerly("ratio"))
    residual: float
    limit_share: float = field(metadata=formerly("held"))
    lost: int
    cool_down: int = field(metadata=formerly("rest"))
    failed_searches: int = field(metadata=formerly("fails"))
    pending_checks: int = field(metadata=formerly("unsure"))
    seed: int
    origin: Tensor | None = None
    coefficients: Tensor | None = None
    person_covariance: Tensor | None = None
    person_sensitivity: Tensor | None = None
    person: Tensor | None = None
    sure: bool = True
    searched: Tensor | None = None

    @property
    def found(self) -> bool:
        """Whether there is a pose."""
        return bool(self.pose.isfinite().all())

    @property
    def known_person(self) -> KnownPerson | None:
        """What is known of coefficients, and of the last pose with them after a usable frame."""
        if self.coefficients is None or self.person_covariance is None or self.person_sensitivity is None:
            return None
        return KnownPerson(self.coefficients, self.person_covariance, self.person_sensitivity)

    @property
    def known_coefficients(self) -> KnownPerson | None:
        """What is known of coefficients, whatever the pose."""
        known = self.known_person
        return None if known is None else known.alone

    @property
    def tracked(self) -> bool:
        """Whether a frame was ever fitted."""
        return self.num_inliers > 0


@dataclass(frozen=True)
class DemoResult(Result):
    """A hand tracked through a made-up sequence, and the truth; T frames were done.

    Args:
        track: what the tracker found.
        truths: (T, num_dofs) the poses behind the clouds.
        clouds: T clouds (M_t, 3), metres.
        inliers: T masks (M_t,), True where a datum is near the tracked surface.
        tip_errors: (T, 5) distance of each fingertip, thumb to little finger, from its true place, metres.
        tips_seen: (T, 5) True where the cameras saw enough of the fingertip to measure it.
        seed: of motion and measurements.
    """

    shapes: ClassVar[Mapping[str, str]] = {
        "truths": "T D",
        "clouds": "T",
        "inliers": "T",
        "tip_errors": "T 5",
        "tips_seen": "T 5",
    }

    track: TrackResult
    truths: Tensor
    clouds: tuple[Tensor, ...]
    inliers: tuple[Tensor, ...]
    tip_errors: Tensor
    tips_seen: Tensor
    seed: int
