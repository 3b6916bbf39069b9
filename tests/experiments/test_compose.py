import dataclasses

import pytest

from experiments.compose import CONFIGS, from_data, known_configs, load_sweep
from experiments.errors import ConfigError
from experiments.plan import planned_trials
from experiments.registry import TASKS
from experiments.schema import ReportConfig, SweepConfig


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "probe").mkdir()
    (tmp_path / "probe/big.yaml").write_text(
        "task: probe\nquestion: why?\ntrial: {size: 16}\ngrid:\n  scale: [1, 2]\n  rounds: [2, 4, 8]\nseeds: 5\n"
    )
    (tmp_path / "probe/small.yaml").write_text(
        "defaults: [big, _self_]\ntrial: {size: 4}\ngrid: {rounds: [2]}\nseeds: 1\n"
    )
    return tmp_path


def test_files_are_composed_and_checked(folder):
    big, small = load_sweep("probe/big", root=folder), load_sweep("probe/small", root=folder)
    assert (big.name, big.trial.size, big.seeds) == ("probe/big", 16, 5)
    assert (small.name, small.trial.size, small.question) == ("probe/small", 4, "why?")
    assert small.grid == {"scale": [1, 2], "rounds": [2]}
    assert len(planned_trials(big)) == 30
    assert len(planned_trials(small)) == 2


def test_a_file_may_lie_anywhere(folder, tmp_path):
    own = tmp_path / "own.yaml"
    own.write_text("task: probe\nquestion: why?\n")
    assert load_sweep(str(own), root=folder / "probe").name == "own"


def test_overrides_reach_every_field(folder):
    found = load_sweep("probe/big", ["size=8", "trial.seconds=0.5", "seeds=2", "grid.scale=[3]"], root=folder)
    assert (found.trial.size, found.trial.seconds, found.seeds, found.grid["scale"]) == (8, 0.5, 2, [3])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("sizes=8", r"unknown key trial.sizes; known keys of trial: .*rounds.*size.*did you mean size\?"),
        ("size=big", "trial.size must be an integer, got str 'big'"),
        ("seeds=0", "seeds must be at least 1"),
        ("seeds", "write key=value"),
        ("~trial.size=1", "write key=value"),
        ("trial.size=[1", "big.yaml cannot be read"),
        ("task=sculpture", "unknown task 'sculpture'; known tasks: alignment, neural_init, probe, registration, spine"),
        ("report.colour=red", "unknown key report.colour; known keys of report: curve_log"),
    ],
)
def test_wrong_overrides_are_named(folder, override, message):
    with pytest.raises(ConfigError, match=message):
        load_sweep("probe/big", [override], root=folder)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("task: [probe", "cannot be read"),
        ("- a\n- b\n", "cannot be read|must hold a mapping"),
        ("task: probe\nquestion: q\nsead: 1\n", "unknown key sead; known keys: cases, grid, name"),
        ("question: q\n", "task must be the name of a task, got None"),
        ("task: probe\n", "question is missing"),
        ("defaults: [missing]\ntask: probe\n", "cannot be read"),
        ("task: probe\nquestion: q\ntrial: {size: ${nowhere}}\n", "cannot be read"),
    ],
)
def test_wrong_files_are_named(tmp_path, text, message):
    (tmp_path / "wrong.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_sweep("wrong", root=tmp_path)


def test_an_unknown_configuration_is_answered_with_the_known_ones(folder):
    with pytest.raises(ConfigError, match="unknown configuration 'probe/bug'; known ones: probe/big, probe/small"):
        load_sweep("probe/bug", root=folder)


def test_nothing_in_a_file_is_called(tmp_path):
    (tmp_path / "evil.yaml").write_text("task: probe\nquestion: q\ntrial: {_target_: os.system}\n")
    with pytest.raises(ConfigError, match=r"unknown key trial\._target_"):
        load_sweep("evil", root=tmp_path)


def test_a_wrong_value_in_plain_data_is_named():
    with pytest.raises(ConfigError, match=r"report\.heat must name two axes"):
        from_data({"name": "x", "task": "probe", "question": "q", "report": {"heat": ["a"]}})


def test_no_task_has_a_field_that_a_sweep_has_too():
    """Overrides are told apart by their first name."""
    own = {item.name for item in dataclasses.fields(SweepConfig)} | {
        item.name for item in dataclasses.fields(ReportConfig)
    } - {"name"}
    for task in TASKS.values():
        names = {item.name for item in dataclasses.fields(task.schema)} - {"name"}
        assert not names & own


@pytest.mark.parametrize("name", known_configs())
def test_every_configuration_of_the_repository_fits_its_schema(name):
    sweep = load_sweep(name)
    trials = planned_trials(sweep)
    assert trials
    assert name.startswith(sweep.task)
    axes = trials[0].axes
    assert set(sweep.report.heat) <= set(axes)
    assert not sweep.report.group or sweep.report.group in axes


@pytest.mark.parametrize("name", [name for name in known_configs() if "smoke" not in name])
def test_every_configuration_has_a_smoke_twin(name):
    small, full = load_sweep(f"{name}_smoke"), load_sweep(name)
    assert (CONFIGS / f"{name}_smoke.yaml").read_text().startswith("defaults:")
    assert len(planned_trials(small)) <= max(4, len(planned_trials(full)) // 4)
    assert small.seeds == 1
