"""Whole results on disk: every field of a result goes to safetensors + JSON and comes back as it was."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
from enum import Enum
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_finite, check_shape
from torchreg.errors import FormatError, InputError, InputTypeError, ModelError
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, local_path, open_zip, read_bytes
from torchreg.io.points import PARSER_ERRORS
from torchreg.io.tensors import FORMAT, load_tensors, save_tensors
from torchreg.models.grid_lbs import GridLBS, GridLBSRecord
from torchreg.models.spine import Spine, SpineFields
from torchreg.results.alignment import AlignRecord, AlignResult, Calibration, PoseStarts
from torchreg.results.base import Result, Status, register_writer
from torchreg.results.scans import PoseSolution, RegisterRecord, ScanRegistration, SequenceRegistration
from torchreg.results.spines import SpineSequence
from torchreg.results.tracking import DemoResult, FrameResult, TrackResult, TrackState
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.record import HandSpec, ShapeRecord, build_shape, record_shape
from torchreg.shapes.rigs import RigSurface, ShapeSpec

# What a file may name: nothing else is ever built from it.
_RESULTS: dict[str, type[Result]] = {
    kind.__name__: kind
    for kind in (
        AlignResult,
        Calibration,
        DemoResult,
        FrameResult,
        PoseSolution,
        PoseStarts,
        ScanRegistration,
        SequenceRegistration,
        SpineSequence,
        TrackResult,
        TrackState,
    )
}
_SHAPE_RECORDS = (ShapeRecord, ShapeSpec, HandSpec, KinematicTree, Joint, Primitive, RigSurface)
_RECORDS: dict[str, type] = {
    kind.__name__: kind
    for kind in (AlignRecord, GridLBSRecord, RegisterRecord, SpineFields, TrackResult, *_SHAPE_RECORDS)
}
_ENUMS: dict[str, type[Enum]] = {kind.__name__: kind for kind in (Status,)}


def save_result(result: Result, path: str | os.PathLike[str]) -> None:
    """Write a result to ``path`` and its JSON file; what `Result.save` calls, see there."""
    kind = type(result).__name__
    if _RESULTS.get(kind) is not type(result):
        raise InputTypeError(f"result must be one of {', '.join(_RESULTS)}, got {kind}")
    tensors: dict[str, Tensor] = {}
    values = {item.name: _encode(getattr(result, item.name), item.name, tensors) for item in fields(result)}  # type: ignore[arg-type]
    save_tensors(path, tensors, {"kind": kind, "fields": values})


def load(path: str | os.PathLike[str], *, limits: FileLimits = DEFAULT_LIMITS) -> Result:
    """Return the result that its ``save`` wrote, every field as it was, on the CPU.

    Args:
        path: the .safetensors file; its JSON file must lie beside it.
        limits: on the size of each of the two.

    Returns:
        an `AlignResult`, or whichever kind of result was saved.

    Raises:
        FileNotFoundError: if there is no such file.
        FormatError: if a file is missing or damaged, or holds no result that this release knows.
        InputError: if the ending is another.
    """
    tensors, metadata = load_tensors(path, limits=limits)
    kind, values = metadata.get("kind"), metadata.get("fields")
    if not isinstance(kind, str) or kind not in _RESULTS:
        raise FormatError(f"{path}: holds a result of kind {kind!r}; this release reads {', '.join(_RESULTS)}")
    try:
        return _build(_RESULTS[kind], values, tensors, "fields")
    except (_WrongContentError, ModelError, InputError) as error:
        raise FormatError(f"{path}: is not a complete {kind} ({error}): the file is damaged") from error


def load_pose(path: str | os.PathLike[str], shape: ArticulatedShape, *, limits: FileLimits = DEFAULT_LIMITS) -> Tensor:
    """Return a pose (num_dofs,) of a shape from a file.

    Args:
        path: a saved `AlignResult`, or `TrackResult` for its last pose (.safetensors or its .json); or .json with a
            list of num_dofs numbers, or with values by name of degree of freedom, the others at rest; or .npz with an
            array ``pose``, or a single array.
        shape: whose pose it is.
        limits: on the size of the file.

    Returns:
        the pose, metres and radians, in the shape's dtype and on its device.

    Raises:
        FileNotFoundError: if there is no such file.
        FormatError: if the file is damaged, or holds no pose.
        InputError: if the pose is not finite or does not fit the shape; names the file.
    """
    place = local_path(path)
    readers = {".safetensors": _pose_of_result, ".json": _pose_of_json, ".npz": _pose_of_npz}
    if place.suffix.lower() not in readers:
        place.stat()  # a missing file is the first thing to say
        raise FormatError(f"{place} has the ending {place.suffix!r}; a pose is read from {', '.join(readers)}")
    values = readers[place.suffix.lower()](place, shape, limits)
    pose = as_float_tensor(values, f"the pose in {place}", like=shape.rest)
    check_shape(pose, f"the pose in {place}", (shape.num_dofs,))
    check_finite(pose, f"the pose in {place}")
    return pose


def _pose_of_result(place: Path, shape: ArticulatedShape, limits: FileLimits) -> Tensor:
    result = load(place, limits=limits)
    if isinstance(result, TrackResult):
        known = result.poses[result.poses.isfinite().all(-1)]
        if not len(known):
            raise FormatError(f"{place} holds a TrackResult in which the shape was never found")
        return known[-1]
    if not isinstance(result, AlignResult):
        raise FormatError(f"{place} holds a {type(result).__name__}; a pose is read from an AlignResult or TrackResult")
    return result.pose


def _pose_of_json(place: Path, shape: ArticulatedShape, limits: FileLimits) -> Any:
    try:
        content = json.loads(read_bytes(place, limits).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{place}: cannot be read as JSON ({error})") from error
    if isinstance(content, dict) and content.get("format") == FORMAT:
        return _pose_of_result(place.with_suffix(".safetensors"), shape, limits)
    entries = content.values() if isinstance(content, dict) else content
    if not isinstance(content, (dict, list)) or not all(type(entry) in (int, float) for entry in entries):
        raise FormatError(f"{place}: a pose is a list of {shape.num_dofs} numbers, or numbers by name")
    if isinstance(content, list):
        return torch.tensor(content, dtype=torch.float64)
    names = shape.dof_names
    unknown = [name for name in content if name not in names]
    if unknown:
        raise InputError(f"{place}: the shape has no degree of freedom {unknown[0]!r}; known: {', '.join(names)}")
    pose = shape.rest_pose().double()
    for name, value in content.items():
        pose[names.index(name)] = value
    return pose


def _pose_of_npz(place: Path, shape: ArticulatedShape, limits: FileLimits) -> Tensor:
    content = read_bytes(place, limits)
    try:
        open_zip(content, limits)
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            name = "pose" if "pose" in archive.files else archive.files[0]
            if name != "pose" and len(archive.files) > 1:
                raise FormatError(f"holds the arrays {', '.join(archive.files)}; call one of them pose")
            values = np.asarray(archive[name], dtype=np.float64)
    except FormatError as error:
        raise FormatError(f"{place}: {error}") from error
    except PARSER_ERRORS as error:
        raise FormatError(f"{place}: cannot be read as NPZ ({error})") from error
    return torch.from_numpy(values)


class _WrongContentError(Exception):
    """The stored fields do not make up the record they claim to be."""


def _encode(value: Any, name: str, tensors: dict[str, Tensor]) -> Any:
    """Return ``value`` as plain data; its tensors are put under names that start with ``name``."""
    if isinstance(value, Tensor):
        tensors[name] = value
        return {"tensor": name}
    if value is None or type(value) in (bool, int, float, str):
        return value
    if type(value).__name__ in _ENUMS:
        return {"enum": type(value).__name__, "value": value.value}
    if isinstance(value, ArticulatedShape):
        value = record_shape(value)
    if isinstance(value, GridLBS):
        value = value.record()
    if isinstance(value, Spine):
        value = value.record()
    if type(value).__name__ in _RECORDS:
        columns = {
            item.name: _encode(getattr(value, item.name), f"{name}.{item.name}", tensors) for item in fields(value)
        }
        return {"record": type(value).__name__, "fields": columns}
    if isinstance(value, tuple):
        return _encode_table(value, name, tensors) if _is_table(value) else [
            _encode(item, f"{name}.{index}", tensors) for index, item in enumerate(value)
        ]  # fmt: skip
    raise InputTypeError(f"{name} cannot be stored: {type(value).__name__} is not a tensor, record, tuple or number")


def _is_table(value: tuple[Any, ...]) -> bool:
    return len(value) > 0 and type(value[0]).__name__ in _RECORDS and len({type(item) for item in value}) == 1


def _encode_table(rows: Sequence[Any], name: str, tensors: dict[str, Tensor]) -> dict[str, Any]:
    """Return records of one kind column by column: tensors of one shape are stacked, so a history is a few tensors."""
    columns: dict[str, Any] = {}
    for item in fields(rows[0]):
        column, place = [getattr(row, item.name) for row in rows], f"{name}.{item.name}"
        if _can_stack(column):
            tensors[place] = torch.stack([entry.detach() for entry in column])
            columns[item.name] = {"stack": place}
        else:
            columns[item.name] = [_encode(entry, f"{place}.{index}", tensors) for index, entry in enumerate(column)]
    return {"table": type(rows[0]).__name__, "rows": len(rows), "columns": columns}


def _can_stack(column: Sequence[Any]) -> bool:
    kinds = {(entry.dtype, entry.shape, entry.device) if isinstance(entry, Tensor) else None for entry in column}
    return len(kinds) == 1 and None not in kinds


def _decode(value: Any, tensors: Mapping[str, Tensor], where: str) -> Any:
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, list):
        return tuple(_decode(item, tensors, f"{where}[{index}]") for index, item in enumerate(value))
    if "tensor" in value:
        return _tensor(value["tensor"], tensors, where)
    if "enum" in value:
        return _member(_known(_ENUMS, value["enum"], where), value.get("value"), where)
    if "record" in value:
        record = _build(_known(_RECORDS, value["record"], where), value.get("fields"), tensors, where)
        if isinstance(record, SpineFields):
            return Spine(record.curves, record.graph, record.radii, record.frames, record.times)
        if isinstance(record, GridLBSRecord):
            return GridLBS.from_record(record)
        return build_shape(record) if isinstance(record, ShapeRecord) else record
    if "table" in value:
        return _decode_table(value, tensors, where)
    raise _WrongContentError(f"{where} holds entries {', '.join(value)}")


def _decode_table(value: Mapping[str, Any], tensors: Mapping[str, Tensor], where: str) -> tuple[Any, ...]:
    kind, columns = _known(_RECORDS, value["table"], where), value.get("columns")
    if not isinstance(columns, dict) or not columns:
        raise _WrongContentError(f"{where} has no columns")
    decoded = {name: _decode_column(column, tensors, f"{where}.{name}") for name, column in columns.items()}
    if any(len(column) != value.get("rows") for column in decoded.values()):
        raise _WrongContentError(f"{where} does not have {value.get('rows')} rows in every column")
    rows = zip(*decoded.values(), strict=True)
    return tuple(_make(kind, dict(zip(decoded, row, strict=True)), f"{where}[{k}]") for k, row in enumerate(rows))


def _decode_column(column: Any, tensors: Mapping[str, Tensor], where: str) -> tuple[Any, ...]:
    if isinstance(column, dict) and "stack" in column:
        stacked = _tensor(column["stack"], tensors, where)
        # A copy each, so that a record that is kept does not keep the others.
        return tuple(entry.clone() for entry in stacked) if stacked.ndim else ()
    decoded = _decode(column, tensors, where)
    if not isinstance(decoded, tuple):
        raise _WrongContentError(f"{where} must be a list")
    return decoded


def _member(kind: type[Enum], value: Any, where: str) -> Enum:
    for member in kind:
        if type(member.value) is type(value) and member.value == value:
            return member
    raise _WrongContentError(f"{where} holds the unknown {kind.__name__} {value!r}")


def _build(kind: type, values: Any, tensors: Mapping[str, Tensor], where: str) -> Any:
    if not isinstance(values, dict):
        raise _WrongContentError(f"{where} must be a dict")
    return _make(kind, {name: _decode(value, tensors, f"{where}.{name}") for name, value in values.items()}, where)


def _make(kind: type, values: dict[str, Any], where: str) -> Any:
    """Return the record of decoded values, once names and types are seen to be those it declares."""
    hints = get_type_hints(kind)
    declared = {item.name: item for item in fields(kind)}
    missing = [name for name, item in declared.items() if name not in values and item.default is MISSING]
    unknown = [name for name in values if name not in declared]
    if missing or unknown:
        raise _WrongContentError(f"{where} lacks or does not know {', '.join(missing + unknown)}")
    for name, value in values.items():
        if not _fits(value, hints[name]):
            raise _WrongContentError(f"{where}.{name} must not be of type {type(value).__name__}")
    return kind(**values)


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a value has the type that a field declares."""
    hint = hint.__bound__ if isinstance(hint, TypeVar) else hint
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(_fits(value, option) for option in inner)
    if origin is tuple:
        each = inner[:1] * len(value) if isinstance(value, tuple) and inner[1:] == (...,) else inner
        return isinstance(value, tuple) and len(value) == len(each) and all(map(_fits, value, each))
    return isinstance(value, (int, float) if hint is float else hint)


def _tensor(name: Any, tensors: Mapping[str, Tensor], where: str) -> Tensor:
    if not isinstance(name, str) or name not in tensors:
        raise _WrongContentError(f"{where} names the tensor {name!r}, which is not there")
    return tensors[name]


def _known(kinds: Mapping[str, Any], name: Any, where: str) -> Any:
    if not isinstance(name, str) or name not in kinds:
        raise _WrongContentError(f"{where} is of the unknown kind {name!r}")
    return kinds[name]


register_writer(save_result)
