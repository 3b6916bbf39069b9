"""Trials as tasks of a Ray cluster, or of one that is started on this machine."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from ..engines.base import EngineConfig, share_code
from ..errors import ExperimentError
from ..worker import Job, Outcome, execute

_LOOPBACK = "127.0.0.1"
# Between looks at whether the cluster lives.
_POLL_SECONDS = 5.0
_DEAD = "the Ray cluster died; finished trials are kept, the same command goes on with the others"


class RayEngine:
    """One Ray task per trial. All machines must see the folder of results, and this code at the same path.

    The cluster is the one that RAY_ADDRESS names; without it one is started here with as many slots as jobs.

    Args:
        config: the number of tasks at a time, and so on.

    Raises:
        ExperimentError: if Ray is not installed or the cluster cannot be reached.
    """

    def __init__(self, config: EngineConfig) -> None:
        try:
            import ray
        except ImportError as error:
            raise ExperimentError("ray is not installed: pip install 'torchreg-articulated[ray]'") from error
        self.config, self._ray = config, ray
        self._started = not ray.is_initialized()
        if self._started:
            self._start(ray)
        self.gpus = float(ray.cluster_resources().get("GPU", 0)) if config.gpus != 0 else 0.0
        # A task whose process dies comes back as an outcome: how often it is tried is the driver's business.
        self._execute = ray.remote(max_retries=0)(execute)

    def _start(self, ray: Any) -> None:
        share_code()
        address = os.environ.get("RAY_ADDRESS")
        # What is meant for Ray itself; a task counts as one core unless told otherwise.
        options: dict[str, Any] = {
            "include_dashboard": False,
            "num_cpus": self.config.jobs * self.config.threads,
            # No other machine can reach what listens here; a cluster of several is named by RAY_ADDRESS.
            "_node_ip_address": _LOOPBACK,
        }
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            ray.init(
                address=address, log_to_driver=False, logging_level="ERROR",
                runtime_env={"env_vars": {"PYTHONPATH": os.environ["PYTHONPATH"]}}, **({} if address else options),
            )  # fmt: skip
        except Exception as error:
            raise ExperimentError(f"no Ray cluster at {address or 'this machine'}: {error}") from error

    def run(self, jobs: Sequence[Job]) -> Iterator[Outcome]:
        """Yield one outcome per job; see `Engine`."""
        ray, waiting = self._ray, deque(jobs)
        running: dict[Any, Job] = {}
        while waiting or running:
            while waiting and len(running) < self.config.jobs:
                job = waiting.popleft()
                running[self._submit(job)] = job
            for reference in self._ended(list(running)):
                job = running.pop(reference)
                try:
                    yield ray.get(reference)
                except ray.exceptions.RayTaskError as error:
                    raise error.cause from error
                except ray.exceptions.RayError:
                    yield Outcome(job.id, "lost")

    def _ended(self, running: list[Any]) -> list[Any]:
        """Return a task that ended; ExperimentError if the cluster did."""
        while True:
            try:
                ended: list[Any] = self._ray.wait(running, num_returns=1, timeout=_POLL_SECONDS)[0]
                alive = ended or any(node["Alive"] for node in self._ray.nodes())
            except (self._ray.exceptions.RayError, ConnectionError, RuntimeError, TimeoutError) as error:
                raise ExperimentError(f"{_DEAD} ({error!s:.200})") from error
            if not alive:
                raise ExperimentError(_DEAD)
            if ended:
                return ended

    def _submit(self, job: Job) -> Any:
        gpus = (1.0 if self.config.gpus is None else self.config.gpus) if job.accelerated and self.gpus else 0.0
        options = {"num_cpus": self.config.threads, "num_gpus": gpus}
        return self._execute.options(**options).remote(replace(job, accelerated=gpus > 0))

    def close(self) -> None:
        """Leave the cluster, and end it if it was started here."""
        if self._started:
            self._ray.shutdown()
