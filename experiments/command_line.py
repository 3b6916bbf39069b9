"""The commands: run one trial, run a sweep, collect its records, query them, and write its report."""

from __future__ import annotations

import contextlib
import sys
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from .compose import known_configs, load_sweep, swept_fields
from .driver import OnOutcome, Summary, run_sweep
from .engines.base import EngineConfig
from .engines.by_name import make_engine
from .errors import ConfigError, ExperimentError
from .papers.blocks import DEFAULT_PAIRS
from .plan import planned_trials
from .records import TrialRecord, parse_record
from .registry import Bench, find_task
from .schema import SweepConfig
from .sinks import make_sink
from .store import Store, same_sweep
from .worker import Job, Outcome, execute, measure, use_threads

application = typer.Typer(help=__doc__, no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)

Name = Annotated[str, typer.Argument(help="a configuration such as alignment/sigma_schedule, or a YAML file")]
Overrides = Annotated[
    list[str] | None,
    typer.Argument(help="key=value, such as seeds=3; several values sweep a field: schedule.start=0.04,0.06"),
]
Results = Annotated[Path, typer.Option(help="folder of all results")]
_RESULTS = Path("results")


@application.command("list")
def list_configs() -> None:
    """Print the names of all configurations."""
    for name in known_configs():
        typer.echo(name)


@application.command()
def run(config: Name, overrides: Overrides = None, threads: int = 1) -> None:
    """Run the single trial of a configuration, without its cases and its grid, and print its results."""
    for key in swept_fields(overrides or []):
        raise ConfigError(f"run takes one value of {key}; sweep takes several")
    plan = replace(load_sweep(config, overrides or []), grid={}, cases=(), seeds=1, picture_seeds=0)
    (trial,) = planned_trials(plan)
    accelerated = find_task(plan.task).accelerated
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder))
        store.prepare()
        execute(Job(folder, plan.task, trial.id, trial.config, "run", "none", threads, accelerated))
        record = store.read(trial.id)
    if record is not None:
        _print_record(record)
        if record.status == "failed":
            raise typer.Exit(1)


@application.command()
def rerun(record: Path, threads: int = 1) -> None:
    """Run the trial of a record file again, and report whether its numbers are the same."""
    with _readable(record):
        old = parse_record(record.read_bytes(), record.name)
    use_threads(threads)
    with tempfile.TemporaryDirectory() as folder:
        found = measure(find_task(old.task), old.config, Bench("cpu", Path(folder)))
    for name, value in found.metrics.items():
        before = old.metrics.get(name)
        same = "as recorded" if value == before or (before is None and value != value) else f"recorded: {before}"
        typer.echo(f"{name:24} {value!r:24} {same}")


@application.command()
def sweep(
    config: Name,
    overrides: Overrides = None,
    engine: Annotated[str, typer.Option(help="local, ray or slurm")] = "local",
    jobs: Annotated[int, typer.Option(help="trials at a time")] = 1,
    threads: Annotated[int, typer.Option(help="of each worker")] = 1,
    gpus: Annotated[float | None, typer.Option(help="per trial; by default one if there are any")] = None,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="run failed and skipped trials again")] = False,
    timeout: Annotated[float | None, typer.Option(help="seconds after which a trial is ended, as failed")] = None,
    slurm: Annotated[list[str] | None, typer.Option(help="key=value for Slurm, such as partition=short")] = None,
    sink: Annotated[list[str] | None, typer.Option(help="tensorboard, mlflow or wandb")] = None,
    results: Results = _RESULTS,
) -> None:
    """Run the missing trials of a sweep. Repeat the command after a crash, or run it on several machines at once."""
    plan = load_sweep(config, overrides or [])
    if timeout is not None and not 0 < timeout < threading.TIMEOUT_MAX:
        raise ConfigError(f"--timeout must be a positive number of seconds, got {timeout}")
    store = Store(results / plan.name)
    options = EngineConfig(jobs, threads, gpus, dict(_pair(text) for text in slurm or []))
    sinks = [make_sink(name, plan.name, str(store.root)) for name in sink or []]
    with _told_if_interrupted(), _progress(plan) as on_outcome:
        summary = run_sweep(
            plan, store, lambda: make_engine(engine, options), engine_name=engine, threads=threads,
            retry_failed=retry_failed, timeout=timeout, on_outcome=on_outcome, sinks=sinks,
        )  # fmt: skip
    if summary.kept + summary.ran + summary.elsewhere:
        from .report.terminal import sweep_table

        typer.echo(f"medians over seeds, means of shares, with 95 % confidence intervals\n{sweep_table(plan, store)}")
    _print_summary(summary, store)
    if summary.unfinished:
        raise typer.Exit(1)


@application.command()
def papers(
    output: Annotated[Path, typer.Option("--output", "-o", help="folder of the page and of all results")],
    smoke: Annotated[bool, typer.Option("--smoke", help="small and coarse, within three minutes on two cores")] = False,
    pairs: Annotated[int, typer.Option(help="of each column of table 1, at most the paper's")] = DEFAULT_PAIRS,
    jobs: Annotated[int, typer.Option(help="trials at a time")] = 2,
    seed: Annotated[int, typer.Option(help="of all that is made up")] = 0,
) -> None:
    """Make every figure and table of the three papers again, on one page. Repeat the command to go on after a stop."""
    if pairs < 1:
        raise ConfigError(f"--pairs must be at least 1, got {pairs}")
    from .papers.command import PapersRun, make_papers

    run = PapersRun(output, pairs, smoke, seed)
    options = EngineConfig(jobs, 1, None, {})
    with contextlib.ExitStack() as bars:
        page = make_papers(
            run, lambda: make_engine("local", options), lambda plan: bars.enter_context(_progress(plan))
        )  # fmt: skip
    for line in page.with_suffix(".txt").read_text(encoding="utf-8").splitlines():
        typer.echo(line)
    typer.echo(page)


