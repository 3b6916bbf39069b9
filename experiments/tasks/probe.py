"""A trial of given cost; without torch, so that processes start quickly."""

from __future__ import annotations

import os
import signal
import time

import numpy as np

from ..errors import SkippedTrial
from ..registry import Bench, TrialOutcome
from ..schema import ProbeTrial


def run(config: ProbeTrial, bench: Bench) -> TrialOutcome:
    """Return numbers that depend on the order of every sum, so that two runs agree only if all of them do."""
    if config.log:
        _append(config.log, f"{config.seed} {time.time():.6f}\n")
    if config.outcome == "killed" or (config.outcome == "killed once" and _first_time(bench)):
        os.kill(os.getpid(), signal.SIGKILL)
    if config.outcome == "skipped":
        raise SkippedTrial("there is nothing to probe")
    if config.outcome == "failed":
        raise ValueError("the probe was told to fail")
    time.sleep(config.seconds)
    begin = time.perf_counter()
    matrix = np.random.default_rng(config.seed).standard_normal((config.size, config.size), dtype=np.float32)
    state, sizes = matrix, []
    for _ in range(config.rounds if config.size else 0):
        state = np.tanh(state @ matrix)
        sizes.append(float(np.linalg.norm(state)))
    value = config.scale * float(state.sum(dtype=np.float64))
    return TrialOutcome({"value": value}, {"compute": time.perf_counter() - begin}, {"norm": sizes})


def _first_time(bench: Bench) -> bool:
    path = bench.file("begun")
    if path.exists():
        return False
    path.touch()
    return True


def _append(path: str, line: str) -> None:
    # One write in append mode: lines of several processes do not mix.
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    try:
        os.write(handle, line.encode())
    finally:
        os.close(handle)
