"""Registering two range scans of something that moves, by a reduced deformable model: bones, joints, weights."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import (
    as_float_tensor,
    as_tensor,
    check_choice,
    check_count,
    check_finite,
    check_shape,
    warn_about_rounding,
)
from torchreg._threads import one_thread
from torchreg.capture.depth_frame import DepthFrame
from torchreg.capture.moved import moved_scans
from torchreg.errors import DegenerateDataWarning, InputError, InputTypeError, UnitsWarning
from torchreg.geometry.far_origin import far_origin, to_local, to_world
from torchreg.geometry.loaded import as_scan
from torchreg.geometry.neighbors import nearest_neighbor
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.scan_clusters import clustered_scan
from torchreg.geometry.spread import SPREADS, spread_dimensions
from torchreg.geometry.support import SUPPORTS, split_support, warn_about_support
from torchreg.geometry.units import likely_pair, robust_size
from torchreg.registration.bones.alternation import ReducedFit, Samples, turned_normals
from torchreg.registration.bones.config import BoneConfig, OnRegisterStep
from torchreg.registration.bones.labels import CellData, labels_of_parts
from torchreg.registration.bones.sparse_grid import MAX_RESOLUTION, SparseGrid
from torchreg.registration.config import RegisterConfig
from torchreg.registration.dense.align_scans import align_scans
from torchreg.registration.dense.reliability import SCAN_CALIBRATION
from torchreg.registration.normalization import Normalization
from torchreg.registration.paper.algorithm import PaperFit
from torchreg.registration.results import RegisterRecord, ScanRegistration
from torchreg.result import Status


@dataclass(frozen=True)
class _Most:
    """How much of large scans is fitted to."""

    points: int = 16_000  # several for each sample, so that matches lie on the surface; all are moved in the end


_MOST = _Most()


@torch.no_grad()
@one_thread()
def register(
    source: RangeScan | Any,
    target: RangeScan | Any,
    num_bones: int = 20,
    grid_resolution: int = 50,
    config: RegisterConfig | None = None,
    generator: torch.Generator | None = None,
    on_step: OnRegisterStep | None = None,
    *,
    start: Tensor | None = None,
    confidence: Tensor | None = None,
    parts: Tensor | None = None,
    support: str = "auto",
) -> ScanRegistration:
    """Return the bones, weights and deformation that take one range scan onto another, without a template.

    ``D(x) = sum_j w_j(x) (R_j x + t_j)``, the weights interpolated on a sparse grid around the source. Unlike the
    paper, which starts from a random segmentation and spin images, a dense alignment by a deformation graph comes
    first: see `align_scans`. Parts that move rigidly in it become the first bones; then motions, correspondences and
    labels are solved in turn, and last continuous weights with the motions. `RegisterConfig.paper` is the paper's way.

    Units change nothing, and turns and shifts of both scans nothing beyond rounding. Computed in double precision on
    the CPU; the result has the dtype and device of the source.

    Args:
        source: the scan to be moved, N points; or what a loader returns, a cloud or a mesh. Of two `DepthFrame`s
            without masks, what moved between them is registered, see `moved_masks`.
        target: the scan to be reached, in the same frame and unit.
        num_bones: most bones; fewer where the motion needs no more, or the grid has fewer cells.
        grid_resolution: cells along the longest side of the source.
        config: see `RegisterConfig`.
        generator: source of randomness; None draws the same numbers at every call.
        on_step: called with a `RegisterRecord` after each step.
        start: (N, 3) known positions of the source's points in the target's pose, about, instead of an alignment.
        confidence: (N,) from 0 to 1, of ``start``; ones by default.
        parts: (N,) integers from zero, less than ``num_bones``, the parts from which bones start, such as the limbs of
            a spine, ``skeletonize(mesh).limb_of(source.points)``; by default patches that move as one.
        support: "auto" leaves out a table or a floor that a scanned thing stands on, see `split_support`, so that N is
            the number of the other points, and the background of two depth pictures; "keep" keeps them.

    Returns:
        a `ScanRegistration`.

    Raises:
        InputError: if a number is out of range or not finite, a shape does not fit, or the paper's way is given a start
            or parts.
        InputTypeError: if a scan is none.

    Warns:
        DegenerateDataWarning: if a scan lies on a line or on a plane; the status is DEGENERATE.
        UnitsWarning: if one scan is more than seven times larger than the other, unless ``start`` is given.
        FileWarning: if a support or a background is left out.

    Differentiable: no; `GridLBS` is, for refining what was found.

    Cost: 1.3 to 3.5 s for scans of 8,000 points on one core, the alignment three quarters of it; a second
    more for 400,000, of which 16,000 to 32,000 stand for all until the end, see `clustered_scan`.

    References: Chang and Zwicker 2009, algorithm 1; Le and Deng 2012, for motions and weights in turn.
    """
    config = RegisterConfig() if config is None else config
    check_choice(support, "support", SUPPORTS)
    if support == "auto" and isinstance(source, DepthFrame) and isinstance(target, DepthFrame):
        # From the caller of `register` and its two decorators.
        source, target = moved_scans(source, target, stacklevel=3)
    source, target = _checked_scans(source, target, num_bones, grid_resolution)
    _check_start(source, start, confidence, config)
    parts = _checked_parts(source, parts, num_bones, config)
    if support == "auto":
        (source, kept), (target, _) = _without_support(source, "source"), _without_support(target, "target")
        start, confidence, parts = (
            rows if rows is None or kept is None else rows[kept.to(rows.device)] for rows in (start, confidence, parts)
        )
    origin = far_origin((source.points, target.points))
    source, target, start = to_local(source, origin), to_local(target, origin), to_local(start, origin)
    degenerate = warn_about_flat_scans((source, target), stacklevel=4)
    if start is None:
        warn_about_units((source, target), ("source", "target"), stacklevel=4)
    found = _registered(
        source, target, num_bones, grid_resolution, config, generator, on_step,
        start=start, confidence=confidence, parts=parts, degenerate=degenerate,
    )  # fmt: skip
    return to_world(found, origin)


def _registered(
    source: RangeScan,
    target: RangeScan,
    num_bones: int,
    grid_resolution: int,
    config: RegisterConfig,
    generator: torch.Generator | None,
    on_step: OnRegisterStep | None,
    *,
    start: Tensor | None,
    confidence: Tensor | None,
    parts: Tensor | None,
    degenerate: bool,
) -> ScanRegistration:
    """Run algorithm 1 on checked scans; arguments as of `register`."""
    clock = _Clock()
    fine_source, fine_target = source, target
    (source, chosen, nearest), (target, _, _) = (clustered_scan(scan, _MOST.points) for scan in (source, target))
    start, confidence, parts = (
        rows if rows is None else rows[chosen.to(rows.device)] for rows in (start, confidence, parts)
    )
    index = source_samples(source, config, generator)
    normalization = Normalization.from_points(source.points[index])
    normalized_source, normalized_target = (normalization.normalize_scan(scan) for scan in (source, target))
    # Line 1 of the algorithm: the grid, around all points.
    grid = SparseGrid.from_points(normalization.normalize(fine_source.points), grid_resolution)
    data = CellData(grid, normalized_source.points[index], CellData.PER_BONE * num_bones)
    clock.lap()
    # Line 2: first matches; by default a first alignment of all points, which alone tells how sure it is.
    sure: float | None = None
    fit: ReducedFit | PaperFit
    if config.printed is not None:
        fit = PaperFit(
            data, normalized_source, index, normalized_target, config, config.printed, num_bones=num_bones,
            generator=generator, on_step=on_step,
        )  # fmt: skip
    else:
        if start is None:
            aligned = align_scans(source, target, config.align, generator=generator, on_step=initial_records(on_step))
            start, confidence, sure = aligned.points, aligned.point_confidence, aligned.confidence
        samples = _aligned_samples(normalized_source, index, normalization.normalize(start), confidence)
        labels = None if parts is None else labels_of_parts(data, normalized_source.points, parts)
        targets = (normalized_target,)
        fit = ReducedFit(data, samples, targets, config, num_bones=num_bones, labels=labels, on_step=on_step)
    clock.lap()
    # Lines 3 to 8: motions, correspondences and labels in turn.
    converged = fit.fit_labels()
    clock.lap()
    # Line 9: continuous weights.
    converged = fit.refine() and converged
    clock.lap()
    result = _scan_registration(fine_source, fine_target, normalization, fit, converged, degenerate, clock.seconds)
    return result if sure is None or confidence is None else _trusted(result, sure, confidence[nearest])


def _trusted(result: ScanRegistration, sure: float, confidence: Tensor) -> ScanRegistration:
    """Return a result with how far it can be trusted: doubtful where its alignment is."""
    doubtful = sure < SCAN_CALIBRATION.doubtful and result.status.usable
    status = Status.DOUBTFUL if doubtful else result.status
    return replace(result, status=status, confidence=sure, point_confidence=confidence)


def _checked_scans(source: Any, target: Any, num_bones: int, grid_resolution: int) -> tuple[RangeScan, RangeScan]:
    """Return the scans; raise unless they are some and the numbers fit, and warn where they are rounded."""
    source, target = as_scan(source, "source"), as_scan(target, "target")
    check_inputs((source, target), num_bones, grid_resolution)
    # From the caller of `register` and its two decorators.
    warn_about_rounding(source.points, "points of source", source.diagonal, stacklevel=5)
    return source, target


def _without_support(scan: RangeScan, name: str) -> tuple[RangeScan, Tensor | None]:
    """Return a scan without what the scanned thing stands on, and a mask (N,) of its points; None for all of them."""
    split = split_support(scan)
    if split.plane is None:
        return scan, None
    # From the caller of `register` and its two decorators.
    warn_about_support(f"{int(split.mask.sum())} of {len(scan)} points of {name}", stacklevel=5)
    return scan.subset(~split.mask, mark_cut=True), ~split.mask


def _aligned_samples(source: RangeScan, index: Tensor, start: Tensor, confidence: Tensor | None) -> Samples:
    """Return the samples of a source whose points (N, 3) start at known positions, all confident by default."""
    confidence = torch.ones_like(start[:, 0]) if confidence is None else confidence.detach().cpu()
    return Samples.from_alignment(source, index, start[None], confidence[None])


def _scan_registration(
    source: RangeScan,
    target: RangeScan,
    normalization: Normalization,
    fit: ReducedFit | PaperFit,
    converged: bool,
    degenerate: bool,
    seconds: Tensor,
) -> ScanRegistration:
    """Return the registration of all points in the unit and frame of the source, from that of normalized scans."""
    config, like = fit.config, source.points
    points = normalization.normalize(source.points)
    weights, transforms = fit.model.weights_at(points), fit.model.transforms
    moved = fit.model.move(points, weights)[0]
    normals = turned_normals(source.normals.detach().cpu().double(), weights, transforms)[0]
    (matcher,) = fit.matchers
    matches = matcher.match(moved, normals, max_distance=config.max_distance[1], max_angle=config.max_angle[1])
    fit.model.set_transforms_(fit.model.transforms.detach()[0])
    model = fit.model.rescaled(normalization.scale, normalization.center).to(dtype=like.dtype, device=like.device)
    return ScanRegistration(
        model=model,
        points=like.detach(),
        faces=source.faces,
        deformed=normalization.denormalize(moved, like),
        labels=weights.argmax(-1).to(like.device),
        transforms=model.transforms.detach(),
        weights=weights.to(like),
        distances=(normalization.scale * nearest_neighbor(moved, normalization.normalize(target.points))[1]).to(like),
        matched=matches.kept.to(like.device),
        status=fit_status(int(matches.kept.sum()) / len(moved), converged, config, degenerate=degenerate),
        seconds=seconds,
        history=tuple(fit.history),
    )


def fit_status(matched: float, converged: bool, config: BoneConfig, *, degenerate: bool) -> Status:
    """Return the status of a fit that matched a share of the points of scans, degenerate ones or not."""
    if degenerate:
        return Status.DEGENERATE
    if matched == 0:
        return Status.NO_DATA
    if matched < config.min_matched:
        return Status.FEW_INLIERS
    return Status.CONVERGED if converged else Status.MAX_STEPS


class _Clock:
    """Seconds between laps: setup, initialization, alignment and refinement, as in the paper's table 1."""

    def __init__(self) -> None:
        self._marks = [time.perf_counter()]

    def lap(self) -> None:
        """End a stage."""
        self._marks.append(time.perf_counter())

    @property
    def seconds(self) -> Tensor:
        """Of each stage."""
        return torch.tensor(self._marks, dtype=torch.float64).diff()


