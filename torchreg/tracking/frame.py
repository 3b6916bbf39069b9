"""A frame as it comes, around a pose, and with a pose fitted to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchreg.alignment.fit.annealed_em import ANNEALING
from torchreg.alignment.fit.landmarks import MeasuredKeypoints
from torchreg.alignment.fit.problem import AlignProblem
from torchreg.alignment.fit.surface_fit import SURFACE_FIT
from torchreg.alignment.inputs import UNITS
from torchreg.alignment.known_dofs import KnownDofs
from torchreg.capture.depth_frame import DepthFrame
from torchreg.shapes.pose_algebra import shifted
from torchreg.shapes.skin import stacked_rows
from torchreg.tracking.person_filter import OrientedScan, PersonFit
from torchreg.tracking.results import TrackState

# Fewer data, or fewer inliers, determine no pose.
MIN_DATA = UNITS.min_data


@dataclass(frozen=True)
class KernelWidths:
    """Kernel widths of the fits of a frame, as shares of the model's size."""

    min_start: float = 0.03  # first sigma of the EM where predictions are good: about their error
    max_start: float = ANNEALING.start  # where they are poor: wider, neighboring limbs would share their data
    stop: float = ANNEALING.stop  # last sigma of the EM and of the scores of candidates: near the noise of the data
    coarse: float = 0.06  # first surface fit from poses that may be far off
    surface: float = SURFACE_FIT.widths[-1]  # surface fit before the last one, which follows from the residuals


WIDTHS = KernelWidths()


@dataclass(frozen=True)
class Frame:
    """What is known of a frame before it is aligned."""

    cloud: Tensor  # (M, 3), metres
    finite: Tensor  # (M,) True where a point is finite
    elapsed: float  # time since the frame before, in intervals
    picture: DepthFrame | None = None  # whose points the cloud holds, if it is that of a depth camera
    known: KnownDofs | None = None
    keypoints: MeasuredKeypoints | None = None

    @property
    def prior_arguments(self) -> dict[str, Any]:
        """What is known as `align` and `find_pose` take it."""
        return {} if self.known is None else {"locked": self.known.locked, "prior": (self.known.mean, self.known.std)}

    @property
    def data(self) -> Tensor:
        """The finite points (F, 3)."""
        return self.cloud[self.finite]

    @property
    def seen_keypoints(self) -> dict[str, Any]:
        """The keypoints as `align` and `find_pose` take them next to what the camera measured; nothing without any."""
        if self.keypoints is None:
            return {}
        return {"keypoints": self.keypoints.targets, "keypoint_std": self.keypoints.std}

    @property
    def keypoints_in_space(self) -> dict[str, Any]:
        """The same next to a cloud, which has no camera."""
        return {} if self.keypoints is None or self.keypoints.camera is not None else self.seen_keypoints


@dataclass(frozen=True)
class FrameView:
    """A frame around a pose: the alignment of the data in reach, in coordinates around the pose's base."""

    problem: AlignProblem  # one alignment; its prior's mean is the pose
    origin: Tensor  # (3,) of its coordinates
    rows: Tensor  # (4 P, 3) part transforms of the prior's mean, see `LinearBlendSkin.place`
    in_reach: Tensor  # (M,) where a point of the cloud is in reach; the problem may hold a subset of these
    elapsed: float
    viewpoint: Tensor | None  # (3,) of the camera, if one took the frame
    scan: OrientedScan | None = None  # the data with normals, where coefficients are fitted too

    def to_local(self, poses: Tensor) -> Tensor:
        """Return poses (S, num_dofs) of the world in these coordinates and within the limits, (1, S, num_dofs)."""
        return self.problem.clamp(shifted(poses, -self.origin)).unsqueeze(0)


@dataclass(frozen=True)
class FrameFit:
    """A pose fitted to a frame, in the coordinates of its view, and the evidence for it."""

    view: FrameView
    pose: Tensor  # (1, num_dofs)
    distance: Tensor  # (1, M) signed distances of the data to the surface
    jacobian: Tensor  # (1, M, num_dofs) of the distances
    transforms: Tensor  # (P, 4, 4) of the parts
    residual: Tensor  # () robust standard deviation of the distances near the surface, metres
    last_step: Tensor  # (1, num_dofs) of the fit, in tangent coordinates
    cost: float  # soft count of outliers and the prior, by which fits to a frame are ranked
    intruding: Tensor  # data that points in free space stand for, see `free_space_loss`
    num_inliers: int  # number of data near the surface
    unexplained: Tensor  # (K, 3) clusters of data off the surface, as dense as the data on it
    num_new_unexplained: int  # of them, that a limb can reach and that are no cluster of the frame before
    limit_share: float  # share of the joints at a limit
    deviation: float  # of most model points from the prediction, metres
    acquired: str  # what led to the pose, see `FrameResult`
    person: PersonFit | None = None  # where coefficients are fitted too

    @property
    def ratio_in_reach(self) -> float:
        """Inliers as a share of the data in reach."""
        return self.num_inliers / max(1, self.distance.shape[-1])

    @property
    def soft_inliers(self) -> float:
        """Soft count of the inliers among all data in reach, less the prior's cost: higher is better."""
        return (1 - self.cost / max(1, self.distance.shape[-1])) * int(self.view.in_reach.sum())

    @property
    def rows(self) -> Tensor:
        """The transforms as (4 P, 3), see `LinearBlendSkin.place`."""
        return stacked_rows(self.transforms)

    @property
    def world_pose(self) -> Tensor:
        """The pose (num_dofs,) in the coordinates of the cloud."""
        return shifted(self.pose[0], self.view.origin)


def frame_generator(state: TrackState) -> torch.Generator:
    """Return the generator of a frame's random draws, which starts anew at every call."""
    return torch.Generator().manual_seed(state.seed + state.frame)


def subsample(data: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return at most ``count`` of the data (M, 3), drawn at random."""
    return data if len(data) <= count else data[torch.randperm(len(data), generator=generator)[:count].to(data.device)]
