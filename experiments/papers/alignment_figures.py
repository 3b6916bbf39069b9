"""Figures 1 to 3, timings and rivals of the first paper, by the default and by the printed settings."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

import torchreg as tr
from torchreg.datasets.hand import HandCloud, make_hand_cloud, random_hand_pose, surface_skin
from torchreg.datasets.sequences import hand_sequence
from torchreg.viz.figures import bending_picture, draw_scene, scene_view
from torchreg.viz.posed_scenes import posed_scene

from ..papers.pictures import PANEL, Drawing, panels
from ..registry import Bench, TrialOutcome
from ..schema import AlignmentTrial, AlignSolver, HandScene, PaperTrial, ScheduleConfig
from ..tasks import alignment

_SEQUENCES = ("rotation", "bending_palm", "bending_back")
_TIPS = alignment.TIPS
_FPS = 20.0


def _align_configs() -> dict[str, tr.AlignConfig]:
    return {"default": tr.AlignConfig(), "as printed": tr.AlignConfig.paper()}


def _track_configs() -> dict[str, tr.TrackConfig]:
    return {"default": tr.TrackConfig(), "as printed": tr.TrackConfig.paper()}


def _model_data_alignment(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Figure 1: a hand before, the data, and the hand aligned with them."""
    hand = tr.Hand().requires_grad_(False)
    generator = torch.Generator().manual_seed(config.seed + 4)
    pose = random_hand_pose(hand, generator)
    start = pose.clone()
    start[6:] += 0.2 * torch.randn(hand.num_dofs - 6, generator=generator)
    start[:3] += torch.tensor([0.012, -0.01, 0.012])
    start, skin = hand.clamp(start), surface_skin(hand)
    cloud = make_hand_cloud(
        hand, pose, num_points=600, outlier_ratio=0.3, camera=torch.zeros(3), skin=skin, generator=generator
    )
    view = scene_view(posed_scene(hand, pose[None], skin=skin), size=(PANEL, PANEL))

    def drawing(where: Tensor, data: Sequence[Tensor] = (), inliers: Tensor | None = None) -> Drawing:
        scene = posed_scene(hand, where[None], data, None if inliers is None else [inliers], skin=skin)
        return lambda ax: draw_scene(scene, ax=ax, view=view)

    drawings = [("model, previous pose", drawing(start)), ("and the data", drawing(start, [cloud.points]))]
    metrics = {"start: fingertips, mm": _tips_mm(hand, start, pose)}
    for name, settings in _align_configs().items():
        found = tr.align(hand, cloud.points, start, config=settings)
        drawings.append((f"aligned, {name}", drawing(found.pose, [cloud.points], found.inliers)))
        metrics[f"{name}: fingertips, mm"] = _tips_mm(hand, found.pose, pose)
    return TrialOutcome(metrics, artifacts={"alignment": panels(bench.file("alignment.png"), drawings)})


