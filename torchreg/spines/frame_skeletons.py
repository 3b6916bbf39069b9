"""The skeletons of many frames: computed in parallel, reported one by one, and kept on disk for a later call."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import astuple
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchreg.errors import FormatError, InputError, SolverError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.skeleton import Skeleton
from torchreg.io.tensors import load_tensors, save_tensors
from torchreg.spines.results import SpineRecord
from torchreg.spines.skeletonize import SkeletonizeConfig, skeletonize_surface
from torchreg.spines.tip_relations import TipRelations

# Fewer frames are not worth the start of processes.
_MIN_PARALLEL = 4
# The tensors of a skeleton, and those of its tips' relations.
_FIELDS = ("nodes", "edges", "radii", "frames", "confidence")
_RELATIONS = ("geodesics", "volumes")
# A skeleton's tensors as arrays, which pass between processes without shared memory, its notes, and seconds.
_Packed = tuple[dict[str, np.ndarray[Any, Any]], tuple[str, ...], float]
# A skeleton and the relations of its tips along the surface.
FrameSkeleton = tuple[Skeleton, TipRelations]
# Surfaces that wait for each process: it is never idle, and few are copied at a time.
_QUEUED = 2


def skeletonize_frames(
    meshes: Sequence[TriangleMesh],
    config: SkeletonizeConfig,
    *,
    workers: int | None = None,
    on_step: Callable[[SpineRecord], None] | None = None,
    progress: str | os.PathLike[str] | None = None,
) -> list[FrameSkeleton]:
    """Return the skeleton of every frame, and the relations of its tips along the surface.

    Args:
        meshes: T surfaces, each of which is taken when its turn comes.
        config: see `skeletonize`.
        workers: processes; by default one per core that may be used. Where processes cannot be forked, or for few
            frames, all is done in this one.
        on_step: called with every frame, in the order in which they are done.
        progress: a folder, created if absent, in which each skeleton is kept as soon as it is done; those of the same
            surface and configuration are not computed again.

    Raises:
        InputError: if a surface cannot be skeletonized; names the frame.
        SolverError: if a process is killed, and again on the second attempt.
    """
    skeletons: dict[int, FrameSkeleton] = {}
    folder = None if progress is None else Path(progress)

    def done(frame: int, found: FrameSkeleton, seconds: float) -> None:
        skeletons[frame] = found
        skeleton = found[0]
        if on_step is not None:
            on_step(
                SpineRecord(
                    frame=frame,
                    num_frames=len(meshes),
                    num_tips=len(skeleton.tips),
                    topology=skeleton.topology,
                    seconds=seconds,
                )
            )

    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        for frame, mesh in enumerate(meshes):
            kept = _load_skeleton(folder, frame, _fingerprint(mesh, config))
            if kept is not None:
                done(frame, kept, 0.0)
    missing = [frame for frame in range(len(meshes)) if frame not in skeletons]
    for frame, (arrays, notes, seconds) in _computed(meshes, config, missing, workers):
        found = _from_tensors({name: torch.from_numpy(array) for name, array in arrays.items()}, notes)
        if folder is not None:
            _save_skeleton(folder, frame, _fingerprint(meshes[frame], config), found)
        done(frame, found, seconds)
    return [skeletons[frame] for frame in range(len(meshes))]


def _computed(
    meshes: Sequence[TriangleMesh], config: SkeletonizeConfig, frames: Sequence[int], workers: int | None
) -> Iterator[tuple[int, _Packed]]:
    """Yield frames and their skeletons."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = min(cores if workers is None else workers, len(frames))
    can_fork = "fork" in multiprocessing.get_all_start_methods() and not multiprocessing.current_process().daemon
    if count < 2 or not can_fork or len(frames) < _MIN_PARALLEL or meshes[0].vertices.is_cuda:
        yield from ((frame, _compute(meshes[frame], frame, config)) for frame in frames)
        return
    try:
        for frame, packed in _forked(meshes, config, frames, count):
            frames = [other for other in frames if other != frame]
            yield frame, packed
        return
    except BrokenProcessPool:
        pass  # a worker was killed, perhaps by accident: once more, for the frames that are missing
    try:
        yield from _forked(meshes, config, frames, min(count, len(frames)))
    except BrokenProcessPool as error:
        raise SolverError(
            f"a worker process that skeletonized one of the frames {list(frames)} was killed twice, as a system out of "
            "memory does; pass workers=1, or coarser meshes, and progress=FOLDER to keep what is done"
        ) from error


