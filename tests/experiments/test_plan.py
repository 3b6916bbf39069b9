import pytest

from experiments.errors import ConfigError
from experiments.plan import axes_of, planned_trials, trial_id
from experiments.schema import AlignmentTrial, SweepConfig


def test_cases_times_grid_times_seeds(probe_sweep):
    sweep = probe_sweep(
        cases=({"case": "small", "size": 2}, {"size": 8, "rounds": 3}), grid={"scale": [1.0, 2.0]}, seeds=3
    )
    trials = planned_trials(sweep)
    assert len(trials) == len({trial.id for trial in trials}) == 12
    assert axes_of(sweep) == {"case": ["small", "size 8, rounds 3"], "scale": [1.0, 2.0]}
    assert trials[0].axes == {"case": "small", "scale": 1.0}
    assert trials[0].config["size"] == 2
    assert [trial.seed for trial in trials[::4]] == [0, 1, 2]
    assert trials[3].config | {"seed": 0} == {**trials[3].config, "size": 8, "rounds": 3, "scale": 2.0}


def test_nested_and_dotted_axes_are_one():
    def sweep(grid):
        return SweepConfig("s", "alignment", "q", AlignmentTrial(), grid=grid)

    dotted, nested = sweep({"scene.outlier_ratio": [0, 0.5]}), sweep({"scene": {"outlier_ratio": [0.0, 0.5]}})
    assert [trial.id for trial in planned_trials(dotted)] == [trial.id for trial in planned_trials(nested)]


def test_ids_depend_on_version_task_and_every_field_but_not_on_order_or_spelling(probe_sweep):
    config = planned_trials(probe_sweep())[0].config
    base = trial_id("probe", config)
    assert trial_id("probe", dict(reversed(config.items()))) == base
    assert trial_id("spine", config) != base
    assert trial_id("probe", config, version="99") != base
    assert len({trial_id("probe", config | {key: "changed"}) for key in config}) == len(config)
    whole, real = (planned_trials(probe_sweep(grid={"scale": [value]})) for value in (1, 1.0))
    assert whole[0].id == real[0].id


def test_pictures_are_kept_of_the_first_seeds():
    sweep = SweepConfig("s", "alignment", "q", AlignmentTrial(), seeds=3, picture_seeds=1)
    assert [trial.config["pictures"] for trial in planned_trials(sweep)] == [True, False, False]


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
