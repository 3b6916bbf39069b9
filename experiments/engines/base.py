"""The interface of all engines, and their common functions."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from ..errors import ConfigError
from ..worker import Job, Outcome


class Engine(Protocol):
    """Runs jobs in other processes."""

    def run(self, jobs: Sequence[Job]) -> Iterator[Outcome]:
        """Yield one outcome per job, in the order in which they end.

        Raises:
            StoreError: if results cannot be written.
        """
        ...

    def close(self) -> None:
        """Release all processes; running jobs are abandoned."""
        ...


@dataclass(frozen=True)
class EngineConfig:
    """Settings of an engine.

    Args:
        jobs: trials at a time.
        threads: per worker.
        gpus: per trial of a task that has use for one; None: one, if the machine has any.
        options: of Slurm, such as {"cluster": "local", "partition": "short", "timeout_min": "60"}.
    """

    jobs: int = 1
    threads: int = 1
    gpus: float | None = None
    options: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("jobs", "threads"):
            if getattr(self, name) < 1:
                raise ConfigError(f"--{name} must be at least 1, got {getattr(self, name)}")
        if self.gpus is not None and self.gpus < 0:
            raise ConfigError(f"--gpus must not be negative, got {self.gpus}")


def visible_gpus() -> list[str]:
    """Return the GPUs of this machine that may be used, without loading torch."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is not None:
        return [name.strip() for name in named.split(",") if name.strip() not in ("", "-1")]
    tool = shutil.which("nvidia-smi")
    if tool is None:
        return []
    try:
        listed = subprocess.run([tool, "-L"], capture_output=True, text=True, timeout=30, check=False).stdout
    except (OSError, subprocess.TimeoutExpired):
        return []
    count = sum(line.startswith("GPU ") for line in listed.splitlines())
    return [str(number) for number in range(count)]


def share_code() -> None:
    """Give processes that start later the import path of this package."""
    # The folder that holds the outermost package: the checkout, or where the library is installed.
    root = str(Path(__file__).resolve().parents[(__package__ or "").count(".") + 1])
    paths = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    if root not in paths:
        os.environ["PYTHONPATH"] = os.pathsep.join([root, *filter(None, paths)])
