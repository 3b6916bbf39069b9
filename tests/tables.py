"""Tables of tests, a row a line: what is given and what comes of it, or the words of the error that it raises."""

import inspect
import re
from collections.abc import Callable
from typing import Any

import pytest

import torchreg as tr


def each_row(*table: Any) -> Callable[..., Any]:
    """Run a test once for every row (tuple), whose entries are the test's last arguments."""

    def decorate(test: Callable[..., Any]) -> Any:
        names = list(inspect.signature(test).parameters)
        return pytest.mark.parametrize(names[len(names) - len(table[0]) :], table)(test)

    return decorate


def each(*table: Any) -> Callable[..., Any]:
    """Run a test once for every value of its last argument."""
    return lambda test: pytest.mark.parametrize(list(inspect.signature(test).parameters)[-1], table)(test)


def refusing(
    call: Callable[..., Any], error: Any = tr.errors.FormatError, *, file: str = "", leaves: int | None = None
) -> Any:
    """Return the function that makes a test of rows: ``call(folder, *given)`` raises an error with given words.

    A row is (*given, words), or (*given, error, words) with an error of its own. ``file`` is a name that the message
    begins with, ``leaves`` how many files the folder holds afterwards.
    """

    def table(*table: tuple[Any, ...]) -> Callable[..., None]:
        @each(*table)
        def test(tmp_path: Any, row: tuple[Any, ...]) -> None:
            *given, words = row
            expected = given.pop() if given and isinstance(given[-1], type) else error
            with pytest.raises(expected, match=f"(?s){re.escape(file)}.*({words or ''})"):
                call(tmp_path, *given)
            assert leaves is None or len(list(tmp_path.iterdir())) == leaves

        return test

    return table


def refused(*rows: tuple[Callable[[], Any], str | None], error: Any = tr.errors.FormatError) -> None:
    """Make each (call, words) of a table raise."""
    for call, words in rows:
        with pytest.raises(error, match=words):
            call()


def swap(whole: str, old: str, new: str) -> str:
    """Return a text with a first piece replaced, which must be there."""
    assert old in whole
    return whole.replace(old, new, 1)
