"""Configurations read from files: Hydra's compose puts them together, the schema checks them.

Hydra merges files, defaults and overrides; nothing in a file is ever called or instantiated.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from .errors import ConfigError, ExperimentError
from .plan import planned_trials
from .registry import find_task
from .schema import SweepConfig
from .structure import beside, build, flatten, unknown_key

# Beside the package in a checkout, inside it where it is installed.
_INSTALLED = Path(__file__).resolve().parent / "configs"
CONFIGS = _INSTALLED if _INSTALLED.is_dir() else Path(__file__).resolve().parents[1] / "configs"
_FIELDS = {item.name: item for item in dataclasses.fields(SweepConfig)}


def known_configs(root: Path = CONFIGS) -> list[str]:
    """Return the names of all configurations, such as alignment/sigma_schedule."""
    return sorted(path.relative_to(root).with_suffix("").as_posix() for path in root.rglob("*.yaml"))


def load_sweep(name: str, overrides: Sequence[str] = (), root: Path = CONFIGS) -> SweepConfig:
    """Return a checked configuration.

    Args:
        name: of a file below ``root`` without its ending, or the path of a YAML file.
        overrides: each ``key=value`` in Hydra's grammar; keys that are no field of a `SweepConfig` are the trial's.
            Several values, ``schedule.start=0.04,0.06``, are an axis of the grid, in place of the file's own.
        root: folder of the configurations.

    Raises:
        ConfigError: naming the key that is unknown, of a wrong type or out of range, and the known ones.
        ExperimentError: if Hydra is not installed.
    """
    path = Path(name) if name.endswith((".yaml", ".yml")) else root / f"{name}.yaml"
    if not path.is_file():
        raise ConfigError(f"unknown configuration {name!r}; known ones: {', '.join(known_configs(root))}")
    axes = swept_fields(overrides)
    single = [text for text in overrides if _trial_key(text) not in axes]
    data = _composed(path.resolve(), [_whole_key(text) for text in single])
    keys = [_trial_key(text) for text in overrides]
    data["grid"] = _grid(data, axes, [key for key in keys if key not in axes])
    relative = path.resolve().relative_to(root.resolve()) if path.resolve().is_relative_to(root.resolve()) else path
    data.setdefault("name", relative.with_suffix("").as_posix() if relative != path else path.stem)
    try:
        sweep = from_data(data)
        planned_trials(replace(sweep, grid={key: sweep.grid[key] for key in axes}, cases=(), seeds=1, picture_seeds=0))
    except ConfigError as error:
        raise _with_neighbors(error, data.get("task"), keys) from error
    return sweep


def swept_fields(overrides: Sequence[str]) -> dict[str, list[Any]]:
    """Return the values of the trial's fields that are given several, ``schedule.start=0.04,0.06``, by dotted name.

    Raises:
        ConfigError: if a field is given no value, or is not the trial's.
        ExperimentError: if Hydra is not installed.
    """
    axes = {}
    for text in overrides:
        values = _several_values(text)
        if values is None:
            continue
        key = _trial_key(text)
        if key.partition(".")[0] in _FIELDS:
            raise ConfigError(f"{key} takes one value: it is a field of the sweep, only fields of the trial are swept")
        axes[key] = values
    return axes


def _several_values(text: str) -> list[Any] | None:
    """Return the values of an override in Hydra's grammar, None if it is one value or cannot be read."""
    try:
        from hydra.core.override_parser.overrides_parser import OverridesParser
        from hydra.core.override_parser.types import QuotedString, Transformer
        from hydra.errors import HydraException
    except ImportError as error:
        raise ExperimentError("hydra is not installed: pip install 'torchreg-articulated[experiments]'") from error
    try:
        parsed = OverridesParser.create().parse_override(_whole_key(text))
    except HydraException:
        return None
    if not parsed.is_sweep_override():
        return None
    values = list(parsed.sweep_iterator(transformer=Transformer.identity))
    return [value.text if isinstance(value, QuotedString) else value for value in values]


def _grid(data: dict[str, Any], axes: dict[str, list[Any]], single: list[str]) -> dict[str, Any]:
    """Return the file's grid with axes from the command line, and those that were given one value left with it."""
    own = data.get("grid") or {}
    if not isinstance(own, dict):
        raise ConfigError(f"grid must be a mapping, got {type(own).__name__} {own!r}")
    grid, trial = flatten(own), flatten(data.get("trial") or {})
    return {**grid, **{key: [trial[key]] for key in single if key in grid and key in trial}, **axes}