@application.command()
def collect(config: Name, results: Results = _RESULTS) -> None:
    """Put all records of a sweep into one Parquet file."""
    from .tables import write_parquet

    store = Store(results / _sweep_of(config, results).name)
    count, bad = write_parquet(store)
    for error in bad:
        typer.echo(f"left out: {error}", err=True)
    typer.echo(f"{count} records in {store.parquet}")


@application.command()
def query(config: Name, sql: str, results: Results = _RESULTS) -> None:
    """Query the records of a sweep by DuckDB; the table is called trials."""
    from .tables import query_records

    typer.echo(query_records(Store(results / _sweep_of(config, results).name), sql))


@application.command()
def report(
    config: Name,
    output: Annotated[Path | None, typer.Option(help="the page; by default report.html beside the records")] = None,
    picture: Annotated[Path | None, typer.Option(help="PNG of the page in headless Chromium")] = None,
    plots: Annotated[Path | None, typer.Option(help="PNG or PDF of metrics over all axes of numbers")] = None,
    results: Results = _RESULTS,
) -> None:
    """Write the report of a sweep: one page that opens without a network."""
    from .report.page import write_report

    plan = _sweep_of(config, results)
    store = Store(results / plan.name)
    notes = []
    if not config.endswith((".yaml", ".yml")) and config in known_configs():
        now = load_sweep(config)
        if now.name == plan.name and not same_sweep(now, plan):
            notes.append(
                "The configuration differs from the one that the sweep was last run with, which is shown here."
            )
    page = write_report(plan, store, output or store.root / "report.html", notes)
    typer.echo(page)
    if plots is not None:
        from .report.plots import save_plots

        typer.echo(save_plots(plan, store, plots) or "no axis of this sweep has several numbers: there are no plots")
    if picture is not None:
        from .report.browser import photograph

        for told in photograph(page, picture):
            typer.echo(f"the browser's console: {told}", err=True)


def main() -> None:
    """Run a command; errors of experiments end with one line and code 1."""
    try:
        application()
    except ExperimentError as error:
        typer.echo(f"error: {error}", err=True)
        sys.exit(1)
    except KeyboardInterrupt:
        typer.echo("interrupted; finished trials are kept, the same command goes on", err=True)
        sys.exit(130)


@contextlib.contextmanager
def _told_if_interrupted() -> Iterator[None]:
    """Say on Ctrl-C what is kept; typer would end without a word."""
    try:
        yield
    except KeyboardInterrupt:
        typer.echo("interrupted; finished trials are kept, the same command goes on", err=True)
        raise typer.Exit(130) from None


def _sweep_of(config: str, results: Path) -> SweepConfig:
    """Return the stored configuration of a sweep, else that of its file."""
    name = config if not config.endswith((".yaml", ".yml")) else load_sweep(config).name
    if not (results / name).resolve().is_relative_to(results.resolve()):
        raise ConfigError(f"{name!r} is not below the results in {results}")
    found = Store(results / name).read_sweep()
    return load_sweep(config) if found is None else found


@contextlib.contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from error


@contextlib.contextmanager
def _progress(plan: SweepConfig) -> Iterator[OnOutcome]:
    from tqdm import tqdm

    with tqdm(total=len({trial.id for trial in planned_trials(plan)}), disable=None, desc=plan.name) as bar:

        def step(outcome: Outcome, summary: Summary) -> None:
            bar.update(summary.kept + summary.ran + summary.elsewhere - bar.n)
            bar.set_postfix(failed=summary.failed, skipped=summary.skipped)
            if outcome.status == "failed" and outcome.fresh:
                bar.write(f"{outcome.id} failed: {outcome.note}", file=sys.stderr)

        yield step


def _print_summary(summary: Summary, store: Store) -> None:
    for told in summary.set_aside:
        typer.echo(f"set aside and run again: {told}", err=True)
    text = f"{summary.planned} trials: {summary.ran} run now, {summary.kept} finished before"
    text += f", {summary.elsewhere} run by another driver" if summary.elsewhere else ""
    text += f"; {summary.failed} failed, {summary.skipped} skipped"
    typer.echo(text)
    if summary.unfinished:
        typer.echo(f"{summary.unfinished} trials have no result: no process that could run them stayed alive", err=True)
    if summary.foreign:
        typer.echo(f"{summary.foreign} records of other configurations of this sweep are kept beside them")
    typer.echo(f"results in {store.root}")


def _print_record(record: TrialRecord) -> None:
    typer.echo(f"{record.status} in {record.wall_seconds:.2f} s, {record.peak_memory_mb:.0f} MB, {record.device}")
    for name, value in {**record.metrics, **{f"seconds.{k}": v for k, v in record.seconds.items()}}.items():
        typer.echo(f"{name:24} {value}")
    for told in (*record.warnings, record.traceback or record.note):
        if told:
            typer.echo(told, err=True)


def _pair(text: str) -> tuple[str, str]:
    key, sign, value = text.partition("=")
    if not sign:
        raise ConfigError(f"--slurm takes key=value, got {text!r}")
    return key, value
