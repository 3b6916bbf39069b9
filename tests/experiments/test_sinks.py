import sys
import types
from contextlib import contextmanager

import pytest

from experiments.driver import run_sweep
from experiments.errors import ConfigError, ExperimentError
from experiments.sinks import SINKS, make_sink


@pytest.mark.parametrize("name", SINKS)
def test_a_sink_whose_package_is_missing_says_so(name, monkeypatch, tmp_path):
    package = "torch.utils.tensorboard" if name == "tensorboard" else name
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ExperimentError, match=f"--sink {name} needs the package .*, which is not installed"):
        make_sink(name, "sweep", str(tmp_path))


def test_an_unknown_sink_is_answered_with_the_known_ones(tmp_path):
    with pytest.raises(ConfigError, match="unknown sink 'paper'; known sinks: tensorboard, mlflow, wandb"):
        make_sink("paper", "sweep", str(tmp_path))


def fake_mlflow(told):
    module = types.ModuleType("mlflow")

    @contextmanager
    def start_run(run_name):
        told.append(run_name)
        yield

    module.set_experiment = module.log_params = module.log_metrics = module.set_tags = told.append
    module.start_run = start_run
    return module


def fake_wandb(told):
    def init(**settings):
        told.append(settings["name"])
        return types.SimpleNamespace(log=told.append, finish=lambda exit_code: told.append(exit_code))

    module = types.ModuleType("wandb")
    module.init = init
    return module


def fake_tensorboard(told):
    class SummaryWriter:
        def __init__(self, folder):
            told.append(folder.rpartition("/")[2])

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def add_scalar(self, name, value, step):
            told.append((name, step))

        def add_hparams(self, settings, numbers, run_name):
            told.append(numbers)

    module = types.ModuleType("torch.utils.tensorboard")
    module.SummaryWriter = SummaryWriter
    return module


@pytest.mark.parametrize(
    ("name", "module", "make"),
    [
        ("mlflow", "mlflow", fake_mlflow),
        ("wandb", "wandb", fake_wandb),
        ("tensorboard", "torch.utils.tensorboard", fake_tensorboard),
    ],
)
def test_a_sink_hears_of_every_record(name, module, make, monkeypatch, store, probe_sweep, inline_engine):
    told = []
    monkeypatch.setitem(sys.modules, module, make(told))
    sink = make_sink(name, "probes", str(store.root))
    run_sweep(probe_sweep(), store, lambda: inline_engine, sinks=[sink])
    records, _ = store.records()
    assert {record.id for record in records} <= {one for one in told if isinstance(one, str)}
    values = [one["value"] for one in told if isinstance(one, dict) and "value" in one]
    assert sorted(values) == sorted(record.metrics["value"] for record in records)
