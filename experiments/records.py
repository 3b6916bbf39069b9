"""The record of a trial: one JSON document with its configuration, its results and its provenance."""

from __future__ import annotations

import functools
import json
import math
import platform
import socket
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

import torchreg

from .errors import ConfigError, CorruptRecordError
from .plan import trial_id
from .structure import build, plain

Status = Literal["done", "failed", "skipped"]
_LIBRARIES = ("torch", "numpy", "scipy")
_ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class TrialRecord:
    """One finished trial.

    Args:
        id: hash of version, task and configuration.
        task: name in the registry.
        version: of torchreg.
        config: resolved.
        seed: of it.
        status: "done", "failed" or "skipped".
        metrics: that depend on the configuration alone; None stands for a number that is not finite.
        seconds: by stage; "cpu" is the processor time of the whole trial.
        curves: values per step.
        artifacts: files kept, relative to the trial's folder of artifacts.
        note: of a failure the last line, of a skipped trial the reason.
        traceback: of a failure.
        warnings: that were raised on the way.
        wall_seconds: of the trial alone.
        peak_memory_mb: of the process while it ran.
        peak_gpu_memory_mb: of the accelerator; 0 without one.
        host: that it ran on.
        device: that it ran on.
        threads: of a worker.
        engine: that started it.
        versions: of the libraries.
        commit: of the repository, with "-dirty" after it if files differed; empty without a repository.
        started: in UTC.
        attempt: how many times it was begun in this session.
        session: the run of a driver that it belongs to.
        rerun: command that runs it again and compares.
    """

    id: str
    task: str
    version: str
    config: dict[str, Any]
    seed: int
    status: Status
    metrics: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, Any] = field(default_factory=dict)
    curves: dict[str, Any] = field(default_factory=dict)
    artifacts: dict[str, Any] = field(default_factory=dict)
    note: str = ""
    traceback: str = ""
    warnings: tuple[str, ...] = ()
    wall_seconds: float = 0.0
    peak_memory_mb: float = 0.0
    peak_gpu_memory_mb: float = 0.0
    host: str = ""
    device: str = "cpu"
    threads: int = 1
    engine: str = ""
    versions: dict[str, Any] = field(default_factory=dict)
    commit: str = ""
    started: str = ""
    attempt: int = 1
    session: str = ""
    rerun: str = ""

    def to_json(self) -> bytes:
        """Return the document."""
        return json.dumps(_finite(plain(self)), indent=1, allow_nan=False).encode()


def parse_record(content: bytes, name: str, expected: str | None = None) -> TrialRecord:
    """Return the record of a document.

    Args:
        content: of the file.
        name: of the file, for messages.
        expected: id of the trial that it should be.

    Raises:
        CorruptRecordError: if it is no whole record, or its configuration is not the one that its id stands for.
    """
    try:
        data = json.loads(content)
        record = build(TrialRecord, data)
        _check_numbers(record)
        own = trial_id(record.task, record.config, record.version)
    except (ValueError, TypeError, RecursionError, ConfigError) as error:
        raise CorruptRecordError(f"{name} is not a record of a trial: {error}") from error
    if own != record.id:
        raise CorruptRecordError(f"{name}: configuration or version were changed after the trial ran, as its id tells")
    if expected is not None and record.id != expected:
        raise CorruptRecordError(f"{name} holds the record of another trial, {record.id}")
    return record


def _check_numbers(record: TrialRecord) -> None:
    """Raise ValueError unless metrics, seconds and curves hold numbers, and null for those that are not finite."""
    for name in ("metrics", "seconds", "curves"):
        for key, value in getattr(record, name).items():
            values = value if name == "curves" and isinstance(value, list) else [value]
            for number in values:
                if number is not None and not (isinstance(number, (int, float)) and math.isfinite(number)):
                    raise ValueError(f"{name}.{key} must hold finite numbers, got {number!r:.40}")


@functools.cache
def provenance() -> Mapping[str, Any]:
    """Return host, versions and commit: the fields of a record that are the same for all trials of a process."""
    versions = {name: metadata.version(name) for name in _LIBRARIES}
    versions |= {"torchreg": torchreg.__version__, "python": platform.python_version()}
    return {"host": socket.gethostname(), "versions": versions, "commit": _commit()}


def _commit() -> str:
    if not (_ROOT / ".git").exists():
        return ""  # installed, perhaps inside a repository of something else
    command = ["git", "-C", str(_ROOT), "describe", "--always", "--abbrev=12", "--dirty", "--exclude", "*"]
    try:
        found = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return found.stdout.strip()


def _finite(value: Any) -> Any:
    """Return plain data with None for numbers that JSON does not know."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    return [_finite(item) for item in value] if isinstance(value, list) else value
