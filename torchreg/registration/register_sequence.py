"""Registering many range scans of one thing together: one set of bones and weights, motions for every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from torchreg._checks import check_count, warn_about_rounding
from torchreg._threads import one_thread
from torchreg.errors import InputError
from torchreg.geometry.far_origin import far_origin, to_local, to_world
from torchreg.geometry.loaded import as_scan
from torchreg.geometry.neighbors import nearest_neighbor
from torchreg.geometry.range_scan import RangeScan
from torchreg.registration.bones.alternation import ReducedFit, Samples, turned_normals
from torchreg.registration.bones.config import OnRegisterStep
from torchreg.registration.bones.labels import CellData
from torchreg.registration.bones.sparse_grid import SparseGrid
from torchreg.registration.config import RegisterConfig
from torchreg.registration.dense.align_scans import align_scans
from torchreg.registration.dense.problem import ExpectedPlaces
from torchreg.registration.dense.reliability import SCAN_CALIBRATION, confidence_onward
from torchreg.registration.frame_tree import FrameTree
from torchreg.registration.normalization import Normalization
from torchreg.registration.register import (
    check_inputs,
    fit_status,
    initial_records,
    register,
    source_samples,
    warn_about_flat_scans,
    warn_about_units,
)
from torchreg.registration.results import SequenceRegistration
from torchreg.result import Status


@dataclass(frozen=True)
class FrameToFrame:
    """Bounds on the settings by which the reference is transferred from frame to frame, by few large bones."""

    label_cost: float = 0.002
    smoothness: float = 0.2
    point_to_point: float = 0.1
    joint_weight: float = 1e-4

    def apply(self, config: RegisterConfig) -> RegisterConfig:
        """Return the settings within the bounds."""
        first, last = config.joint_weight
        return replace(
            config,
            label_cost=max(config.label_cost, self.label_cost),
            smoothness=max(config.smoothness, self.smoothness),
            point_to_point=max(config.point_to_point, self.point_to_point),
            joint_weight=(min(first, self.joint_weight), min(last, self.joint_weight)),
        )


@dataclass(frozen=True)
class Motion:
    """Steps of points from frame to frame as an autoregression whose share and variance are estimated from them."""

    momentum: float = 0.5  # the prior share of the last step that is kept; with all of it, hidden limbs would run away

    def predict(self, places: Sequence[Tensor], seen: Tensor | None = None) -> ExpectedPlaces | None:
        """Return the expected positions of points (N, 3) after the places so far, latest last; None before two of them.

        ``seen`` (N,) is how surely a point was observed in the latest place: a hidden point's last step is a
        prediction.
        """
        if len(places) < 2:
            return None
        steps = torch.stack(tuple(places)).diff(dim=0)
        before, after = steps[:-1], steps[1:]
        power, tiny = steps[0].square().mean(), torch.finfo(steps.dtype).tiny
        together = self.momentum * power + (before * after).mean((1, 2)).sum()
        kept = (together / (power + before.square().mean((1, 2)).sum()).clamp_min(tiny)).clamp(0, 1)
        new = (1 - self.momentum**2) * power + (after - kept * before).square().mean((1, 2)).sum()
        share = kept if seen is None else torch.lerp(torch.full_like(seen, self.momentum), kept, seen).unsqueeze(1)
        return ExpectedPlaces(places[-1] + share * steps[-1], float(new / len(steps)) ** 0.5)


@dataclass(frozen=True)
class AllFrames:
    """Bounds on the settings by which all frames are fitted together."""

    match_steps: int = 4  # lower bound; borders between parts are drawn by motions, which should have converged
    refine_steps: int = 3  # lower bound, unless there are none
    rtol: float = 0.02  # upper bound; displacements along the surface converge slowly
    joint_weight: float = 0.01  # lower bound, unless joints are left out; many frames determine joints well
    # lower bound, radians; bones hold each other in wide turns too, else each frame loses twists anew
    turn_scale: float = 0.5
    point_to_point: float = 0.001  # upper bound; positions along the surface drift

    def apply(self, config: RegisterConfig) -> RegisterConfig:
        """Return the settings within the bounds."""
        first, last = (max(weight, self.joint_weight) if weight > 0 else weight for weight in config.joint_weight)
        return replace(
            config,
            match_steps=max(config.match_steps, self.match_steps),
            refine_steps=max(config.refine_steps, self.refine_steps) if config.refine_steps > 0 else 0,
            rtol=min(config.rtol, self.rtol),
            joint_weight=(first, last),
            turn_scale=max(config.turn_scale, self.turn_scale),
            point_to_point=min(config.point_to_point, self.point_to_point),
        )


FRAME_TO_FRAME = FrameToFrame()
MOTION = Motion()
ALL_FRAMES = AllFrames()


@torch.no_grad()
@one_thread()
def register_sequence(
    scans: Sequence[RangeScan],
    num_bones: int = 20,
    grid_resolution: int = 50,
    config: RegisterConfig | None = None,
    generator: torch.Generator | None = None,
    on_step: OnRegisterStep | None = None,
    *,
    reference: int | Literal["auto"] = 0,
) -> SequenceRegistration:
    """Return one set of bones and weights that takes a reference scan onto all scans, and what all of them show.

    From the reference outward, the reference as moved to one frame is aligned with the next, its points expected where
    an autoregression of their steps predicts them, and a few bones are fitted to that alignment: every frame is reached
    by deforming the reference itself, so that errors do not pile up. Then labels, weights and the motions of all frames
    are solved together, from the alignments; a hinge prior penalizes rotation between bones that share weight about
    more than one axis.

    Args:
        scans: T scans of one thing, two at least, in one unit and frame; motions between neighbors as in `register`.
        num_bones: see `register`.
        grid_resolution: see `register`.
        config: see `RegisterConfig`.
        generator: source of randomness; None draws the same numbers at every call.
        on_step: called with a `RegisterRecord` after each step.
        reference: number of the scan that is moved, from which the others are reached in turn; "auto" for scans in any
            order takes the one most like the others, and reaches each scan from that most like it.

    Returns:
        a `SequenceRegistration`.

    Raises:
        InputError: if there are fewer than two scans, or a number is out of range.
        InputTypeError: if a scan is none.

    Warns:
        DegenerateDataWarning: if a scan lies on a line or on a plane; the status is DEGENERATE.
        UnitsWarning: if one scan is more than seven times larger or smaller than the others.

    Differentiable: no.

    Cost: that of `register` for every frame, and three quarters of a second each for the joint fit.

    References: Chang and Zwicker 2009, section 6, which asks for a simultaneous optimization.
    """
    config = RegisterConfig() if config is None else config
    if config.printed is not None:
        raise InputError(
            "config must be a RegisterConfig without printed, got one of RegisterConfig.paper(), which registers pairs "
            "only, as the paper does; call register for each pair"
        )
    scans = tuple(as_scan(scan, f"scans[{number}]") for number, scan in enumerate(scans))
    if len(scans) < 2:
        raise InputError(f"scans must hold at least two, got {len(scans)}")
    for scan in scans:
        check_inputs((scan, scan), num_bones, grid_resolution)
    warn_about_rounding(scans[0].points, "points of scans", scans[0].diagonal, stacklevel=4)
    _check_reference(reference, len(scans))
    origin = far_origin([scan.points for scan in scans])
    scans = tuple(to_local(scan, origin) for scan in scans)
    degenerate = warn_about_flat_scans(scans, stacklevel=4)
    warn_about_units(scans, [f"scans[{number}]" for number in range(len(scans))], stacklevel=4)
    tree = (
        FrameTree.alike([scan.points for scan in scans])
        if reference == "auto"
        else FrameTree.in_turn(reference, len(scans))
    )
    reference = tree.order[0]
    source = scans[reference]
    index = source_samples(source, config, generator)
    normalization = Normalization.from_points(source.points[index])
    moved, confidence, sure = aligned_frames(
        scans, tree, num_bones, grid_resolution, config, generator=generator, on_step=on_step
    )
    normalized = [normalization.normalize_scan(scan) for scan in scans]
    normalized_source, config = normalized[reference], ALL_FRAMES.apply(config)
    grid = SparseGrid.from_points(normalized_source.points, grid_resolution)
    data = CellData(grid, normalized_source.points[index], CellData.PER_BONE * num_bones, linked=True)
    samples = Samples.from_alignment(normalized_source, index, normalization.normalize(moved), confidence)
    fit = ReducedFit(data, samples, normalized, config, num_bones=num_bones, on_step=on_step)
    converged = fit.fit_labels()
    converged = fit.refine() and converged
    found = _sequence_registration(source, reference, normalized, normalization, fit, converged, degenerate)
    doubtful = bool((sure < SCAN_CALIBRATION.doubtful).any()) and found.status.usable
    return to_world(replace(found, confidence=sure, status=Status.DOUBTFUL if doubtful else found.status), origin)


def _check_reference(reference: int | Literal["auto"], count: int) -> None:
    """Raise InputError unless a reference is "auto" or the number of one of so many scans."""
    if reference != "auto":
        check_count(reference, "reference", 0)
        if reference >= count:
            raise InputError(f"reference must be below the number of scans {count}, got {reference}")


def aligned_frames(
    scans: tuple[RangeScan, ...],
    tree: FrameTree,
    num_bones: int,
    grid_resolution: int,
    config: RegisterConfig,
    *,
    generator: torch.Generator | None = None,
    on_step: OnRegisterStep | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the reference's points aligned with every frame, (T, N, 3), their confidence (T, N), and that of frames.

    They come from the dense alignments, in which small parts move that the few bones cannot represent.
    """
    few_bones = FRAME_TO_FRAME.apply(config)
    reference = tree.order[0]
    source = scans[reference]
    aligned, confidence = {reference: source.points}, {reference: torch.ones(len(source)).to(source.points)}
    deformed, sure = {reference: source}, torch.ones(len(scans)).to(source.points)
    for frame in tree.order[1:]:
        parent = tree.parents[frame]
        found = align_scans(
            deformed[parent], scans[frame], config.align,
            generator=generator, on_step=initial_records(on_step),
            expected=MOTION.predict([deformed[past].points for past in tree.path(parent)], confidence[parent]),
        )  # fmt: skip
        aligned[frame], confidence[frame] = found.points, found.point_confidence
        sure[frame] = confidence_onward(float(sure[parent]), found.confidence)
        if frame not in tree.parents:
            continue
        bent = register(
            source, scans[frame], num_bones, grid_resolution, few_bones, generator,
            start=found.points, confidence=found.point_confidence,
        )  # fmt: skip
        normals = turned_normals(source.normals, bent.weights, bent.transforms)
        deformed[frame] = RangeScan(bent.deformed, source.faces, normals)
    frames = range(len(scans))
    points, confident = ([each[frame] for frame in frames] for each in (aligned, confidence))
    return torch.stack(points), torch.stack(confident).cpu(), sure


