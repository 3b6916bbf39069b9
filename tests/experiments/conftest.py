"""Small sweeps of probes, run in this process or by a driver of its own."""

import os
import subprocess
import sys
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

from experiments.schema import ProbeTrial, SweepConfig
from experiments.store import Store
from experiments.worker import execute

ROOT = Path(__file__).resolve().parents[2]


class InlineEngine:
    """Runs jobs in this process, one after the other."""

    def __init__(self):
        self.ran = Counter()

    def run(self, jobs):
        for job in jobs:
            self.ran[job.id] += 1
            yield execute(job)

    def close(self):
        pass


@pytest.fixture
def inline_engine():
    return InlineEngine()


@pytest.fixture(scope="session")
def probe_sweep():
    """Return the function that makes a sweep of three probes, or others."""

    def make(name="probes", trial=None, **settings):
        settings.setdefault("grid", {"scale": [1.0, 2.0, 3.0]})
        return SweepConfig(name, "probe", "does it work?", trial or ProbeTrial(), **settings)

    return make


@pytest.fixture(scope="session")
def loaded_sweep():
    """Return the function that loads a configuration of the repository, which is not to be changed, once."""
    compose = pytest.importorskip("experiments.compose", reason="experiments take the extra experiments")
    return cache(compose.load_sweep)


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "results")


@pytest.fixture
def start_driver():
    """Return the function that starts ``python -m experiments`` with arguments in a process of its own."""
    started = []

    def start(*arguments, **variables):
        environment = {**os.environ, "OMP_NUM_THREADS": "1", **variables}
        driver = subprocess.Popen(
            [sys.executable, "-m", "experiments", *map(str, arguments)],
            cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        started.append(driver)
        return driver

    yield start
    for driver in started:
        driver.kill()
        driver.wait()
        driver.stdout.close()
