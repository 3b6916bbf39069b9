"""Work on frames: done in parallel by processes, and kept on disk for a later call."""

from __future__ import annotations

import hashlib
import io
import multiprocessing
import os
import pickle
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from torchreg.errors import FormatError, InputError, SolverError
from torchreg.io.tensors import load_tensors, save_tensors

_Found = TypeVar("_Found")


@dataclass(frozen=True)
class _Pool:
    """How work is shared."""

    min_frames: int = 4  # fewer are not worth the start of processes
    queued: int = 2  # jobs for each process: it is never idle, and few surfaces are copied at a time


_POOL = _Pool()


@dataclass(frozen=True, eq=False)
class Job(Generic[_Found]):
    """A piece of work for a frame; the task can be pickled, and done is called with its result in this process."""

    frame: int
    task: Callable[[], _Found]
    done: Callable[[_Found], None]


def do_jobs(next_job: Callable[[], Job[Any] | None], num_frames: int, workers: int | None) -> None:
    """Do jobs, and call `Job.done` with each result in the order in which they come."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = min(cores if workers is None else workers, num_frames)
    can_fork = "fork" in multiprocessing.get_all_start_methods() and not multiprocessing.current_process().daemon
    if count < 2 or not can_fork or num_frames < _POOL.min_frames:
        while (job := next_job()) is not None:
            job.done(job.task())
        return
    unfinished: list[Job[Any]] = []
    try:
        _do_in_processes(next_job, count, unfinished)
        return
    except BrokenProcessPool:
        pass  # a worker was killed, perhaps by accident: once more
    try:
        _do_in_processes(next_job, count, unfinished)
    except BrokenProcessPool as error:
        raise SolverError(
            f"a worker process for one of the frames {sorted({job.frame for job in unfinished})} was killed twice, as "
            "a system out of memory does; pass workers=1, or coarser meshes, and progress=FOLDER to keep what is done"
        ) from error


def _do_in_processes(next_job: Callable[[], Job[Any] | None], count: int, unfinished: list[Job[Any]]) -> None:
    """Do jobs in a number of forked processes, those first that were left unfinished; the list is kept up to date."""
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(count, mp_context=context, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        waiting = {pool.submit(_run, _pickled(job.task)): job for job in unfinished}
        try:
            while True:
                while len(waiting) < count * _POOL.queued and (job := next_job()) is not None:
                    unfinished.append(job)
                    waiting[pool.submit(_run, _pickled(job.task))] = job
                if not waiting:
                    return
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    result = pickle.loads(future.result())
                    job = waiting.pop(future)
                    unfinished.remove(job)
                    job.done(result)
        finally:
            _cancel(waiting)


def _cancel(futures: Mapping[Future[bytes], Job[Any]]) -> None:
    for future in futures:
        future.cancel()


def _run(task: bytes) -> bytes:
    return _pickled(pickle.loads(task)())


class _Pickler(pickle.Pickler):
    """Pickles tensors as arrays, which pass between processes without shared memory."""

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, Tensor):
            return torch.from_numpy, (value.detach().cpu().numpy(),)
        return NotImplemented


def _pickled(value: Any) -> bytes:
    buffer = io.BytesIO()
    _Pickler(buffer, pickle.HIGHEST_PROTOCOL).dump(value)
    return buffer.getvalue()


@dataclass(frozen=True)
class KeptResults:
    """Results of jobs in a folder, each kept as soon as it is done, for a later call; no folder keeps nothing."""

    folder: Path | None

    @classmethod
    def in_folder(cls, folder: str | os.PathLike[str] | None) -> KeptResults:
        """Return the results in a folder, which is created if absent."""
        if folder is None:
            return cls(None)
        Path(folder).mkdir(parents=True, exist_ok=True)
        return cls(Path(folder))

    def digest(self, *sources: Tensor | str) -> str:
        """Return a digest of what a result is made from; an empty one if nothing is kept."""
        found = hashlib.sha256()
        for part in sources if self.folder is not None else ():
            found.update(part.encode() if isinstance(part, str) else part.detach().cpu().contiguous().numpy().tobytes())
        return found.hexdigest() if self.folder is not None else ""

    def save(self, name: str, source: str, tensors: Mapping[str, Tensor], notes: Sequence[str] = ()) -> None:
        """Keep a result under a name, with the digest of what it is made from."""
        if self.folder is not None:
            save_tensors(self._path(name), tensors, {"source": source, "notes": list(notes)})

    def load(
        self, name: str, source: str, make: Callable[[Mapping[str, Tensor], Sequence[str]], _Found]
    ) -> _Found | None:
        """Return ``make`` of the kept tensors and notes of a name and source; None if there are none undamaged."""
        if self.folder is None:
            return None
        try:
            tensors, metadata = load_tensors(self._path(name))
            return make(tensors, metadata["notes"]) if metadata.get("source") == source else None
        except (FileNotFoundError, FormatError, KeyError, InputError):
            return None

    def _path(self, name: str) -> Path:
        return Path(self.folder or "", f"{name}.safetensors")
