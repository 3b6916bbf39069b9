"""Results of registering and posing scans."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor, nn

from torchreg.geometry.range_scan import RangeScan
from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.result import Result, Status, formerly, stored_as
from torchreg.solvers.rigid_groups import merge_alike

if TYPE_CHECKING:
    from torchreg.registration.robots.model import RobotModel

# Weight that two bones share, as a share of all points, from which they are neighbors.
_LEAST_SHARED = 1e-3


@dataclass(frozen=True)
class RegisterRecord:
    """One step of a scan registration, as given to ``on_step``. Counts of matches are sums over the frames.

    Args:
        stage: "initialize", which leaves the fields after ``joint`` at zero; "align", labels and motions in turn; or
            "refine", weights and motions in turn.
        step: number of the step in its stage.
        num_steps: steps planned in the stage.
        distance: weighted mean squared residual of the matches, squared shares of the source's diagonal.
        joint: sum of the squared gaps of the joints that are held, squared shares of the diagonal.
        smoothness: pairs of neighboring cells with different labels.
        num_labels: bones with a cell.
        kept: matches that hold.
        boundary: matches dropped because the target is on a boundary.
        far: matches dropped because of their distance.
        turned: matches dropped because normals differ.
        energies: what each term of the paper's eqs. 2 and 8 adds to the energy, by name, as in `RegistrationEnergy`;
            their sum is the energy. Weights of the terms are the same in all steps: those of the refinement, and the
            last one of the joints in the paper. Means over the frames; empty in the initialization, which has no bones.
    """

    stage: str
    step: int
    num_steps: int
    distance: float
    joint: float
    smoothness: int = 0
    num_labels: int = 0
    kept: int = 0
    boundary: int = 0
    far: int = 0
    turned: int = 0
    energies: dict[str, float] = field(default_factory=dict)


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
        origin: (3,) float64 about which it was computed, where the scans, in float64, lie far from that of coordinates;
            None elsewhere.
        confidence: probability, from 0 to 1, that 90 % of the points are within 2.5 % of the diagonal of where they
            went, by a model learnt from made-up pairs; below one half the status is DOUBTFUL. None where a start was
            given, and of the paper's way, which do not tell.
        point_confidence: (N,) from 0 to 1, posterior mass of each point's match in the first alignment; low where the
            target shows nothing and points follow what is around them. None as above.
        up: the upright direction, where it is known, as from a file's format; pictures else guess it from the points.
    """

    shapes: ClassVar[Mapping[str, str]] = {
        "points": "N 3", "faces": "F 3", "deformed": "N 3", "labels": "N", "transforms": "B 4 4", "weights": "N B",
        "distances": "N", "matched": "N", "seconds": "4", "point_confidence": "N",
    }  # fmt: skip

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
    origin: Tensor | None = None
    confidence: float | None = None
    point_confidence: Tensor | None = None
    up: tuple[float, float, float] | None = None

    def moved(self, origin: Tensor) -> ScanRegistration:
        """Return the result, whose coordinates begin at an origin (3,), in those in which the origin is given."""
        model = self.model.double().rescaled(1.0, origin)
        points, deformed = self.points.double() + origin, self.deformed.double() + origin
        return replace(
            self, model=model, points=points, deformed=deformed, transforms=model.transforms.detach(), origin=origin
        )

    def local(self) -> ScanRegistration:
        """Return the result in coordinates that begin at its origin; itself without one."""
        return self if self.origin is None else replace(self.moved(-self.origin), origin=None)

    def parts(self, tolerance: float = 0.01) -> Tensor:
        """Return labels (N,) int64 in which neighboring bones that moved as one are one part, numbered from 0.

        Bones outnumber parts where a surface stretches, or where two scans do not tell parts apart. The two that moved
        most alike are joined again and again and move as the larger one then, as long as the motion of each leaves the
        other's points at a mean distance of up to ``tolerance`` from where they moved.

        Args:
            tolerance: share of the diagonal of the moved points.
        """
        return _parts(self.deformed.unsqueeze(0), self.transforms.unsqueeze(0), self.labels, self.weights, tolerance)


def _parts(deformed: Tensor, transforms: Tensor, labels: Tensor, weights: Tensor, tolerance: float) -> Tensor:
    """Return the parts (N,) of points moved to (T, N, 3) by transforms (T, B, 4, 4), alike in all T frames."""
    weights, members = weights.double(), nn.functional.one_hot(labels, weights.shape[1]).double()
    # Frame by frame: all at once would need T B N positions.
    residuals = torch.stack(
        [
            _residual_sums(points, motions, labels, members)
            for points, motions in zip(deformed.double(), transforms.double(), strict=True)
        ]
    )
    neighbors = weights.mT @ weights > _LEAST_SHARED * len(labels)
    part = merge_alike(residuals, members.sum(0), neighbors, tolerance)
    return part[labels].unique(return_inverse=True)[1]


