"""Configurations: composed from files and command lines, checked by name, and turned into trials."""

import dataclasses
import time
from typing import Literal

import pytest

pytest.importorskip("hydra", reason="experiments take the extra experiments")

from experiments.compose import CONFIGS, known_configs, load_sweep
from experiments.errors import ConfigError
from experiments.plan import axes_of, planned_trials, trial_id
from experiments.registry import TASKS
from experiments.schema import AlignmentTrial, ReportConfig, SweepConfig
from experiments.structure import build, flatten, plain, updated


@dataclasses.dataclass(frozen=True)
class Inner:
    size: int = 3
    width: float = 1.0
    kind: Literal["a", "b"] = "a"

    def __post_init__(self):
        if self.size < 0:
            raise ValueError("size must not be negative")


@dataclasses.dataclass(frozen=True)
class Outer:
    name: str
    inner: Inner = dataclasses.field(default_factory=Inner)
    ratio: float | None = None
    values: tuple[float, ...] = ()
    on: bool = False
    extra: dict[str, object] = dataclasses.field(default_factory=dict)


def test_plain_data_become_dataclasses_and_come_back():
    data = {"name": "x", "inner": {"size": 4, "kind": "b"}, "ratio": 2, "values": [1, 2.5], "on": True}
    found = build(Outer, data)
    assert found == Outer("x", Inner(4, 1.0, "b"), 2.0, (1.0, 2.5), True)
    assert isinstance(found.ratio, float)
    assert isinstance(found.values[0], float)
    assert build(Outer, plain(found)) == found
    assert flatten(plain(found))["inner.size"] == 4
    assert updated(Outer("x"), {"inner.size": 7, "ratio": 1}) == Outer("x", Inner(7), 1.0)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"inner": {"sizes": 4}}, r"unknown key inner.sizes; known keys of inner: kind, size, width; .*size"),
        ({"nam": "x"}, r"unknown key nam; known keys: extra, inner, name, on, ratio, values; did you mean name\?"),
        ({}, "name is missing"),
        ({"name": 3}, "name must be a text, got int 3"),
        ({"inner": {"size": True}}, "inner.size must be an integer, got bool True"),
        ({"inner": {"kind": "c"}}, "inner.kind must be one of a, b, got str 'c'"),
        ({"inner": {"size": -1}}, "inner.size must not be negative"),
        ({"ratio": "many"}, "ratio must be a number, got str 'many'"),
        ({"ratio": float("nan")}, "ratio must be finite"),
        ({"values": [1, "b"]}, r"values\[1\] must be a number, got str 'b'"),
        ({"on": 1}, "on must be true or false, got int 1"),
        ([1], "the configuration must be a mapping"),
    ],
)
def test_wrong_data_are_named(data, message):
    named = {"name": "x", **data} if isinstance(data, dict) and data and "nam" not in data else data
    with pytest.raises(ConfigError, match=message):
        build(Outer, named)


def test_cases_times_grid_times_seeds(probe_sweep):
    cases = ({"case": "small", "size": 2}, {"size": 8, "rounds": 3})
    sweep = probe_sweep(cases=cases, grid={"scale": [1.0, 2.0]}, seeds=3)
    trials = planned_trials(sweep)
    assert len(trials) == len({trial.id for trial in trials}) == 12
    assert axes_of(sweep) == {"case": ["small", "size 8, rounds 3"], "scale": [1.0, 2.0]}
    assert trials[0].axes == {"case": "small", "scale": 1.0}
    assert trials[0].config["size"] == 2
    assert [trial.seed for trial in trials[::4]] == [0, 1, 2]
    assert trials[3].config | {"seed": 0} == {**trials[3].config, "size": 8, "rounds": 3, "scale": 2.0}


