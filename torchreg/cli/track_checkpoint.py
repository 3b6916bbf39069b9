"""How far a tracker got, in one file: what it found, what its next frame depends on, and its options."""

from __future__ import annotations

import io
import json
import os
import tempfile
import zipfile
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchreg.errors import FormatError
from torchreg.io.atomic import write_atomic
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, local_path, open_zip, read_bytes
from torchreg.io.points import PARSER_ERRORS
from torchreg.storage import load, save_result
from torchreg.tracking.results import TrackResult, TrackState

_RESULT, _STATE, _JOB = "result.safetensors", "state.safetensors", "job.json"
# The entry of the job that holds the digests of the frames.
_CONTENTS = "contents of frames"
_MEMBERS = (_RESULT, "result.json", _STATE, "state.json", _JOB)
# Fields of a `TrackResult` that belong to all frames.
_NOT_BY_FRAME = {"origin", "shape", "up", "coefficients", "coefficient_covariance"}


@dataclass(frozen=True)
class TrackProgress:
    """Results and state of a tracker up to some frame, what it was to do as plain data, and digests of the frames."""

    result: TrackResult
    state: TrackState
    job: dict[str, Any]
    contents: list[str] = field(default_factory=list)


def save_progress(path: str | os.PathLike[str], progress: TrackProgress) -> None:
    """Write a run to one file, whole or not at all; `load_progress` reads it back to the last bit."""
    place = local_path(path)
    content = io.BytesIO()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # The shape is the command's own, and may be large.
        save_result(replace(progress.result, shape=None), folder / _RESULT)
        save_result(progress.state, folder / _STATE)
        (folder / _JOB).write_text(json.dumps({**progress.job, _CONTENTS: progress.contents}), encoding="utf-8")
        with zipfile.ZipFile(content, "w") as archive:
            for member in _MEMBERS:
                archive.writestr(member, (folder / member).read_bytes())
    write_atomic(place, content.getvalue())


def load_progress(path: str | os.PathLike[str], *, limits: FileLimits = DEFAULT_LIMITS) -> TrackProgress:
    """Return the run that `save_progress` wrote; FormatError, which names the file, if it is damaged."""
    place = local_path(path)
    content = read_bytes(place, limits)
    try:
        with open_zip(content, limits) as archive, tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            for member in _MEMBERS:
                (folder / member).write_bytes(archive.read(member))
            result, state = load(folder / _RESULT, limits=limits), load(folder / _STATE, limits=limits)
            job = json.loads((folder / _JOB).read_text(encoding="utf-8"))
    except (FormatError, RecursionError, *PARSER_ERRORS) as error:
        raise FormatError(f"{place}: is no progress of a tracker, or damaged ({error})") from error
    if not isinstance(result, TrackResult) or not isinstance(state, TrackState) or not isinstance(job, dict):
        raise FormatError(f"{place}: must hold a TrackResult, a TrackState and what was to be done")
    contents = job.pop(_CONTENTS, [])
    if not isinstance(contents, list):
        raise FormatError(f"{place}: must hold a list of digests of the frames")
    if state.frame != len(result.statuses):
        raise FormatError(f"{place}: has the state after {state.frame} frames beside {len(result.statuses)} results")
    return TrackProgress(result, state, job, contents)


def first_frames(result: TrackResult, count: int) -> TrackResult:
    """Return the first frames of a tracked sequence."""
    values = {item.name: getattr(result, item.name) for item in fields(result)}
    cut = {name: value[:count] for name, value in values.items() if name not in _NOT_BY_FRAME}
    return replace(result, **cut)


def join_frames(first: TrackResult, second: TrackResult) -> TrackResult:
    """Return two parts of a tracked sequence of one shape as one."""

    def joined(one: Any, other: Any) -> Any:
        return torch.cat([one, other]) if isinstance(one, Tensor) else one + other

    names = [item.name for item in fields(first) if item.name not in _NOT_BY_FRAME]
    parts = {name: joined(getattr(first, name), getattr(second, name)) for name in names}
    return replace(second, **parts)
