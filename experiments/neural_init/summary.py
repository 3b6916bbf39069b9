"""Final errors of the variants beside the baseline's, and the steps after which they reach its final error."""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Sequence
from pathlib import Path

from ..records import TrialRecord
from ..store import Store

BASELINE, METRIC = "scratch", "tips_mm"
# The baseline is also cut off at these shares of its steps: what help is worth depends on how long one trains.
SHARES = (0.1, 0.25, 0.5, 1.0)


def steps_to(record: TrialRecord, error: float) -> float | None:
    """Return the steps after which a trial reaches an error, interpolated between points of its curve.

    None if it never is.
    """
    steps, errors = record.curves["steps"], record.curves[METRIC]
    for number, value in enumerate(errors):
        if value <= error:
            if number == 0:
                return float(steps[0])
            share = (errors[number - 1] - error) / (errors[number - 1] - value)
            return float(steps[number - 1] + share * (steps[number] - steps[number - 1]))
    return None


def error_at(records: Sequence[TrialRecord], steps: float) -> float:
    """Return the mean error of trials after a number of steps, at the nearest points of their curves."""
    rows = [
        min(range(len(record.curves["steps"])), key=lambda row: abs(record.curves["steps"][row] - steps))
        for record in records
    ]
    return statistics.fmean(record.curves[METRIC][row] for record, row in zip(records, rows, strict=True))


def table(records: Sequence[TrialRecord], baseline: Sequence[TrialRecord]) -> list[str]:
    """Return lines: per variant the final error, its ratio to the baseline's, and the share of steps it takes."""
    groups: dict[str, list[TrialRecord]] = {}
    for record in records:
        groups.setdefault(str(record.config["variant"]), []).append(record)
    total = float(baseline[0].config["steps"])
    heads = "  ".join(f"{f'of {share * total:g}':>18}" for share in SHARES)
    lines = [f"{'variant':12} {'tips, mm':>22} {'ratio':>6}  steps to the baseline's error after: {heads}"]
    for variant, members in groups.items():
        final = [float(record.metrics[METRIC]) for record in members]
        ratio = statistics.fmean(final) / error_at(baseline, total)
        shown = [_share(members, error_at(baseline, share * total), share * total) for share in SHARES]
        spread = f"{statistics.fmean(final):.2f} ({min(final):.2f} to {max(final):.2f})"
        lines.append(f"{variant:12} {spread:>22} {ratio:6.2f}  {'':37} " + "  ".join(f"{text:>18}" for text in shown))
    return lines


def _share(members: Sequence[TrialRecord], error: float, steps: float) -> str:
    """Return the share of steps, mean and spread over seeds, that trials need for an error."""
    found = [steps_to(record, error) for record in members]
    known = [needed / steps for needed in found if needed is not None]
    if len(known) < len(found):
        return f"not by {len(found) - len(known)} of {len(found)}"
    return f"{statistics.fmean(known):.2f} ({min(known):.2f} to {max(known):.2f})"


def finished(folder: Path) -> list[TrialRecord]:
    """Return the finished trials in a folder of results, variant by variant in the order of their names."""
    done = [record for record in Store(folder).records()[0] if record.status == "done"]
    return sorted(done, key=lambda record: (str(record.config["variant"]), record.seed))


def main(arguments: Sequence[str] | None = None) -> list[str]:
    """Print the table of a folder of results."""
    parser = argparse.ArgumentParser(prog="python -m experiments.neural_init", description=__doc__)
    parser.add_argument("results", nargs="?", type=Path, default=Path("results/neural_init/variants"))
    parser.add_argument("--baseline", type=Path, help="other results that hold the baseline")
    options = parser.parse_args(arguments)
    folder = options.baseline or options.results
    baseline = [record for record in finished(folder) if record.config["variant"] == BASELINE]
    if not baseline:
        parser.error(f"{folder} holds no finished trial of the variant {BASELINE}; run its sweep first")
    lines = table(finished(options.results), baseline)
    print("\n".join(lines))  # noqa: T201 - what the command is for
    return lines
