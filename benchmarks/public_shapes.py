"""Shapes that others published, as benchmarks use them: where robots and animals are, and how a hand's nodes hang."""

from __future__ import annotations

import importlib.util
import sysconfig
from pathlib import Path


def robots_folder() -> Path | None:
    """Return the folder of example-robot-data, or None if it is not installed."""
    folder = Path(sysconfig.get_path("purelib"), "cmeel.prefix", "share", "example-robot-data", "robots")
    return folder if folder.is_dir() else None


def animals_folder() -> Path | None:
    """Return the folder of dm_control, or None if it is not installed."""
    found = importlib.util.find_spec("dm_control")
    return None if found is None or found.origin is None else Path(found.origin).parent


def hand_parents() -> dict[str, str | None]:
    """Return the joint above each joint of webxr_hand_right.glb: the file's nodes are all on one level."""
    parents: dict[str, str | None] = {"wrist": None}
    for finger in ("thumb", "index-finger", "middle-finger", "ring-finger", "pinky-finger"):
        middle = () if finger == "thumb" else ("phalanx-intermediate",)
        above = "wrist"
        for segment in ("metacarpal", "phalanx-proximal", *middle, "phalanx-distal", "tip"):
            parents[f"{finger}-{segment}"] = above
            above = f"{finger}-{segment}"
    return parents
