"""What trials measure, compared with what is known of their scenes."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import torchreg as tr
from experiments import schema
from experiments.errors import SkippedTrial
from experiments.registry import TASKS, Bench
from experiments.schema import AlignmentTrial, AlignSolver, RegistrationTrial, ScanPairConfig, ScheduleConfig
from experiments.tasks import alignment, peers, probe, registration, spine

ROOT = Path(__file__).resolve().parents[2]
SMALL = AlignmentTrial(scene=schema.HandScene(num_points=120), solver=AlignSolver(num_model_points=120))
TOY = ScanPairConfig(dataset="toy", num_points=500)


@pytest.fixture
def bench(tmp_path):
    return Bench("cpu", tmp_path)


@pytest.fixture(scope="module")
def toy():
    return registration.make_problem(TOY, 0)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"kind": "geometric", "stop": 0.02, "steps": 3}, (0.016, 0.008, 0.004)),
        ({"kind": "linear", "stop": 0.02, "steps": 3}, (0.016, 0.01, 0.004)),
        ({"kind": "constant", "steps": 2}, (0.016, 0.016)),
        ({"kind": "adaptive", "stop": 0.02, "steps": 7}, (0.016, 0.004)),
        ({"kind": "geometric", "stop": 0.03, "steps": 3, "kappa": 0.5}, (0.016, 0.008, 0.006)),
    ],
)
def test_schedules_are_shares_of_the_size(settings, expected):
    schedule = alignment.sigma_schedule(ScheduleConfig(start=0.08, **settings), 0.2)
    assert schedule.values == pytest.approx(expected)
    assert schedule.steps == settings["steps"]
    assert alignment.sigma_schedule(ScheduleConfig(kind="default"), 0.2) is None


@pytest.mark.parametrize("settings", [{"stop": 0.2}, {"stop": 0.0}, {"steps": 0}, {"kappa": 0.0}, {"kappa": 1.5}])
def test_impossible_schedules_are_refused(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        ScheduleConfig(**settings)


def test_trials_depend_on_the_seed_and_not_on_the_method(plain_hand, bench):
    closest = replace(SMALL, solver=replace(SMALL.solver, method="closest"))
    one, other, third = (alignment.make_scene(plain_hand, x) for x in (SMALL, closest, replace(SMALL, seed=1)))
    assert torch.equal(one.cloud.points, other.cloud.points)
    assert torch.equal(one.start, other.start)
    assert not torch.equal(one.start, third.start)
    first, again, new = (probe.run(schema.ProbeTrial(seed=seed, rounds=3), bench) for seed in (0, 0, 1))
    assert first.metrics == again.metrics != new.metrics
    assert len(first.curves["norm"]) == 3


def test_a_hand_that_starts_at_the_truth_stays_there(bench):
    scene = replace(SMALL.scene, start_deg=0.0, outlier_ratio=0.0, num_points=400)
    solver = replace(SMALL.solver, em_steps=2, surface_steps=2, prior=True)
    schedule = ScheduleConfig(kind="default")
    found = alignment.run(replace(SMALL, scene=scene, schedule=schedule, solver=solver, pictures=True), bench)
    assert found.metrics["failed"] == 0
    assert max(found.metrics["tips_mm"], found.metrics["points_mm"]) < 3
    assert found.curves["tips_mm"][-1] == pytest.approx(found.metrics["tips_mm"], rel=1e-4)
    assert len(set(map(len, found.curves.values()))) == 1
    assert {path.name for path in bench.folder.iterdir()} == set(found.artifacts.values())


def test_missing_programs_and_files_skip_the_trial(monkeypatch, bench):
    for name in ("cpd", "skeletor"):
        monkeypatch.setitem(peers.PACKAGES, name, "no_such_package")
    nowhere = {"folder": str(bench.folder), "name": "gone"}
    calls = {
        "no_such_package is not installed: pip install 'torchreg-articulated": lambda: alignment.run(
            replace(SMALL, solver=replace(SMALL.solver, method="cpd")), bench
        ),
        "no_such_package is not installed": lambda: spine.run(
            schema.SpineTrial(method="skeletor", frames=1, resolution=24), bench
        ),
        "there is no file .*gone.npz; say where the data lie with pair.folder": lambda: registration.make_problem(
            replace(TOY, dataset="file", **nowhere), 0
        ),
        "there is no file": lambda: spine.run(schema.SpineTrial(creature="file", **nowhere), bench),
    }
    for message, call in calls.items():
        with pytest.raises(SkippedTrial, match=message):
            call()


def test_scans_from_a_file(tmp_path, bench, toy):
    np.savez(
        tmp_path / "pair.npz", source_points=toy.source.points, source_faces=toy.source.faces, source_truth=toy.truth,
        target_points=toy.target.points, target_faces=toy.target.faces, diagonal=toy.diagonal,
    )  # fmt: skip
    stored = ScanPairConfig(dataset="file", folder=str(tmp_path), name="pair")
    trial = RegistrationTrial(pair=stored, num_bones=4, grid_resolution=15, num_samples=200, pictures=True)
    found = registration.run(trial, bench)
    assert found.metrics["vertices"] == len(toy.source.points)
    assert set(found.seconds) == {"setup", "initialize", "align", "weights", "total"}
    assert found.seconds["total"] == pytest.approx(sum(found.seconds[name] for name in registration.STAGES), rel=1e-5)
    assert {path.name for path in bench.folder.iterdir()} >= set(found.artifacts.values())


def test_experiments_use_the_public_library_alone():
    """Top-level names, data sets, scores and pictures; and how files are written in one step.

    But what trains the weights of the package builds a part of it, and made-up data are made of its geometry.
    """
    assert all(callable(task.load()) for task in TASKS.values())
    allowed = ("torchreg.datasets.", "torchreg.viz.", "torchreg.metrics", "torchreg.io.atomic")
    for path in (ROOT / "experiments").rglob("*.py"):
        if path.parent.name in ("matcher", "hand_data", "made_up"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("torchreg."):
                assert node.module.startswith(allowed), f"{path}:{node.lineno}"
                assert not any(name.name.startswith("_") for name in node.names)
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "tr":
                assert node.attr in tr.__all__, f"{path}:{node.lineno}: tr.{node.attr} is not public"
