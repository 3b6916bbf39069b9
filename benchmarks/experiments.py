"""What the runner of experiments costs: scaling over workers, overhead per trial, reports of many records.

    python benchmarks/experiments.py            # every figure
    python benchmarks/experiments.py --smoke    # small ones, to see that it runs

- scaling: trials that compute for a quarter of a second, by one worker and by two, in turn; processes are started
  before. Bar: two workers 1.7 times as fast. A busy machine has less than two cores to give: "possible" is what two
  plain processes gain that do nothing but compute, measured between the others, and "waiting" are trials that sleep.
- overhead: trials that do nothing, by one worker. Bar: 100 ms each, its record's way to the disk included.
- finished: the same sweep once more, when nothing is left to do. Bar: 2 s.
- many: records made up, collected into a table and reported. Bar: 30 s together.
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.driver import run_sweep
from experiments.engines.base import EngineConfig
from experiments.engines.local import LocalEngine
from experiments.plan import planned_trials
from experiments.records import TrialRecord, provenance
from experiments.report.page import write_report
from experiments.schema import ProbeTrial, ReportConfig, SweepConfig
from experiments.store import Store
from experiments.tables import write_parquet
from experiments.tasks.probe import run as run_probe
from experiments.worker import Job, Outcome, use_threads

SIZE = 160
BAR_SCALING, BAR_OVERHEAD_MS, BAR_FINISHED, BAR_MANY = 1.7, 100.0, 2.0, 30.0


@dataclass(frozen=True)
class Line:
    """One figure beside its bar."""

    name: str
    measured: float
    bar: float | None = None
    least: bool = False

    def __str__(self) -> str:
        text = f"{self.name:58} {self.measured:9.3f}"
        if self.bar is None:
            return text
        good = self.measured >= self.bar if self.least else self.measured <= self.bar
        return f"{text}   {'>=' if self.least else '<='} {self.bar:g}: {'pass' if good else 'FAIL'}"


class Started:
    """A local engine whose processes have started, and stay for the next sweep."""

    def __init__(self, jobs: int) -> None:
        self.engine = LocalEngine(EngineConfig(jobs))
        with tempfile.TemporaryDirectory() as folder:
            run_sweep(sweep("warm", ProbeTrial(seconds=0.1), 4 * jobs), Store(Path(folder)), lambda: self)

    def run(self, jobs: Sequence[Job]) -> Iterator[Outcome]:
        """Yield one outcome per job."""
        return self.engine.run(jobs)

    def close(self) -> None:
        """Stay."""


def sweep(name: str, trial: ProbeTrial, trials: int) -> SweepConfig:
    return SweepConfig(name, "probe", "what does it cost?", trial, seeds=trials)


def seconds_of(call: Callable[[], object]) -> float:
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def run_on(engine: Started, trial: ProbeTrial, trials: int) -> float:
    with tempfile.TemporaryDirectory() as folder:
        return seconds_of(lambda: run_sweep(sweep("timed", trial, trials), Store(Path(folder)), lambda: engine))


def rounds_for(seconds: float) -> int:
    """Return how many rounds of a probe take as long on this machine."""
    found = [run_probe(ProbeTrial(size=SIZE, rounds=200), None).seconds["compute"] for _ in range(5)]
    return max(1, round(200 * seconds / statistics.median(found)))


def _compute(rounds: int, trials: int) -> None:
    for _ in range(trials):
        run_probe(ProbeTrial(size=SIZE, rounds=rounds), None)


def plain_gain(rounds: int, trials: int) -> float:
    """Return how much faster two plain processes are than one, their start included in neither."""
    context = multiprocessing.get_context("spawn")
    with context.Pool(2) as pool:
        pool.starmap(_compute, [(1, 1)] * 4, chunksize=1)
        one = seconds_of(lambda: pool.apply(_compute, (rounds, trials)))
        two = seconds_of(lambda: pool.starmap(_compute, [(rounds, trials // 2)] * 2, chunksize=1))
    return one / two


def scaling(seconds: float, trials: int, repeats: int) -> Iterator[Line]:
    trial = ProbeTrial(size=SIZE, rounds=rounds_for(seconds))
    one, two = Started(1), Started(2)
    gains, possible = [], []
    for _ in range(repeats):
        possible.append(plain_gain(trial.rounds, trials))
        gains.append(run_on(one, trial, trials) / run_on(two, trial, trials))
    idle = ProbeTrial(size=0, seconds=seconds)
    waiting = statistics.median(run_on(one, idle, trials) / run_on(two, idle, trials) for _ in range(repeats))
    one.engine.close()
    two.engine.close()
    yield Line("two workers over one, waiting", waiting, BAR_SCALING, True)
    yield Line("two workers over one, median", statistics.median(gains), BAR_SCALING, True)
    yield Line("the same, best", max(gains))
    yield Line("possible: two plain processes over one, median", statistics.median(possible))
    yield Line("the same, best", max(possible))


def overhead(trials: int) -> Iterator[Line]:
    engine, many = Started(1), sweep("timed", ProbeTrial(size=0), trials)
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder))
        spent = seconds_of(lambda: run_sweep(many, store, lambda: engine))
        inside = sum(record.wall_seconds for record in store.records()[0])
        again = seconds_of(lambda: run_sweep(many, store, lambda: engine))
    engine.engine.close()
    yield Line("overhead per trial, ms", 1e3 * (spent - inside) / trials, BAR_OVERHEAD_MS)
    yield Line("the same sweep when it is finished, s", again, BAR_FINISHED)


def many_records(count: int) -> Iterator[Line]:
    """Yield how long it takes to collect and report as many records, a tenth as many cells."""
    seeds = 10
    scales = [float(number) for number in range(max(1, count // seeds // 10))]
    plan = SweepConfig(
        "many", "probe", "what does it cost?", ProbeTrial(), grid={"scale": scales, "rounds": list(range(1, 11))},
        seeds=seeds, report=ReportConfig(heat=("scale", "rounds")),
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder))
        store.prepare()
        store.write_sweep(plan)
        version = provenance()["versions"]["torchreg"]
        for trial in planned_trials(plan):
            value = trial.config["scale"] * trial.config["rounds"] + trial.seed
            record = TrialRecord(
                trial.id, "probe", version, trial.config, trial.seed, "done", {"value": value, "other": -value},
                {"compute": 1e-3}, {"norm": [1.0 / step for step in range(1, 31)]}, started="2026", **provenance(),
            )  # fmt: skip
            store.record_path(record.id).write_bytes(record.to_json())
        collect = seconds_of(lambda: write_parquet(store))
        report = seconds_of(lambda: write_report(plan, store, store.root / "report.html"))
        size = (store.root / "report.html").stat().st_size / 2**20
    yield Line(f"{count} records: collect, s", collect)
    yield Line(f"{count} records: report, s", report)
    yield Line(f"{count} records: both, s", collect + report, BAR_MANY)
    yield Line("the report, MB", size)


def main(arguments: Sequence[str] | None = None) -> list[Line]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=("scaling", "overhead", "many"), help="this one only")
    parser.add_argument("--repeats", type=int, default=5, help="of the scaling (default 5)")
    parser.add_argument("--records", type=int, default=10_000)
    parser.add_argument("--smoke", action="store_true", help="a few short trials and few records")
    options = parser.parse_args(arguments)
    use_threads(1)
    parts: dict[str, Callable[[], Iterator[Line]]] = {
        "scaling": lambda: scaling(0.02, 4, 1) if options.smoke else scaling(0.25, 24, options.repeats),
        "overhead": lambda: overhead(5 if options.smoke else 200),
        "many": lambda: many_records(100 if options.smoke else options.records),
    }
    lines = []
    for name in [options.part] if options.part else parts:
        for line in parts[name]():
            print(line, flush=True)
            lines.append(line)
    return lines


if __name__ == "__main__":
    main()
