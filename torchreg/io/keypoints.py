"""Keypoints that a detector measured, as files (.json)."""

from __future__ import annotations

import json
import os
from typing import Any

import torch
from torch import Tensor

from torchreg.errors import FormatError
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, local_path, read_bytes


def load_keypoints(path: str | os.PathLike[str], *, limits: FileLimits = DEFAULT_LIMITS) -> Tensor:
    """Return the keypoints (F, K, C) of F frames, float64, NaN for those that were not seen.

    The file holds a list of frames, or a single one: a list of K keypoints, each [column, row] in pixels, [x, y, z] in
    metres, or null where it was not seen. A frame in which none was seen may be null.

    Args:
        path: ends in .json.
        limits: ``max_bytes`` applies.

    Raises:
        FormatError: if it is no such list, or frames or keypoints have several sizes; names the file.
        FileNotFoundError: if there is no such file.
    """
    file = local_path(path)
    if file.suffix.lower() != ".json":
        raise FormatError(f"{file} must end in .json")
    try:
        content = json.loads(read_bytes(file, limits).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{file}: cannot be read as JSON ({error})") from error
    frames = content if _is_several(content) else [content]
    counts = {len(frame) for frame in frames if isinstance(frame, list)}
    rows = [point for frame in frames if isinstance(frame, list) for point in frame if point is not None]
    sizes = {len(point) if isinstance(point, list) else 0 for point in rows}
    if len(counts) != 1 or len(sizes) != 1 or not sizes <= {2, 3}:
        raise FormatError(
            f"{file}: must hold a list of keypoints for each frame, as many in all, each [column, row], [x, y, z] or "
            f"null; got lists of {sorted(counts)} keypoints of {sorted(sizes)} numbers"
        )
    unseen = [None] * sizes.pop()
    table = [[point or unseen for point in frame or [unseen] * max(counts)] for frame in frames]
    return torch.tensor([[[_number(value, file) for value in point] for point in frame] for frame in table]).double()


def _is_several(content: Any) -> bool:
    """Return whether a list is one of frames: what its entries hold are keypoints."""
    if not isinstance(content, list):
        return False
    return any(isinstance(point, list) or point is None for frame in content if frame for point in frame)


def _number(value: Any, file: Any) -> float:
    if value is None:
        return float("nan")
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > torch.finfo(torch.float32).max:
        raise FormatError(f"{file}: must hold numbers, got {value!r}")
    return float(value)
