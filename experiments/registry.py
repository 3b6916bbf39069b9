"""Tasks by name: each a dataclass of settings and a function that runs one trial.

The functions are loaded when a trial runs; configurations are read without them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from .errors import ConfigError
from .schema import AlignmentTrial, NeuralTrial, PaperTrial, ProbeTrial, RegistrationTrial, SpineTrial


@dataclass
class TrialOutcome:
    """The results of a trial.

    Args:
        metrics: that depend on the configuration alone, by name.
        seconds: by stage, which differ from run to run.
        curves: by name, a value per step.
        artifacts: by name, files in the trial's folder.
    """

    metrics: dict[str, float] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    curves: dict[str, list[float]] = field(default_factory=dict)
    artifacts: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Bench:
    """The surroundings of a trial.

    Args:
        device: "cpu" or "cuda".
        folder: for files to keep; made when it is asked for.
    """

    device: str
    folder: Path

    def file(self, name: str) -> Path:
        """Return the path of an artifact to write."""
        self.folder.mkdir(parents=True, exist_ok=True)
        return self.folder / name


Run = Callable[[Any, Bench], TrialOutcome]


@dataclass(frozen=True)
class Task:
    """A kind of trial.

    Args:
        name: in configurations.
        schema: dataclass of a trial's settings.
        module: in this package, that holds ``run(config, bench) -> TrialOutcome``.
        accelerated: whether a GPU is of use.
        settings: name in torchreg of the class that a trial's ``config`` changes fields of; none if empty.
    """

    name: str
    schema: type
    module: str
    accelerated: bool = False
    settings: str = ""

    def load(self) -> Run:
        """Return the function that runs one trial."""
        run: Run = import_module(self.module, __package__).run
        return run

    def check(self, trial: Any) -> None:
        """Raise ConfigError unless the library's settings have the fields that a trial changes, and take its values."""
        if self.settings and trial.config:
            import torchreg

            from .library_settings import with_settings

            kind = getattr(torchreg, self.settings)
            with_settings(kind.paper() if _method_of(trial) == "paper" else kind(), trial.config)


def _method_of(trial: Any) -> str:
    return str(getattr(getattr(trial, "solver", trial), "method", ""))


_TASKS = (
    Task("alignment", AlignmentTrial, ".tasks.alignment", accelerated=True, settings="AlignConfig"),
    Task("registration", RegistrationTrial, ".tasks.registration", settings="RegisterConfig"),
    Task("spine", SpineTrial, ".tasks.spine", settings="SpineConfig"),
    Task("neural_init", NeuralTrial, ".tasks.neural_init"),
    Task("papers", PaperTrial, ".papers.trial"),
    Task("probe", ProbeTrial, ".tasks.probe"),
)
TASKS = {task.name: task for task in _TASKS}


def find_task(name: str) -> Task:
    """Return a task by name.

    Raises:
        ConfigError: if there is none, naming those there are.
    """
    if name not in TASKS:
        raise ConfigError(f"unknown task {name!r}; known tasks: {', '.join(sorted(TASKS))}")
    return TASKS[name]
