"""Figures and timings of the third paper, by default and as printed."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch

import torchreg as tr
from torchreg.viz.figures import draw_scene, scene_view
from torchreg.viz.result_scenes import result_scene
from torchreg.viz.scene import Scene
from torchreg.viz.spines import tip_distance_paint

from ..papers.pictures import (
    PANEL,
    Drawing,
    line_plot,
    mesh_drawing,
    panels,
    square_view,
)
from ..registry import Bench, TrialOutcome
from ..schema import PaperTrial, SpineTrial
from ..tasks.spine import Sequence as Creatures
from ..tasks.spine import count_tips, make_sequence

_GRAY = (0.8, 0.8, 0.8)
_LEVELS = 100


def _configs() -> dict[str, tr.SpineConfig]:
    return {"default": tr.SpineConfig(), "as printed": tr.SpineConfig.paper()}


def _creatures(config: PaperTrial, creature: str = "starfish", touching: str = "none", frames: int = 12) -> Creatures:
    # Arms that touch do so in the middle third.
    small = 3 if touching == "none" else 9
    trial = SpineTrial(
        seed=config.seed,
        creature=creature,  # type: ignore[arg-type]
        touching=touching,  # type: ignore[arg-type]
        frames=min(small, frames) if config.smoke else frames,
        resolution=48 if config.smoke else 96,
    )
    return make_sequence(trial)


def _scene_drawing(scene: Scene, frame: int = 0) -> Drawing:
    view = scene_view(scene, size=(PANEL, PANEL))
    return lambda ax: draw_scene(replace(scene, title=""), frame, ax, view=view)


def _surface_steps(mesh: tr.TriangleMesh, skeleton: tr.Skeleton) -> list[tuple[str, Drawing]]:
    """Return the surface, the geodesic distance from a tip, and its level sets."""
    view, tip = square_view(mesh.vertices), skeleton.nodes[skeleton.tips[0]]
    return [
        ("surface", mesh_drawing(mesh, view, _GRAY)),
        ("distance from a tip", mesh_drawing(mesh, view, tip_distance_paint(mesh, tip))),
        ("level sets, every fourth", mesh_drawing(mesh, view, tip_distance_paint(mesh, tip, _LEVELS // 4))),
    ]


def _subject_to_spine(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Figure 1."""
    meshes = _creatures(config, frames=8).meshes
    skeleton = tr.skeletonize(meshes[0])
    spine = tr.extract_spine(meshes, workers=1)
    scene = result_scene(spine, data=meshes)
    drawings = [
        ("surface", mesh_drawing(meshes[0], square_view(meshes[0].vertices), _GRAY)),
        ("skeleton", _scene_drawing(result_scene(skeleton, data=[meshes[0]]))),
        ("spine, first frame", _scene_drawing(scene)),
        ("spine, last frame", _scene_drawing(scene, len(meshes) - 1)),
    ]
    return TrialOutcome({"tips": float(spine.num_tips)}, artifacts={"spine": panels(bench.file("spine.png"), drawings)})


