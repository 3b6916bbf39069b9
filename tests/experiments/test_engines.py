"""Three engines, one behavior: what one process finds, all find, whoever is killed on the way."""

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.driver import run_sweep
from experiments.engines.base import EngineConfig, share_code, visible_gpus
from experiments.engines.by_name import make_engine
from experiments.errors import ConfigError, ExperimentError
from experiments.schema import ProbeTrial
from experiments.store import Store

ENGINES = {"local": (), "ray": (), "slurm": ("--slurm", "cluster=local")}
SWEEP = """
task: probe
question: Does every trial end with one result?
trial: {{size: 16, seconds: {seconds}, log: {log}}}
grid: {{scale: [1.0, 2.0], rounds: [2, 4, 8]}}
seeds: 4
"""


@pytest.fixture(scope="module")
def ray_cluster():
    """One Ray cluster for all tests, as its start takes longest; drivers find it by its address."""
    ray = pytest.importorskip("ray")
    share_code()
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    context = ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    yield context.address_info["address"]
    ray.shutdown()


@pytest.fixture
def engine_name(request, monkeypatch):
    if request.param == "slurm":
        pytest.importorskip("submitit")
    if request.param == "ray":
        monkeypatch.setenv("RAY_ADDRESS", request.getfixturevalue("ray_cluster"))
    return request.param


def config(name, **settings):
    options = {"cluster": "local"} if name == "slurm" else {}
    return EngineConfig(options=options, **settings)


def wait_for_records(store, count, driver, timeout=60):
    deadline = time.monotonic() + timeout
    while len(list(store.trials.glob("*.json"))) < count:
        assert driver.poll() is None, driver.stdout.read()
        assert time.monotonic() < deadline, "no progress"
        time.sleep(0.01)


@pytest.mark.parametrize(("engine_name", "kills"), [("local", 2), ("ray", 1), ("slurm", 2)], indirect=["engine_name"])
def test_a_driver_may_be_killed_at_any_moment(engine_name, kills, tmp_path, start_driver):
    """Then every trial has one result, and no finished one ran again."""
    sweep, log = tmp_path / "many.yaml", tmp_path / "log"
    # The jobs of Slurm do not end with the driver, and should leave something for the next one.
    sweep.write_text(SWEEP.format(log=log, seconds=0.15 if engine_name == "slurm" else 0.06))
    store, chance = Store(tmp_path / "results/many"), random.Random(engine_name)
    command = ["sweep", sweep, "--results", tmp_path / "results", "--jobs", "2", "--engine", engine_name]
    snapshots = []
    for turn in range(kills):
        driver = start_driver(*command, *ENGINES[engine_name])
        known = len(list(store.trials.glob("*.json")))
        wait_for_records(store, known + chance.randint(1, 3), driver)
        time.sleep(chance.uniform(0, 0.1))
        driver.kill()
        driver.wait()
        if turn < kills - 1:
            kill_jobs(store)
        snapshots.append({path: (path.stat().st_ino, path.read_bytes()) for path in store.trials.glob("*.json")})
    final = start_driver(*command, *ENGINES[engine_name])
    printed, _ = final.communicate(timeout=100)
    assert final.returncode == 0, printed
    records, bad = store.records()
    assert (len(records), bad) == (24, [])
    assert {record.status for record in records} == {"done"}
    for snapshot in snapshots:
        for path, before in snapshot.items():
            assert (path.stat().st_ino, path.read_bytes()) == before
    # A trial starts again only if it was cut off: at most two at a time, at every kill.
    assert 24 <= len(log.read_text().splitlines()) <= 24 + 2 * kills
    # Whatever ran them, another engine, which starts soonest, finds them finished.
    again = start_driver("sweep", sweep, "--results", tmp_path / "results")
    printed, _ = again.communicate(timeout=60)
    assert "24 trials: 0 run now, 24 finished before" in printed


def kill_jobs(store):
    """Kill what submitit started, which outlives its driver and would do all the work before the next one is there."""
    for path in store.root.glob("slurm/*_submitted.pkl"):
        pid = int(path.name.partition("_")[0])
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            if b"submitit" in Path(f"/proc/{pid}/cmdline").read_bytes():
                children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
                for one in (pid, *map(int, children)):
                    os.kill(one, signal.SIGKILL)


