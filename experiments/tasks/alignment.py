"""A hand aligned to a cloud of known pose: the errors of fingertips, joints and model points."""

from __future__ import annotations

import functools
import math
import time
from dataclasses import dataclass

import torch
from torch import Tensor

import torchreg as tr
from torchreg.datasets.hand import HandCloud, make_hand_cloud, random_hand_pose, surface_skin
from torchreg.viz.figures import save_scene, watch
from torchreg.viz.gltf import save_shape_animation
from torchreg.viz.posed_scenes import posed_scene

from ..library_settings import with_settings
from ..registry import Bench, TrialOutcome
from ..schema import AlignmentTrial, ScheduleConfig
from ..tasks.peers import PACKAGES, moved_by

TIPS = [4, 8, 12, 16, 20]
# An alignment has failed if the seen fingertips are off by more than this on average, metres.
FAILURE = 0.01
# A fingertip counts as seen with this share of the points on its last phalanx.
MIN_SEEN = 0.016
PICTURE_PIXELS = (300, 300)


@dataclass(frozen=True)
class Scene:
    """The problem of a trial.

    Args:
        cloud: the data.
        start: (num_dofs,) joints off by the scene's angle.
        skin: what moves the model points.
        seen: (5,) fingertips that the data show.
    """

    cloud: HandCloud
    start: Tensor
    skin: tr.LinearBlendSkin
    seen: Tensor


def run(config: AlignmentTrial, bench: Bench) -> TrialOutcome:
    """Return the errors of an alignment."""
    hand = _hand(bench.device)
    begin = time.perf_counter()
    scene = make_scene(hand, config)
    seconds = {"setup": time.perf_counter() - begin}
    begin = time.perf_counter()
    if config.solver.method in PACKAGES:
        start = scene.skin(scene.start)
        moved = moved_by(config.solver.method, start, scene.cloud.points, config.scene.outlier_ratio)
        seconds["align"] = time.perf_counter() - begin
        return TrialOutcome({"points_mm": _points_mm(scene, moved)}, seconds)
    found = tr.align(
        hand, scene.cloud.points, scene.start, model_points=scene.skin, config=align_config(hand, scene, config)
    )
    seconds["align"] = time.perf_counter() - begin
    outcome = TrialOutcome(_metrics(hand, scene, found), seconds, _curves(hand, scene, found))
    if config.pictures:
        outcome.artifacts = _artifacts(hand, scene, found, bench)
    return outcome


@functools.cache
def _hand(device: str) -> tr.Hand:
    return tr.Hand().requires_grad_(False).to(device)


@functools.cache
def _surface(device: str, sharpness: float) -> tr.LinearBlendSkin:
    return surface_skin(_hand(device), sharpness=sharpness)


@functools.cache
def _model_skin(device: str, count: int, sharpness: float) -> tr.LinearBlendSkin:
    return tr.sample_skin(_hand(device), count, sharpness=sharpness)


def make_scene(hand: tr.Hand, config: AlignmentTrial) -> Scene:
    """Return the cloud of a trial; pose and signs of the start's errors depend on the seed alone."""
    scene, generator = config.scene, torch.Generator().manual_seed(config.seed)
    device = str(hand.rest.device)
    pose = random_hand_pose(hand, generator)
    signs = 2.0 * torch.randint(2, (hand.num_dofs - 6,), generator=generator).to(pose) - 1.0
    start = pose.clone()
    start[6:] += math.radians(scene.start_deg) * signs
    start = hand.clamp(start)
    camera = None if scene.view == "whole" else torch.zeros(3).to(pose)
    surface = _surface(device, scene.sharpness)
    cloud = make_hand_cloud(
        hand, pose, num_points=scene.num_points, noise=scene.noise_mm / 1e3, outlier_ratio=scene.outlier_ratio,
        camera=camera, skin=surface, generator=generator,
    )  # fmt: skip
    counts = torch.stack([(cloud.part_labels == part).sum() for part in hand.fingertip_parts])
    seen = counts >= min(MIN_SEEN * scene.num_points, int(counts.max()))
    if scene.view != "tracked":
        return Scene(cloud, start, _model_skin(device, config.solver.num_model_points, config.solver.sharpness), seen)
    before = make_hand_cloud(
        hand, start, num_points=config.solver.num_model_points, noise=scene.noise_mm / 1e3, outlier_ratio=0.0,
        camera=camera, skin=surface, generator=generator,
    )  # fmt: skip
    return Scene(cloud, start, tr.BendingSkin(hand, before.points, start, config.solver.sharpness), seen)


