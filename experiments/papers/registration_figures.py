"""Figures of the second paper: walking figures and toys registered by the default and as printed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from torch import Tensor

import torchreg as tr
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.viz.bone_colors import bone_palette, error_colors, weight_colors
from torchreg.viz.figures import show_pixels

from ..library_settings import with_settings
from ..made_up.walks import walking_figure
from ..papers.blocks import PAIR_SETS, PairSet
from ..papers.pictures import SOURCE, TARGET, Drawing, line_plot, mesh_drawing, panels, square_view
from ..papers.table import pair_trial
from ..registry import Bench, TrialOutcome
from ..schema import PaperTrial, ScanPairConfig
from ..tasks.registration import NEAR, REGISTERED, Problem, make_problem

_WALK = PAIR_SETS[0]
# Distances from the closest point at the end of the colors of figure 8, % of the diagonal.
_WORST_DISTANCE = 1.0


def _printed(kind: PairSet) -> tr.RegisterConfig:
    settings = pair_trial(kind, "paper", 0).config
    return with_settings(tr.RegisterConfig.paper(), settings)


def _both(problem: Problem, kind: PairSet = _WALK) -> dict[str, tr.ScanRegistration]:
    """Return the registration by default and as printed."""
    return {
        "default": tr.register(problem.source, problem.target, grid_resolution=kind.resolution),
        "as printed": tr.register(problem.source, problem.target, kind.bones, kind.resolution, _printed(kind)),
    }


def _problem(config: PaperTrial, kind: PairSet = _WALK, frame: int = 3, apart: int = 1) -> Problem:
    return make_problem(pair_trial(kind, "default", frame, apart=apart).pair, config.seed)


def _surface(points: Tensor, faces: Tensor | None) -> tr.TriangleMesh:
    if faces is None:
        raise ValueError("scans need triangles to be drawn")
    return tr.TriangleMesh(points.cpu(), faces.cpu())


def _row(problem: Problem, found: Mapping[str, tr.ScanRegistration]) -> list[tuple[str, Drawing]]:
    """Return source and target, and for each registration the moved source over the target, and its weights."""
    source, target = (_surface(scan.points, scan.faces) for scan in (problem.source, problem.target))
    view = square_view(torch.cat([source.vertices, target.vertices]))
    drawings = [("source", mesh_drawing(source, view, SOURCE)), ("target", mesh_drawing(target, view, TARGET))]
    for name, result in found.items():
        moved = _surface(result.deformed, result.faces)
        drawings.append((f"moved, {name}", mesh_drawing(moved, view, weight_colors(result.weights).clamp(0, 1))))
    return drawings


def _scores(problem: Problem, found: Mapping[str, tr.ScanRegistration]) -> dict[str, float]:
    return {key: value for name, result in found.items() for key, value in _score(problem, name, result).items()}


def _score(problem: Problem, name: str, result: tr.ScanRegistration) -> dict[str, float]:
    errors = (result.deformed - problem.truth).norm(dim=-1) / problem.diagonal
    return {
        f"{name}: points within 2.5 %, %": 100 * float((errors < NEAR).double().mean()),
        f"{name}: mean error, % of the diagonal": 100 * float(errors.mean()),
    }


def _result_and_weights(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Figure 1."""
    problem = _problem(config)
    found = _both(problem)
    return TrialOutcome(
        _scores(problem, found),
        artifacts={"registration": panels(bench.file("registration.png"), _row(problem, found))},
    )


