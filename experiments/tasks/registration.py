"""A scan registered to another with known truth: the share of points near it, parts, joints, and time."""

from __future__ import annotations

import functools
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import torchreg as tr
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.hand import faces_of, hand_motion, surface_skin
from torchreg.datasets.scan_sequences import ScanPair, ScanSequence, jointed_toy
from torchreg.datasets.toys import robot
from torchreg.viz.bone_colors import error_colors
from torchreg.viz.figures import save_scene
from torchreg.viz.scan_gltf import save_grid_animation
from torchreg.viz.scene import MovingMesh, Scene

from ..errors import SkippedTrial
from ..library_settings import with_settings
from ..made_up.moving_labels import moving_labels
from ..made_up.toys import excavator
from ..made_up.walks import walking_animal, walking_figure
from ..registry import Bench, TrialOutcome
from ..schema import RegistrationTrial, ScanPairConfig
from ..tasks.peers import PACKAGES, moved_by

# A point is near its true place within this share of the diagonal; a pair is registered if this share of them is near.
NEAR, REGISTERED, JOINT = 0.025, 0.9, 0.05
# Names of the paper's table 1 for the four stages.
STAGES = ("setup", "initialize", "align", "weights")
# Noise of the scanner of the hand, 1/m: 0.2 mm at 0.6 m, as of structured light.
HAND_NOISE = 6e-4
# Reach and grid resolution of the paper's way, times its own, in the first try and in others: section 5 blames either.
RETRIES = ((1.0, 1.0), (1.0, 1.0), (1.5, 1.0), (1.0, 0.8), (1.5, 1.25), (2.0, 0.8))
PICTURE_PIXELS = (300, 300)


@dataclass(frozen=True)
class Problem:
    """Two scans and the true positions (N, 3) of the source's points; the full truth if the scans are made up."""

    source: tr.RangeScan
    target: tr.RangeScan
    truth: Tensor
    diagonal: float
    pair: ScanPair | None = None


def run(config: RegistrationTrial, bench: Bench) -> TrialOutcome:
    """Return the errors of a registration."""
    problem = make_problem(config.pair, config.seed)
    sizes = {"vertices": float(len(problem.source.points)), "target_vertices": float(len(problem.target.points))}
    begin = time.perf_counter()
    if config.method in PACKAGES:
        moved = moved_by(config.method, problem.source.points, problem.target.points)
        return TrialOutcome(sizes | _accuracy(problem, moved), {"total": time.perf_counter() - begin})
    found, tried = _registered(problem, config)
    seconds = dict(zip(STAGES, found.seconds.tolist(), strict=True)) | {"total": float(found.seconds.sum())}
    metrics = sizes | _accuracy(problem, found.deformed) | _model_metrics(problem, found)
    if config.method == "paper":
        metrics |= {"first_try": float(tried == 1 and bool(metrics["registered"])), "tries": float(tried)}
    outcome = TrialOutcome(metrics, seconds, _curves(found))
    if config.pictures and problem.source.faces is not None:
        outcome.artifacts = _artifacts(problem, problem.source.faces, found, bench)
    return outcome


def _registered(problem: Problem, config: RegistrationTrial) -> tuple[tr.ScanRegistration, int]:
    """Return the registration, and the number of the try that registered the pair, or of the last one."""
    settings = _settings(config)
    for number, (reach, finer) in enumerate(RETRIES[: config.retries + 1]):
        changed = settings
        if settings.printed is not None:
            printed = replace(settings.printed, max_distance=reach * settings.printed.max_distance)
            changed = replace(settings, printed=printed)
        found = tr.register(
            problem.source, problem.target, num_bones=config.num_bones, config=changed,
            grid_resolution=round(finer * config.grid_resolution), generator=torch.Generator().manual_seed(number),
        )  # fmt: skip
        if _accuracy(problem, found.deformed)["registered"]:
            break
    return found, number + 1


def _curves(found: tr.ScanRegistration) -> dict[str, list[float]]:
    return {
        "distance_percent": [100 * math.sqrt(step.distance) for step in found.history],
        "labels": [float(step.num_labels) for step in found.history],
        "kept": [float(step.kept) for step in found.history],
        **{name: [step.energies[name] for step in found.history] for name in _energy_names(found)},
    }


def _energy_names(found: tr.ScanRegistration) -> list[str]:
    return list(found.history[0].energies) if found.history else []


def _settings(config: RegistrationTrial) -> tr.RegisterConfig:
    if config.method == "paper":
        return with_settings(tr.RegisterConfig.paper(), config.config)
    settings = tr.RegisterConfig(
        joint_weight=(10 * config.joint_weight, config.joint_weight),
        refine_steps=config.refine_steps,
        num_samples=config.num_samples,
    )
    return with_settings(settings, config.config)


@functools.lru_cache(maxsize=2)
def make_problem(config: ScanPairConfig, seed: int) -> Problem:
    """Return the scans of a trial: the first pair of a different motion for every seed.

    Raises:
        SkippedTrial: if a file is asked for that is not here.
    """
    if config.dataset == "file":
        return _from_file(Path(config.folder) / f"{config.name}.npz")
    if config.dataset == "hand":
        return _hand_pair(config, seed)
    frames = config.frames or config.frame + config.apart + 1
    pair = _sequence(config.dataset, frames, seed, config.num_points).pair(config.frame, config.frame + config.apart)
    return Problem(pair.source, pair.target, pair.truth, pair.source.diagonal, pair)