def _sliding_skin(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Figure 2: a bent finger, its skin sliding and near rigid."""
    bending_picture(bench.file("bending.png"))
    return TrialOutcome(artifacts={"a = 2, a = 10": "bending.png"})


def _three_sequences(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Figure 3: three sequences tracked, some frames of each."""
    hand = tr.Hand().requires_grad_(False)
    skin, count = surface_skin(hand), 8 if config.smoke else 100
    outcome = TrialOutcome()
    for motion in _SEQUENCES:
        clouds = hand_sequence(motion, count, _FPS, shape=hand, skin=skin, seed=config.seed)
        drawings = []
        for name, settings in _track_configs().items():
            track = _tracked(hand, clouds, settings)
            seen = torch.stack([cloud.seen_parts[list(hand.fingertip_parts)] for cloud in clouds[1:]])
            true = torch.stack([cloud.keypoints for cloud in clouds[1:]])
            errors = 1e3 * (track.keypoints - true).norm(dim=-1)[:, _TIPS]
            outcome.metrics[f"{motion}, {name}: seen fingertips, median mm"] = float(errors[seen].median())
            outcome.metrics[f"{motion}, {name}: frames within 10 mm, %"] = 100 * _good(errors, seen)
            for frame in torch.linspace(0, count - 2, 3).long().tolist():
                drawings.append(
                    (f"{name}, frame {frame + 1}", _frame(hand, skin, clouds[frame + 1], track.poses[frame]))
                )
        outcome.artifacts[motion] = panels(bench.file(f"{motion}.png"), drawings, rows=2)
    return outcome


def _timings(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Frames per second, data and inliers."""
    hand = tr.Hand().requires_grad_(False)
    clouds = hand_sequence("bending_palm", 8 if config.smoke else 100, _FPS, shape=hand, seed=config.seed)
    metrics = {"data per frame": statistics.median(float(len(cloud.points)) for cloud in clouds)}
    seconds = {}
    for name, settings in _track_configs().items():
        begin = time.perf_counter()
        track = _tracked(hand, clouds, settings)
        seconds[f"{name}, per frame"] = (time.perf_counter() - begin) / (len(clouds) - 1)
        counts = torch.tensor([float(len(cloud.points)) for cloud in clouds[1:]])
        metrics[f"{name}: inliers, median"] = float((track.inlier_ratios * counts).median())
    return TrialOutcome(metrics, seconds)


def _rivals(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Section 4: other rules that match points, on the same clouds."""
    plain = AlignmentTrial(scene=HandScene(outlier_ratio=0.3), solver=AlignSolver(em_steps=6))
    adaptive = ScheduleConfig(kind="adaptive", steps=30)
    trials = {
        "annealed EM alone": plain,
        "EM, estimated sigma": replace(plain, schedule=adaptive, solver=replace(plain.solver, em_steps=1)),
        "SoftAssign": replace(plain, solver=replace(plain.solver, method="softassign")),
        "ICP": replace(plain, solver=replace(plain.solver, method="closest")),
        "as printed": replace(plain, solver=replace(plain.solver, method="paper")),
        "default": replace(plain, schedule=ScheduleConfig(kind="default"), solver=_default_solver()),
    }
    outcome = TrialOutcome()
    for name, trial in trials.items():
        found = [alignment.run(replace(trial, seed=seed), bench) for seed in range(2 if config.smoke else 24)]
        tips = [one.metrics["tips_mm"] for one in found]
        outcome.metrics[f"{name}: fingertips, median mm"] = statistics.median(tips)
        outcome.metrics[f"{name}: failures, %"] = 100 * statistics.fmean(one.metrics["failed"] for one in found)
        outcome.seconds[name] = statistics.median(one.seconds["align"] for one in found)
    return outcome


def _default_solver() -> AlignSolver:
    plain = tr.AlignConfig()
    return AlignSolver(
        em_steps=plain.em_steps, surface_steps=plain.surface_steps, search="auto", debias=plain.debias, prior=True
    )


def _tracked(hand: tr.Hand, clouds: list[HandCloud], settings: tr.TrackConfig) -> tr.TrackResult:
    """Return all frames but the first, whose pose is known, as in the paper."""
    return tr.Tracker(hand, clouds[0].pose, config=settings).run([cloud.points for cloud in clouds[1:]])


def _frame(hand: tr.Hand, skin: tr.LinearBlendSkin, cloud: HandCloud, pose: Tensor) -> Drawing:
    view = scene_view(posed_scene(hand, cloud.pose[None], skin=skin), size=(PANEL, PANEL))
    scene = posed_scene(hand, pose[None], [cloud.points], [cloud.inliers], skin=skin)
    return lambda ax: draw_scene(scene, ax=ax, view=view)


def _good(errors: Tensor, seen: Tensor) -> float:
    """Return the share of frames whose seen fingertips are within 10 mm on average."""
    mean = torch.where(seen, errors, torch.nan).nanmean(1)
    return float((mean[~mean.isnan()] < 1e3 * alignment.FAILURE).double().mean())


def _tips_mm(hand: tr.Hand, pose: Tensor, truth: Tensor) -> float:
    return 1e3 * float((hand.keypoints(pose) - hand.keypoints(truth)).norm(dim=-1)[_TIPS].mean())


MAKERS: dict[str, Callable[[PaperTrial, Bench], TrialOutcome]] = {
    "p1-fig-1": _model_data_alignment,
    "p1-fig-2": _sliding_skin,
    "p1-fig-3": _three_sequences,
    "p1-timings": _timings,
    "p1-rivals": _rivals,
}
