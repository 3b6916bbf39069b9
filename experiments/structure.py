"""Plain data into dataclasses and back, strictly: errors give the full name of an unknown key or a wrong type."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import math
import types
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from .errors import ConfigError

T = TypeVar("T")


def build(kind: type[T], data: Any, path: str = "") -> T:
    """Return a dataclass made of nested mappings.

    Args:
        kind: the dataclass.
        data: its fields; those left out take their defaults.
        path: name of ``data`` in messages, empty at the top.

    Raises:
        ConfigError: for an unknown key, naming the known ones; for a wrong type, a missing field or a value out of
            range.
    """
    if not isinstance(data, Mapping):
        raise ConfigError(f"{path or 'the configuration'} must be a mapping, got {_told(data)}")
    fields, hints = _schema(cast(Any, kind))
    for key in data:
        if key not in fields:
            raise unknown_key(str(key), fields, path)
    values = {key: convert(hints[key], value, joined(path, key)) for key, value in data.items()}
    for name, item in fields.items():
        required = item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING
        if required and name not in values:
            raise ConfigError(f"{joined(path, name)} is missing")
    try:
        return kind(**values)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(joined(path, str(error))) from error


@functools.cache
def _schema(kind: Any) -> tuple[dict[str, dataclasses.Field[Any]], dict[str, Any]]:
    return {item.name: item for item in dataclasses.fields(kind)}, get_type_hints(kind)


def convert(kind: Any, value: Any, path: str) -> Any:
    """Return a value as the type of a field, or raise a ConfigError that names the field."""
    origin, arguments = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin is Literal:
        if value not in arguments or isinstance(value, bool):
            raise ConfigError(f"{path} must be one of {', '.join(map(str, arguments))}, got {_told(value)}")
        return value
    if origin in (Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        return convert(next(argument for argument in arguments if argument is not type(None)), value, path)
    if origin is tuple:
        if isinstance(value, str) or not isinstance(value, Sequence):
            raise ConfigError(f"{path} must be a list, got {_told(value)}")
        return tuple(convert(arguments[0], item, f"{path}[{number}]") for number, item in enumerate(value))
    if origin is dict:
        if not isinstance(value, Mapping):
            raise ConfigError(f"{path} must be a mapping, got {_told(value)}")
        return dict(value)
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        return value if isinstance(value, kind) else build(kind, value, path)
    return _scalar(kind, value, path)


def _scalar(kind: type, value: Any, path: str) -> Any:
    good = isinstance(value, kind) and not (kind is not bool and isinstance(value, bool))
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        # One number has one spelling, so that 0 and 0.0 are the same trial.
        value, good = float(value), True
    if not good:
        raise ConfigError(f"{path} must be {_NAMES.get(kind, kind.__name__)}, got {_told(value)}")
    if kind is float and not math.isfinite(value):
        raise ConfigError(f"{path} must be finite, got {value}")
    return value


_NAMES = {int: "an integer", float: "a number", str: "a text", bool: "true or false"}


def unknown_key(key: str, known: Mapping[str, Any], path: str = "") -> ConfigError:
    """Return the error for a key that is not among the known ones."""
    close = difflib.get_close_matches(key, known, n=1)
    meant = f"; did you mean {close[0]}?" if close else ""
    where = f" of {path}" if path else ""
    return ConfigError(f"unknown key {joined(path, key)}; known keys{where}: {', '.join(sorted(known))}{meant}")


def joined(path: str, key: str) -> str:
    """Return the dotted name of a key."""
    return f"{path}.{key}" if path else key


def plain(value: Any) -> Any:
    """Return a dataclass as nested dictionaries and lists, ready for JSON."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {item.name: plain(getattr(value, item.name)) for item in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    return [plain(item) for item in value] if isinstance(value, (tuple, list)) else value


def flatten(data: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Return nested mappings as one, with dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in data.items():
        name = joined(path, str(key))
        flat |= flatten(value, name) if isinstance(value, Mapping) else {name: value}
    return flat


def updated(config: T, changes: Mapping[str, Any], path: str = "trial") -> T:
    """Return a dataclass with the fields of dotted keys changed, checked like a file.

    Raises:
        ConfigError: for an unknown key or a wrong type.
    """
    data = plain(config)
    for key, value in changes.items():
        *parents, last = key.split(".")
        place, kind = data, cast(Any, type(config))
        for depth, name in enumerate(parents):
            _check_known(name, place, kind, ".".join([path, *parents[:depth]]))
            place, kind = place.setdefault(name, {}), _kind_of(kind, name)
        _check_known(last, place, kind, ".".join([path, *parents]))
        place[last] = value
    return build(type(config), data, path)


def _check_known(key: str, place: Any, kind: Any, path: str) -> None:
    """Raise ConfigError unless a key is there, or its mapping takes any."""
    open_mapping = get_origin(kind) is dict or kind is dict
    if not isinstance(place, dict) or (key not in place and not open_mapping):
        raise unknown_key(key, place if isinstance(place, dict) else {}, path)


def _kind_of(kind: Any, name: str) -> Any:
    """Return the type of a field; of what lies in a mapping that takes any key, dict."""
    return _schema(kind)[1].get(name) if dataclasses.is_dataclass(cast(object, kind)) else dict


def beside(kind: type, key: str) -> list[str]:
    """Return the names of the fields beside that of a dotted key, or as far as the key is known."""
    found: Any = kind
    for name in key.split(".")[:-1]:
        inner = _schema(found)[1].get(name)
        if not dataclasses.is_dataclass(inner):
            break
        found = inner
    return sorted(_schema(found)[0])


def _told(value: Any) -> str:
    return f"{type(value).__name__} {value!r}"
