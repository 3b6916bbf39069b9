"""The files that a command writes: their endings and numbers, and a check against overwriting."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, overload

import typer

from torchreg.errors import InputError

PICTURE_ENDINGS = (".png", ".pdf", ".svg")

Force = Annotated[bool, typer.Option("--force", help="Overwrite outputs that exist.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]


@overload
def with_ending(path: Path, endings: Sequence[str], *, add: bool = ...) -> Path: ...
@overload
def with_ending(path: None, endings: Sequence[str], *, add: bool = ...) -> None: ...
@overload
def with_ending(path: Path | None, endings: Sequence[str], *, add: bool = ...) -> Path | None: ...
def with_ending(path: Path | None, endings: Sequence[str], *, add: bool = False) -> Path | None:
    """Return the path, with the first ending added if ``add``; InputError if its ending is not allowed."""
    if path is None or path.suffix.lower() in endings:
        return path
    if add:
        return path.with_name(path.name + endings[0])
    raise InputError(f"{path} must end in {', '.join(endings)}; rename the output")


@overload
def numbered(path: Path, index: int, count: int) -> Path: ...
@overload
def numbered(path: None, index: int, count: int) -> None: ...
@overload
def numbered(path: Path | None, index: int, count: int) -> Path | None: ...
def numbered(path: Path | None, index: int, count: int) -> Path | None:
    """Return the path of output number ``index`` of ``count``: the same for a single one, else as in name_01.ply."""
    if path is None or count == 1:
        return path
    return path.with_name(f"{path.stem}_{index + 1:0{len(str(count))}}{path.suffix}")


def check_outputs(paths: Iterable[Path | None], force: bool) -> None:
    """Raise an error if an output cannot be written, or exists and may not be overwritten."""
    wanted = [path for path in paths if path is not None]
    for path in wanted:
        if wanted.count(path) > 1:
            raise InputError(f"two outputs would be called {path}; rename one")
        if not path.parent.is_dir():
            raise FileNotFoundError(f"the folder {path.parent} does not exist; create it first")
        if path.exists() and not force:
            raise InputError(f"{path} exists; pass --force to overwrite it, or name another output with -o")
