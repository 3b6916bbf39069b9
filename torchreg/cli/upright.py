"""The option --up: what is upright in pictures, pages and glTF files, where neither format nor motion determine it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from torchreg.errors import InputError

if TYPE_CHECKING:
    from torchreg.geometry.upright import Direction

Found = TypeVar("Found")

UPS: dict[str, Direction] = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
UPS |= {f"-{name}": (-up[0], -up[1], -up[2]) for name, up in UPS.items()}

Up = Annotated[
    str | None,
    typer.Option(
        metavar="AXIS",
        help="What is upright: x, y, z, -x, -y or -z; by default -y before a camera, y of .obj, .glb and .gltf, "
        "else told from what stands and moves.",
    ),
]

Upright = Annotated[
    bool,
    typer.Option(
        "--upright",
        help="The shape stands upright, as in its own file: without --start only turns about the vertical (see --up) "
        "are searched.",
    ),
]


def check_up(up: str | None) -> Direction | None:
    """Return the direction of --up."""
    if up is not None and up not in UPS:
        raise InputError(f"--up must be one of {', '.join(sorted(UPS))}, got {up!r}")
    return None if up is None else UPS[up]


def known_up(up: str | None, files: Sequence[Path | str], *, camera: bool = False) -> Direction | None:
    """Return what --up says, else a camera's or the format of files or folders; None where points decide."""
    from torchreg.geometry.upright import Y_UP_ENDINGS

    if up is not None or camera:
        return check_up(up) or UPS["-y"]
    return UPS["y"] if any(_ending(Path(path)) in Y_UP_ENDINGS for path in files) else None


def _ending(path: Path) -> str:
    """Return the ending of a file, or of the first one in a folder, that says its format."""
    first = next(iter(sorted(path.iterdir())), path) if path.is_dir() else path
    packed = first.suffix.lower() == ".gz"
    return (first.with_suffix("") if packed else first).suffix.lower()


def remembering(found: Found, up: Direction | None) -> Found:
    """Return a result that keeps what is upright, where that is known."""
    if up is None:
        return found
    changed: Any = replace(found, up=up)  # type: ignore[type-var]
    return changed
