"""One page of all figures and tables of the papers, and the same numbers as text."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchreg.io.atomic import write_atomic

from ..errors import ExperimentError
from ..papers.blocks import BLOCKS, PAIR_SETS, PAPERS, Block
from ..papers.table import COLUMNS, table_rows
from ..records import TrialRecord
from ..report.cells import number
from ..store import Store, explained

_TEMPLATES = Path(__file__).parent
_TABLE = "p2-table-1"


@dataclass(frozen=True)
class Shown:
    """A block as the page shows it.

    Args:
        block: what it is.
        verdict: "reproduced", "other data", or why not.
        filled: whether it holds a picture or rows.
        pictures: captions and data URLs.
        rows: of its table, a head first; none if empty.
    """

    block: Block
    verdict: str
    filled: bool
    pictures: list[tuple[str, str]]
    rows: list[tuple[str, ...]]


def write_page(
    path: Path, blocks: Mapping[str, TrialRecord], pairs: Mapping[str, TrialRecord], *, store: Store, smoke: bool
) -> list[Shown]:
    """Write the page, and beside it the numbers as text; return what is shown.

    Args:
        path: of the page.
        blocks: records by block.
        pairs: records of the pairs of table 1 by case.
        store: of the blocks' pictures.
        smoke: whether the run was small.

    Raises:
        StoreError: if a file cannot be written.
        ExperimentError: if jinja2 is not installed.
    """
    shown = [_shown(block, blocks.get(block.id), pairs, store) for block in BLOCKS]
    notes = _notes(shown, pairs, smoke)
    with explained(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, _render(shown, notes).encode())
        write_atomic(path.with_suffix(".txt"), as_text(shown, notes).encode())
    return shown


def as_text(shown: list[Shown], notes: list[str]) -> str:
    """Return the verdicts and the numbers as lines."""
    lines = [*notes, ""]
    for one in shown:
        lines.append(f"{one.block.id:12} {one.verdict:12} {one.block.title}")
        widths = [max(map(len, column)) for column in zip(*one.rows, strict=True)] if one.rows else []
        for row in one.rows:
            cells = [text.ljust(width) for text, width in zip(row, widths, strict=True)]
            lines.append(("    " + "  ".join(cells)).rstrip())
    return "\n".join(lines) + "\n"


def _shown(block: Block, record: TrialRecord | None, pairs: Mapping[str, TrialRecord], store: Store) -> Shown:
    rows = table_rows(pairs) if block.id == _TABLE and pairs else _numbers(record)
    pictures = _pictures(record, store)
    measured = any(row[1] in COLUMNS.values() for row in rows) if block.id == _TABLE else len(rows) > 1
    filled = bool(pictures) or measured
    verdict = ("other data" if block.data else "reproduced") if filled else f"not: {_why_not(block, record)}"
    return Shown(block, verdict, filled, pictures, rows)


def _why_not(block: Block, record: TrialRecord | None) -> str:
    if block.why_not:
        return block.why_not
    return "it has not run yet" if record is None else record.note or "there is nothing to show"


def _numbers(record: TrialRecord | None) -> list[tuple[str, ...]]:
    if record is None or record.status != "done":
        return []
    rows = [(name, _told(value)) for name, value in record.metrics.items()]
    rows += [(f"{name}, s", _told(value)) for name, value in record.seconds.items() if name != "cpu"]
    rows += [(name, ", ".join(map(_told, values))) for name, values in record.curves.items()]
    return [("", "measured"), *rows] if rows else []


def _told(value: Any) -> str:
    return "-" if value is None else number(float(value))


def _pictures(record: TrialRecord | None, store: Store) -> list[tuple[str, str]]:
    found = []
    for caption, file in ({} if record is None else record.artifacts).items():
        path = store.artifacts(record.id) / str(file) if record is not None else Path()
        if path.is_file():
            found.append((caption, f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"))
    return found


def _notes(shown: list[Shown], pairs: Mapping[str, TrialRecord], smoke: bool) -> list[str]:
    counted = [one for one in shown if not one.block.extra]
    filled, total = sum(one.filled for one in counted), sum(one.filled for one in shown)
    notes = [
        f"{filled} of the {len(counted)} figures and tables of results, {total} of all {len(shown)}, are made again.",
        "The papers' data are not public: other data means data of the same kind, made up, with exact truth.",
        "A pair counts as registered when 90 % of its points end within 2.5 % of the diagonal of their true places; "
        "the paper judged by eye. Retries know from the truth that they are needed, as its authors did by eye.",
    ]
    done = {kind.name: sum(name.startswith(f"{kind.name} as printed ") for name in pairs) for kind in PAIR_SETS}
    told = ", ".join(f"{name} {done[name]} of {kind.pairs}" for name, kind in zip(done, PAIR_SETS, strict=True))
    notes.append(f"Pairs of table 1 that ran: {told}.")
    if smoke:
        notes.append("This is a small run, to see that all of it works; its numbers mean little.")
    return notes


def _render(shown: list[Shown], notes: list[str]) -> str:
    try:
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
    except ImportError as error:
        raise ExperimentError("jinja2 is not installed: pip install 'torchreg-articulated[experiments]'") from error
    loader = FileSystemLoader(_TEMPLATES)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("papers.html.j2").render(shown=shown, notes=notes, papers=PAPERS)
