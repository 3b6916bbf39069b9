"""Claims: of all processes on all machines that share a folder, one runs a trial.

A claim is a lock that the operating system holds for the process that runs the trial, and frees when the process ends,
however it ends. Its file tells who took it; what is left of it after a crash tells how often the trial was begun.
"""

from __future__ import annotations

import fcntl
import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def claimed(path: Path, session: str) -> Iterator[int]:
    """Hold a claim while the block runs; yield the number of the attempt, or 0 if another process holds the claim.

    Args:
        path: of the claim's file; its folder must exist.
        session: attempts are counted anew for every session.

    Raises:
        OSError: if the file cannot be written.
    """
    handle = _locked(path)
    if handle is None:
        yield 0
        return
    try:
        attempt = _attempts(handle, session) + 1
        told = {"session": session, "attempt": attempt, "host": socket.gethostname(), "pid": os.getpid()}
        os.ftruncate(handle, 0)
        os.pwrite(handle, json.dumps(told).encode(), 0)
        yield attempt
        # Still locked: whoever opened the old file meanwhile finds out that it is gone.
        path.unlink(missing_ok=True)
    finally:
        os.close(handle)


def is_claimed(path: Path) -> bool:
    """Return whether a process holds the claim at this moment."""
    try:
        handle = os.open(path, os.O_RDWR)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    else:
        return False
    finally:
        os.close(handle)


def _locked(path: Path) -> int | None:
    """Return a handle to the locked file, or None if another process has the lock."""
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _same_file(handle, path):
                return handle
        except BlockingIOError:
            os.close(handle)
            return None
        except BaseException:
            os.close(handle)
            raise
        # The one before took the file away between opening and locking.
        os.close(handle)


def _same_file(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except FileNotFoundError:
        return False


def _attempts(handle: int, session: str) -> int:
    try:
        told = json.loads(os.pread(handle, 4096, 0))
        return int(told["attempt"]) if told["session"] == session else 0
    except (ValueError, KeyError, TypeError):
        return 0
