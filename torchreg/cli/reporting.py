"""How a command ends: one line per error or warning, and an exit code."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any, TextIO

import typer

from torchreg.errors import TorchregError, TorchregWarning

# Exit codes beside 0; 2 is also what wrong usage ends with.
UNUSABLE, ERROR, INTERRUPTED = 1, 2, 130


def reporting(command: Callable[..., None]) -> Callable[..., None]:
    """Return the command with errors and warnings of the library told in one line, and Ctrl-C as exit code 130."""

    @functools.wraps(command)
    def run(*arguments: Any, **options: Any) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("always", TorchregWarning)
            warnings.showwarning = show_warning
            try:
                command(*arguments, **options)
            except KeyboardInterrupt:
                raise interruption() from None
            except BrokenPipeError:
                raise
            except (TorchregError, OSError) as error:
                typer.echo(f"torchreg: {_one_line(error)}", err=True)
                raise typer.Exit(ERROR) from None

    return run


def interruption(done: str = "") -> typer.Exit:
    """Return the exit of an interrupted command, which has said what is done, as in "2 of 4 clouds are done"."""
    typer.echo(f"torchreg: interrupted{'; ' if done else ''}{done}", err=True)
    return typer.Exit(INTERRUPTED)


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


def show_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, file: TextIO | None = None,
    line: str | None = None,
) -> None:  # fmt: skip
    """Print a warning in one line; those that the library does not raise itself say where they come from."""
    place = "" if issubclass(category, TorchregWarning) else f"{filename}:{lineno}: "
    typer.echo(f"torchreg: warning: {place}{' '.join(str(message).split())}", err=True)
