"""Refusals as one table a door: a row is what is given and the words of the error that it raises."""

import re
from collections.abc import Callable
from typing import Any

import pytest

from torchreg.errors import FormatError


def refusing(call: Callable[..., Any], error: Any = FormatError, *, file: str = "", leaves: int | None = None) -> Any:
    """Return the function that makes a test of rows: ``call(folder, *given)`` raises an error with given words.

    A row is (*given, words), or (*given, error, words) with an error of its own. ``file`` is a name that the message
    begins with, ``leaves`` how many files the folder holds afterwards.
    """

    def table(*rows: tuple[Any, ...]) -> Callable[..., None]:
        @pytest.mark.parametrize("row", rows)
        def test(tmp_path: Any, row: tuple[Any, ...]) -> None:
            *given, words = row
            expected = given.pop() if given and isinstance(given[-1], type) else error
            with pytest.raises(expected, match=f"(?s){re.escape(file)}.*({words or ''})"):
                call(tmp_path, *given)
            assert leaves is None or len(list(tmp_path.iterdir())) == leaves

        return test

    return table


def swap(whole: str, old: str, new: str) -> str:
    """Return a text with a first piece replaced, which must be there."""
    assert old in whole
    return whole.replace(old, new, 1)
