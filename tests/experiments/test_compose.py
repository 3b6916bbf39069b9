import dataclasses

import pytest

pytest.importorskip("hydra", reason="experiments take the extra experiments")

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


def test_several_values_are_an_axis(folder):
    found = load_sweep("probe/big", ["size=8,16", "trial.seconds=0.5,1", "seeds=2"], root=folder)
    assert found.grid == {"scale": [1, 2], "rounds": [2, 4, 8], "size": [8, 16], "seconds": [0.5, 1]}
    assert len(planned_trials(found)) == 2 * 3 * 2 * 2 * 2


def test_values_on_the_command_line_replace_those_of_the_file(folder):
    assert load_sweep("probe/big", ["scale=3,4,5"], root=folder).grid["scale"] == [3, 4, 5]
    one = load_sweep("probe/big", ["scale=3"], root=folder)
    assert one.grid["scale"] == [3]
    assert {trial.config["scale"] for trial in planned_trials(one)} == {3.0}


def test_values_are_read_by_hydras_grammar(folder):
    found = load_sweep("probe/big", ["size=range(1,4)", "log='a,b',c", "outcome=done,failed"], root=folder)
    assert (found.grid["size"], found.grid["log"], found.grid["outcome"]) == (
        [1, 2, 3],
        ["a,b", "c"],
        ["done", "failed"],
    )


def test_nested_fields_and_the_librarys_own_settings_are_swept():
    found = load_sweep("alignment/sigma_range_smoke", ["schedule.start=0.04,0.06", "config.outlier=1.0,limit"])
    trials = planned_trials(found)
    assert {trial.config["schedule"]["start"] for trial in trials} == {0.04, 0.06}
    assert {trial.config["config"]["outlier"] for trial in trials} == {1.0, "limit"}
    found = load_sweep(
        "registration/grid_bones_smoke", ["grid_resolution=20,40,80", "config.refine.smoothness=0.1,0.5"]
    )
    assert {trial.config["grid_resolution"] for trial in planned_trials(found)} == {20, 40, 80}
    assert {trial.config["config"]["refine"]["smoothness"] for trial in planned_trials(found)} == {0.1, 0.5}


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("schedule.strt=0.04,0.06", r"unknown key trial.schedule.strt; .* kappa, kind, start, steps, stop; did you"),
        ("schedule.start=0.04,-1", "schedule.start was given on the command line, .*: kappa, kind, start, steps, stop"),
        ("schedule.start=-1", "schedule.start was given on the command line, .*: kappa, kind, start, steps, stop"),
        ("schedule.start=0.04,wide", "trial.schedule.start must be a number, got str 'wide'; .* kappa, kind, start"),
        ("schedule.start=", "schedule.start is given no value; write schedule.start=VALUE, or .* to sweep it"),
        ("schedule.start=,", "schedule.start is given no value"),
        ("seeds=1,2", "seeds takes one value"),
        ("schedule.start.more=1,2", "unknown key trial.schedule.start.more"),
        ("config.outlir=1,2", "unknown key trial.config.outlir; known keys of trial.config: .*did you mean outlier"),
        ("config.outlier=-1.0,2.0", "trial.config.outlier: outlier must be positive .*; known keys of"),
        ("config.schedule.values=1,2", "unknown key trial.config.schedule.values"),
    ],
)  # fmt: skip
def test_a_wrong_sweep_is_told_with_the_fields_beside_it(override, message):
    with pytest.raises(ConfigError, match=message):
        load_sweep("alignment/sigma_range_smoke", [override])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("grid_resolution=20,1000", "grid_resolution must be at most 256, got 1000; .*: config, grid"),
        ("num_bones=0,4", "num_bones must be at least 1, got 0"),
        ("config.num_samples=0,4", "num_samples must be at least 1"),
    ],
)  # fmt: skip
def test_values_out_of_range_are_told_before_anything_runs(override, message):
    with pytest.raises(ConfigError, match=message):
        load_sweep("registration/grid_bones_smoke", [override])


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
        ("task=sculpture", "unknown task 'sculpture'; known tasks: alignment, neural_init, papers, probe"),
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
def test_every_configuration_of_the_repository_fits_its_schema(name, loaded_sweep):
    sweep = loaded_sweep(name)
    trials = planned_trials(sweep)
    assert trials
    assert name.startswith(sweep.task)
    axes = trials[0].axes
    assert set(sweep.report.heat) <= set(axes)
    assert not sweep.report.group or sweep.report.group in axes


@pytest.mark.parametrize("name", [name for name in known_configs() if "smoke" not in name])
def test_every_configuration_has_a_smoke_twin(name, loaded_sweep):
    small, full = loaded_sweep(f"{name}_smoke"), loaded_sweep(name)
    assert (CONFIGS / f"{name}_smoke.yaml").read_text().startswith("defaults:")
    assert len(planned_trials(small)) <= max(4, len(planned_trials(full)) // 4)
    assert small.seeds == 1
