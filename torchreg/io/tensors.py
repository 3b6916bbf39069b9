"""Named tensors and plain metadata on disk: safetensors with a readable JSON file beside it."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from torchreg.errors import FormatError, InputError, InputTypeError
from torchreg.io.atomic import write_atomic
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, local_path, read_bytes

FORMAT = "torchreg tensors"
VERSION = 1
_SUFFIX = ".safetensors"
# JSON has no words for these; the rest of the file stays standard JSON.
_NON_FINITE = "$float"


def save_tensors(path: str | os.PathLike[str], tensors: Mapping[str, Tensor], metadata: Mapping[str, Any]) -> None:
    """Write tensors to a .safetensors file, and their description and metadata to a JSON file of the same stem.

    Each appears whole or not at all. The JSON file is written last and holds the checksum of the other. Metadata are
    nested dicts, lists, tuples (come back as lists), str, bool, int, float, also infinite and NaN, and None.
    """
    file, description = _pair(path)
    stored = dict[str, Tensor]()
    for name, value in tensors.items():
        if not isinstance(name, str) or not isinstance(value, Tensor):
            raise InputTypeError(f"tensors[{name!r}] must be a tensor under a str, got {type(value).__name__}")
        if value.layout != torch.strided:
            raise InputTypeError(f"tensors[{name!r}] must be dense, got layout {value.layout}; call .to_dense()")
        # A copy each: the format refuses tensors that share memory.
        stored[name] = value.detach().cpu().clone(memory_format=torch.contiguous_format)
    plain = _encode(metadata, "metadata")
    try:
        content = safetensors.torch.save(stored)
    except (safetensors.SafetensorError, KeyError, ValueError) as error:
        raise InputTypeError(f"tensors cannot be stored ({error}); use dense tensors of the usual dtypes") from error
    record = {
        "format": FORMAT,
        "version": VERSION,
        "sha256": hashlib.sha256(content).hexdigest(),
        "tensors": {name: _describe(value) for name, value in stored.items()},
        "metadata": plain,
    }
    write_atomic(file, content)
    write_atomic(description, (json.dumps(record, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode())


def load_tensors(
    path: str | os.PathLike[str], *, limits: FileLimits = DEFAULT_LIMITS
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return the tensors of a file by name, on the CPU, and the metadata that `save_tensors` wrote with them."""
    file, description = _pair(path)
    content = read_bytes(file, limits)
    try:
        text = read_bytes(description, limits)
    except FileNotFoundError as error:
        raise FormatError(f"{file}: the file {description.name} must lie beside it; copy both together") from error
    record = _read_record(text, description)
    if hashlib.sha256(content).hexdigest() != record["sha256"]:
        raise FormatError(f"{file}: is damaged, or is not the file that {description.name} describes")
    try:
        tensors = safetensors.torch.load(content)
    except (safetensors.SafetensorError, ValueError, LookupError, TypeError, OverflowError) as error:
        raise FormatError(f"{file}: cannot be read as safetensors ({error})") from error
    if {name: _describe(value) for name, value in tensors.items()} != record["tensors"]:
        raise FormatError(f"{file}: its tensors are not those that {description.name} lists")
    # The order of the JSON file is that in which they were saved.
    return {name: tensors[name] for name in record["tensors"]}, _decode(record["metadata"])


def _pair(path: str | os.PathLike[str]) -> tuple[Path, Path]:
    file = local_path(path)
    if file.suffix != _SUFFIX:
        raise InputError(f"path must end in {_SUFFIX}, got {str(file)!r}")
    return file, file.with_suffix(".json")


def _describe(value: Tensor) -> dict[str, Any]:
    return {"dtype": str(value.dtype).removeprefix("torch."), "shape": list(value.shape)}


def _read_record(text: bytes, path: Path) -> dict[str, Any]:
    try:
        record = json.loads(text.decode("utf-8"))
    except (ValueError, RecursionError) as error:  # also what is not UTF-8
        raise FormatError(f"{path}: cannot be read as JSON ({error})") from error
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise FormatError(f"{path}: does not describe tensors: its format must be {FORMAT!r}")
    if record.get("version") != VERSION:
        raise FormatError(
            f"{path}: has version {record.get('version')!r}, this release reads {VERSION}; update torchreg"
        )
    for key, kind in (("sha256", str), ("tensors", dict), ("metadata", dict)):
        if not isinstance(record.get(key), kind):
            raise FormatError(f"{path}: the entry {key!r} must be of type {kind.__name__}: the file is damaged")
    return record


def _encode(value: Any, where: str) -> Any:
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else {_NON_FINITE: str(float(value))}
    if isinstance(value, (list, tuple)):
        return [_encode(item, f"{where}[{k}]") for k, item in enumerate(value)]
    if not isinstance(value, Mapping):
        raise InputTypeError(
            f"{where} must be a dict, list, str, bool, int, float or None, got {type(value).__name__}; put tensors "
            f"under tensors, and convert other numbers with float() or int()"
        )
    for key in value:
        if not isinstance(key, str):
            raise InputTypeError(f"{where} must have keys of type str, got {key!r}")
        if key == _NON_FINITE:
            raise InputError(f"{where} must not have the key {_NON_FINITE!r}, which is reserved")
    return {key: _encode(item, f"{where}.{key}") for key, item in value.items()}


def _decode(value: Any) -> Any:
    if isinstance(value, list):
        return [_decode(item) for item in value]
    if not isinstance(value, dict):
        return value
    if set(value) == {_NON_FINITE} and value[_NON_FINITE] in ("nan", "inf", "-inf"):
        return float(value[_NON_FINITE])
    return {key: _decode(item) for key, item in value.items()}
