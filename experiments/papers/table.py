"""Table 1 of the second paper: its pairs as trials, and its rows from their records."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace

from ..papers.blocks import PAIR_SETS, PairSet
from ..records import TrialRecord
from ..report.intervals import confidence_interval
from ..schema import RegistrationTrial, ScanPairConfig

COLUMNS = {"reduced": "default", "paper": "as printed"}


def pair_trial(kind: PairSet, method: str, frame: int, *, apart: int = 1, retries: int = 0) -> RegistrationTrial:
    """Return a pair of a column of table 1: "paper" with the column's own parameters, "reduced" with its grid alone."""
    pair = ScanPairConfig(dataset=kind.dataset, frames=kind.pairs + 1, frame=frame, apart=apart)  # type: ignore[arg-type]
    trial = RegistrationTrial(pair=pair, grid_resolution=kind.resolution)
    if method != "paper":
        return trial
    printed = {"max_distance": kind.reach, "first_matches": "closest" if kind.near else "spin_images"}
    settings = {"num_samples": kind.correspondences, "printed": printed}
    return replace(trial, method="paper", num_bones=kind.bones, config=settings, retries=retries)


def case_name(kind: PairSet, method: str, frame: int) -> str:
    """Return the name of a pair among the trials."""
    return f"{kind.name} {COLUMNS[method]} {frame}"


def table_rows(records: Mapping[str, TrialRecord]) -> list[tuple[str, ...]]:
    """Return head and rows of the table; the paper's numbers, then ours by default and as printed."""
    head = ("set", "", "pairs", "first try", "95 %", "after retries", "mean error, %", "bones", "seconds a pair")
    rows: list[tuple[str, ...]] = [head]
    for kind in PAIR_SETS:
        retried = "-" if kind.retried is None else _share(kind.retried, kind.pairs)
        first = _share(kind.first_try, kind.pairs)
        rows.append(
            (kind.name, "the paper", str(kind.pairs), first, _interval(kind.first_try, kind.pairs), retried, "-",
             str(kind.bones), f"{kind.seconds:.1f}")
        )  # fmt: skip
        for method, label in COLUMNS.items():
            found = [one for name, one in records.items() if name.startswith(f"{kind.name} {label} ")]
            done = [one for one in found if one.status == "done"]
            if done:
                rows.append((kind.name, label, *_row(done, method)))
    return rows


def _row(done: Sequence[TrialRecord], method: str) -> tuple[str, ...]:
    total = len(done)
    registered = sum(bool(one.metrics["registered"]) for one in done)
    first = registered if method != "paper" else sum(bool(one.metrics["first_try"]) for one in done)
    error = statistics.fmean(one.metrics["error_percent"] for one in done)
    bones = statistics.fmean(one.metrics["bones"] for one in done)
    seconds = statistics.median(one.seconds["total"] for one in done)
    retried = "-" if method != "paper" else _share(registered, total)
    return (
        str(total), _share(first, total), _interval(first, total), retried, f"{error:.2f}", f"{bones:.1f}",
        f"{seconds:.2f}",
    )  # fmt: skip


def _share(count: int, total: int) -> str:
    return f"{count} ({100 * count / total:.0f} %)"


def _interval(count: int, total: int) -> str:
    found = confidence_interval([1.0] * count + [0.0] * (total - count), mean=True)
    return "-" if found is None else f"{100 * found[0]:.0f} to {100 * found[1]:.0f} %"
