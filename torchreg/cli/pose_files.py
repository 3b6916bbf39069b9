"""Poses of a sequence as JSON, by name of degree of freedom."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from torchreg.io.atomic import write_atomic

if TYPE_CHECKING:
    from torchreg.tracking.results import TrackResult


def write_poses(path: Path, track: TrackResult) -> None:
    """Write the poses of a tracked sequence: times, statuses, and a list of numbers by name of degree of freedom.

    NaN, before the shape was first found, is null.
    """
    columns = {name: [_number(value) for value in column.tolist()] for name, column in track.named_poses.items()}
    content = {
        "units": "metres and radians; times in the unit of the sequence",
        "times": track.times.tolist(),
        "statuses": [status.value for status in track.statuses],
        "poses": columns,
    }
    write_atomic(path, (json.dumps(content, indent=1) + "\n").encode())


def _number(value: float) -> float | None:
    return value if value == value else None
