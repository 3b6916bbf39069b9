"""The order of files by the numbers in their names."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Any

# A number in a name: with decimal points or an exponent, as str() and printf write 5e-05 and 1.5E+3, and a sign that is
# no hyphen between words. An exponent without a sign takes a decimal point before it: s1e02 is an episode.
_NUMBER = re.compile(
    r"((?:(?<![^\W_])-)?"
    r"(?:(?:\d+(?:\.\d+)?[eE][+-]|\d+\.\d+[eE])\d{1,3}(?![^\W_]|\.\d)|\d+(?:\.\d+)*))"
)  # fmt: skip


def natural_sorted(paths: Iterable[Path]) -> list[Path]:
    """Return paths in the order of the numbers in their names: frame2 before frame10, 5e-05 before 0.1.

    Where two names would be one number, as 1.1 and 1.10, the point separates two counters.
    """
    files = list(paths)
    values = [tuple((kind, value) for kind, value, _ in natural_key(file)) for file in files]
    return sorted(files, key=natural_key if len(set(values)) == len(files) else partial(natural_key, decimals=False))


def natural_key(path: str | os.PathLike[str], *, decimals: bool = True) -> list[tuple[int, Any, str]]:
    """Return a key that sorts paths with the numbers in them as numbers: frame2 before frame10, 1.25 before 1.5."""
    key = list[tuple[int, Any, str]]()
    for number, piece in enumerate(_NUMBER.split(os.fspath(path))):
        # Digits of other scripts and leading zeros are distinguished by the text itself.
        if number % 2 == 0:
            key.append((1, piece, piece))
        elif "e" in piece.lower() or (decimals and piece.count(".") == 1):
            key.append((0, Decimal(piece), piece))
        else:
            key += [(0, Decimal(part), part) for part in piece.split(".")]
    return key


def last_number(path: Path) -> Decimal | None:
    """Return the last number in the name of a file, None if there is none."""
    return next((value for kind, value, _ in reversed(natural_key(path.stem)) if kind == 0), None)
