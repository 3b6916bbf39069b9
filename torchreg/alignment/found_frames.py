"""The poses of the frames of a calibration: aligned from starts, or searched for, and which of them can be trusted."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.alignment.align import align
from torchreg.alignment.config import AlignConfig
from torchreg.alignment.results import AlignResult
from torchreg.errors import FramesWarning
from torchreg.result import Status
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import LinearBlendSkin


@dataclass(frozen=True)
class _Trust:
    """Numbers of the trust in frames."""

    surest: int = 3  # frames that give a first size where none can be trusted: a shape of another size is near them


_TRUST = _Trust()


@dataclass(frozen=True, eq=False)
class FramePoses:
    """Poses (T, num_dofs), statuses, confidence (T,), and which are ``known`` (T,), starts for the next alignment."""

    poses: Tensor
    statuses: tuple[Status, ...]
    confidence: Tensor
    known: Tensor
    searched: bool

    @classmethod
    def of(cls, starts: Tensor, searched: bool) -> FramePoses:
        """Return the poses (T, num_dofs) before any alignment."""
        known = torch.full_like(starts[:, 0], not searched, dtype=torch.bool)
        return cls(starts, (), torch.zeros_like(starts[:, 0]), known, searched)

    def aligned(
        self, shape: ArticulatedShape, data: Tensor, valid: Tensor, config: AlignConfig, skin: LinearBlendSkin | None
    ) -> FramePoses:
        """Return the poses after an alignment of each frame (T, M, 3), in a batch; those not known are searched."""
        poses, confidence, statuses = self.poses.clone(), self.confidence.clone(), [Status.NO_DATA] * len(data)
        for rows, start in ((self.known, True), (~self.known, False)):
            index = rows.nonzero()[:, 0]
            if len(index) == 0:
                continue
            starts = self.poses[index] if start else None
            found = align(shape, data[index], starts, model_points=skin, mask=valid[index], config=config)
            poses[index] = found.pose
            confidence[index] = torch.zeros_like(confidence[index]) if found.confidence is None else found.confidence
            for row, status in zip(index.tolist(), found.statuses, strict=True):
                statuses[row] = status
        usable = torch.tensor([status.usable for status in statuses], device=data.device)
        known = usable if self.searched else self.known
        return replace(self, poses=poses, statuses=tuple(statuses), confidence=confidence, known=known)

    def of_person(self, shape: ArticulatedShape, data: Tensor, valid: Tensor, config: AlignConfig) -> FramePoses:
        """Return the poses of a rig in frames (T, M, 3); the first sure one gives its coefficients.

        Later ones in which a pose is doubtful are fitted with coefficients of their own, by more evidence.
        """
        surest, first = None, 0
        for number, (points, kept) in enumerate(zip(data, valid, strict=True)):
            found = align(shape, points[kept], fit_shape=True, config=config)
            if surest is None or _confidence(found) > _confidence(surest):
                surest, first = found, number
            if found.statuses[0].usable:
                break
        if surest is None or surest.coefficients is None:
            return self
        person, known = shape.with_coefficients(surest.coefficients), torch.zeros_like(self.known)
        poses = self.poses.index_put((torch.tensor(first),), surest.pose)
        known[first] = True
        frames = replace(self, poses=poses, known=known).aligned(person, data, valid, config, None)
        for number in filter(lambda left: left > first, frames.left_out):
            found = align(shape, data[number, valid[number]], fit_shape=True, config=config)
            if found.statuses[0].usable:
                frames = frames._with(number, found)
        return frames

    def _with(self, number: int, found: AlignResult) -> FramePoses:
        """Return the poses with that of another alignment in one frame."""
        index = torch.tensor([number], device=self.poses.device)
        statuses = (*self.statuses[:number], found.statuses[0], *self.statuses[number + 1 :])
        return replace(
            self, poses=self.poses.index_copy(0, index, found.pose.reshape(1, -1)), statuses=statuses,
            confidence=self.confidence.index_fill(0, index, _confidence(found)),
            known=self.known.index_fill(0, index, True),
        )  # fmt: skip

    @property
    def failed(self) -> set[Status]:
        """Statuses of frames that do not count; a doubtful one from a start does, as the shape is not fitted yet."""
        return {status for status in self.statuses if not (status.usable or status is Status.DOUBTFUL)}

    @property
    def counting(self) -> Tensor:
        """Which frames (T,) count in a fit: those that can be trusted or, where none can, the surest."""
        if not self.searched:
            return torch.tensor([status not in self.failed for status in self.statuses], device=self.known.device)
        if bool(self.known.any()):
            return self.known
        surest = self.confidence.topk(min(_TRUST.surest, len(self.known))).indices
        return self.known.index_fill(0, surest, True)

    @property
    def left_out(self) -> tuple[int, ...]:
        """Numbers of the frames that were searched and cannot be trusted."""
        return tuple((~self.known).nonzero()[:, 0].tolist())

    def status(self, fitted: Status) -> Status:
        """Return the status of a calibration whose fit ended with one."""
        if not self.searched:
            failed = self.failed
            few = Status.FEW_INLIERS if failed else fitted
            return Status.DEGENERATE if Status.DEGENERATE in failed else few
        if 2 * len(self.left_out) > len(self.known):
            return self.statuses[0] if len(set(self.statuses)) == 1 else Status.DOUBTFUL
        return Status.WITH_WARNINGS if self.left_out else fitted

    def warn(self) -> None:
        """Say which frames were left out."""
        if self.left_out:
            names = ", ".join(map(str, self.left_out))
            warnings.warn(
                f"the shape is not surely found in frames {names} of {len(self.known)}, counted from 0; they are left "
                f"out: give initial_poses near them, or remove them",
                FramesWarning, stacklevel=3,
            )  # fmt: skip


def _confidence(found: AlignResult) -> float:
    return 0.0 if found.confidence is None else float(found.confidence)
