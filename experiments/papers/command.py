"""All figures and tables of the papers: blocks and pairs are trials of two sweeps, so that a run can go on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..driver import OnOutcome, run_sweep
from ..engines.base import Engine
from ..papers.page import write_page
from ..papers.table import COLUMNS, case_name, pair_trial
from ..plan import planned_trials
from ..records import TrialRecord
from ..schema import PaperTrial, RegistrationTrial, SweepConfig
from ..store import Store
from ..structure import plain
from .blocks import BLOCK_IDS, DEFAULT_PAIRS, PAIR_SETS

# Further tries as printed of pairs that were not registered, with other reaches, grids and seeds.
_RETRIES = 5


@dataclass(frozen=True)
class PapersRun:
    """What is run.

    Args:
        folder: of the page, and of all results.
        pairs: of each column of table 1, at most as many as the paper's.
        smoke: small and coarse, within minutes; a pair of each column.
        seed: of all that is made up.
    """

    folder: Path
    pairs: int = DEFAULT_PAIRS
    smoke: bool = False
    seed: int = 0

    def store(self, sweep: SweepConfig) -> Store:
        """Return the folder of a sweep's results; those of a small run stand apart."""
        return Store(self.folder / "results" / (f"{sweep.name}_smoke" if self.smoke else sweep.name))


def block_sweep(run: PapersRun) -> SweepConfig:
    """Return the sweep whose trials are the blocks."""
    question = "What do the figures and tables of the three papers look like, made again?"
    trial = PaperTrial(seed=run.seed, smoke=run.smoke)
    return SweepConfig("blocks", "papers", question, trial, grid={"block": list(BLOCK_IDS)})


def pair_sweep(run: PapersRun) -> SweepConfig:
    """Return the sweep whose trials are the pairs of table 1, each by default and as printed."""
    cases: list[dict[str, Any]] = []
    for kind in PAIR_SETS:
        for method in COLUMNS:
            for frame in spread(kind.pairs, 1 if run.smoke else run.pairs):
                trial = pair_trial(kind, method, frame, retries=0 if run.smoke else _RETRIES)
                cases.append({"case": case_name(kind, method, frame), **_changes(trial)})
    question = "Table 1: how many pairs are registered, and how fast?"
    return SweepConfig("pairs", "registration", question, RegistrationTrial(seed=run.seed), cases=tuple(cases))


def _changes(trial: RegistrationTrial) -> dict[str, Any]:
    return {key: value for key, value in plain(trial).items() if key not in ("seed", "pictures")}


def spread(total: int, count: int) -> list[int]:
    """Return up to ``count`` of the numbers from 0 to ``total - 1``, evenly spread."""
    count = min(count, total)
    return sorted({round((number + 0.5) * total / count - 0.5) for number in range(count)})


def make_papers(
    run: PapersRun, start_engine: Callable[[], Engine], progress: Callable[[SweepConfig], OnOutcome] | None = None
) -> Path:
    """Run what is missing, write the page after each sweep, and return its path.

    Args:
        run: what is run.
        start_engine: makes the engine that runs trials.
        progress: called with every sweep before it begins; returns what to call after each trial.

    Raises:
        StoreError: if results cannot be written.
    """
    sweeps, page = (block_sweep(run), pair_sweep(run)), run.folder / "papers.html"
    for sweep in sweeps:
        run_sweep(sweep, run.store(sweep), start_engine, on_outcome=None if progress is None else progress(sweep))
        write_page(page, *(records_by_case(run, one) for one in sweeps), store=run.store(sweeps[0]), smoke=run.smoke)
    return page


def records_by_case(run: PapersRun, sweep: SweepConfig) -> dict[str, TrialRecord]:
    """Return the records there are of a sweep, by the value of its only axis."""
    records = {record.id: record for record in run.store(sweep).records()[0]}
    names = {next(iter(trial.axes.values())): trial.id for trial in planned_trials(sweep)}
    return {name: records[trial] for name, trial in names.items() if trial in records}