def source_samples(scan: RangeScan, config: RegisterConfig, generator: torch.Generator | None) -> Tensor:
    """Return indices (n,) of the source points that are matched."""
    return scan.uniform_subsample(min(config.num_samples, len(scan)), generator=generator)


def initial_records(on_step: OnRegisterStep | None) -> Callable[[Any], None] | None:
    """Return the callback that hands on records of the dense alignment as those of the initialization."""
    if on_step is None:
        return None
    return lambda record: on_step(
        RegisterRecord(
            stage="initialize",
            step=record.step,
            num_steps=record.num_steps,
            distance=record.residual,
            joint=record.smoothness,
        )
    )


def check_inputs(scans: tuple[Any, ...], num_bones: int, grid_resolution: int) -> None:
    """Raise unless there are scans with an extent, and numbers in range."""
    for name, scan in zip(("source", "target"), (scans[0], scans[-1]), strict=True):
        if not scan.diagonal > 0:
            raise InputError(f"{name} must have points at different places")
    check_count(num_bones, "num_bones", 1)
    check_count(grid_resolution, "grid_resolution", 1)
    if grid_resolution > MAX_RESOLUTION:
        raise InputError(f"grid_resolution must be at most {MAX_RESOLUTION}, got {grid_resolution}")


def warn_about_flat_scans(scans: Sequence[RangeScan], *, stacklevel: int) -> bool:
    """Return whether a scan lies on a line or on a plane, in which it may slide; warn if one does."""
    spreads = [int(spread_dimensions(scan.points, scan.diagonal)) for scan in scans]
    if min(spreads) >= len(SPREADS):
        return False
    warnings.warn(
        f"the points of scan {spreads.index(min(spreads))} lie {SPREADS[min(spreads)]}, within a thousandth of their "
        f"extent: along it their motion is not determined",
        DegenerateDataWarning,
        stacklevel=stacklevel + 1,
    )
    return True


