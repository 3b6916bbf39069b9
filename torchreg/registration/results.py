"""What registering and posing scans returns."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.result import Result, Status, stored_as
from torchreg.solvers.rigid_groups import merge_alike

# Shared weight, as a share of all points, from which two bones meet.
_MEETING = 1e-3


@dataclass(frozen=True)
class RegisterRecord:
    """One step of a scan registration, as given to ``on_step``. Counts of matches are sums over the frames.

    Args:
        stage: "initialize", of which only the first five fields tell; "align", labels and motions in turn; or "refine",
            weights and motions in turn.
        step: number of the step in its stage.
        num_steps: steps planned in the stage.
        distance: weighted mean squared distance of the matches, squared shares of the source's diagonal.
        joint: sum of the squared gaps of the joints that are held, squared shares of the diagonal.
        smoothness: pairs of neighboring cells with different labels.
        num_labels: bones alive.
        kept: matches that hold.
        boundary: matches dropped because the target is on a boundary.
        far: matches dropped because of their distance.
        turned: matches dropped because normals differ.
    """

    stage: str
    step: int
    num_steps: int
    distance: float
    joint: float
    smoothness: int
    num_labels: int
    kept: int
    boundary: int
    far: int
    turned: int


@dataclass(frozen=True)
class ScanRegistration(Result):
    """A range scan taken onto another by B bones, in the unit and frame of the scans.

    Args:
        model: the `GridLBS`: ``model(points)`` deforms any points, ``model(points, transforms)`` poses them anew.
        points: (N, 3) of the source, before they are moved.
        faces: (F, 3) of the source, or None.
        deformed: (N, 3) source points moved onto the target.
        labels: (N,) int64, the bone with the largest weight at each source point.
        transforms: (B, 4, 4) of the bones.
        weights: (N, B) of the bones at the source points, rows sum to one.
        distances: (N,) from moved points to the nearest point of the target, seen there or not.
        matched: (N,) True where a moved point has a compatible counterpart in the target.
        status: how the registration ended.
        seconds: (4,) setup, initialization, alignment, refinement.
        history: one `RegisterRecord` per step of the last two stages.
    """

    model: GridLBS = field(metadata=stored_as(GridLBS.record, GridLBS.from_record))
    points: Tensor
    faces: Tensor | None
    deformed: Tensor
    labels: Tensor
    transforms: Tensor
    weights: Tensor
    distances: Tensor
    matched: Tensor
    status: Status
    seconds: Tensor
    history: tuple[RegisterRecord, ...] = ()

    def parts(self, tolerance: float = 0.01) -> Tensor:
        """Return labels (N,) int64 in which bones that meet and moved as one are one part, numbered from 0.

        Bones outnumber parts where a surface stretches, or where two scans do not tell parts apart. The two that moved
        most alike are joined again and again and move as the larger one then, as long as the motion of one leaves the
        other's points within ``tolerance`` of where they went, in the mean.

        Args:
            tolerance: share of the diagonal of the moved points.
        """
        return _parts(self.deformed.unsqueeze(0), self.transforms.unsqueeze(0), self.labels, self.weights, tolerance)


def _parts(moved: Tensor, transforms: Tensor, labels: Tensor, weights: Tensor, tolerance: float) -> Tensor:
    """Return the parts (N,) of points moved to (T, N, 3) by transforms (T, B, 4, 4), alike in all T frames."""
    blends, own = weights.double(), nn.functional.one_hot(labels, weights.shape[1]).double()
    # Frame by frame: all at once would need T B N places.
    apart = torch.stack(
        [_misses(*frame, labels, own) for frame in zip(moved.double(), transforms.double(), strict=True)]
    )
    meet = blends.mT @ blends > _MEETING * len(labels)
    part = merge_alike(apart, own.sum(0), meet, tolerance)
    return part[labels].unique(return_inverse=True)[1]


def _misses(points: Tensor, motions: Tensor, labels: Tensor, own: Tensor) -> Tensor:
    """Return how far the motion of every bone takes every bone's points (B, B) from where they went, in all.

    In diagonals of the moved points (N, 3); ``own`` (N, B) tells whose each of them is.
    """
    size = (points.amax(0) - points.amin(0)).norm()
    rest = (torch.linalg.inv(motions)[labels] @ nn.functional.pad(points, (0, 1), value=1.0).unsqueeze(-1))[:, :3, 0]
    places = rest @ motions[:, :3, :3].mT + motions[:, None, :3, 3]
    return (places - points).norm(dim=-1) @ own / size


@dataclass(frozen=True)
class SequenceRegistration(Result):
    """A reference scan taken onto T scans by one set of B bones, in the unit and frame of the scans.

    Args:
        model: the `GridLBS`, its poses the T frames: ``model(points)`` is (T, N, 3).
        points: (N, 3) of the reference, before they are moved.
        faces: (F, 3) of the reference, or None.
        deformed: (T, N, 3) its points moved onto every scan.
        labels: (N,) int64, the bone with the largest weight at each point.
        transforms: (T, B, 4, 4) of the bones.
        weights: (N, B) of the bones at the points, rows sum to one.
        fused: (K, 3) the points of all scans in the pose of the reference: a more complete model than any of them.
        fused_normals: (K, 3) unit normals there.
        fused_frames: (K,) int64, the scan that each is from.
        reference: number of the scan that is moved.
        status: how the registration ended.
        history: one `RegisterRecord` per step of the joint fit.
    """

    model: GridLBS = field(metadata=stored_as(GridLBS.record, GridLBS.from_record))
    points: Tensor
    faces: Tensor | None
    deformed: Tensor
    labels: Tensor
    transforms: Tensor
    weights: Tensor
    fused: Tensor
    fused_normals: Tensor
    fused_frames: Tensor
    reference: int
    status: Status
    history: tuple[RegisterRecord, ...] = ()

    def parts(self, tolerance: float = 0.01) -> Tensor:
        """Return labels (N,) int64 of parts, as `ScanRegistration.parts` does: bones that moved as one in every frame.

        Args:
            tolerance: share of the diagonal of the moved points.
        """
        return _parts(self.deformed, self.transforms, self.labels, self.weights, tolerance)


@dataclass(frozen=True)
class PoseSolution(Result):
    """A pose of a registered thing in which handles lie at targets. A batch adds leading dimensions to all tensors.

    Args:
        transforms: (B, 4, 4) of the bones.
        placed: (H, 3) where the handles are.
        misses: (H,) their distances from the targets.
        gaps: (J,) how far apart the bones of each joint take its center.
        num_steps: linear systems solved.
        status: CONVERGED or MAX_STEPS; a tuple with one entry per problem for a batch.
    """

    transforms: Tensor
    placed: Tensor
    misses: Tensor
    gaps: Tensor
    num_steps: int
    status: Status | tuple[Status, ...]
