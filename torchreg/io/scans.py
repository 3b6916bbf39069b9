"""Range scans from files."""

from __future__ import annotations

import os
from typing import Any

import torch

from torchreg.errors import FormatError
from torchreg.geometry.neighbors import weld
from torchreg.geometry.range_scan import RangeScan
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits
from torchreg.io.points import load_points


def load_scan(
    path: str | os.PathLike[str],
    *,
    viewpoint: Any = None,
    scale: float = 1.0,
    nan_policy: str = "raise",
    limits: FileLimits = DEFAULT_LIMITS,
    dtype: torch.dtype | None = None,
    time: float | None = None,
    frame: int | None = None,
) -> RangeScan:
    """Return the range scan of a file, with its faces and normals where it has them.

    Points keep the order and the unit of the file. Missing normals and boundaries are computed, see `RangeScan`.

    Args:
        path: a local file; see `load_points` for the formats.
        viewpoint: (3,) position of the camera, in the unit of the file; None if unknown.
        scale: see `load_points`.
        nan_policy: see `load_points`; ``"omit"`` drops the points of rays that measured nothing.
        limits: see `load_points`.
        dtype: see `load_points`.
        time: see `load_points`.
        frame: see `load_points`.

    Returns:
        The scan, on the CPU.

    Raises:
        FormatError: if there are too few points for a surface, and as `load_points`; names the file.
        FileNotFoundError: if there is no such file.
        InputError: if the viewpoint is not three finite numbers.
    """
    cloud = load_points(path, scale=scale, nan_policy=nan_policy, limits=limits, dtype=dtype, time=time, frame=frame)
    if int(weld(cloud.points).max()) < 2:
        raise FormatError(f"{os.fspath(path)}: a scan needs points at 3 places or more, it holds {len(cloud)} points")
    return RangeScan(cloud.points, cloud.faces, cloud.normals, viewpoint=viewpoint)
