"""Further destinations of records: a sink is called with every new record. None is needed; the files suffice."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from .errors import ConfigError, ExperimentError
from .records import TrialRecord
from .structure import flatten


class Sink(Protocol):
    """A receiver of records, one by one, as trials end."""

    def __call__(self, record: TrialRecord) -> None:
        """Pass a record on."""
        ...


def make_sink(name: str, sweep: str, folder: str) -> Sink:
    """Return a sink by name.

    Args:
        name: "tensorboard", "mlflow" or "wandb".
        sweep: name of the sweep, for the sink's runs.
        folder: of the results, for sinks that write files.

    Raises:
        ConfigError: if there is no such sink.
        ExperimentError: if its package is not installed.
    """
    if name not in SINKS:
        raise ConfigError(f"unknown sink {name!r}; known sinks: {', '.join(SINKS)}")
    try:
        return SINKS[name](sweep, folder)
    except ImportError as error:
        raise ExperimentError(f"--sink {name} needs the package {error.name}, which is not installed") from error


def numbers_of(record: TrialRecord) -> dict[str, float]:
    """Return all numbers of a record by name."""
    numbers = record.metrics | {f"seconds.{name}": value for name, value in record.seconds.items()}
    return {name: float(value) for name, value in numbers.items() if value is not None}


def _tensorboard(sweep: str, folder: str) -> Sink:
    from torch.utils.tensorboard import SummaryWriter

    def send(record: TrialRecord) -> None:
        with SummaryWriter(f"{folder}/tensorboard/{record.id}") as writer:
            for name, values in record.curves.items():
                for step, value in enumerate(values):
                    if value is not None:
                        writer.add_scalar(f"{sweep}/{name}", value, step)
            writer.add_hparams(_settings(record), numbers_of(record), run_name=".")

    return send


def _mlflow(sweep: str, folder: str) -> Sink:
    import mlflow

    mlflow.set_experiment(sweep)

    def send(record: TrialRecord) -> None:
        with mlflow.start_run(run_name=record.id):
            mlflow.log_params(_settings(record))
            mlflow.log_metrics(numbers_of(record))
            mlflow.set_tags({"status": record.status, "commit": record.commit})

    return send


def _wandb(sweep: str, folder: str) -> Sink:
    import wandb

    def send(record: TrialRecord) -> None:
        run = wandb.init(
            project="torchreg", group=sweep, name=record.id, config=_settings(record), dir=folder, reinit=True
        )
        run.log(numbers_of(record))
        run.finish(exit_code=int(record.status == "failed"))

    return send


SINKS: dict[str, Callable[[str, str], Sink]] = {"tensorboard": _tensorboard, "mlflow": _mlflow, "wandb": _wandb}


def _settings(record: TrialRecord) -> dict[str, Any]:
    return {key: "" if value is None else value for key, value in flatten(record.config).items()}
