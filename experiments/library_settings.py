"""Any field of the library's own settings, by its dotted name: ``config.refine.smoothness=0.1,0.5``."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar, cast

import torchreg as tr

from .errors import ConfigError
from .structure import flatten, unknown_key

T = TypeVar("T")


def with_settings(config: T, changes: Mapping[str, Any], path: str = "trial.config") -> T:
    """Return settings of the library with fields changed.

    Args:
        config: a frozen dataclass of settings.
        changes: values by dotted name, or nested; lists stand for tuples.
        path: of ``changes`` in messages.

    Raises:
        ConfigError: for an unknown field, naming those beside it, and for a value that the library refuses.
    """
    for key, value in flatten(changes).items():
        config = _changed(config, key.split("."), tuple(value) if isinstance(value, list) else value, path)
    return config


def _changed(config: T, names: list[str], value: Any, path: str) -> T:
    """Return a dataclass with the field of a path of names changed."""
    fields = (
        {item.name for item in dataclasses.fields(cast(Any, config))} if dataclasses.is_dataclass(config) else set()
    )
    first, *rest = names
    if first not in fields:
        raise unknown_key(first, dict.fromkeys(fields), path)
    if rest:
        value = _changed(getattr(config, first), rest, value, f"{path}.{first}")
    try:
        return cast(T, dataclasses.replace(cast(Any, config), **{first: value}))
    except (tr.errors.InputError, tr.errors.InputTypeError, TypeError) as error:
        raise ConfigError(f"{path}.{first}: {error}; known keys of {path}: {', '.join(sorted(fields))}") from error
