"""The skeletons of many frames: over several processes, told as they come, and kept on disk to go on from."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchreg.errors import FormatError, InputError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.skeleton import Skeleton
from torchreg.io.tensors import load_tensors, save_tensors
from torchreg.spines.results import SpineRecord
from torchreg.spines.skeletonize import SkeletonizeConfig, skeletonize

# Fewer frames than this are not worth the start of a process.
_WORTH_PROCESSES = 4
_FIELDS = ("nodes", "edges", "radii", "frames", "confidence")
# What forked processes work on: they inherit it, so that no surface is copied.
_job: tuple[Sequence[TriangleMesh], SkeletonizeConfig] | None = None


def skeletonize_frames(
    meshes: Sequence[TriangleMesh],
    config: SkeletonizeConfig,
    *,
    workers: int | None = None,
    on_step: Callable[[SpineRecord], None] | None = None,
    progress: str | os.PathLike[str] | None = None,
) -> list[Skeleton]:
    """Return the skeleton of every frame.

    Args:
        meshes: T surfaces.
        config: see `skeletonize`.
        workers: processes; by default one per core that may be used. Where processes cannot be forked, or for few
            frames, all is done in this one.
        on_step: told of every frame, in the order in which they are done.
        progress: a folder, made if need be, in which each skeleton is kept as soon as it is there; those of the same
            surface and configuration are not made again.

    Raises:
        InputError: if a surface cannot be skeletonized; names the frame.
    """
    skeletons: dict[int, Skeleton] = {}
    folder = None if progress is None else Path(progress)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)

    def done(frame: int, skeleton: Skeleton, seconds: float) -> None:
        skeletons[frame] = skeleton
        if on_step is not None:
            on_step(SpineRecord(frame, len(meshes), len(skeleton.tips), skeleton.topology, seconds))

    if folder is not None:
        for frame, mesh in enumerate(meshes):
            kept = _kept(folder, frame, _fingerprint(mesh, config))
            if kept is not None:
                done(frame, kept, 0.0)
    left = [frame for frame in range(len(meshes)) if frame not in skeletons]
    for frame, skeleton, seconds in _made(meshes, config, left, workers):
        if folder is not None:
            _keep(folder, frame, _fingerprint(meshes[frame], config), skeleton)
        done(frame, skeleton, seconds)
    return [skeletons[frame] for frame in range(len(meshes))]


def _made(
    meshes: Sequence[TriangleMesh], config: SkeletonizeConfig, frames: Sequence[int], workers: int | None
) -> Iterator[tuple[int, Skeleton, float]]:
    """Yield frames, their skeletons and how long each took."""
    global _job
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = min(cores if workers is None else workers, len(frames))
    can_fork = "fork" in multiprocessing.get_all_start_methods() and not multiprocessing.current_process().daemon
    _job = (meshes, config)
    try:
        if count < 2 or not can_fork or len(frames) < _WORTH_PROCESSES or any(m.vertices.is_cuda for m in meshes):
            for frame in frames:
                yield _unpacked(_work(frame))
            return
        context = multiprocessing.get_context("fork")
        with ProcessPoolExecutor(count, mp_context=context, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            waiting = [pool.submit(_work, frame) for frame in frames]
            try:
                for future in as_completed(waiting):
                    yield _unpacked(future.result())
            finally:
                for future in waiting:
                    future.cancel()
    finally:
        _job = None


def _work(frame: int) -> tuple[int, dict[str, np.ndarray[Any, Any]], tuple[str, ...], float]:
    """Return a frame's skeleton as arrays, which pass between processes without shared memory."""
    if _job is None:
        raise InputError("frames must be asked for by skeletonize_frames")
    meshes, config = _job
    start = time.perf_counter()
    try:
        skeleton = skeletonize(meshes[frame], config)
    except InputError as error:
        raise InputError(f"meshes[{frame}]: {error}") from error
    arrays = {name: getattr(skeleton, name).detach().cpu().numpy() for name in _FIELDS}
    return frame, arrays, skeleton.notes, time.perf_counter() - start


def _unpacked(
    result: tuple[int, dict[str, np.ndarray[Any, Any]], tuple[str, ...], float],
) -> tuple[int, Skeleton, float]:
    frame, arrays, notes, seconds = result
    return frame, Skeleton(**{name: torch.from_numpy(array) for name, array in arrays.items()}, notes=notes), seconds


def _fingerprint(mesh: TriangleMesh, config: SkeletonizeConfig) -> str:
    digest = hashlib.sha256(repr(astuple(config)).encode())
    for part in (mesh.vertices, mesh.faces):
        digest.update(part.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _place(folder: Path, frame: int) -> Path:
    return folder / f"frame_{frame:05d}.safetensors"


def _keep(folder: Path, frame: int, fingerprint: str, skeleton: Skeleton) -> None:
    tensors: dict[str, Tensor] = {name: getattr(skeleton, name) for name in _FIELDS}
    save_tensors(_place(folder, frame), tensors, {"surface": fingerprint, "notes": list(skeleton.notes)})


def _kept(folder: Path, frame: int, fingerprint: str) -> Skeleton | None:
    """Return the skeleton that was kept of a surface, if there is one and it is sound."""
    try:
        tensors, metadata = load_tensors(_place(folder, frame))
        if metadata.get("surface") != fingerprint:
            return None
        return Skeleton(**{name: tensors[name] for name in _FIELDS}, notes=tuple(metadata["notes"]))
    except (FileNotFoundError, FormatError, KeyError, InputError):
        return None