def _steps(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Figure 2: the steps for a starfish."""
    (mesh, *_) = _creatures(config, frames=1).meshes
    skeletons = {name: tr.skeletonize(mesh, settings.skeletons) for name, settings in _configs().items()}
    drawings = _surface_steps(mesh, skeletons["default"])
    drawings += [
        (f"skeleton, {name}", _scene_drawing(result_scene(skeleton, data=[mesh])))
        for name, skeleton in skeletons.items()
    ]
    metrics = {f"{name}: tips": float(len(skeleton.tips)) for name, skeleton in skeletons.items()}
    return TrialOutcome(metrics, artifacts={"steps": panels(bench.file("steps.png"), drawings)})


def _imposing(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Figure 4: skeletons of single frames in which two arms touch, and the one graph imposed on them."""
    sequence = _creatures(config, touching="flanks", frames=18)
    meshes, outcome = sequence.meshes, TrialOutcome()
    chosen = torch.linspace(0, len(meshes) - 1, min(4, len(meshes))).long().tolist()
    for number, (name, settings) in enumerate(_configs().items()):
        spine = tr.extract_spine(meshes, config=settings, workers=1)
        before = [
            (
                f"alone, frame {frame}",
                _scene_drawing(result_scene(tr.skeletonize(meshes[frame], settings.skeletons), data=[meshes[frame]])),
            )
            for frame in chosen
        ]
        scene = result_scene(spine, data=meshes)
        after = [(f"spine, frame {frame}", _scene_drawing(scene, frame)) for frame in chosen]
        outcome.artifacts[name] = panels(bench.file(f"imposing_{number}.png"), before + after, rows=2)
        final = max(set(spine.topologies), key=spine.topologies.count)
        outcome.metrics |= {
            f"{name}: frames with that tree before, %": 100 * _share([own == final for own in spine.own_topologies]),
            f"{name}: frames with that tree after, %": 100 * _share([one == final for one in spine.topologies]),
            f"{name}: frames with all names right, %": 100 * float(sequence.named(spine).double().mean()),
        }
    return outcome


def _share(flags: Sequence[bool]) -> float:
    return sum(flags) / len(flags)


def _subjects(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Figure 6: surface, distance, level sets, skeletons of two creatures."""
    outcome = TrialOutcome()
    for creature in ("starfish", "octopus"):
        (mesh, *_) = _creatures(config, creature, frames=1).meshes
        skeletons = {name: tr.skeletonize(mesh, settings.skeletons) for name, settings in _configs().items()}
        drawings = _surface_steps(mesh, skeletons["default"])
        drawings += [
            (f"skeleton, {name}", _scene_drawing(result_scene(one, data=[mesh]))) for name, one in skeletons.items()
        ]
        outcome.artifacts[creature] = panels(bench.file(f"{creature}.png"), drawings)
        outcome.metrics |= {f"{creature}, {name}: tips": float(len(one.tips)) for name, one in skeletons.items()}
        outcome.metrics[f"{creature}: vertices"] = float(mesh.num_vertices)
    return outcome


def _tips_per_frame(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Figure 7: tips found in each frame by itself; two arms touch in the middle third."""
    outcome, lines = TrialOutcome(), {}
    for creature in ("starfish",) if config.smoke else ("starfish", "octopus"):
        sequence = _creatures(config, creature, touching="flanks", frames=24)
        for name, settings in _configs().items():
            counts = [len(tr.skeletonize(mesh, settings.skeletons).tips) for mesh in sequence.meshes]
            lines[f"{creature}, {name}"] = [float(count) for count in counts]
            mode = max(set(counts), key=counts.count)
            outcome.metrics[f"{creature}, {name}: most frequent number (true: {sequence.tips})"] = float(mode)
            outcome.metrics[f"{creature}, {name}: frames with it, %"] = 100 * _share([one == mode for one in counts])
    outcome.artifacts["tips"] = line_plot(bench.file("tips.png"), lines, "frame", "tips found")
    return outcome


def _timings(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Seconds per mesh for the skeleton, and for all correspondences."""
    sequence = _creatures(config, frames=24)
    metrics = {"frames": float(len(sequence.meshes)), "vertices": float(sequence.meshes[0].num_vertices)}
    seconds = {}
    for name, settings in _configs().items():
        records: list[Any] = []
        begin = time.perf_counter()
        spine = tr.extract_spine(sequence.meshes, config=settings, workers=1, on_step=records.append)
        total = time.perf_counter() - begin
        spent = [record.seconds for record in records]
        seconds[f"{name}, skeleton of a mesh"] = sum(spent) / len(spent)
        seconds[f"{name}, correspondences and imposing, all frames"] = total - sum(spent)
        metrics[f"{name}: tips"] = float(count_tips(spine.topologies[0]))
    return TrialOutcome(metrics, seconds)


MAKERS: dict[str, Callable[[PaperTrial, Bench], TrialOutcome]] = {
    "p3-fig-1": _subject_to_spine,
    "p3-fig-2": _steps,
    "p3-fig-4": _imposing,
    "p3-fig-6": _subjects,
    "p3-fig-7": _tips_per_frame,
    "p3-timings": _timings,
}
