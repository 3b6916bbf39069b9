"""The trials of a sweep: cases, times the grid, times seeds; each is identified by its configuration."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torchreg

from .errors import ConfigError
from .registry import find_task
from .schema import SweepConfig
from .structure import flatten, plain, updated

CASE = "case"
_ID_LENGTH = 16


@dataclass(frozen=True)
class PlannedTrial:
    """A trial of a sweep.

    Args:
        id: hash of version and configuration.
        config: resolved, as plain data.
        axes: what sets it apart in the sweep: values by axis, without the seed.
        seed: of it.
    """

    id: str
    config: dict[str, Any]
    axes: dict[str, Any]
    seed: int


def canonical(value: Any) -> str:
    """Return the one JSON text of plain data."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def trial_id(task: str, config: Mapping[str, Any], version: str = torchreg.__version__) -> str:
    """Return the name of a trial: a hash of the version, the task and the resolved configuration."""
    text = canonical({"version": version, "task": task, "config": config})
    return hashlib.sha256(text.encode()).hexdigest()[:_ID_LENGTH]


def axes_of(sweep: SweepConfig) -> dict[str, list[Any]]:
    """Return the axes and their values in the order of the file, the cases first.

    Raises:
        ConfigError: if an axis holds no list of values.
    """
    axes: dict[str, list[Any]] = {}
    if sweep.cases:
        axes[CASE] = [_label(case) for case in sweep.cases]
        if len(set(axes[CASE])) < len(sweep.cases):
            raise ConfigError(f"cases must have different names, got {', '.join(axes[CASE])}")
    for key, values in flatten(sweep.grid).items():
        if not isinstance(values, (list, tuple)) or not values:
            raise ConfigError(f"grid.{key} must be a list of values, got {values!r}")
        axes[key] = list(values)
    return axes


def planned_trials(sweep: SweepConfig) -> list[PlannedTrial]:
    """Return all trials of a sweep, seed by seed, so that a sweep that is stopped early covers all cases.

    Raises:
        ConfigError: if a case or axis names an unknown field or holds a wrong value.
    """
    return list(_trials(sweep))


def _trials(sweep: SweepConfig) -> Iterator[PlannedTrial]:
    axes = axes_of(sweep)
    cases = dict(zip(axes.pop(CASE, [None]), sweep.cases or ({},), strict=True))
    first, task = sweep.trial.seed, find_task(sweep.task)
    if "seed" in axes and sweep.seeds > 1:
        raise ConfigError("grid.seed and seeds > 1 say the same twice; give one of them")
    for number in range(sweep.seeds):
        for name, case in cases.items():
            for values in itertools.product(*axes.values()):
                point = dict(zip(axes, values, strict=True))
                changes = {key: value for key, value in case.items() if key != CASE} | point
                changes.setdefault("seed", first + number)
                if number < sweep.picture_seeds:
                    changes["pictures"] = True
                trial = updated(sweep.trial, changes)
                task.check(trial)
                config = plain(trial)
                shown = ({CASE: name} if name is not None else {}) | point
                yield PlannedTrial(trial_id(sweep.task, config), config, shown, int(config["seed"]))


def _label(case: Mapping[str, Any]) -> str:
    return str(case.get(CASE) or ", ".join(f"{key.split('.')[-1]} {value}" for key, value in case.items()))