def _sequence_registration(
    source: RangeScan,
    reference: int,
    scans: Sequence[RangeScan],
    normalization: Normalization,
    fit: ReducedFit,
    converged: bool,
    degenerate: bool,
) -> SequenceRegistration:
    """Return the registration in the unit and frame of the source, from that of the normalized scans."""
    like, points = source.points, scans[reference].points
    weights = fit.model.weights_at(points)
    moved = fit.model.move(points, weights)
    fused, normals, frames = _back_to_reference(scans, moved, weights, fit.model.transforms.detach())
    matched = fit.history[-1].kept / (len(scans) * len(fit.samples.points))
    model = fit.model.rescaled(normalization.scale, normalization.center).to(dtype=like.dtype, device=like.device)
    return SequenceRegistration(
        model=model,
        points=like.detach(),
        faces=source.faces,
        deformed=normalization.denormalize(moved, like),
        labels=weights.argmax(-1).to(like.device),
        transforms=model.transforms.detach(),
        weights=weights.to(like),
        fused=normalization.denormalize(fused, like),
        fused_normals=normals.to(like),
        fused_frames=frames.to(like.device),
        observed=normalization.denormalize(torch.cat([scan.points for scan in scans]), like),
        observed_normals=torch.cat([scan.normals for scan in scans]).to(like),
        reference=reference,
        status=fit_status(matched, converged, fit.config, degenerate=degenerate),
        history=tuple(fit.history),
    )


def _back_to_reference(
    scans: Sequence[RangeScan], moved: Tensor, weights: Tensor, transforms: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return all points (K, 3) of all scans in the pose of the reference, their normals and their frames (K,)."""
    points, normals, frames = [], [], []
    for frame, scan in enumerate(scans):
        nearest, _ = nearest_neighbor(scan.points, moved[frame])
        motions = torch.einsum("nb,bij->nij", weights[nearest], transforms[frame])
        offsets = (scan.points - motions[:, :3, 3]).unsqueeze(-1)
        points.append(torch.linalg.solve(motions[:, :3, :3], offsets).squeeze(-1))
        turned = torch.linalg.solve(motions[:, :3, :3], scan.normals.unsqueeze(-1)).squeeze(-1)
        normals.append(torch.nn.functional.normalize(turned, dim=-1))
        frames.append(torch.full((len(scan),), frame))
    return torch.cat(points), torch.cat(normals), torch.cat(frames)