def _with_neighbors(error: ConfigError, task: Any, keys: Sequence[str]) -> ConfigError:
    """Return an error about fields given on the command line that also tells the fields beside them."""
    text = str(error)
    for key in keys:
        near = ".".join(["trial", *key.split(".")[:-1]])
        if near in text and "known keys" not in text and isinstance(task, str):
            names = ", ".join(beside(find_task(task).schema, key))
            text += f"; {key} was given on the command line, known keys of {near}: {names}"
    return ConfigError(text)


def from_data(data: dict[str, Any]) -> SweepConfig:
    """Return the checked configuration of plain data, as `plain` makes it.

    Raises:
        ConfigError: as `load_sweep`.
    """
    for key in data:
        if key not in _FIELDS:
            raise unknown_key(str(key), _FIELDS)
    task = data.get("task")
    if not isinstance(task, str):
        raise ConfigError(f"task must be the name of a task, got {task!r}")
    trial: Any = build(find_task(task).schema, data.get("trial") or {}, "trial")
    return build(SweepConfig, {**data, "trial": trial})


def _whole_key(override: str) -> str:
    """Return an override of a key that may be new to the file, but not to the schema."""
    key, sign, value = override.partition("=")
    if not sign or not key or not key[0].isalpha():
        raise ConfigError(
            f"write key=value, such as seeds=3 or scene.outlier_ratio=0.4, or several values to sweep a field, "
            f"schedule.start=0.04,0.06; got {override!r}"
        )
    if not value.strip(" ,"):
        raise ConfigError(f"{key} is given no value; write {key}=VALUE, or {key}=VALUE,VALUE to sweep it")
    first = key.partition(".")[0]
    return f"++{key if first in _FIELDS else 'trial.' + key}={value}"


def _trial_key(override: str) -> str:
    """Return the dotted name of an override's field, without the trial's own name before it."""
    return override.partition("=")[0].removeprefix("trial.")


def _composed(path: Path, overrides: list[str]) -> dict[str, Any]:
    try:
        from hydra import compose, initialize_config_dir
        from hydra.errors import HydraException
        from omegaconf import OmegaConf
        from omegaconf.errors import OmegaConfBaseException
    except ImportError as error:
        raise ExperimentError("hydra is not installed: pip install 'torchreg-articulated[experiments]'") from error
    _check_text(path)
    try:
        with (
            warnings.catch_warnings(),
            initialize_config_dir(str(path.parent), version_base="1.3", job_name="experiments"),
        ):
            # A list of defaults without _self_ is read as it always was: the file last.
            warnings.simplefilter("ignore", UserWarning)
            found = OmegaConf.to_container(compose(path.stem, overrides=overrides), resolve=True)
    except (HydraException, OmegaConfBaseException, yaml.YAMLError, RecursionError, ValueError, OSError) as error:
        raise ConfigError(f"{path.name} cannot be read: {error}") from error
    if not isinstance(found, dict):
        raise ConfigError(f"{path.name} must hold a mapping")
    return {str(key): value for key, value in found.items()}


@dataclasses.dataclass(frozen=True)
class _TextLimits:
    """Largest files of configurations."""

    size: int = 1_000_000  # bytes
    nodes: int = 100_000  # values, those that aliases repeat counted each time
    depth: int = 50  # of values within each other


_LIMITS = _TextLimits()


def _check_text(path: Path) -> None:
    """Raise ConfigError if a file is too large, its aliases repeat too much, or it asks for the environment."""
    try:
        text = path.read_bytes()
        if len(text) > _LIMITS.size:
            raise ConfigError(f"{path.name} has {len(text)} bytes; configurations have at most {_LIMITS.size}")
        count = _count_nodes(text)
    except (yaml.YAMLError, ValueError, RecursionError, OSError) as error:
        raise (
            error if isinstance(error, ConfigError) else ConfigError(f"{path.name} cannot be read: {error}")
        ) from error
    if count > _LIMITS.nodes:
        raise ConfigError(f"{path.name} holds more than {_LIMITS.nodes} values, aliases included; write fewer")
    if b"${oc.env" in text:
        raise ConfigError(f"{path.name} asks for environment variables, which records would tell; write the value")


def _count_nodes(text: bytes) -> int:
    """Return how many values a document holds once aliases are replaced, without replacing them."""
    total, sizes, open_nodes = 0, dict[str, int](), list[tuple[str | None, int]]()
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            total += sizes.get(event.anchor, 1)
        elif isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append((event.anchor, total))
            total += 1
            if len(open_nodes) > _LIMITS.depth:
                raise ConfigError(f"values lie more than {_LIMITS.depth} deep within each other")
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_nodes.pop()
            if anchor is not None:
                sizes[anchor] = total - before
        elif isinstance(event, yaml.ScalarEvent):
            total += 1
        if total > _LIMITS.nodes:
            break
    return total
