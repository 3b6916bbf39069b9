"""Results on disk: every field of a result is stored in safetensors and JSON files and restored exactly.

A file may name only public results and the types of their fields: no other objects are ever built from it.
"""

from __future__ import annotations

import io
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_finite, check_shape
from torchreg.alignment.results import AlignResult
from torchreg.errors import FormatError, InputError, InputTypeError, ModelError
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, local_path, open_zip, read_bytes
from torchreg.io.points import PARSER_ERRORS
from torchreg.io.pose_table import load_pose_table
from torchreg.io.tensors import FORMAT, load_tensors, save_tensors
from torchreg.result import Result, public
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.tracking.results import TrackResult


def save_result(result: Result, path: str | os.PathLike[str]) -> None:
    """Write a result to ``path`` and its JSON file; see `Result.save`."""
    name = type(result).__name__
    if _result_kind(name) is not type(result):
        raise InputTypeError(f"result must be of a public kind of torchreg, got {name}")
    tensors: dict[str, Tensor] = {}
    values = _encode_fields(result, "", _named_types(type(result)), tensors)
    save_tensors(path, tensors, {"kind": name, "fields": values})


def load(path: str | os.PathLike[str], *, limits: FileLimits = DEFAULT_LIMITS) -> Result:
    """Return the result that `Result.save` wrote, with all its fields, on the CPU.

    Args:
        path: the .safetensors file; its JSON file must lie beside it.
        limits: on the size of each of the two.

    Returns:
        The result, of the kind that was saved, such as an `AlignResult`.

    Raises:
        FileNotFoundError: if there is no such file.
        FormatError: if a file is missing or damaged, or holds no result that this release knows.
        InputError: if the ending is another.
    """
    tensors, metadata = load_tensors(path, limits=limits)
    name = metadata.get("kind")
    kind = _result_kind(name)
    if kind is None:
        raise FormatError(f"{path}: holds a result of kind {name!r}, which this release does not know")
    try:
        result: Result = _Decoder(tensors, _named_types(kind)).build(kind, metadata.get("fields"), "fields")
    except (_WrongContentError, ModelError, InputError) as error:
        raise FormatError(f"{path}: is not a complete {name} ({error}): the file is damaged") from error
    defect = result.shape_defect()
    if defect is not None:
        raise FormatError(f"{path}: is not a complete {name} ({defect}): the file is damaged")
    return result


def load_pose(path: str | os.PathLike[str], shape: ArticulatedShape, *, limits: FileLimits = DEFAULT_LIMITS) -> Tensor:
    """Return a pose (num_dofs,) of a shape from a file, in the shape's dtype unless that would round it noticeably.

    A saved `AlignResult`, or `TrackResult` for its last pose (.safetensors or its .json); or .json with a list of
    num_dofs numbers, or with values by name of degree of freedom, the others at rest; or .csv with a line of such
    names, of which the last row that is complete counts; or .npz with an array ``pose``, or a single array.
    """
    file = local_path(path)
    readers = {
        ".safetensors": _pose_of_result, ".json": _pose_of_json, ".npz": _pose_of_npz, ".csv": _pose_of_table,
    }  # fmt: skip
    if file.suffix.lower() not in readers:
        file.stat()  # a missing file is reported first
        raise FormatError(f"{file} has the ending {file.suffix!r}; a pose is read from {', '.join(readers)}")
    values = readers[file.suffix.lower()](file, shape, limits)
    exact = torch.as_tensor(values, dtype=torch.float64, device=shape.rest.device)
    pose = as_float_tensor(values, f"the pose in {file}", like=shape.rest)
    check_shape(pose, f"the pose in {file}", (shape.num_dofs,))
    check_finite(pose, f"the pose in {file}")
    return exact if bool(((exact - pose.double()).abs() > _ROUNDING).any()) else pose


# Metres, or radians, by which a pose may be rounded unnoticed.
_ROUNDING = 1e-5


