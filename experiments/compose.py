"""Configurations read from files: Hydra's compose puts them together, the schema checks them.

Hydra merges files, defaults and overrides; nothing in a file is ever called or instantiated.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from experiments.errors import ConfigError, ExperimentError
from experiments.registry import find_task
from experiments.schema import SweepConfig
from experiments.structure import build, unknown_key

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
_FIELDS = {item.name: item for item in dataclasses.fields(SweepConfig)}


def known_configs(root: Path = CONFIGS) -> list[str]:
    """Return the names of all configurations, such as alignment/sigma_schedule."""
    return sorted(path.relative_to(root).with_suffix("").as_posix() for path in root.rglob("*.yaml"))


def load_sweep(name: str, overrides: Sequence[str] = (), root: Path = CONFIGS) -> SweepConfig:
    """Return a checked configuration.

    Args:
        name: of a file below ``root`` without its ending, or the path of a YAML file.
        overrides: each ``key=value`` in Hydra's grammar; keys that are no field of a `SweepConfig` are the trial's.
        root: folder of the configurations.

    Raises:
        ConfigError: naming the key that is unknown, of a wrong type or out of range, and the known ones.
        ExperimentError: if Hydra is not installed.
    """
    path = Path(name) if name.endswith((".yaml", ".yml")) else root / f"{name}.yaml"
    if not path.is_file():
        raise ConfigError(f"unknown configuration {name!r}; known ones: {', '.join(known_configs(root))}")
    data = _composed(path.resolve(), [_whole_key(text) for text in overrides])
    relative = path.resolve().relative_to(root.resolve()) if path.resolve().is_relative_to(root.resolve()) else path
    data.setdefault("name", relative.with_suffix("").as_posix() if relative != path else path.stem)
    return from_data(data)


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
        raise ConfigError(f"write key=value, such as seeds=3 or scene.outlier_ratio=0.4; got {override!r}")
    first = key.partition(".")[0]
    return f"++{key if first in _FIELDS else 'trial.' + key}={value}"


def _composed(path: Path, overrides: list[str]) -> dict[str, Any]:
    try:
        from hydra import compose, initialize_config_dir
        from hydra.errors import HydraException
        from omegaconf import OmegaConf
        from omegaconf.errors import OmegaConfBaseException
    except ImportError as error:
        raise ExperimentError("hydra is not installed: pip install 'torchreg[experiments]'") from error
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