@pytest.mark.parametrize("engine_name", ENGINES, indirect=True)
def test_a_killed_worker_does_not_stop_the_sweep(engine_name, store, probe_sweep):
    """One trial kills its process the first time; another always, and is recorded as failed."""
    sweep = probe_sweep(trial=ProbeTrial(), grid={"outcome": ["done", "killed once", "killed"]})
    summary = run_sweep(
        sweep, store, lambda: make_engine(engine_name, config(engine_name, jobs=2)), engine_name=engine_name
    )
    assert (summary.ran, summary.failed, summary.unfinished) == (3, 1, 0)
    records = {record.config["outcome"]: record for record in store.records()[0]}
    assert [records[name].status for name in ("done", "killed once", "killed")] == ["done", "done", "failed"]
    assert "died 3 times" in records["killed"].note
    assert records["killed once"].attempt == 2


def test_workers_end_with_their_driver(tmp_path, start_driver):
    sweep = tmp_path / "slow.yaml"
    sweep.write_text(f"task: probe\nquestion: q\ntrial: {{seconds: 60, log: {tmp_path / 'log'}}}\n")
    driver = start_driver("sweep", sweep, "--results", tmp_path)
    deadline = time.monotonic() + 60
    while not (tmp_path / "log").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    children = subprocess.run(["ps", "-o", "pid=", "--ppid", str(driver.pid)], capture_output=True, text=True).stdout
    os.kill(driver.pid, signal.SIGKILL)
    driver.communicate()
    pids = [int(pid) for pid in children.split()]
    assert pids
    while any(os.path.exists(f"/proc/{pid}") for pid in pids):
        assert time.monotonic() < deadline, "a worker lives on"
        time.sleep(0.02)


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("local", {"threads": 0}, "--threads must be at least 1, got 0"),
        ("local", {"gpus": -1.0}, "--gpus must not be negative"),
        ("slurm", {}, "there is no Slurm here .*--slurm cluster=local"),
    ],
)
def test_engines_that_cannot_be_are_refused(name, settings, message, monkeypatch):
    monkeypatch.setenv("PATH", "")
    with pytest.raises((ConfigError, ExperimentError), match=message):
        make_engine(name, EngineConfig(**settings))


def test_gpus_are_found_without_torch_and_shared_out_among_local_workers(monkeypatch, tmp_path):
    tool = tmp_path / "nvidia-smi"
    tool.write_text("#!/bin/sh\necho 'GPU 0: a'\necho 'GPU 1: b'\n")
    tool.chmod(0o755)
    found = f"{tmp_path}:/usr/bin:/bin"
    cases = (("2, 5", "", ["2", "5"]), ("", found, []), (None, found, ["0", "1"]), (None, "", []))
    for visible, path, expected in cases:
        with monkeypatch.context() as patch:
            patch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
            if visible is not None:
                patch.setenv("CUDA_VISIBLE_DEVICES", visible)
            patch.setenv("PATH", path)
            assert visible_gpus() == expected
    # Each worker sees one.
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,7")
    engine = make_engine("local", EngineConfig(jobs=3))
    try:
        pools = [engine._new_pool(slot) for slot in range(3)]
        assert [pool.submit(os.getenv, "CUDA_VISIBLE_DEVICES").result() for pool in pools] == ["4", "7", "4"]
        for pool in pools:
            pool.shutdown()
    finally:
        engine.close()


def test_ray_listens_on_the_loopback_alone_and_its_death_is_an_error(monkeypatch):
    """Ray itself is not started: what it is asked for, and what it answers, is."""
    from experiments.engines import ray_cluster

    asked, answers = {}, []

    class Ray:
        class exceptions:
            RayError = type("RayError", (Exception,), {})

        is_initialized = staticmethod(lambda: False)
        cluster_resources = staticmethod(dict)
        nodes = staticmethod(lambda: [{"Alive": False}])
        init = staticmethod(lambda **options: asked.update(options))
        remote = staticmethod(lambda **options: lambda function: function)
        wait = staticmethod(lambda running, **options: answers.pop())

    monkeypatch.setitem(sys.modules, "ray", Ray)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    engine = ray_cluster.RayEngine(EngineConfig(jobs=2))
    assert asked["_node_ip_address"] == "127.0.0.1"
    assert asked["include_dashboard"] is False
    answers[:] = [([], ["a"])]
    with pytest.raises(ExperimentError, match="the Ray cluster died; finished trials are kept"):
        engine._ended(["a"])

    def fails(**options):
        raise Exception("the current node timed out")

    monkeypatch.setattr(Ray, "init", staticmethod(fails))
    with pytest.raises(ExperimentError, match="no Ray cluster at this machine: the current node timed out"):
        ray_cluster.RayEngine(EngineConfig())
