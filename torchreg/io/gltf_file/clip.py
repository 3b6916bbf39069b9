"""Animations of glTF files: the nodes of a document as they stand at a time of its first clip."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchreg.errors import FormatError, InputError
from torchreg.io.clouds.raw_cloud import Array
from torchreg.io.gltf_file.document import GltfDocument

# Change of a track, of numbers of one or more, that is rounding.
_STILL = 1e-5
_WIDTHS = {"translation": 3, "rotation": 4, "scale": 3}


def pose_nodes(document: GltfDocument, time: float | None, frame: int | None) -> None:
    """Put nodes, in place, where the first animation has them at a time, seconds, or at a keyframe; -1 is the last."""
    if time is None and frame is None:
        return
    if time is not None and frame is not None:
        raise InputError("time= and frame= say the same; give one of them")
    clips = document.items("animations")
    if not clips:
        raise FormatError("holds no animation, so that it has no time= or frame=")
    channels = [channel for channel in document.entry(clips[0], "channels", list) if isinstance(channel, dict)]
    samplers = document.entry(clips[0], "samplers", list)
    tracks = [track for channel in channels if (track := _track(document, channel, samplers)) is not None]
    if not tracks:
        raise FormatError("holds an animation that moves nothing")
    if frame is not None:
        keys = np.unique(np.concatenate([times for _, _, times, _ in tracks]))
        if not -len(keys) <= frame < len(keys):
            raise InputError(f"frame must be below {len(keys)}, the number of keyframes; got {frame}")
        time = float(keys[frame])
    for node, path, times, sampler in tracks:
        entry = document.item("nodes", node)
        entry[path] = _value(document, path, times, sampler, float(time or 0.0)).tolist()


def moved_nodes(document: GltfDocument) -> dict[int, set[str]]:
    """Return the nodes that a clip turns ("rotation") or slides ("translation"), without tracks that stand still."""
    found = dict[int, set[str]]()
    for clip in document.items("animations"):
        samplers = document.entry(clip, "samplers", list)
        for channel in document.entry(clip, "channels", list):
            track = _track(document, channel, samplers) if isinstance(channel, dict) else None
            if track is None or track[1] not in ("rotation", "translation"):
                continue
            node, path, times, sampler = track
            values = np.stack([_value(document, path, times, sampler, time) for time in times])
            if path == "rotation":
                values = values * np.where(values @ values[0] < 0, -1.0, 1.0)[:, None]
            if np.ptp(values, axis=0).max() > _STILL * max(1.0, float(np.abs(values).max())):
                found.setdefault(node, set()).add(path)
    return found


def _track(
    document: GltfDocument, channel: dict[str, Any], samplers: list[Any]
) -> tuple[int, str, Array, dict[str, Any]] | None:
    """Return node, what moves, the times of the keys and the sampler of a channel; None if it moves no node."""
    target = document.entry(channel, "target", dict)
    path, number = target.get("path"), document.entry(channel, "sampler", int)
    if target.get("node") is None or path not in (*_WIDTHS, "weights"):
        return None
    if not 0 <= number < len(samplers) or not isinstance(samplers[number], dict):
        raise FormatError(f"an animation names sampler {number} of {len(samplers)}")
    times = document.accessor(samplers[number].get("input"), "the times of an animation", ("SCALAR",))[:, 0]
    times = times.astype(np.float64)
    if not len(times) or not np.isfinite(times).all() or (np.diff(times) < 0).any():
        raise FormatError("the times of an animation must be finite and in order")
    return document.index("nodes", target["node"], "what an animation moves"), path, times, samplers[number]


def _value(document: GltfDocument, path: str, times: Array, sampler: dict[str, Any], time: float) -> Array:
    """Return what a sampler gives at a time."""
    values = document.accessor(sampler.get("output"), f"the {path} of an animation").astype(np.float64)
    kind = document.entry(sampler, "interpolation", str, "LINEAR")
    width = _WIDTHS.get(path) or values.size // len(times) // (3 if kind == "CUBICSPLINE" else 1)
    groups = 3 if kind == "CUBICSPLINE" else 1  # in-tangent, value, out-tangent
    if values.size != len(times) * groups * width or not np.isfinite(values).all():
        raise FormatError(f"the {path} of an animation does not fit its {len(times)} times")
    keys = values.reshape(len(times), groups, width)
    after = int(np.searchsorted(times, time, side="right"))
    if after == 0 or after == len(times) or kind == "STEP":
        return keys[max(after - 1, 0), groups // 2]
    step = times[after] - times[after - 1]
    share = (time - times[after - 1]) / step
    first, last = keys[after - 1, groups // 2], keys[after, groups // 2]
    if kind == "CUBICSPLINE":
        s2, s3 = share**2, share**3
        return (
            (2 * s3 - 3 * s2 + 1) * first + (s3 - 2 * s2 + share) * step * keys[after - 1, 2]
            + (3 * s2 - 2 * s3) * last + (s3 - s2) * step * keys[after, 0]
        )  # fmt: skip
    return _slerp(first, last, share) if path == "rotation" else (1 - share) * first + share * last


def _slerp(first: Array, last: Array, share: float) -> Array:
    """Return the unit quaternion between two on the shorter arc."""
    cosine = float(first @ last)
    last, cosine = (last, cosine) if cosine >= 0 else (-last, -cosine)
    angle = np.arccos(min(cosine, 1.0))
    if angle < 1e-6:
        return (1 - share) * first + share * last
    return (np.sin((1 - share) * angle) * first + np.sin(share * angle) * last) / np.sin(angle)
