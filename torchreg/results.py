"""What pipelines return: frozen records of tensors."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, fields
from enum import Enum
from html import escape
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor, nn

from torchreg.errors import TorchregError

# The class of a shape: models belong to a layer above this one.
Shape = TypeVar("Shape", bound=nn.Module)
Writer = Callable[[Any, str | os.PathLike[str]], None]

# Files belong to a layer above this one, which registers its function when it is imported.
_writer: Writer | None = None


def register_writer(writer: Writer) -> None:
    """Make ``writer(result, path)`` what `Result.save` calls."""
    global _writer
    _writer = writer


def _described(value: Any) -> str:
    """Return what is said of a field in few words."""
    if isinstance(value, Tensor):
        if value.numel() == 1 and not value.is_complex():
            return f"{value.item():.4g}"
        return f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}"
    if isinstance(value, Enum):
        return str(value.value)
    if isinstance(value, tuple):
        words = [str(item.value) if isinstance(item, Enum) else item for item in value if isinstance(item, (Enum, str))]
        kinds = sorted(set(words))
        if len(words) < len(value) or len(kinds) > _FEW:
            return f"{len(value)} x {type(value[0]).__name__}"
        return ", ".join(f"{words.count(kind)} {kind}" for kind in kinds) or "none"
    if isinstance(value, (Result, nn.Module)):
        return type(value).__name__
    return f"{value:.4g}" if isinstance(value, float) else str(value)


# Different words that are counted one by one.
_FEW = 6
# Shared weight, as a share of all points, from which two bones meet.
_MEETING = 1e-3


class Result:
    """What a pipeline returns: a frozen record that can be saved.

    It prints in one line, and in notebooks as a table: tensors by type and shape, not by their numbers.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        # A class that has these already is given no others by @dataclass.
        cls.__repr__ = Result.__repr__  # type: ignore[method-assign]

    def __repr__(self) -> str:
        parts = ", ".join(f"{name}={text}" for name, text in self._described())
        return f"{type(self).__name__}({parts})"

    def _repr_html_(self) -> str:
        """Return a table of the fields, which notebooks show."""
        rows = "".join(
            f"<tr><th style='text-align:left'>{escape(name)}</th><td style='text-align:left'>{escape(text)}</td></tr>"
            for name, text in self._described()
        )
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"

    def _described(self) -> list[tuple[str, str]]:
        return [(item.name, _described(getattr(self, item.name))) for item in fields(self)]  # type: ignore[arg-type]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result to ``path``, which ends in .safetensors, and a JSON file beside it.

        `torchreg.load` reads it back with every field as it was, on the CPU and without gradients.

        Args:
            path: a local file ending in .safetensors; an existing pair is replaced, each file whole or not at all.

        Raises:
            InputError: if the ending is another.
            InputTypeError: if a field holds something that cannot be stored.
            FileNotFoundError: if the folder does not exist.
            TorchregError: if nothing that writes files was imported.
        """
        if _writer is None:
            raise TorchregError("nothing that writes results was imported; import torchreg.pipelines.storage first")
        _writer(self, path)


class Status(Enum):
    """How a pipeline ended."""

    CONVERGED = "converged"
    MAX_STEPS = "max_steps"
    WITH_WARNINGS = "with_warnings"
    FEW_INLIERS = "few_inliers"
    NO_DATA = "no_data"
    LOST = "lost"
    OTHER_UNITS = "other_units"

    @property
    def usable(self) -> bool:
        """Whether the result rests on data, converged or not."""
        return self in (Status.CONVERGED, Status.MAX_STEPS, Status.WITH_WARNINGS)


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

    @property
    def statuses(self) -> tuple[Status, ...]:
        """One status per problem, also where there is a single one."""
        return (self.status,) if isinstance(self.status, Status) else self.status


@dataclass(frozen=True)
class Calibration(Result, Generic[Shape]):
    """A shape fitted to clouds of it in T poses.

    Args:
        shape: a copy of the shape with the fitted scales.
        poses: (T, num_dofs) of the frames, metres and radians.
        log_length_scales: (P,) of the fitted shape.
        log_radius_scales: (P,) of the fitted shape.
        cost: (), of the joint fit, lower is better.
        status: how the calibration ended.
    """

    shape: Shape
    poses: Tensor
    log_length_scales: Tensor
    log_radius_scales: Tensor
    cost: Tensor
    status: Status


@dataclass(frozen=True)
class SpineRecord:
    """One frame that was skeletonized, as given to ``on_step``.

    Args:
        frame: its number; frames may be done in any order.
        num_frames: in all.
        num_tips: that it shows by itself.
        topology: of its own tree, see `Skeleton.topology`.
        seconds: that it took; zero if it was kept from before.
    """

    frame: int
    num_frames: int
    num_tips: int
    topology: str
    seconds: float


@dataclass(frozen=True)
class SpineSequence(Result, Generic[Shape]):
    """One graph of K tips and L limbs that moves through T frames; lengths in the unit of the surfaces.

    Convention: limb l runs from node ``graph[l, 0]`` to ``graph[l, 1]``. Nodes 0 to K - 1 are the tips, and limb k of
    the first K starts at tip k; the other nodes are the junctions. ``frames`` are ``R_world_node``, third columns along
    the limb.

    Args:
        model: the `Spine`, which gives curves at any time between frames.
        graph: (L, 2) node indices.
        curves: (T, L, S, 3) points along the limbs at equal intervals of their lengths.
        radii: (T, L, S) distances to the surface.
        frames: (T, L, S, 3, 3) rotations that travel with the curves.
        times: (T,) of the frames.
        found: (T, K) True where the frame's own skeleton has the tip.
        own: (T, L) True where the frame's own skeleton has the limb; others were carried over from frames around.
        reference: frame from which names were passed on.
        topologies: per frame the canonical form of the tree of curves as delivered, see `Skeleton.topology`.
        own_topologies: per frame that of its own skeleton, before the graph was imposed.
        statuses: per frame.
        status: WITH_WARNINGS if any frame's is, else CONVERGED.
        warnings: what was not as it should be, with the number of the frame.
    """

    model: Shape
    graph: Tensor
    curves: Tensor
    radii: Tensor
    frames: Tensor
    times: Tensor
    found: Tensor
    own: Tensor
    reference: int
    topologies: tuple[str, ...]
    own_topologies: tuple[str, ...]
    statuses: tuple[Status, ...]
    status: Status
    warnings: tuple[str, ...]

    @property
    def num_tips(self) -> int:
        """Number K of tips."""
        return self.found.shape[-1]

    @property
    def tips(self) -> Tensor:
        """Where the tips are, (T, K, 3)."""
        return self.curves[:, : self.num_tips, 0]

    @property
    def junctions(self) -> Tensor:
        """Where the junctions are, (T, J, 3); none if there are two tips."""
        flat = self.graph.reshape(-1)
        first = [int((flat == node).nonzero()[0, 0]) for node in range(self.num_tips, len(self.graph) + 1)]
        return self.curves[:, :, [0, -1]].flatten(1, 2)[:, first]


@dataclass(frozen=True)
class PoseStarts(Result):
    """Poses in which an articulated shape may lie on data, best first. A batch adds a leading dimension B to all.

    Args:
        poses: (S, num_dofs), metres and radians; poses that fell together with a better one come last.
        costs: (S,) data that a pose leaves unexplained, softly counted, and a weak prior; lower is better.
        confidence: () from 0 to 1: how surely the first pose is the right one; low too where limbs are not shown.
    """

    poses: Tensor
    costs: Tensor
    confidence: Tensor

    @property
    def best(self) -> Tensor:
        """The first pose, (num_dofs,)."""
        return self.poses[..., 0, :]

    def row(self, index: int) -> PoseStarts:
        """Return the starts of one cloud of a batch."""
        return PoseStarts(self.poses[index], self.costs[index], self.confidence[index])


@dataclass(frozen=True, kw_only=True)
class FrameResult(AlignResult):
    """One frame of a tracked sequence.

    Distances of points out of the shape's reach are infinite; ``sigma``, ``cost``, covariance and residual of a frame
    that was not fitted are NaN, as is everything before the shape was first found.

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

    covariance: Tensor
    acquired: str
    frame: int
    time: float
    inlier_ratio: float
    residual: float

    @property
    def std(self) -> Tensor:
        """Standard deviations (num_dofs,) of the pose, metres and radians."""
        return self.covariance.diagonal().sqrt()


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
    """

    poses: Tensor
    std: Tensor
    keypoints: Tensor
    inlier_ratios: Tensor
    residuals: Tensor
    times: Tensor
    seconds: Tensor
    statuses: tuple[Status, ...]
    acquired: tuple[str, ...]


@dataclass(frozen=True)
class TrackState(Result):
    """All that the next frame of a tracker depends on. Running figures are means over the frames before.

    Args:
        frame: number of frames seen.
        time: of the last one.
        interval: usual time between frames; zero before the second.
        pose: (num_dofs,) last or held, NaN before the shape was first found.
        velocity: (num_dofs,) tangent, per unit of time.
        points: (N, 3) model points for the next frame, metres.
        weights: (N, P) their binding to the parts.
        reference_pose: (num_dofs,) the pose they are given in.
        previous: (K, num_dofs) some earlier poses.
        strays: (S, 3) data off the surface as dense as those on it, in the frame of the first part, metres.
        error: running largest error of the prediction at the model points, metres.
        surprise: (3,) the same of the base's place, metres, its turn and the joints, radians.
        total: running number of data.
        inliers: running number of inliers; zero before the first fit.
        ratio: running share of inliers in the data in reach.
        residual: running residual, metres.
        held: running share of the joints at a limit.
        lost: frames since the last fit.
        rest: frames before a search is tried again.
        fails: searches in a row that left doubts.
        unsure: how often a pose that was found everywhere may still be checked.
        seed: of all that is drawn.
    """

    frame: int
    time: float
    interval: float
    pose: Tensor
    velocity: Tensor
    points: Tensor
    weights: Tensor
    reference_pose: Tensor
    previous: Tensor
    strays: Tensor
    error: float
    surprise: Tensor
    total: float
    inliers: float
    ratio: float
    residual: float
    held: float
    lost: int
    rest: int
    fails: int
    unsure: int
    seed: int

    @property
    def found(self) -> bool:
        """Whether there is a pose."""
        return bool(self.pose.isfinite().all())

    @property
    def tracked(self) -> bool:
        """Whether a frame was ever fitted."""
        return self.inliers > 0


@dataclass(frozen=True)
class DemoResult(Result):
    """A hand tracked through a made-up sequence, beside the truth; T frames were done.

    Args:
        track: what the tracker found.
        truths: (T, num_dofs) the poses behind the clouds.
        clouds: T clouds (M_t, 3), metres.
        inliers: T masks (M_t,), True where a datum is near the tracked surface.
        tip_errors: (T, 5) distance of each fingertip, thumb to little finger, from its true place, metres.
        tips_seen: (T, 5) True where the cameras saw enough of the fingertip to measure it.
        seed: of motion and measurements.
    """

    track: TrackResult
    truths: Tensor
    clouds: tuple[Tensor, ...]
    inliers: tuple[Tensor, ...]
    tip_errors: Tensor
    tips_seen: Tensor
    seed: int


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
class ScanRegistration(Result, Generic[Shape]):
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

    model: Shape
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
        most alike are joined again and again and move as the larger one then, until the motion of either takes the
        other's points farther than ``tolerance`` from where they went, in the mean.

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
    part = _joined_alike(apart, own.sum(0), meet, tolerance)
    return part[labels].unique(return_inverse=True)[1]


def _misses(points: Tensor, motions: Tensor, labels: Tensor, own: Tensor) -> Tensor:
    """Return how far the motion of every bone takes every bone's points (B, B) from where they went, in all.

    In diagonals of the moved points (N, 3); ``own`` (N, B) tells whose each of them is.
    """
    size = (points.amax(0) - points.amin(0)).norm()
    rest = (torch.linalg.inv(motions)[labels] @ nn.functional.pad(points, (0, 1), value=1.0).unsqueeze(-1))[:, :3, 0]
    places = rest @ motions[:, :3, :3].mT + motions[:, None, :3, 3]
    return (places - points).norm(dim=-1) @ own / size


def _joined_alike(apart: Tensor, counts: Tensor, meet: Tensor, tolerance: float) -> Tensor:
    """Return the part (B,) of each bone; by bone a's motion, bone b's points miss by ``apart[t, a, b]`` in all.

    Chains of bones, each of which moves much like the next, do not make one part of all: the larger bone's motion
    counts for both, not the nearest one's.
    """
    apart, counts, meet = apart.clone(), counts.clone(), meet.clone().fill_diagonal_(False)
    part = torch.arange(len(counts), device=counts.device)
    meet &= (counts > 0) & (counts > 0).unsqueeze(1)
    while bool(meet.any()):
        mean = apart / counts.clamp_min(1)
        gap = torch.minimum(mean, mean.mT).amax(0).masked_fill(~meet, torch.inf)
        one, other = divmod(int(gap.argmin()), len(counts))
        if float(gap[one, other]) > tolerance:
            break
        if counts[other] > counts[one]:
            one, other = other, one
        apart[..., one] += apart[..., other]
        counts[one] += counts[other]
        meet[one] |= meet[other]
        meet[:, one] |= meet[:, other]
        meet[other], meet[:, other], meet[one, one] = False, False, False
        part[part == other] = one
    return part


@dataclass(frozen=True)
class SequenceRegistration(Result, Generic[Shape]):
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

    model: Shape
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