def test_ids_depend_on_version_task_and_every_field_but_not_on_order_or_spelling(probe_sweep):
    config = planned_trials(probe_sweep())[0].config
    base = trial_id("probe", config)
    assert trial_id("probe", dict(reversed(config.items()))) == base
    assert trial_id("spine", config) != base
    assert trial_id("probe", config, version="99") != base
    assert len({trial_id("probe", config | {key: "changed"}) for key in config}) == len(config)
    whole, real = (planned_trials(probe_sweep(grid={"scale": [value]})) for value in (1, 1.0))
    assert whole[0].id == real[0].id
    grids = {"scene.outlier_ratio": [0, 0.5]}, {"scene": {"outlier_ratio": [0.0, 0.5]}}
    sweeps = [SweepConfig("s", "alignment", "q", AlignmentTrial(), grid=grid, picture_seeds=1) for grid in grids]
    dotted, nested = ([trial.id for trial in planned_trials(sweep)] for sweep in sweeps)
    assert dotted == nested
    pictures = planned_trials(dataclasses.replace(sweeps[0], grid={}, seeds=3))
    assert [trial.config["pictures"] for trial in pictures] == [True, False, False]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"grid": {"scales": [1.0]}}, "unknown key trial.scales; known keys of trial: .*scale"),
        ({"grid": {"scale": ["a"]}}, "trial.scale must be a number, got str 'a'"),
        ({"grid": {"scale": 1.0}}, "grid.scale must be a list of values, got 1.0"),
        ({"grid": {"scale": []}}, "grid.scale must be a list of values"),
        ({"grid": {"seed": [1, 2]}, "seeds": 2}, "grid.seed and seeds > 1 say the same twice"),
        ({"cases": ({"case": "a"}, {"case": "a", "size": 2})}, "cases must have different names, got a, a"),
        ({"cases": ({"case": "a", "sizes": 2},)}, "unknown key trial.sizes"),
    ],
)
def test_wrong_sweeps_are_named(probe_sweep, settings, message):
    with pytest.raises(ConfigError, match=message):
        planned_trials(probe_sweep(**settings))


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


def test_files_are_composed_and_lie_anywhere(folder, tmp_path):
    big, small = load_sweep("probe/big", root=folder), load_sweep("probe/small", root=folder)
    assert (big.name, big.trial.size, big.seeds) == ("probe/big", 16, 5)
    assert (small.name, small.trial.size, small.question) == ("probe/small", 4, "why?")
    assert small.grid == {"scale": [1, 2], "rounds": [2]}
    assert (len(planned_trials(big)), len(planned_trials(small))) == (30, 2)
    (tmp_path / "own.yaml").write_text("task: probe\nquestion: &q why?\ntrial: {}\ngrid: {scale: &s [1.0, 2.0]}\n")
    own = load_sweep(str(tmp_path / "own.yaml"), root=folder / "probe")
    assert (own.name, own.grid["scale"]) == ("own", [1.0, 2.0])


@pytest.mark.parametrize(
    ("overrides", "grid"),
    [
        (["size=8,16", "trial.seconds=0.5,1"], {"scale": [1, 2], "size": [8, 16], "seconds": [0.5, 1]}),
        (["scale=3,4,5"], {"scale": [3, 4, 5]}),
        (["scale=3"], {"scale": [3]}),
        (["grid.scale=[3]"], {"scale": [3]}),
        (["size=range(1,4)", "log='a,b',c"], {"size": [1, 2, 3], "log": ["a,b", "c"]}),
    ],
)
def test_command_lines_replace_and_sweep_fields(folder, overrides, grid):
    found = load_sweep("probe/big", [*overrides, "seeds=2"], root=folder)
    assert found.grid == {"scale": [1, 2], "rounds": [2, 4, 8], **grid}
    assert found.seeds == 2
    assert load_sweep("probe/big", ["size=8"], root=folder).trial.size == 8


