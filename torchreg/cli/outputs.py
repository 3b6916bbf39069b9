"""The files that a command writes: their endings and numbers, and a check against overwriting."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from torchreg.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

Given = TypeVar("Given", Path, Path | None)

fcntl: ModuleType | None
try:
    import fcntl
except ImportError:  # on Windows, where files that are written cannot be opened twice anyway
    fcntl = None

# Bytes without which no output is worth to be begun.
_LEAST_SPACE = 256 * 1024
# Endings of the files that lie beside a result, and of those that options name.
_BESIDE = (".safetensors", ".json", ".glb", ".progress")
_OTHER_KINDS = (
    ".swc", ".bvh", ".npz", ".npy", ".csv", ".ply", ".obj", ".stl", ".off", ".pcd", ".xyz", ".gltf", ".gif", ".mp4",
    ".png", ".pdf", ".svg", ".html", ".rrd", ".urdf",
)  # fmt: skip
PICTURE_ENDINGS = (".png", ".pdf", ".svg")

Force = Annotated[bool, typer.Option("--force", help="Overwrite outputs that exist.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]


def check_used(wanted: bool, flag: str, options: Mapping[str, Any]) -> None:
    """Raise InputError if options are given that have no meaning without a flag."""
    for name, value in options.items():
        if value is not None and not wanted:
            raise InputError(f"{name} has no meaning without {flag}; leave it out")


def written_to(metavar: str, words: str) -> Any:
    """Return the option that names what a command writes."""
    return typer.Option("--output", "-o", metavar=metavar, help=words)


def with_ending(path: Given, endings: Sequence[str], *, add: bool = False) -> Given:
    """Return the path of an output; InputError if its ending is not allowed; with ``add`` names of results get it."""
    if path is None or (ending := path.suffix.lower()) in endings:
        return path
    if add and ending in _BESIDE:
        return path.with_suffix(endings[0])
    if add and ending not in _OTHER_KINDS:
        return path.with_name(path.name + endings[0])
    raise InputError(f"{path} must end in {', '.join(endings)}; rename the output")


def numbered(path: Given, index: int, count: int) -> Given:
    """Return the path of output number ``index`` of ``count``: the same for a single one, else as in name_01.ply."""
    if path is None or count == 1:
        return path
    return path.with_name(f"{path.stem}_{index + 1:0{len(str(count))}}{path.suffix}")


def result_file(name: Path) -> Path:
    """Return the .safetensors file of a result that is named without ending, or by its .json file."""
    return name.with_suffix(".safetensors") if name.suffix.lower() in ("", ".json") else name


def counted(number: int, thing: str) -> str:
    """Return a number with its noun, in the plural unless it is one."""
    return f"{number} {thing}{'' if number == 1 else 's'}"


def shifted_to(origin: Tensor | None, pose: Tensor) -> Tensor:
    """Return a pose (num_dofs,) in coordinates that begin at an origin (3,), where there is one."""
    from torchreg.shapes.pose_algebra import shifted

    return pose if origin is None else shifted(pose.double(), -origin)


def tell_origin(path: Path, origin: Tensor | None) -> None:
    """Tell where the coordinates of a file in single precision begin, if not at zero."""
    if origin is not None:
        place = " ".join(f"{value:g}" if abs(value) < 1e5 else f"{value:.0f}" for value in origin.tolist())
        typer.echo(f"torchreg: {path} holds coordinates from {place} on: it has single precision only", err=True)


@contextmanager
def claimed(output: Path) -> Iterator[None]:
    """Let no other run write an output in a ``with`` block; InputError if one does."""
    if fcntl is None:
        yield
        return
    lock = output.with_name(f".{output.name}.lock")
    with lock.open("a+") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # The run before may just have removed the file.
            owned = lock.exists() and os.path.samestat(os.fstat(handle.fileno()), lock.stat())
        except BlockingIOError:
            owned = False
        if not owned:
            handle.seek(0)
            number = handle.read().strip() or "unknown"
            raise InputError(
                f"{output} is being written by another run, process {number}; wait for its end, or name another output "
                f"with -o"
            )
        handle.truncate(0)
        handle.write(str(os.getpid()))
        handle.flush()
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)


def _check_folder(folder: Path) -> None:
    """Raise an OSError, which names the folder, if no file can be written there."""
    if not folder.is_dir():
        raise FileNotFoundError(f"the folder {folder} does not exist; create it first")
    try:
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(bytes(_LEAST_SPACE))
            probe.flush()
    except OSError as error:
        raise OSError(error.errno, f"nothing can be written there ({error.strerror})", str(folder)) from error


def check_outputs(paths: Iterable[Path | None], force: bool) -> None:
    """Raise an error if an output cannot be written, or exists and may not be overwritten."""
    wanted, checked = [path for path in paths if path is not None], set[Path]()
    for path in wanted:
        if wanted.count(path) > 1:
            raise InputError(f"two outputs would be called {path}; rename one")
        if path.parent not in checked:
            _check_folder(path.parent)
            checked.add(path.parent)
        if path.exists() and not force:
            raise InputError(f"{path} exists; pass --force to overwrite it, or name another output with -o")
