"""What pipelines return: frozen records of tensors."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from torch import Tensor


class Status(Enum):
    """How a pipeline ended."""

    CONVERGED = "converged"
    MAX_STEPS = "max_steps"
    FEW_INLIERS = "few_inliers"
    NO_DATA = "no_data"


@dataclass(frozen=True)
class AlignRecord:
    """One step of an alignment, as given to ``on_step``.

    Args:
        stage: "em" or "surface".
        step: number of the step in its stage.
        num_steps: steps planned in the stage.
        sigma: (B,) kernel width, metres.
        cost: (B,) objective of the stage after the step.
        pose: (B, num_dofs) after the step.
        pose_change: (B,) largest change of a joint in the step, radians (or metres for sliding joints).
    """

    stage: str
    step: int
    num_steps: int
    sigma: Tensor
    cost: Tensor
    pose: Tensor
    pose_change: Tensor


@dataclass(frozen=True)
class AlignResult:
    """An articulated shape aligned to data. With a batch of problems every tensor has a leading dimension B.

    Args:
        pose: (num_dofs,), metres and radians.
        registered: (N, 3) model points moved onto the data, metres.
        keypoints: (K, 3) keypoints of the shape (a hand's 21, else the origins of the parts), metres.
        distances: (M,) signed distance of each datum to the fitted surface, metres; NaN where padded.
        inliers: (M,) True where the distance is below the inlier threshold.
        posterior: (M,) probability that the datum belongs to the model at the last sigma (eq. 17 summed over i).
        sigma: last kernel width, metres.
        cost: objective that ranks alignments of the same data, lower is better.
        status: how the alignment ended; a tuple with one entry per problem for a batch.
        history: one `AlignRecord` per step.
    """

    pose: Tensor
    registered: Tensor
    keypoints: Tensor
    distances: Tensor
    inliers: Tensor
    posterior: Tensor
    sigma: Tensor
    cost: Tensor
    status: Status | tuple[Status, ...]
    history: tuple[AlignRecord, ...] = ()