@pytest.mark.parametrize(
    ("name", "override", "message"),
    [
        ("sigma", "schedule.strt=0.04,0.06", r"unknown key trial.schedule.strt; .* start, steps, stop; did"),
        ("sigma", "schedule.start=0.04,-1", "schedule.start was given on the command line, .*: kappa, kind"),
        ("sigma", "schedule.start=0.04,wide", "trial.schedule.start must be a number, got str 'wide'; .* kappa, kind"),
        ("sigma", "schedule.start=", "schedule.start is given no value; write schedule.start=VALUE, or .* to sweep it"),
        ("sigma", "seeds=1,2", "seeds takes one value"),
        ("sigma", "config.outlir=1,2", "unknown key trial.config.outlir; known keys of trial.config: .*mean outlier"),
        ("sigma", "config.outlier=-1.0,2.0", "trial.config.outlier: outlier must be positive .*; known keys of"),
        ("sigma", "config.schedule.values=1,2", "unknown key trial.config.schedule.values"),
        ("bones", "grid_resolution=20,1000", "grid_resolution must be at most 256, got 1000; .*: config, grid"),
        ("bones", "num_bones=0,4", "num_bones must be at least 1, got 0"),
        ("probe", "sizes=8", r"unknown key trial.sizes; known keys of trial: .*rounds.*size.*did you mean size\?"),
        ("probe", "seeds=0", "seeds must be at least 1"),
        ("probe", "seeds", "write key=value"),
        ("probe", "trial.size=[1", "big.yaml cannot be read"),
        ("probe", "task=sculpture", "unknown task 'sculpture'; known tasks: alignment, neural_init, papers, probe"),
        ("probe", "report.colour=red", "unknown key report.colour; known keys of report: curve_log"),
        ("bug", "size=3", "unknown configuration 'probe/bug'; known ones: probe/big, probe/small"),
    ],
)  # fmt: skip
def test_wrong_overrides_are_named_before_anything_runs(folder, name, override, message):
    names = {"sigma": "alignment/sigma_range_smoke", "bones": "registration/grid_bones_smoke", "probe": "probe/big"}
    root = {"root": folder} if name in ("probe", "bug") else {}
    with pytest.raises(ConfigError, match=message):
        load_sweep(names.get(name, "probe/bug"), [override], **root)


BOMB = [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 12)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("task: [probe", "cannot be read"),
        ("task: probe\nquestion: q\nsead: 1\n", "unknown key sead; known keys: cases, grid, name"),
        ("question: q\n", "task must be the name of a task, got None"),
        ("task: probe\n", "question is missing"),
        # Hostile ones: nothing in a file is called, and nothing grows without a bound.
        ("task: probe\nquestion: q\ntrial: {_target_: os.system}\n", r"unknown key trial\._target_"),
        ("\n".join(["a0: &a0 [x, x, x, x, x, x, x, x, x, x]", *BOMB]), "more than 100000 values, aliases included"),
        ("a: " + "[" * 200 + "]" * 200, "deep within each other"),
        ("# " + "x" * 1_000_001, "have at most 1000000"),
        ("task: probe\nquestion: ${oc.env:PATH}\n", "environment variables"),
        ("a: &a [*a]", "cannot be read|unknown"),
        ("\t\x00", "cannot be read"),
    ],
)
def test_wrong_files_are_named(tmp_path, text, message):
    (tmp_path / "wrong.yaml").write_text(text)
    begin = time.perf_counter()
    with pytest.raises(ConfigError, match=message):
        load_sweep("wrong", root=tmp_path)
    assert time.perf_counter() - begin < 5


def test_no_task_has_a_field_that_a_sweep_has_too():
    """The first name of an override decides whose field it is."""
    own = {item.name for config in (SweepConfig, ReportConfig) for item in dataclasses.fields(config)} - {"name"}
    for task in TASKS.values():
        assert not ({item.name for item in dataclasses.fields(task.schema)} - {"name"}) & own


@pytest.mark.parametrize("name", known_configs())
def test_every_configuration_of_the_repository_fits_its_schema_and_has_a_smoke_twin(name, loaded_sweep):
    sweep = loaded_sweep(name)
    trials = planned_trials(sweep)
    assert name.startswith(sweep.task)
    axes = trials[0].axes
    assert set(sweep.report.heat) <= set(axes)
    assert not sweep.report.group or sweep.report.group in axes
    if "smoke" not in name:
        small = loaded_sweep(f"{name}_smoke")
        assert (CONFIGS / f"{name}_smoke.yaml").read_text().startswith("defaults:")
        assert len(planned_trials(small)) <= max(4, len(trials) // 4)
        assert (small.seeds, small.report, small.task) == (1, sweep.report, sweep.task)
