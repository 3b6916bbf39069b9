"""What trials measure, compared with what is known of their scenes."""

import ast
import importlib.util
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

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


def test_points_are_as_far_off_as_the_start_is_if_nothing_moves(plain_hand, monkeypatch, bench):
    monkeypatch.setattr(alignment, "moved_by", lambda method, source, target, outliers: source)
    scene = alignment.make_scene(plain_hand, SMALL)
    expected = 1e3 * (scene.skin(scene.start) - scene.skin(scene.cloud.pose)).norm(dim=-1).mean()
    found = alignment.run(replace(SMALL, solver=replace(SMALL.solver, method="cpd")), bench)
    assert found.metrics == {"points_mm": pytest.approx(float(expected), rel=1e-5)}


@pytest.mark.parametrize(("method", "package"), [("cpd", "pycpd"), ("gicp", "small_gicp")])
def test_other_programs_find_a_small_motion(method, package):
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    source = torch.rand(400, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 2.0, 3.0])
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.05, 0.0], [0.05, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    target = source @ turn.T + 0.03
    moved = peers.moved_by(method, source, target)
    before, after = ((points - target).norm(dim=-1).mean() for points in (source, moved))
    assert after < 0.3 * before


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


@pytest.mark.parametrize("dataset", ["robot", "car", "hand"])
def test_pairs_of_the_papers_kinds_have_exact_truth(dataset):
    pair = ScanPairConfig(dataset=dataset, num_points=700, frames=4, frame=2)
    problem = registration.make_problem(pair, 0)
    # Of points that the target sees, most have a neighbor there; the others are hidden.
    assert float(torch.cdist(problem.truth, problem.target.points).amin(1).median()) < problem.target.spacing
    assert registration._accuracy(problem, problem.truth)["error_percent"] == 0
    assert registration._accuracy(problem, problem.source.points)["motion_percent"] > 0.5
    assert not torch.equal(registration.make_problem(replace(pair, frame=1), 0).source.points, problem.source.points)


def test_pairs_that_are_not_registered_are_tried_again_with_other_parameters(monkeypatch, toy):
    tried = []

    def register(source, target, *, num_bones, config, grid_resolution, generator):
        tried.append((config.printed.max_distance, grid_resolution, generator.initial_seed()))
        return SimpleNamespace(deformed=toy.truth if len(tried) == 3 else source.points + source.diagonal)

    monkeypatch.setattr(registration.tr, "register", register, raising=False)
    trial = RegistrationTrial(method="paper", retries=5)
    assert registration._registered(toy, trial)[1] == 3
    assert len(set(tried)) == 3
    assert tried[0] == (20.0, 50, 0)
    tried.clear()
    assert registration._registered(toy, replace(trial, retries=0))[1] == 1


def test_settings_of_the_library_are_its_own_or_reached_by_their_names():
    assert registration._settings(RegistrationTrial()) == tr.RegisterConfig()
    assert registration._settings(RegistrationTrial(joint_weight=0.0)).joint_weight == (0.0, 0.0)
    changed = registration._settings(RegistrationTrial(config={"refine": {"smoothness": 0.3}, "max_angle": [1.0, 0.4]}))
    assert (changed.refine.smoothness, changed.max_angle) == (0.3, (1.0, 0.4))
    printed = registration._settings(RegistrationTrial(method="paper", config={"printed.max_distance": 30.0}))
    assert printed == tr.RegisterConfig.paper(printed=replace(tr.RegisterConfig.paper().printed, max_distance=30.0))


def test_errors_of_scans_leave_out_parts_that_the_target_lacks(toy):
    assert toy.pair.missing.any()
    moved = toy.truth.clone()
    moved[toy.pair.missing] += 10
    perfect = registration._accuracy(toy, moved)
    assert (perfect["registered"], perfect["near_percent"], perfect["error_percent"]) == (1, 100, 0)
    assert registration._accuracy(toy, toy.truth + 0.1 * toy.diagonal)["near_percent"] == 0


def test_a_captured_sequence_from_a_file(tmp_path, bench):
    still = spine.creature_sequence(spine.STARFISH, 1, resolution=24).meshes[0]
    vertices = torch.stack([still.vertices + shift for shift in (0.0, 0.1, 0.2, 0.3)])
    np.savez(tmp_path / "moving.npz", vertices=vertices, faces=still.faces)
    trial = schema.SpineTrial(creature="file", folder=str(tmp_path), name="moving", frames=2, pictures=True)
    found = spine.run(trial, bench)
    assert (found.metrics["frames"], found.metrics["tips"]) == (2, 5)
    assert (found.metrics["named"], found.metrics["trees_after"]) == (1, 1)
    assert found.curves == {"own_tips": [5, 5], "tips": [5, 5]}
    for topology, tips in (("(()()()()())", 5), ("((()())()(()()))", 5), ("(()())", 2)):
        assert spine.count_tips(topology) == tips


def test_experiments_use_the_public_library_alone():
    """Top-level names, data sets, scores and pictures; and how files are written in one step.

    But what trains the weights of the package builds a part of it, and made-up data are made of its geometry.
    """
    assert all(callable(task.load()) for task in TASKS.values())
    allowed = ("torchreg.datasets.", "torchreg.viz.", "torchreg.metrics", "torchreg.io.atomic")
    for path in (ROOT / "experiments").rglob("*.py"):
        if path.parent.name in ("matcher", "made_up"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("torchreg."):
                assert node.module.startswith(allowed), f"{path}:{node.lineno}"
                assert not any(name.name.startswith("_") for name in node.names)
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "tr":
                assert node.attr in tr.__all__, f"{path}:{node.lineno}: tr.{node.attr} is not public"