def _pose_of_table(file: Path, shape: ArticulatedShape, limits: FileLimits) -> Tensor:
    rows = load_pose_table(file, shape.dof_names, limits=limits)
    complete = [row for row in rows if all(math.isfinite(value) for value in row.values())]
    if not complete:
        raise FormatError(f"{file}: none of its {len(rows)} rows is a pose, without empty entries")
    pose = shape.rest_pose().double()
    for name, value in complete[-1].items():
        pose[shape.dof_names.index(name)] = value
    return pose


def _pose_of_result(file: Path, shape: ArticulatedShape, limits: FileLimits) -> Tensor:
    result = load(file, limits=limits)
    if isinstance(result, TrackResult):
        known = result.poses[result.poses.isfinite().all(-1)]
        if not len(known):
            raise FormatError(f"{file} holds a TrackResult in which the shape was never found")
        return known[-1]
    if not isinstance(result, AlignResult):
        raise FormatError(f"{file} holds a {type(result).__name__}; a pose is read from an AlignResult or TrackResult")
    return result.pose


def _pose_of_json(file: Path, shape: ArticulatedShape, limits: FileLimits) -> Any:
    try:
        content = json.loads(read_bytes(file, limits).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{file}: cannot be read as JSON ({error})") from error
    if isinstance(content, dict) and content.get("format") == FORMAT:
        return _pose_of_result(file.with_suffix(".safetensors"), shape, limits)
    entries = content.values() if isinstance(content, dict) else content
    if not isinstance(content, (dict, list)) or not all(
        type(entry) in (int, float) and not abs(entry) >= 1e300 for entry in entries
    ):
        raise FormatError(f"{file}: a pose is a list of {shape.num_dofs} numbers, or numbers by name")
    if isinstance(content, list):
        return torch.tensor(content, dtype=torch.float64)
    names = shape.dof_names
    unknown = [name for name in content if name not in names]
    if unknown:
        raise InputError(f"{file}: the shape has no degree of freedom {unknown[0]!r}; known: {', '.join(names)}")
    pose = shape.rest_pose().double()
    for name, value in content.items():
        pose[names.index(name)] = value
    return pose


def _pose_of_npz(file: Path, shape: ArticulatedShape, limits: FileLimits) -> Tensor:
    content = read_bytes(file, limits)
    try:
        open_zip(content, limits)
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            name = "pose" if "pose" in archive.files else archive.files[0]
            if name != "pose" and len(archive.files) > 1:
                raise FormatError(f"holds the arrays {', '.join(archive.files)}; call one of them pose")
            values = np.asarray(archive[name], dtype=np.float64)
    except FormatError as error:
        raise FormatError(f"{file}: {error}") from error
    except PARSER_ERRORS as error:
        raise FormatError(f"{file}: cannot be read as NPZ ({error})") from error
    return torch.from_numpy(values)


class _WrongContentError(Exception):
    """The stored fields are not those of the record that they claim to be."""


def _result_kind(name: Any) -> type[Result] | None:
    """Return the public kind of result of that name, if there is one."""
    try:
        kind = public(name) if isinstance(name, str) else None
    except AttributeError:
        return None
    return kind if isinstance(kind, type) and issubclass(kind, Result) else None


def _named_types(kind: type) -> dict[str, type]:
    """Return the records and enumerations that the fields of a dataclass hold, however deep, by name."""
    found: dict[str, type] = {}
    pending = [kind]
    while pending:
        new = {part.__name__: part for hint in _hints(pending.pop()).values() for part in _types_in(hint)}
        pending += [part for name, part in new.items() if name not in found and is_dataclass(part)]
        found |= new
    return found


@cache
def _hints(kind: type) -> dict[str, Any]:
    """Return the types of a dataclass's fields as they are stored."""
    hints = get_type_hints(kind)
    stored = {item.name: item.metadata["to_record"] for item in fields(kind) if "to_record" in item.metadata}
    return hints | {name: get_type_hints(to_record)["return"] for name, to_record in stored.items()}


def _types_in(hint: Any) -> Iterator[type]:
    """Yield the dataclasses and enumerations of a type, looking into unions and tuples."""
    for inner in get_args(hint):
        yield from _types_in(inner)
    if isinstance(hint, type) and (is_dataclass(hint) or issubclass(hint, Enum)):
        yield hint


def _stored(item: Field[Any], value: Any) -> Any:
    """Return the value of a field as it is stored."""
    return item.metadata["to_record"](value) if "to_record" in item.metadata else value


def _encode_fields(record: Any, prefix: str, known: Mapping[str, type], tensors: dict[str, Tensor]) -> dict[str, Any]:
    """Return the fields of a dataclass as plain data, with tensors under names that start with ``prefix``."""
    return {
        item.name: _encode(_stored(item, getattr(record, item.name)), prefix + item.name, known, tensors)
        for item in fields(record)
    }


def _encode(value: Any, name: str, known: Mapping[str, type], tensors: dict[str, Tensor]) -> Any:
    """Return ``value`` as plain data; its tensors are stored under names that start with ``name``."""
    if isinstance(value, Tensor):
        tensors[name] = value
        return {"tensor": name}
    if value is None or type(value) in (bool, int, float, str):
        return value
    kind = type(value).__name__
    if isinstance(value, Enum) and kind in known:
        return {"enum": kind, "value": value.value}
    if is_dataclass(value) and kind in known:
        return {"record": kind, "fields": _encode_fields(value, f"{name}.", known, tensors)}
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {"dict": {key: _encode(item, f"{name}.{key}", known, tensors) for key, item in value.items()}}
    if isinstance(value, tuple):
        if len(value) and is_dataclass(value[0]) and len({type(item) for item in value}) == 1:
            return _encode_table(value, name, known, tensors)
        return [_encode(item, f"{name}.{index}", known, tensors) for index, item in enumerate(value)]
    raise InputTypeError(f"{name} cannot be stored: {kind} is not a tensor, record, tuple, dict or number")


def _encode_table(
    rows: Sequence[Any], name: str, known: Mapping[str, type], tensors: dict[str, Tensor]
) -> dict[str, Any]:
    """Return records of one kind column by column: tensors of one shape are stacked, so a history is a few tensors."""
    columns: dict[str, Any] = {}
    for item in fields(rows[0]):
        column, key = [_stored(item, getattr(row, item.name)) for row in rows], f"{name}.{item.name}"
        if _can_stack(column):
            tensors[key] = torch.stack([entry.detach() for entry in column])
            columns[item.name] = {"stack": key}
        else:
            columns[item.name] = [
                _encode(entry, f"{key}.{index}", known, tensors) for index, entry in enumerate(column)
            ]
    return {"table": type(rows[0]).__name__, "rows": len(rows), "columns": columns}


def _can_stack(column: Sequence[Any]) -> bool:
    kinds = {(entry.dtype, entry.shape, entry.device) if isinstance(entry, Tensor) else None for entry in column}
    return len(kinds) == 1 and None not in kinds


class _Decoder:
    """Builds records of plain data: of the tensors of a file and the kinds that may be built, both by name."""

    def __init__(self, tensors: Mapping[str, Tensor], known: Mapping[str, type]) -> None:
        self.tensors, self.known = tensors, known

    def build(self, kind: type, values: Any, where: str) -> Any:
        """Return the dataclass of stored fields."""
        if not isinstance(values, dict):
            raise _WrongContentError(f"{where} must be a dict")
        return _make(kind, {name: self._decode(value, f"{where}.{name}") for name, value in values.items()}, where)

    def _decode(self, value: Any, where: str) -> Any:
        if value is None or isinstance(value, (bool, int, float, str)):
            return value
        if isinstance(value, list):
            return tuple(self._decode(item, f"{where}[{index}]") for index, item in enumerate(value))
        if "dict" in value:
            return self._decode_dict(value["dict"], where)
        if "tensor" in value:
            return self._tensor(value["tensor"], where)
        if "enum" in value:
            return _member(self._kind(value["enum"], where), value.get("value"), where)
        if "record" in value:
            return self.build(self._kind(value["record"], where), value.get("fields"), where)
        if "table" in value:
            return self._decode_table(value, where)
        raise _WrongContentError(f"{where} holds entries {', '.join(value)}")

    def _decode_dict(self, value: Any, where: str) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise _WrongContentError(f"{where} must be a dict")
        return {key: self._decode(item, f"{where}.{key}") for key, item in value.items()}

    def _decode_table(self, value: Mapping[str, Any], where: str) -> tuple[Any, ...]:
        kind, columns = self._kind(value["table"], where), value.get("columns")
        if not isinstance(columns, dict) or not columns:
            raise _WrongContentError(f"{where} has no columns")
        decoded = {name: self._decode_column(column, f"{where}.{name}") for name, column in columns.items()}
        if any(len(column) != value.get("rows") for column in decoded.values()):
            raise _WrongContentError(f"{where} does not have {value.get('rows')} rows in every column")
        rows = zip(*decoded.values(), strict=True)
        return tuple(_make(kind, dict(zip(decoded, row, strict=True)), f"{where}[{k}]") for k, row in enumerate(rows))

    def _decode_column(self, column: Any, where: str) -> tuple[Any, ...]:
        if isinstance(column, dict) and "stack" in column:
            stacked = self._tensor(column["stack"], where)
            # A copy each, so that a record that is kept does not keep the others.
            return tuple(entry.clone() for entry in stacked) if stacked.ndim else ()
        decoded = self._decode(column, where)
        if not isinstance(decoded, tuple):
            raise _WrongContentError(f"{where} must be a list")
        return decoded

    def _tensor(self, name: Any, where: str) -> Tensor:
        if not isinstance(name, str) or name not in self.tensors:
            raise _WrongContentError(f"{where} names the tensor {name!r}, which is not there")
        return self.tensors[name]

    def _kind(self, name: Any, where: str) -> Any:
        if not isinstance(name, str) or name not in self.known:
            raise _WrongContentError(f"{where} is of the unknown kind {name!r}")
        return self.known[name]


def _member(kind: type, value: Any, where: str) -> Enum:
    for member in kind if issubclass(kind, Enum) else ():
        if type(member.value) is type(value) and member.value == value:
            return member
    raise _WrongContentError(f"{where} holds the unknown {kind.__name__} {value!r}")


def _make(kind: type, values: dict[str, Any], where: str) -> Any:
    """Return the record of decoded values, whose names and types must be those it declares."""
    if not is_dataclass(kind):
        raise _WrongContentError(f"{where} is of the kind {kind.__name__}, which is no record")
    declared = {item.name: item for item in fields(kind)}
    names = {item.metadata["formerly"]: name for name, item in declared.items() if "formerly" in item.metadata}
    values = {names.get(name, name): value for name, value in values.items()}
    missing = [
        name
        for name, item in declared.items()
        if name not in values and item.default is MISSING and item.default_factory is MISSING
    ]
    unknown = [name for name in values if name not in declared]
    if missing or unknown:
        raise _WrongContentError(f"{where} lacks or does not know {', '.join(missing + unknown)}")
    hints = _hints(kind)
    for name, value in values.items():
        if not _fits(value, hints[name]):
            raise _WrongContentError(f"{where}.{name} must not be of type {type(value).__name__}")
    for name, item in declared.items():
        if "from_record" in item.metadata and name in values:
            values[name] = item.metadata["from_record"](values[name])
    return kind(**values)


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a value has the type that a field declares."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(_fits(value, option) for option in inner)
    if origin is tuple:
        each = inner[:1] * len(value) if isinstance(value, tuple) and inner[1:] == (...,) else inner
        return isinstance(value, tuple) and len(value) == len(each) and all(map(_fits, value, each))
    if origin is dict:
        return isinstance(value, dict) and all(
            _fits(key, inner[0]) and _fits(item, inner[1]) for key, item in value.items()
        )
    return isinstance(value, (int, float) if hint is float else hint)
