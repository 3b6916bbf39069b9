"""Keypoints that a detector measured, as files (.json)."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchreg.errors import FormatError
from torchreg.io.detected_hands import detected_keypoints, is_detection
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, local_path, read_bytes
from torchreg.io.natural_order import natural_sorted


def load_keypoints(
    path: str | os.PathLike[str],
    *,
    side: str | None = None,
    picture: tuple[int, int] | None = None,
    limits: FileLimits = DEFAULT_LIMITS,
) -> Tensor:
    """Return keypoints (F, K, C) of F frames, float64, NaN where not detected: pixels [column, row], or metres.

    A .json file holds one frame or a list of them, or what MediaPipe's hand landmarker or OpenPose wrote; a folder
    holds a file for each frame. ``side`` chooses a hand, ``picture`` (width, height) is for MediaPipe's shares of it.
    """
    file = local_path(path)
    files = natural_sorted(file.glob("*.json")) if file.is_dir() else [file]
    frames = [frame for part in files for frame in _frames(part, side, picture, limits)]
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


def _frames(file: Path, side: str | None, picture: tuple[int, int] | None, limits: FileLimits) -> list[Any]:
    """Return the frames of a file, each a list of keypoints or None."""
    if file.suffix.lower() != ".json":
        raise FormatError(f"{file} must end in .json")
    try:
        content = json.loads(read_bytes(file, limits).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{file}: cannot be read as JSON ({error})") from error
    return [
        detected_keypoints(frame, file, side, picture) if is_detection(frame) else frame
        for frame in (content if _is_several(content) else [content])
    ]


def _is_several(content: Any) -> bool:
    """Return whether a list is one of frames: what its entries hold are keypoints."""
    if not isinstance(content, list):
        return False
    if any(is_detection(frame) for frame in content):
        return True
    return any(isinstance(point, list) or point is None for frame in content if frame for point in frame)


def _number(value: Any, file: Any) -> float:
    if value is None:
        return float("nan")
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > torch.finfo(torch.float32).max:
        raise FormatError(f"{file}: must hold numbers, got {value!r}")
    return float(value)
