"""Registering many range scans of one thing together: one set of bones and weights, motions for every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchreg._checks import check_count
from torchreg._threads import one_thread
from torchreg.errors import InputError
from torchreg.geometry.neighbors import nearest_neighbor
from torchreg.geometry.range_scan import RangeScan
from torchreg.registration.bones.alternation import ReducedFit, Samples, turned_normals
from torchreg.registration.bones.config import OnRegisterStep
from torchreg.registration.bones.labels import CellData
from torchreg.registration.bones.sparse_grid import SparseGrid
from torchreg.registration.config import RegisterConfig
from torchreg.registration.dense.align_scans import align_scans
from torchreg.registration.normalization import Normalization
from torchreg.registration.register import (
    LEAST_CONFIDENCE,
    check_inputs,
    fit_status,
    initial_records,
    register,
    source_samples,
)
from torchreg.registration.results import SequenceRegistration

# From frame to frame few large bones carry the reference: what many small ones take over from noise adds up, and so
# does what slides along the surface. They have no room for all joints, so that none of them may be firm.
_CARRIED_LABEL_COST, _CARRIED_SMOOTHNESS, _CARRIED_POINT_TO_POINT, _CARRIED_JOINTS = 0.002, 0.2, 0.1, 1e-4
# Together, frames tell more of joints, so that these may be firm; what no frame tells is lost again in each of them, so
# that bones hold each other in wide turns too, radians; and places along the surface, which drift, count less.
_HELD_JOINTS, _HELD_TURNS, _HELD_POINT_TO_POINT = 0.01, 0.5, 0.001
# Parts may start from smaller patches, and wide motions tear more where parts meet, cells.
_HELD_PATCHES, _HELD_SEAM_CAP = 200, 1.0
# What moves along the surface settles slowly, and borders between parts are where settled motions agree.
_HELD_MATCH_STEPS, _HELD_REFINE_STEPS, _HELD_SETTLE_STEPS, _HELD_RTOL = 4, 3, 4, 0.02
# Share of its last step by which a point is expected to move on: hidden limbs would run away with the whole.
_GOES_ON = 0.5


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
    reference: int = 0,
) -> SequenceRegistration:
    """Return one set of bones and weights that takes a reference scan onto all scans, and what all of them show.

    Going from the reference outward, the reference as moved for one frame is aligned with the next, its points expected
    to go on somewhat as they went, and a few bones are fitted to that: every frame is reached by bending the reference
    itself, not what earlier frames made of it, so that errors do not pile up. Then labels, weights and the motions of
    all frames are solved together, from the alignments; bones that meet had better turn about one axis in all frames.

    Args:
        scans: T scans of one thing, two at least, in one unit and frame; motions between neighbors as in `register`.
        num_bones: see `register`.
        grid_resolution: see `register`.
        config: see `RegisterConfig`.
        generator: source of randomness; None draws the same numbers at every call.
        on_step: called with a `RegisterRecord` after each step.
        reference: number of the scan that is moved.

    Returns:
        a `SequenceRegistration`.

    Raises:
        InputError: if there are fewer than two scans, or a number is out of range.
        InputTypeError: if a scan is none.

    Differentiable: no.

    Cost: that of `register` for every frame, and three quarters of a second each for the joint fit.

    References: Chang and Zwicker 2009, section 6, which asks for a simultaneous optimization.
    """
    config = RegisterConfig() if config is None else config
    scans = tuple(scans)
    if len(scans) < 2:
        raise InputError(f"scans must hold at least two, got {len(scans)}")
    for scan in scans:
        check_inputs((scan, scan), num_bones, grid_resolution)
    check_count(reference, "reference", 0)
    if reference >= len(scans):
        raise InputError(f"reference must be below the number of scans {len(scans)}, got {reference}")
    source = scans[reference]
    index = source_samples(source, config, generator)
    normalization = Normalization.from_points(source.points[index])
    reached, confidence = _chain(scans, reference, num_bones, grid_resolution, _carrying(config), generator, on_step)
    scan = normalization.normalize_scan(source)
    held = _held(config)
    grid = SparseGrid.from_points(scan.points, grid_resolution)
    data = CellData(grid, scan.points[index], held.num_patches, linked=True)
    places = normalization.normalize(reached)[:, index]
    trust = confidence[:, index].double().clamp(min=LEAST_CONFIDENCE)
    samples = Samples(scan.points[index], scan.normals[index], places, trust)
    fit = ReducedFit(data, samples, [normalization.normalize_scan(other) for other in scans], num_bones, held, on_step)
    settled = fit.fit_labels()
    settled = fit.refine() and settled
    return _result(scans, reference, normalization, fit, settled)


def _carrying(config: RegisterConfig) -> RegisterConfig:
    """Return settings for the few bones that carry the reference from frame to frame."""
    first, last = config.joint_weight
    return replace(
        config,
        label_cost=max(config.label_cost, _CARRIED_LABEL_COST),
        smoothness=max(config.smoothness, _CARRIED_SMOOTHNESS),
        point_to_point=max(config.point_to_point, _CARRIED_POINT_TO_POINT),
        joint_weight=(min(first, _CARRIED_JOINTS), min(last, _CARRIED_JOINTS)),
        settle_steps=0,
    )


def _held(config: RegisterConfig) -> RegisterConfig:
    """Return settings for all frames together."""
    first, last = (max(weight, _HELD_JOINTS) if weight > 0 else weight for weight in config.joint_weight)
    return replace(
        config,
        num_patches=max(config.num_patches, _HELD_PATCHES),
        match_steps=max(config.match_steps, _HELD_MATCH_STEPS),
        refine_steps=max(config.refine_steps, _HELD_REFINE_STEPS) if config.refine_steps > 0 else 0,
        settle_steps=max(config.settle_steps, _HELD_SETTLE_STEPS),
        rtol=min(config.rtol, _HELD_RTOL),
        joint_weight=(first, last),
        turn_scale=max(config.turn_scale, _HELD_TURNS),
        point_to_point=min(config.point_to_point, _HELD_POINT_TO_POINT),
        seam_cap=max(config.seam_cap, _HELD_SEAM_CAP),
    )


def _chain(
    scans: tuple[RangeScan, ...],
    reference: int,
    num_bones: int,
    grid_resolution: int,
    config: RegisterConfig,
    generator: torch.Generator | None,
    on_step: OnRegisterStep | None,
) -> tuple[Tensor, Tensor]:
    """Return where the reference's points are in every frame, (T, N, 3), and how far that can be trusted, (T, N).

    The dense alignments tell, in which small parts move that the few bones carried on have no room for.
    """
    source, ones = scans[reference], torch.ones(len(scans[reference]))
    carried, reached, trust = {reference: source.points}, {reference: source.points}, {reference: ones}
    for step, end in ((1, len(scans)), (-1, -1)):
        current = source
        for frame in range(reference + step, end, step):
            aligned = align_scans(
                current, scans[frame], config.align,
                generator=generator, on_step=initial_records(on_step), expected=_expected(carried, frame, step),
            )  # fmt: skip
            reached[frame], trust[frame] = aligned.points, aligned.confidence
            if frame + step == end:
                break
            found = register(
                source, scans[frame], num_bones, grid_resolution, config, generator,
                start=aligned.points, confidence=aligned.confidence,
            )  # fmt: skip
            carried[frame] = found.deformed
            normals = turned_normals(source.normals, found.weights, found.transforms)
            current = RangeScan(found.deformed, source.faces, normals)
    frames = range(len(scans))
    return torch.stack([reached[frame] for frame in frames]), torch.stack([trust[frame].cpu() for frame in frames])


def _expected(places: dict[int, Tensor], frame: int, step: int) -> Tensor | None:
    """Return where points (N, 3) are expected in a frame by their last step, if that is known."""
    last, before = places[frame - step], places.get(frame - 2 * step)
    return None if before is None else last + _GOES_ON * (last - before)


def _result(
    scans: tuple[RangeScan, ...], reference: int, normalization: Normalization, fit: ReducedFit, settled: bool
) -> SequenceRegistration:
    """Return what was found, in the unit and frame of the scans."""
    source = scans[reference]
    like, points = source.points, normalization.normalize(source.points)
    weights = fit.model.weights_at(points)
    moved = fit.model.move(points, weights)
    fused, normals, frames = _fused(scans, normalization, moved, weights, fit.model.transforms.detach())
    shares = fit.history[-1].kept / (len(scans) * len(fit.samples.points))
    model = fit.model.rescaled(normalization.scale, normalization.center).to(dtype=like.dtype, device=like.device)
    return SequenceRegistration(
        model,
        like.detach(),
        source.faces,
        normalization.denormalize(moved, like),
        weights.argmax(-1).to(like.device),
        model.transforms.detach(),
        weights.to(like),
        normalization.denormalize(fused, like),
        normals.to(like),
        frames.to(like.device),
        reference,
        fit_status(shares, settled, fit.config),
        tuple(fit.history),
    )


def _fused(
    scans: tuple[RangeScan, ...], normalization: Normalization, moved: Tensor, weights: Tensor, transforms: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return all points (K, 3) of all scans in the pose of the reference, their normals and the frames they are from.

    Every point moves back as the nearest point of the moved reference came.
    """
    places, sides, frames = [], [], []
    for frame, scan in enumerate(scans):
        local = normalization.normalize_scan(scan)
        near, _ = nearest_neighbor(local.points, moved[frame])
        blended = torch.einsum("nb,bij->nij", weights[near], transforms[frame])
        shift = (local.points - blended[:, :3, 3]).unsqueeze(-1)
        places.append(torch.linalg.solve(blended[:, :3, :3], shift).squeeze(-1))
        back = torch.linalg.solve(blended[:, :3, :3], local.normals.unsqueeze(-1)).squeeze(-1)
        sides.append(torch.nn.functional.normalize(back, dim=-1))
        frames.append(torch.full((len(scan),), frame))
    return torch.cat(places), torch.cat(sides), torch.cat(frames)