@functools.lru_cache(maxsize=2)
def _sequence(dataset: str, frames: int, seed: int, num_points: int) -> ScanSequence:
    scanner = DepthScanner(num_points=num_points)
    if dataset in ("toy", "robot", "car"):
        toy = excavator() if dataset == "car" else robot()
        return jointed_toy(frames, seed, toy=toy, missing=dataset == "toy", scanner=scanner)
    return (walking_figure if dataset == "figure" else walking_animal)(frames, seed, scanner=scanner)


@functools.lru_cache(maxsize=2)
def _moving_hand(frames: int, seed: int) -> tuple[Tensor, Tensor]:
    """Return the surfaces (T, V, 3) of a hand whose fingers bend, at 15 frames a second, and its faces (F, 3)."""
    hand = tr.Hand().requires_grad_(False)
    skin = surface_skin(hand)
    with torch.no_grad():
        poses = hand_motion(hand, "bending_palm", frames, fps=15.0, seed=seed)
        return torch.stack([skin(pose) for pose in poses]), faces_of(skin)


def _hand_pair(config: ScanPairConfig, seed: int) -> Problem:
    """Return two scans of a moving hand; a camera that measures as precisely as one that stands as near to it."""
    surfaces, faces = _moving_hand(config.frames or config.frame + config.apart + 1, seed)
    first, second = surfaces[config.frame], surfaces[config.frame + config.apart]
    scanner = DepthScanner(num_points=config.num_points, noise=HAND_NOISE)
    view = scanner.view(tr.TriangleMesh(first, faces), reach=0.25)
    scans = [
        scanner.scan(tr.TriangleMesh(mesh, faces), view, torch.Generator().manual_seed(number), torch.float32)
        for number, mesh in enumerate((first, second))
    ]
    truth = scans[0].transferred(second, faces)
    return Problem(scans[0].scan, scans[1].scan, truth, scans[0].scan.diagonal)


def _from_file(path: Path) -> Problem:
    if not path.is_file():
        raise SkippedTrial(f"there is no file {path}; say where the data lie with pair.folder=FOLDER")
    with np.load(path, allow_pickle=False) as file:
        source = tr.RangeScan(file["source_points"], file["source_faces"])
        target = tr.RangeScan(file["target_points"], file["target_faces"])
        return Problem(source, target, torch.from_numpy(file["source_truth"]), float(file["diagonal"]))


def _accuracy(problem: Problem, moved: Tensor) -> dict[str, float]:
    """Return errors of moved points, without those of a part that the target lacks."""
    known = torch.ones(len(moved), dtype=torch.bool) if problem.pair is None else ~problem.pair.missing
    errors = ((moved - problem.truth).norm(dim=-1) / problem.diagonal)[known]
    before = ((problem.source.points - problem.truth).norm(dim=-1) / problem.diagonal)[known]
    near = float((errors < NEAR).double().mean())
    return {
        "registered": float(near >= REGISTERED),
        "near_percent": 100 * near,
        "error_percent": 100 * float(errors.mean()),
        "motion_percent": 100 * float(before.mean()),
    }


@torch.no_grad()
def _model_metrics(problem: Problem, found: tr.ScanRegistration) -> dict[str, float]:
    grid = found.model.grid
    metrics = {
        "bones": float(len(found.transforms)),
        "correspondences": float(found.history[-1].kept if found.history else 0),
        "cells": float(grid.num_cells),
        "corners": float(grid.num_corners),
        "matched_percent": 100 * float(found.matched.double().mean()),
    }
    pair = problem.pair
    if pair is None:
        return metrics
    metrics["rand_index"] = float(tr.metrics.adjusted_rand(found.parts(), moving_labels(pair)))
    gaps = _joint_gaps(found, pair)
    metrics["joints_right"] = sum(gap < JOINT for gap in gaps) / len(gaps) if gaps else math.nan
    return metrics


def _joint_gaps(found: tr.ScanRegistration, pair: ScanPair) -> list[float]:
    """Return distances of true joints, of parts that moved apart, from the nearest ones found; shares of the size."""
    moving, labels = moving_labels(pair), pair.labels
    part = {int(label): int(moving[labels == label][0]) for label in labels.unique()}
    centers, gaps = found.model.joints().centers, []
    for (parent, child), place in zip(pair.joint_parts.tolist(), pair.joints, strict=True):
        if parent in part and child in part and part[parent] != part[child]:
            near = float((centers - place).norm(dim=-1).min()) if len(centers) else math.inf
            gaps.append(near / pair.source.diagonal)
    return gaps


def _artifacts(problem: Problem, faces: Tensor, found: tr.ScanRegistration, bench: Bench) -> dict[str, str]:
    """Keep the model, and a picture of the moved source: blue where it is right, red from the bound of near on."""
    errors = (found.deformed - problem.truth).norm(dim=-1) / problem.diagonal
    shown = Scene("", (MovingMesh("errors", found.deformed, faces, error_colors(errors, NEAR)),))
    save_scene(bench.file("errors.png"), shown, size=PICTURE_PIXELS)
    save_grid_animation(bench.file("bones.glb"), found.model, problem.source.points, faces)
    return {"errors": "errors.png", "bones": "bones.glb"}