def _grid(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Figure 2: the corners of the grid around the source, in the colors of the heaviest bone, and the weights."""
    problem = _problem(config)
    found = _both(problem)
    source = _surface(problem.source.points, problem.source.faces)
    view = square_view(source.vertices)
    drawings = [("source", mesh_drawing(source, view, SOURCE))]
    metrics: dict[str, float] = {}
    for name, result in found.items():
        weights = weight_colors(result.weights).clamp(0, 1)
        drawings += [
            (f"grid, {name}", _corners(result, view)),
            (f"weights, {name}", mesh_drawing(source, view, weights)),
        ]
        grid = result.model.grid
        metrics |= {f"{name}: cells": float(grid.num_cells), f"{name}: corners": float(grid.num_corners)}
        metrics[f"{name}: bones"] = float(result.model.num_bones)
    return TrialOutcome(metrics, artifacts={"grid": panels(bench.file("grid.png"), drawings)})


@torch.no_grad()
def _corners(result: tr.ScanRegistration, view: object) -> Drawing:
    model = result.model
    corners = model.grid.corner_points()
    colors = bone_palette(model.num_bones)[model.corner_weights().argmax(-1)]
    pixels = view.project(corners)[0]  # type: ignore[attr-defined]

    def draw(ax: object) -> None:
        ax.scatter(*pixels.mT.numpy(), c=colors.numpy(), s=3)  # type: ignore[attr-defined]
        show_pixels(ax, view)  # type: ignore[arg-type]
        ax.set_aspect("equal")  # type: ignore[attr-defined]

    return draw


def _joint_term(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Figure 4: registered with and without the joint constraint; pairs that move farther need it more."""
    outcome, frames = TrialOutcome(), (33,) if config.smoke else (3, 33, 63, 93, 123, 153)
    printed = _printed(_WALK)
    settings = {
        "as printed": (_WALK.bones, printed),
        "as printed, no joints": (_WALK.bones, replace(printed, joint_weight=(0.0, 0.0))),
        "default": (20, tr.RegisterConfig()),
        "default, no joints": (20, tr.RegisterConfig(joint_weight=(0.0, 0.0))),
    }
    scores: dict[str, list[float]] = {name: [] for name in settings}
    for frame in frames:
        problem = _problem(config, frame=frame)
        found = {
            name: tr.register(problem.source, problem.target, bones, _WALK.resolution, one)
            for name, (bones, one) in settings.items()
        }
        for name, result in found.items():
            scores[name].append(_score(problem, name, result)[f"{name}: points within 2.5 %, %"])
        if frame == frames[0]:
            outcome.artifacts["joints"] = panels(bench.file("joints.png"), _row(problem, found))
            outcome.curves = _terms(found["as printed"])
            outcome.artifacts["terms of eq. 2"] = line_plot(
                bench.file("terms.png"), outcome.curves, "iteration", "terms of eq. 2", logarithmic=True
            )
    for name, shares in scores.items():
        outcome.metrics[f"{name}: registered of {len(frames)}"] = float(
            sum(share >= 100 * REGISTERED for share in shares)
        )
        outcome.metrics[f"{name}: points within 2.5 %, mean %"] = sum(shares) / len(shares)
    return outcome


def _terms(found: tr.ScanRegistration) -> dict[str, list[float]]:
    """Return the terms of eq. 2 over the iterations, weighed; the last one is the refinement's."""
    names = ("distance", "joint", "smoothness", "norm")
    return {f"eq. 2, {name}": [record.energies[name] for record in found.history] for name in names}


def _refinement(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Figure 6: the surface with labels, and with continuous weights."""
    problem = _problem(config, frame=33)
    printed = _printed(_WALK)
    found = {
        "labels": tr.register(problem.source, problem.target, 7, 50, replace(printed, refine_steps=0)),
        "refined": tr.register(problem.source, problem.target, 7, 50, printed),
        "default, labels": tr.register(problem.source, problem.target, config=tr.RegisterConfig(refine_steps=0)),
        "default": tr.register(problem.source, problem.target),
    }
    metrics = _scores(problem, found)
    for name, result in found.items():
        metrics[f"{name}: longest edge after over before"] = _longest_stretch(problem, result)
    return TrialOutcome(metrics, artifacts={"refinement": panels(bench.file("refinement.png"), _row(problem, found))})


def _longest_stretch(problem: Problem, found: tr.ScanRegistration) -> float:
    """Return the 99.9 % quantile of the ratio of edges after and before the motion."""
    faces = problem.source.faces
    if faces is None:
        raise ValueError("scans need triangles to be measured")
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]]])
    before, after = (
        (points[edges[:, 0]] - points[edges[:, 1]]).norm(dim=-1) for points in (problem.source.points, found.deformed)
    )
    return float((after / before.clamp_min(1e-9)).quantile(0.999))


def _examples(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Figure 7: a pair of each set."""
    outcome = TrialOutcome()
    for kind in PAIR_SETS[:2] if config.smoke else PAIR_SETS:
        problem = _problem(config, kind, frame=5)
        found = _both(problem, kind)
        outcome.artifacts[kind.name] = panels(bench.file(f"{kind.name}.png"), _row(problem, found))
        outcome.metrics |= {f"{kind.name}, {key}": value for key, value in _scores(problem, found).items()}
    return outcome


def _error_colors(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Figure 8: distances to the closest point of the target."""
    drawings, metrics = [], {}
    for kind in PAIR_SETS[:1] if config.smoke else PAIR_SETS:
        problem = _problem(config, kind, frame=7)
        for name, result in _both(problem, kind).items():
            percent = 100 * result.distances / problem.diagonal
            moved = _surface(result.deformed, result.faces)
            paint = error_colors(percent.float(), _WORST_DISTANCE)
            drawings.append((f"{kind.name}, {name}", mesh_drawing(moved, square_view(moved.vertices), paint)))
            metrics[f"{kind.name}, {name}: distance, mean % of the diagonal"] = float(percent.mean())
    return TrialOutcome(metrics, artifacts={"blue 0 %, red 1 %": panels(bench.file("errors.png"), drawings)})


def _occlusion(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Figure 9: a robot that lacks a part in one scan, and a figure that turned and walked for several frames."""
    problems = {"a part is missing": make_problem(ScanPairConfig(dataset="toy", frames=10, frame=4), config.seed)}
    if not config.smoke:
        problems["four frames apart"] = _problem(config, frame=20, apart=4)
        problems["ten frames apart"] = _problem(config, frame=60, apart=10)
    outcome = TrialOutcome()
    for number, (name, problem) in enumerate(problems.items()):
        found = _both(problem, PAIR_SETS[1] if number == 0 else _WALK)
        outcome.artifacts[name] = panels(bench.file(f"occlusion_{number}.png"), _row(problem, found))
        known = torch.ones(len(problem.truth), dtype=torch.bool) if problem.pair is None else ~problem.pair.missing
        for method, result in found.items():
            errors = ((result.deformed - problem.truth).norm(dim=-1) / problem.diagonal)[known]
            outcome.metrics[f"{name}, {method}: points within 2.5 %, %"] = 100 * float((errors < NEAR).double().mean())
    return outcome


def _holes(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Figure 10: the same pair, also with holes."""
    outcome = TrialOutcome()
    for number, (name, holes) in enumerate({"plain": 0, "eight holes": 8}.items()):
        scanner = DepthScanner(num_holes=holes, hole_radius=0.05)
        pair = walking_figure(40, config.seed, scanner=scanner).pair(10, 11)
        problem = Problem(pair.source, pair.target, pair.truth, pair.source.diagonal, pair)
        found = _both(problem)
        outcome.artifacts[name] = panels(bench.file(f"holes_{number}.png"), _row(problem, found))
        outcome.metrics |= {f"{name}, {key}": value for key, value in _scores(problem, found).items()}
    return outcome


def _failures(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Figure 11: of some pairs four frames apart the one that is worst as printed."""
    problems = [_problem(config, frame=frame, apart=4) for frame in ((20, 60) if config.smoke else range(10, 180, 15))]
    found = [tr.register(one.source, one.target, _WALK.bones, _WALK.resolution, _printed(_WALK)) for one in problems]
    near = [
        float(((result.deformed - one.truth).norm(dim=-1) < NEAR * one.diagonal).double().mean())
        for one, result in zip(problems, found, strict=True)
    ]
    worst = min(range(len(near)), key=near.__getitem__)
    problem = problems[worst]
    both = {
        "as printed": found[worst],
        "default": tr.register(problem.source, problem.target, grid_resolution=_WALK.resolution),
    }
    metrics = {
        "pairs four apart": float(len(near)),
        "as printed: registered": float(sum(n >= REGISTERED for n in near)),
    }
    metrics |= {f"the worst, {key}": value for key, value in _scores(problem, both).items()}
    return TrialOutcome(metrics, artifacts={"the worst": panels(bench.file("failure.png"), _row(problem, both))})


def _posing(config: PaperTrial, bench: Bench) -> TrialOutcome:
    """Figure 12: a registered scan posed anew by handles that are dragged half as far again as they moved."""
    problem = _problem(config, frame=33)
    source = _surface(problem.source.points, problem.source.faces)
    view = square_view(torch.cat([source.vertices, problem.target.points]))
    drawings, metrics = [("source", mesh_drawing(source, view, SOURCE))], {}
    for name, result in _both(problem).items():
        moved = (result.deformed - result.points).norm(dim=-1)
        handles = torch.stack([moved.argmax(), moved.argmin()])
        targets = result.deformed[handles] + 0.5 * (result.deformed - result.points)[handles]
        solved = tr.solve_pose(result.model, result.points[handles], targets)
        with torch.no_grad():
            posed = result.model(problem.source.points, solved.transforms)
        weights = weight_colors(result.weights).clamp(0, 1)
        drawings.append((f"posed, {name}", mesh_drawing(_surface(posed, result.faces), view, weights)))
        metrics[f"{name}: handles off, % of the diagonal"] = 100 * float(solved.residuals.max()) / problem.diagonal
    return TrialOutcome(metrics, artifacts={"posing": panels(bench.file("posing.png"), drawings)})


MAKERS: dict[str, Callable[[PaperTrial, Bench], TrialOutcome]] = {
    "p2-fig-1": _result_and_weights,
    "p2-fig-2": _grid,
    "p2-fig-4": _joint_term,
    "p2-fig-6": _refinement,
    "p2-fig-7": _examples,
    "p2-fig-8": _error_colors,
    "p2-fig-9": _occlusion,
    "p2-fig-10": _holes,
    "p2-fig-11": _failures,
    "p2-fig-12": _posing,
}
