"""A scan registered to another with known truth: the share of points near it, parts, joints, and time."""

from __future__ import annotations

import functools
import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import torchreg as tr
from experiments.errors import SkippedTrial
from experiments.library_settings import with_settings
from experiments.registry import Bench, TrialOutcome
from experiments.schema import RegistrationTrial, ScanPairConfig
from experiments.tasks.peers import PACKAGES, moved_by
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import ScanPair, jointed_toy, walking_animal, walking_figure
from torchreg.viz.bone_colors import error_colors
from torchreg.viz.figures import draw_mesh, new_figure, save_picture, watch
from torchreg.viz.scan_gltf import save_grid_animation

# A point is near its true place within this share of the diagonal; a pair is registered if this share of them is near.
NEAR, REGISTERED, JOINT = 0.025, 0.9, 0.05
# Names of the paper's table 1 for the four stages.
STAGES = ("setup", "initialize", "align", "weights")
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
    found = tr.register(
        problem.source, problem.target, num_bones=config.num_bones, grid_resolution=config.grid_resolution,
        config=_settings(config),
    )  # fmt: skip
    seconds = dict(zip(STAGES, found.seconds.tolist(), strict=True)) | {"total": float(found.seconds.sum())}
    metrics = sizes | _accuracy(problem, found.deformed) | _model_metrics(problem, found)
    curves = {
        "distance_percent": [100 * math.sqrt(step.distance) for step in found.history],
        "labels": [float(step.num_labels) for step in found.history],
        "kept": [float(step.kept) for step in found.history],
    }
    outcome = TrialOutcome(metrics, seconds, curves)
    if config.pictures and problem.source.faces is not None:
        outcome.artifacts = _artifacts(problem, problem.source.faces, found, bench)
    return outcome


def _settings(config: RegistrationTrial) -> tr.RegisterConfig:
    if config.method == "paper":
        return with_settings(tr.RegisterConfig.paper(), config.config)
    settings = tr.RegisterConfig(
        joint_weight=(10 * config.joint_weight, config.joint_weight), reuse=config.reuse,
        refine_steps=config.refine_steps, num_samples=config.num_samples,
    )  # fmt: skip
    return with_settings(settings, config.config)


@functools.lru_cache(maxsize=2)
def make_problem(config: ScanPairConfig, seed: int) -> Problem:
    """Return the scans of a trial: the first pair of a different motion for every seed.

    Raises:
        SkippedTrial: if a file is asked for that is not here.
    """
    if config.dataset == "file":
        return _from_file(Path(config.folder) / f"{config.name}.npz")
    scanner, frames = DepthScanner(num_points=config.num_points), config.apart + 1
    if config.dataset == "toy":
        sequence = jointed_toy(frames, seed, missing=True, scanner=scanner)
    else:
        make = walking_figure if config.dataset == "figure" else walking_animal
        sequence = make(frames, seed, scanner=scanner)
    pair = sequence.pair(0, config.apart)
    return Problem(pair.source, pair.target, pair.truth, pair.source.diagonal, pair)


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
    metrics["rand_index"] = float(tr.metrics.adjusted_rand(found.parts(), pair.moving_labels()))
    gaps = _joint_gaps(found, pair)
    metrics["joints_right"] = sum(gap < JOINT for gap in gaps) / len(gaps) if gaps else math.nan
    return metrics


def _joint_gaps(found: tr.ScanRegistration, pair: ScanPair) -> list[float]:
    """Return distances of true joints, of parts that moved apart, from the nearest ones found; shares of the size."""
    moving, labels = pair.moving_labels(), pair.labels
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
    mesh = tr.TriangleMesh(found.deformed.cpu(), faces)
    view = watch(mesh.vertices, size=PICTURE_PIXELS)
    figure, (ax,) = new_figure(*PICTURE_PIXELS)
    draw_mesh(ax, mesh, view, error_colors(errors, NEAR))
    save_picture(figure, bench.file("errors.png"))
    save_grid_animation(bench.file("bones.glb"), found.model, problem.source.points, faces)
    return {"errors": "errors.png", "bones": "bones.glb"}