@dataclass(frozen=True)
class _Units:
    """When scans of one thing seem to be in different units."""

    ratio: float = 7.0  # of their sizes: no pose and no crop of one thing explains more, and units differ by 10 or more


_UNITS = _Units()


def warn_about_units(scans: Sequence[RangeScan], names: Sequence[str], *, stacklevel: int) -> None:
    """Warn if the size of a scan differs so much from the typical one that no pose and no crop explains it."""
    sizes = torch.tensor([robust_size(scan.points) for scan in scans])
    typical = int(sizes.median(0).indices)
    odd = int((sizes / sizes[typical]).log().abs().argmax())
    ratio = float(sizes[odd] / sizes[typical])
    if 1 / _UNITS.ratio < ratio < _UNITS.ratio:
        return
    unit, other, factor = likely_pair(ratio)
    options = " ".join(f"--scale {factor if number == odd else 1:.4g}" for number in range(len(scans)))
    warnings.warn(
        f"{names[odd]} is {max(ratio, 1 / ratio):.4g} times as {'large' if ratio > 1 else 'small'} as "
        f"{names[typical]}: are they in one unit? If {names[odd]} is in {unit} and {names[typical]} in {other}, "
        f"load {names[odd]} with a scale of {factor:.4g}{f' ({options})' if len(scans) == 2 else ''}",
        UnitsWarning,
        stacklevel=stacklevel + 1,
    )


