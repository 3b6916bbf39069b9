"""Poses as tables of text (.csv): a line of names, then one pose a line."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Sequence

from torchreg.errors import FormatError
from torchreg.io.atomic import write_atomic
from torchreg.io.clouds.columns import have_decimal_commas
from torchreg.io.file_format import plain_text
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, local_path, read_bytes


def save_pose_table(
    path: str | os.PathLike[str], names: Sequence[str], rows: Sequence[Sequence[float | int | str]]
) -> None:
    """Write rows of numbers and words below a line of names, all digits kept; an existing file is replaced."""
    file = local_path(path)
    if file.suffix.lower() != ".csv":
        raise FormatError(f"{file} must end in .csv")
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([[repr(value) if isinstance(value, float) else value for value in row] for row in rows])
    write_atomic(file, text.getvalue().encode("utf-8"))


def load_pose_table(
    path: str | os.PathLike[str], names: Sequence[str], *, limits: FileLimits = DEFAULT_LIMITS
) -> list[dict[str, float]]:
    """Return the numbers by name of every row of a table; columns of other names are left alone."""
    file = local_path(path)
    try:
        lines = plain_text(read_bytes(file, limits)).decode("utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise FormatError(f"{file}: is no text ({error})") from error
    separator = max(";,\t", key=lines[0].count) if lines else ","
    try:
        table = [row for row in csv.reader(lines, delimiter=separator) if row]
    except csv.Error as error:
        raise FormatError(f"{file}: is no table ({error})") from error
    head = [name.strip() for name in table[0]] if table else []
    known = [(column, name) for column, name in enumerate(head) if name in names]
    if not known or len(table) < 2:
        got = f"; got the names {', '.join(head[:4])}" if head and not known else ""
        raise FormatError(
            f"{file}: must hold a line of names, such as {', '.join(names[:4])}, and a line of numbers{got}"
        )
    rows = [[entry.strip() for entry in row] for row in table[1:]]
    for number, row in enumerate(rows, start=2):
        if any(row[len(head) :]):
            raise FormatError(
                f"{file}: row {number} holds {len(row)} entries, the line of names {len(head)}; between columns of "
                f"numbers with decimal commas write semicolons"
            )
    if have_decimal_commas(row[k].encode() for row in rows for k, _ in known if k < len(row) and row[k]):
        rows = [[entry.replace(",", ".") for entry in row] for row in rows]
    return [
        {name: _number(row, column, f"{file}: row {number}, {name}") for column, name in known}
        for number, row in enumerate(rows, start=2)
    ]


def _number(row: Sequence[str], column: int, where: str) -> float:
    """Return an entry of a row, NaN where it is empty."""
    text = row[column] if column < len(row) else ""
    try:
        value = float(text or "nan")
    except ValueError as error:
        raise FormatError(f"{where} must be a number, got {text[:40]!r}") from error
    if math.isinf(value):
        raise FormatError(f"{where} must be finite, got {text!r}")
    return value