def align_config(hand: tr.Hand, scene: Scene, config: AlignmentTrial) -> tr.AlignConfig:
    """Return the library's settings for a trial's."""
    solver, plain = config.solver, tr.AlignConfig()
    with torch.no_grad():
        rest = scene.skin(hand.rest_pose())
    size = float((rest.amax(0) - rest.amin(0)).norm())
    if solver.method == "paper":
        printed = tr.AlignConfig.paper(
            schedule=sigma_schedule(config.schedule, size), sharpness=solver.sharpness,
            num_model_points=solver.num_model_points,
        )  # fmt: skip
        return with_settings(printed, config.config)
    settings = tr.AlignConfig(
        schedule=sigma_schedule(config.schedule, size), em_steps=solver.em_steps, surface_steps=solver.surface_steps,
        search=solver.search, debias=solver.debias, prior_std=plain.prior_std if solver.prior else None,
        correspondence=solver.method, sharpness=solver.sharpness, num_model_points=solver.num_model_points,
    )  # fmt: skip
    return with_settings(settings, config.config)


def sigma_schedule(config: ScheduleConfig, size: float) -> tr.SigmaSchedule | None:
    """Return the schedule of a shape of a size, metres; None for the library's default."""
    start, stop = config.start * size, config.stop * size
    if config.kind == "default":
        return None
    if config.kind == "constant":
        return tr.SigmaSchedule.constant(start, config.steps)
    if config.kind == "geometric" and config.kappa is not None:
        values = tuple(max(start * config.kappa**step, stop) for step in range(config.steps))
        return tr.SigmaSchedule(values, config.steps)
    schedule: tr.SigmaSchedule = getattr(tr.SigmaSchedule, config.kind)(start, stop, config.steps)
    return schedule


def _metrics(hand: tr.Hand, scene: Scene, found: tr.AlignResult) -> dict[str, float]:
    off = (found.keypoints - _true_keypoints(hand, scene)).norm(dim=-1)
    tips = float(off[TIPS][scene.seen].mean())
    inliers = scene.cloud.inliers
    return {
        "tips_mm": 1e3 * tips,
        "joints_mm": 1e3 * float(off.mean()),
        "points_mm": _points_mm(scene, scene.skin(found.pose)),
        "failed": float(tips > FAILURE),
        "inliers_right": float((found.inliers == inliers).double().mean()),
        "outlier_posterior": float(found.posterior[~inliers].mean()) if bool((~inliers).any()) else 0.0,
        "em_steps": float(sum(step.stage == "em" for step in found.history)),
    }


def _points_mm(scene: Scene, moved: Tensor) -> float:
    """Return the distances of model points from their positions in the true pose, as for other programs, mm."""
    with torch.no_grad():
        return 1e3 * float((moved - scene.skin(scene.cloud.pose)).norm(dim=-1).mean())


def _curves(hand: tr.Hand, scene: Scene, found: tr.AlignResult) -> dict[str, list[float]]:
    true, steps = _true_keypoints(hand, scene), found.history
    poses = torch.stack([step.pose[0] for step in steps])
    with torch.no_grad():
        off = (hand.keypoints(poses) - true).norm(dim=-1)[:, TIPS][:, scene.seen].mean(-1)
    return {
        "tips_mm": (1e3 * off.double()).tolist(),
        "sigma_mm": [1e3 * float(step.sigma[0]) for step in steps],
        "posed_change": [float(step.pose_change[0]) for step in steps],
    }


def _true_keypoints(hand: tr.Hand, scene: Scene) -> Tensor:
    with torch.no_grad():
        return hand.keypoints(scene.cloud.pose)


def _artifacts(hand: tr.Hand, scene: Scene, found: tr.AlignResult, bench: Bench) -> dict[str, str]:
    skin = _surface(str(hand.rest.device), 2.0)
    with torch.no_grad():
        points = torch.cat([skin(pose) for pose in (scene.start, scene.cloud.pose)])
    view = watch(points.cpu(), size=PICTURE_PIXELS)
    shown = posed_scene(hand, found.pose[None], [scene.cloud.points], [scene.cloud.inliers], skin=skin)
    save_scene(bench.file("alignment.png"), shown, view=view)
    every = torch.stack([scene.start, *(step.pose[0] for step in found.history), found.pose])
    save_shape_animation(bench.file("alignment.glb"), hand, every, fps=10.0, skin=skin)
    return {"alignment": "alignment.png", "alignment, step by step": "alignment.glb"}
