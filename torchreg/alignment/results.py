"""Results of aligning, finding and calibrating articulated shapes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchreg.alignment.evidence.assignment import assigned
from torchreg.capture.depth_frame import DepthFrame
from torchreg.errors import InputError
from torchreg.geometry.loaded import as_points
from torchreg.result import Result, Status, stored_as
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.pose_algebra import shifted
from torchreg.shapes.posed_tree import named_pose
from torchreg.shapes.record import build_kept_shape, build_shape, record_kept_shape, record_shape


@dataclass(frozen=True)
class AlignRecord:
    """One step of an alignment, as given to ``on_step``.

    Args:
        stage: "em" or "surface".
        step: number of the step in its stage.
        num_steps: steps planned in the stage.
        sigma: (B,) kernel width, metres.
        cost: (B,) objective of the stage: after tested steps, before a single untested one.
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
class AlignResult(Result):
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
        status: of the alignment at its end; a tuple with one entry per problem for a batch.
        history: one `AlignRecord` per step.
        covariance: (num_dofs, num_dofs) of the pose in tangent coordinates (base: translation, then a rotation composed
            from the left), from the curvature of the last fit's objective, with data that err together counted once.
        confidence: probability, from 0 to 1, that the ends of the limbs are right to a twentieth of the shape's size on
            average; calibrated on made-up data, see `alignment.evidence.reliability`.
        evidence: (E,) what the confidence rests on, see `alignment.evidence.reliability.Evidence`.
        doubt: what is doubtful, in a sentence, and what the data do not determine, whatever the status; empty where
            nothing is. A tuple for a batch.
        crop: (H, W) bool, the pixels of a whole depth picture in which the shape was found; distances, inliers and
            posterior are those of `points_of` the picture. None where what was aligned to was given.
        origin: (3,) float64 about which it was computed, where the data lie so far from that of coordinates that the
            shape's precision would round them; pose, registered points and keypoints are float64 then. None elsewhere.
        coefficients: (C,) of the shape, where they were fitted too; the distances and all else are those of
            ``shape.with_coefficients(coefficients)``. None where the shape was taken as it was.
        coefficient_covariance: (C, C) of them.
        clothing_offset: (V,) how far clothes lie off the skin at each vertex of the body, metres; `distances` are then
            those to the clothes. None where it wears none that are seen.
        shape: that was aligned; where coefficients were fitted, the rig of that person. A file keeps it
            without its mesh where that takes more than 4 MB.
        up: the upright direction, where it is known, as from a file's format; pictures else guess it from the points.
        dof_confidence: (num_dofs,) from 0 to 1, how well each degree of freedom is known: ``1 - var / var_0``, the
            share of its variance without data that is gone. ``var`` is that of the covariance, ``var_0`` that of the
            uniform distribution over the limits, at most the square of a radian, or of half the size where it slides.
        rivals: (R, num_dofs) different poses that a search found to explain nearly as much, best first, such as that of
            a box after half a turn; a batch has NaN where a cloud has fewer. None where a start was given.
    """

    shapes: ClassVar[Mapping[str, str]] = {
        "pose": "D", "registered": "N 3", "keypoints": "K 3", "distances": "M", "inliers": "M", "posterior": "M",
        "sigma": "", "cost": "", "covariance": "D D", "confidence": "", "evidence": "E", "crop": "H W",
        "coefficients": "C", "coefficient_covariance": "C C", "dof_confidence": "D", "rivals": "R D",
        "clothing_offset": "V",
    }  # fmt: skip

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
    covariance: Tensor | None = None
    confidence: Tensor | None = None
    evidence: Tensor | None = None
    doubt: str | tuple[str, ...] | None = None
    crop: Tensor | None = None
    origin: Tensor | None = None
    coefficients: Tensor | None = None
    coefficient_covariance: Tensor | None = None
    shape: ArticulatedShape | None = field(default=None, metadata=stored_as(record_kept_shape, build_kept_shape))
    up: tuple[float, float, float] | None = None
    dof_confidence: Tensor | None = None
    rivals: Tensor | None = None
    clothing_offset: Tensor | None = None

    @property
    def named_pose(self) -> dict[str, Any]:
        """The pose by name of degree of freedom: numbers, metres and radians; tensors (B,) for a batch."""
        return named_pose(self.shape, self.pose)

    @property
    def std(self) -> Tensor:
        """Standard deviations (num_dofs,) of the pose, metres and radians, by its covariance."""
        if self.covariance is None:
            raise InputError("this result keeps no covariance; align again")
        return self.covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()

    @property
    def named_std(self) -> dict[str, Any]:
        """The standard deviations by name of degree of freedom, as `named_pose` gives the pose."""
        return named_pose(self.shape, self.std)

    def points_of(self, data: Any) -> Tensor:
        """Return the points (M, 3) of what was aligned to that distances and inliers belong to.

        Args:
            data: as `align` was given it, one cloud or picture: of a whole picture the points of its crop are returned.
        """
        return as_points(data.cropped(self.crop) if self.crop is not None and isinstance(data, DepthFrame) else data)

    def assignment(self, data: Any) -> Tensor:
        """Return for each datum whether it is on the shape (2), on something that touches it (1), or elsewhere (0).

        On the shape are the inliers. Something touches it, such as a forearm, a held box or a table, if neighbors
        within three times the typical distance of data connect it to inliers.

        Args:
            data: the one cloud or picture that `align` was given; of a whole picture the points of its crop count.

        Returns:
            (M,) int64, in the order of `points_of`.

        Raises:
            InputError: if the data are not those of the result, or this is the result of a batch.

        Differentiable: no. Cost: O(M log M).
        """
        points = self.points_of(data)
        if points.shape[:-1] != self.inliers.shape or points.ndim != 2:
            raise InputError(
                f"data must be the one cloud that was aligned to, {tuple(self.inliers.shape)} points; got "
                f"{tuple(points.shape[:-1])}"
            )
        return assigned(points, self.inliers.to(points.device))

    def moved(self, origin: Tensor) -> Self:
        """Return the result, whose coordinates begin at an origin (3,), in those in which the origin is given."""
        offset = origin.to(self.pose.device)
        return replace(
            self,
            pose=shifted(self.pose.double(), offset),
            registered=self.registered.double() + offset,
            keypoints=self.keypoints.double() + offset,
            history=tuple(replace(row, pose=shifted(row.pose.double(), offset)) for row in self.history),
            rivals=None if self.rivals is None else shifted(self.rivals.double(), offset),
            origin=origin,
        )

    def local(self, like: Tensor) -> Self:
        """Return the result in coordinates that begin at its origin, in the dtype of ``like``; itself without one."""
        if self.origin is None:
            return self
        found = replace(self.moved(-self.origin), origin=None)
        return replace(
            found,
            pose=found.pose.to(like),
            registered=found.registered.to(like),
            keypoints=found.keypoints.to(like),
            rivals=None if found.rivals is None else found.rivals.to(like),
        )

    def to_gltf(self, path: str | Path, source: str | Path, *, skin: str | int | None = None) -> Path:
        """Write the rig that was fitted, with the bones found and its clips, and return the path.

        See `ArticulatedShape.to_gltf`. At the result's pose its vertices are those of ``shape``; where a file of
        results left that mesh out, it is made again from the rig's own and the coefficients.

        Args:
            path: of the .glb file to write.
            source: the rigged .glb or .gltf file that the shape was read from.
            skin: as given to `ArticulatedShape.from_gltf`.

        Raises:
            InputError: if the result has no shape with a mesh, or it is not one of that file.
            FormatError: if the file cannot be read.
        """
        shape = self.shape
        if self.coefficients is not None and (shape is None or shape.surface is None):
            rig = ArticulatedShape.from_gltf(source, skin=skin).with_bone_coefficients()
            shape = rig.with_coefficients(self.coefficients)
        if shape is None:
            raise InputError("this result has no shape, and no coefficients to make it from")
        return shape.to_gltf(path, source, skin=skin)

    def with_surer(self, index: Tensor, others: AlignResult) -> AlignResult:
        """Return the result with those rows replaced of which others are surer, and the records of these.

        Args:
            index: (I,) rows of a batch; the one row of a single problem.
            others: results of these rows.

        Raises:
            InputError: if a result has no confidence.
        """
        mine, theirs = self.confidence, others.confidence
        if mine is None or theirs is None:
            raise InputError("these results keep no confidence; align again")
        if isinstance(self.status, Status):
            return replace(others if float(theirs) > float(mine) else self, history=others.history)
        is_surer = (theirs > mine[index]).nonzero()[:, 0]
        rows, joined = index[is_surer], self
        if joined.rivals is None and others.rivals is not None:
            none = others.rivals.new_full((len(self.pose), *others.rivals.shape[1:]), torch.nan)
            joined = replace(joined, rivals=none)
        changed: dict[str, Any] = {"history": others.history}
        for item in fields(joined):
            value, other = getattr(joined, item.name), getattr(others, item.name)
            if item.name in ("status", "doubt"):
                pairs = dict(zip(rows.tolist(), (other[row] for row in is_surer.tolist()), strict=True))
                changed[item.name] = tuple(pairs.get(row, value[row]) for row in range(len(value)))
            elif item.name in joined.shapes and value is not None:
                changed[item.name] = value.index_copy(0, rows, other[is_surer])
        return replace(joined, **changed)

    @property
    def statuses(self) -> tuple[Status, ...]:
        """One status per problem, also where there is a single one."""
        return (self.status,) if isinstance(self.status, Status) else self.status


@dataclass(frozen=True)
class Calibration(Result):
    """A shape fitted to clouds of it in T poses.

    Args:
        shape: a copy of the shape with the fitted scales.
        poses: (T, num_dofs) of the frames, metres and radians.
        log_length_scales: (P,) of the fitted shape.
        log_radius_scales: (P,) of the fitted shape.
        cost: (), of the joint fit, lower is better.
        status: of the calibration at its end.
        coefficients: (C,) that all frames share, where the shape has coefficients; it is then that of the person.
        coefficient_covariance: (C, C) of them.
        outliers: frames that were left out, by number, as the shape was not surely found in them.
    """

    shapes: ClassVar[Mapping[str, str]] = {
        "poses": "T D",
        "log_length_scales": "P",
        "log_radius_scales": "P",
        "cost": "",
        "coefficients": "C",
        "coefficient_covariance": "C C",
    }

    shape: ArticulatedShape = field(metadata=stored_as(record_shape, build_shape))
    poses: Tensor
    log_length_scales: Tensor
    log_radius_scales: Tensor
    cost: Tensor
    status: Status
    coefficients: Tensor | None = None
    coefficient_covariance: Tensor | None = None
    outliers: tuple[int, ...] = ()


@dataclass(frozen=True)
class BaseCalibration(Result):
    """Where a robot's base is in a camera's coordinates.

    Args:
        T_camera_base: (4, 4) float64, ``p_camera = T_camera_base @ p_base``, metres.
        offsets: (J,) found at the joints, to be added to what encoders read, radians or metres; zero where the data do
            not tell.
        offset_std: (J,) their standard deviations, zero where none was looked for or told.
        covariance: (6, 6) of the base: its translation, metres, and its rotation about the base's origin, radians, both
            along the camera's axes. Includes what frames share: errors of joints and meshes as large as the data's
            noise, the depth camera's scale (0.5 %), and from three frames on how the base moves without each of them.
        residuals: (T,) median distance of each frame's data from the robot's surface, metres.
        depth_offset: () distance by which the camera sees surfaces too near, along their normals, metres.
        outliers: frames that do not show the robot where the others have it, or not in their joints, by number.
        status: of the calibration at its end.
        camera_link: link that carries the camera (eye in hand). ``T_camera_base`` and ``covariance`` are of this link
            then, in place of the base.
    """

    shapes: ClassVar[Mapping[str, str]] = {
        "T_camera_base": "4 4", "offsets": "J", "offset_std": "J", "covariance": "6 6", "residuals": "T",
        "depth_offset": "",
    }  # fmt: skip

    T_camera_base: Tensor
    offsets: Tensor
    offset_std: Tensor
    covariance: Tensor
    residuals: Tensor
    depth_offset: Tensor
    outliers: tuple[int, ...]
    status: Status
    camera_link: str | None = None


@dataclass(frozen=True)
class PoseStarts(Result):
    """Poses in which an articulated shape may lie on data, best first. A batch adds a leading dimension B to all.

    Args:
        poses: (S, num_dofs), metres and radians; duplicates of a better one come last.
        costs: (S,) data that a pose leaves unexplained, softly counted, and a weak prior; lower is better.
        confidence: () from 0 to 1, in the first pose; low too where no data show a limb.
        shape: that was looked for, see `AlignResult`.
    """

    shapes: ClassVar[Mapping[str, str]] = {"poses": "S D", "costs": "S", "confidence": ""}

    poses: Tensor
    costs: Tensor
    confidence: Tensor
    shape: ArticulatedShape | None = field(default=None, metadata=stored_as(record_kept_shape, build_kept_shape))

    @property
    def best(self) -> Tensor:
        """The first pose, (num_dofs,)."""
        return self.poses[..., 0, :]

    def row(self, index: int) -> PoseStarts:
        """Return the starts of one cloud of a batch."""
        return replace(self, poses=self.poses[index], costs=self.costs[index], confidence=self.confidence[index])