def _forked(
    meshes: Sequence[TriangleMesh], config: SkeletonizeConfig, frames: Sequence[int], count: int
) -> Iterator[tuple[int, _Packed]]:
    """Yield frames and their skeletons, computed by a number of forked processes."""
    context, remaining = multiprocessing.get_context("fork"), iter(frames)
    with ProcessPoolExecutor(count, mp_context=context, initializer=torch.set_num_threads, initargs=(1,)) as pool:

        def submitted(most: int) -> dict[Future[_Packed], int]:
            # Arrays, which pass between processes without shared memory.
            return {
                pool.submit(_compute_packed, *_packed(meshes[frame]), frame, config): frame
                for frame in islice(remaining, most)
            }

        waiting = submitted(count * _QUEUED)
        try:
            while waiting:
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    frame = waiting.pop(future)
                    waiting |= submitted(1)
                    yield frame, future.result()
        finally:
            for future in waiting:
                future.cancel()


def _packed(mesh: TriangleMesh) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    return mesh.vertices.detach().cpu().numpy(), mesh.faces.cpu().numpy()


def _compute_packed(
    vertices: np.ndarray[Any, Any], faces: np.ndarray[Any, Any], frame: int, config: SkeletonizeConfig
) -> _Packed:
    return _compute(TriangleMesh(torch.tensor(vertices), torch.tensor(faces)), frame, config)


def _compute(mesh: TriangleMesh, frame: int, config: SkeletonizeConfig) -> _Packed:
    start = time.perf_counter()
    try:
        skeleton, relations = skeletonize_surface(mesh, config)
    except InputError as error:
        raise InputError(f"meshes[{frame}]: {error}") from error
    arrays = {name: tensor.detach().cpu().numpy() for name, tensor in _tensors((skeleton, relations)).items()}
    return arrays, skeleton.notes, time.perf_counter() - start


def _fingerprint(mesh: TriangleMesh, config: SkeletonizeConfig) -> str:
    """Return a digest of a surface and a configuration."""
    digest = hashlib.sha256(repr(astuple(config)).encode())
    for part in (mesh.vertices, mesh.faces):
        digest.update(part.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _file(folder: Path, frame: int) -> Path:
    return folder / f"frame_{frame:05d}.safetensors"


def _tensors(found: FrameSkeleton) -> dict[str, Tensor]:
    skeleton, relations = found
    return {name: getattr(skeleton, name) for name in _FIELDS} | {name: getattr(relations, name) for name in _RELATIONS}


def _from_tensors(tensors: Mapping[str, Tensor], notes: Sequence[str]) -> FrameSkeleton:
    skeleton = Skeleton(**{name: tensors[name] for name in _FIELDS}, notes=tuple(notes))
    return skeleton, TipRelations(**{name: tensors[name] for name in _RELATIONS})


def _save_skeleton(folder: Path, frame: int, fingerprint: str, found: FrameSkeleton) -> None:
    save_tensors(_file(folder, frame), _tensors(found), {"surface": fingerprint, "notes": list(found[0].notes)})


def _load_skeleton(folder: Path, frame: int, fingerprint: str) -> FrameSkeleton | None:
    """Return the skeleton that was kept of a surface; None if there is none or its file is damaged."""
    try:
        tensors, metadata = load_tensors(_file(folder, frame))
        return _from_tensors(tensors, metadata["notes"]) if metadata.get("surface") == fingerprint else None
    except (FileNotFoundError, FormatError, KeyError, InputError):
        return None
