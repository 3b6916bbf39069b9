"""The worker does the newest alone, in one thread, and survives errors."""

import math
import threading

import pytest

from torchreg.errors import InputError
from torchreg.viz.latest_worker import LatestWorker


@pytest.fixture
def gate():
    return threading.Event()


def test_what_arrives_while_it_is_busy_replaces_what_waits(gate):
    done, threads, started = [], set(), threading.Event()

    def work(job):
        started.set()
        gate.wait(5)
        done.append(dict(job))
        threads.add(threading.current_thread())

    worker = LatestWorker(work, pytest.fail)
    assert math.isnan(worker.median_seconds)
    worker.submit("a", 0)
    started.wait(5)
    for number in range(1, 100):
        worker.submit("a", number)
    worker.submit("b", "other")
    assert not worker.flush(timeout=0.01)
    gate.set()
    assert worker.flush(timeout=5)
    assert done == [{"a": 0}, {"a": 99, "b": "other"}]
    assert len(threads) == 1
    assert len(worker.seconds) == 2
    assert worker.median_seconds >= 0
    worker.close()


def test_what_waits_can_be_dropped(gate):
    done, started = [], threading.Event()

    def work(job):
        started.set()
        gate.wait(5)
        done.append(dict(job))

    worker = LatestWorker(work, pytest.fail)
    worker.submit("a", 0)
    started.wait(5)
    worker.submit("a", 1)
    threading.Timer(0.05, gate.set).start()
    worker.drop()
    assert done == [{"a": 0}]
    worker.close()
    worker.submit("a", 2)
    assert worker.flush(5)  # nothing is waited for that will never be done
    assert done == [{"a": 0}]


def test_an_error_is_told_and_the_next_job_done():
    told, done = [], []

    def work(job):
        if job["a"] < 0:
            raise InputError("a must not be negative")
        done.append(job["a"])

    worker = LatestWorker(work, told.append)
    worker.submit("a", -1)
    assert worker.flush(5)
    worker.submit("a", 1)
    assert worker.flush(5)
    worker.close()
    assert [str(error) for error in told] == ["a must not be negative"]
    assert done == [1]