def _residual_sums(points: Tensor, motions: Tensor, labels: Tensor, members: Tensor) -> Tensor:
    """Return (B, B): summed distances of each bone's moved points from where every bone moves them, in diagonals."""
    size = (points.amax(0) - points.amin(0)).norm()
    rest = (torch.linalg.inv(motions)[labels] @ nn.functional.pad(points, (0, 1), value=1.0).unsqueeze(-1))[:, :3, 0]
    positions = rest @ motions[:, :3, :3].mT + motions[:, None, :3, 3]
    return (positions - points).norm(dim=-1) @ members / size


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
        fused_normals: (K, 3) unit normals of these points.
        fused_frames: (K,) int64, the scan that each is from.
        reference: number of the scan that is moved.
        status: how the registration ended.
        history: one `RegisterRecord` per step of the joint fit.
        origin: see `ScanRegistration`.
        observed: (K, 3) the points of all scans where they were seen; None in files of earlier releases.
        observed_normals: (K, 3) their unit normals there.
        confidence: (T,) probability that each scan is registered, see `ScanRegistration.confidence`, which falls away
            from the reference, as what has gone wrong seldom recovers; one for the reference. Where any is below one
            half the status is DOUBTFUL. None in files of earlier releases.
        up: see `ScanRegistration`.
    """

    shapes: ClassVar[Mapping[str, str]] = {
        "points": "N 3", "faces": "F 3", "deformed": "T N 3", "labels": "N", "transforms": "T B 4 4", "weights": "N B",
        "fused": "Q 3", "fused_normals": "Q 3", "fused_frames": "Q", "observed": "Q 3", "observed_normals": "Q 3",
        "confidence": "T",
    }  # fmt: skip

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
    origin: Tensor | None = None
    observed: Tensor | None = None
    observed_normals: Tensor | None = None
    confidence: Tensor | None = None
    up: tuple[float, float, float] | None = None

    def moved(self, origin: Tensor) -> SequenceRegistration:
        """Return the result, whose coordinates begin at an origin (3,), in those in which the origin is given."""
        model = self.model.double().rescaled(1.0, origin)
        points, deformed, fused = (values.double() + origin for values in (self.points, self.deformed, self.fused))
        return replace(
            self, model=model, points=points, deformed=deformed, fused=fused,
            transforms=model.transforms.detach(), origin=origin,
            observed=None if self.observed is None else self.observed.double() + origin,
        )  # fmt: skip

    def parts(self, tolerance: float = 0.01) -> Tensor:
        """Return labels (N,) int64 of parts, as `ScanRegistration.parts` does: bones that moved as one in every frame.

        Args:
            tolerance: share of the diagonal of the moved points.
        """
        return _parts(self.deformed, self.transforms, self.labels, self.weights, tolerance)

    def to_urdf(self, path: str | os.PathLike[str]) -> RobotModel:
        """Write what was scanned as a robot, and return it with its joint values in every frame.

        Which points are one link, and whether two links turn about an axis, slide or hold together, is decided by how
        well their motions explain the scans, each parameter paying for itself; axes and joint values are then fitted to
        all scans together, each compared with what the others show of the same link. The zero pose is the reference
        scan; each link has its triangles in PATH_meshes, beside the file, or without triangles a closed surface about
        what all scans show of it. Limits are those of the motions that were seen. Scans must be in metres. A joint that
        turns a round part about its own axis cannot be seen.

        Args:
            path: of the .urdf file.

        Returns:
            A record: the kinematic ``tree``, the ``part`` (N,) of each point, ``joint_values`` (T, J), radians and
            metres, the ``base`` (T, 4, 4) of each frame, the ``residuals`` (T,), median distances from the scans,
            metres, and ``loose``, the names of joints that do not explain how their links move.

        Raises:
            FormatError: if the ending is not .urdf.
            FileNotFoundError: if the folder does not exist.

        Differentiable: no.

        Cost: 10 to 35 s for ten scans.

        References: Isack and Boykov 2012; Schwarz 1978; Chow and Liu 1968.
        """
        from torchreg.registration.robots.model import find_robot, write_robot
        from torchreg.registration.robots.surfaces import Target

        if self.observed is None or self.observed_normals is None:
            scans, normals = None, RangeScan(self.points, self.faces).normals
        else:
            chosen = [self.fused_frames == frame for frame in range(len(self.deformed))]
            seen, facing = self.observed.cpu().double(), self.observed_normals.cpu().double()
            scans = [Target(seen[frame], facing[frame]) for frame in chosen]
            normals = facing[chosen[self.reference]]
        found = find_robot(
            self.points, normals, self.deformed, self.labels, scans, self.reference, sparse=self.faces is None
        )
        write_robot(path, found, self.points, self.faces, scans)
        return found


@dataclass(frozen=True)
class PoseSolution(Result):
    """A pose of a registered thing in which handles lie at targets. A batch adds leading dimensions to all tensors.

    Args:
        transforms: (B, 4, 4) of the bones.
        placed: (H, 3) the handles in this pose.
        residuals: (H,) their distances from the targets.
        gaps: (J,) distances between the images of each joint's center under its two bones.
        num_steps: linear systems solved.
        status: CONVERGED or MAX_STEPS; a tuple with one entry per problem for a batch.
    """

    shapes: ClassVar[Mapping[str, str]] = {"transforms": "B 4 4", "placed": "H 3", "residuals": "H", "gaps": "J"}

    transforms: Tensor
    placed: Tensor
    residuals: Tensor = field(metadata=formerly("misses"))
    gaps: Tensor
    num_steps: int
    status: Status | tuple[Status, ...]

    @property
    def misses(self) -> Tensor:
        """The residuals (H,), by their earlier name."""
        return self.residuals
