"""The end of a command: one line per error or warning, and an exit code."""

from __future__ import annotations

import functools
import inspect
import sys
import warnings
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import fields, is_dataclass
from enum import IntEnum
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO, get_type_hints

import typer
from typer.models import OptionInfo

from torchreg.cli.hints import in_options
from torchreg.errors import OutputWarning, TorchregError, TorchregWarning

# The options of the command that runs, for hints.
_options: ContextVar[tuple[str, ...]] = ContextVar("options", default=())
# Whether it could not write something beside its result.
_incomplete: ContextVar[bool] = ContextVar("incomplete", default=False)


class ExitCode(IntEnum):
    """Exit codes of commands that do not end with 0."""

    UNUSABLE = 1
    ERROR = 2  # also of wrong usage
    INTERRUPTED = 130


def reporting(command: Callable[..., None]) -> Callable[..., None]:
    """Return the command with errors and warnings of the library printed in one line, and Ctrl-C as exit code 130.

    A parameter that is a dataclass of options stands for these options.
    """
    parameters, groups = _expanded(command)

    @functools.wraps(command)
    def run(**options: Any) -> None:
        _options.set(options_of(run))
        _incomplete.set(False)
        given = {
            name: kind(**{item.name: options.pop(item.name) for item in fields(kind)}) for name, kind in groups.items()
        }
        with warnings.catch_warnings():
            warnings.simplefilter("always", TorchregWarning)
            warnings.showwarning = show_warning
            try:
                command(**options, **given)
            except KeyboardInterrupt:
                raise interruption() from None
            except BrokenPipeError:
                raise
            except (TorchregError, OSError) as error:
                typer.echo(f"torchreg: {in_options(_one_line(error), _options.get())}", err=True)
                raise typer.Exit(ExitCode.ERROR) from None
            if _incomplete.get():
                raise typer.Exit(ExitCode.UNUSABLE)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {item.name: item.annotation for item in parameters}
    return run


def _expanded(command: Callable[..., None]) -> tuple[list[inspect.Parameter], dict[str, Any]]:
    """Return the parameters of a command, each group replaced by its options, and the groups by name."""
    groups, parameters = dict[str, Any](), list[inspect.Parameter]()
    for given in inspect.signature(command, eval_str=True).parameters.values():
        if is_dataclass(kind := given.annotation):
            groups[given.name], hints = kind, get_type_hints(kind, include_extras=True)
            parameters += [
                inspect.Parameter(item.name, given.KEYWORD_ONLY, default=item.default, annotation=hints[item.name])
                for item in fields(kind)
            ]
        else:
            parameters.append(given.replace(kind=given.KEYWORD_ONLY))
    return parameters, groups


class OptionalOutput:
    """A ``with`` block that draws or writes: where it fails, a warning and exit code 1; no result is lost."""

    def __init__(self, output: Path | str) -> None:
        self.output, self.failed = output, False

    def __enter__(self) -> None:
        pass

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        if not isinstance(error, Exception) or isinstance(error, (typer.Exit, BrokenPipeError)):
            return False
        self.failed = True
        _incomplete.set(True)
        cause = _one_line(error) if isinstance(error, (TorchregError, OSError)) else f"{type(error).__name__}: {error}"
        warnings.warn(f"{self.output} is not written: {cause}; the result does not suffer", OutputWarning, stacklevel=2)
        return True


def interruption(done: str = "") -> typer.Exit:
    """Print that a command was interrupted, and its progress, as in "2 of 4 clouds are done"; return its exit."""
    typer.echo(f"torchreg: interrupted{'; ' if done else ''}{done}", err=True)
    return typer.Exit(ExitCode.INTERRUPTED)


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


def show_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, file: TextIO | None = None,
    line: str | None = None,
) -> None:  # fmt: skip
    """Print a warning in one line, with file and line if it is not one of the library's."""
    origin = "" if issubclass(category, TorchregWarning) else f"{filename}:{lineno}: "
    text = in_options(str(message), _options.get())
    from tqdm import tqdm

    with tqdm.external_write_mode(sys.stderr):  # on a line of its own, not behind a progress bar
        typer.echo(f"torchreg: warning: {origin}{text}", err=True)


def options_of(command: Callable[..., None]) -> tuple[str, ...]:
    """Return the options of a command, as in ``--nan-policy``."""
    found = list[str]()
    for name, parameter in inspect.signature(command).parameters.items():
        declared = [item for item in getattr(parameter.annotation, "__metadata__", ()) if isinstance(item, OptionInfo)]
        for item in declared:
            long = [word for word in item.param_decls or () if word.startswith("--")]
            found += long or ["--" + name.replace("_", "-")]
    return tuple(found)