def _checked_parts(source: RangeScan, parts: Any, num_bones: int, config: RegisterConfig) -> Tensor | None:
    """Return known parts (N,) as int64 on the CPU; raise unless they fit the source and the number of bones."""
    if parts is None:
        return None
    _check_unused("parts", config)
    parts = as_tensor(parts, "parts", "integers")
    if parts.is_floating_point() or parts.dtype == torch.bool:
        raise InputTypeError(f"parts must be integers, got {parts.dtype}")
    check_shape(parts, "parts", (len(source),))
    if not 0 <= int(parts.min()) <= int(parts.max()) < num_bones:
        raise InputError(
            f"parts must be from 0 to num_bones - 1 = {num_bones - 1}, got {int(parts.min())} to {int(parts.max())}"
        )
    return parts.detach().cpu().long()


def _check_unused(name: str, config: RegisterConfig) -> None:
    """Raise if the algorithm as printed is given what replaces its own first steps."""
    if config.printed is not None:
        raise InputError(
            f"{name} cannot be used by RegisterConfig.paper(), which begins with a random segmentation and spin "
            f"images; leave out {name}, or use RegisterConfig()"
        )


def _check_start(source: RangeScan, start: Any, confidence: Any, config: RegisterConfig) -> None:
    """Raise unless a known start fits the source."""
    if start is None:
        if confidence is not None:
            raise InputError("confidence is that of start; give both or neither")
        return
    _check_unused("start", config)
    start = as_float_tensor(start, "start")
    check_shape(start, "start", tuple(source.points.shape))
    check_finite(start, "start")
    if confidence is not None:
        confidence = as_float_tensor(confidence, "confidence")
        check_shape(confidence, "confidence", (len(source),))
        check_finite(confidence, "confidence")
        if bool((confidence < 0).any()):
            raise InputError(f"confidence must not be negative, got {float(confidence.min()):g}")
