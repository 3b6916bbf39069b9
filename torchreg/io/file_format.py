"""A row of the table of file formats, and how content decides on a format where the ending does not."""

from __future__ import annotations

import gzip
import io
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchreg.errors import FileWarning, FormatError, ModelError
from torchreg.io.limits import FileLimits, check_expansion

# First bytes of files that hold nothing themselves, and what to do about them.
_STAND_INS = {
    b"version https://git-lfs.github.com": "is a Git LFS pointer, not the file itself: fetch it with `git lfs pull`",
    b"<!doctype html": "is a web page, not the file itself: download the file's content (on GitHub, the raw file)",
    b"<html": "is a web page, not the file itself: download the file's content (on GitHub, the raw file)",
}
_GZIP, _UTF8_MARK = b"\x1f\x8b", b"\xef\xbb\xbf"
_UTF16_MARKS = (b"\xff\xfe", b"\xfe\xff")
# Deflate packs at most some thousandfold.
_CHUNK = 1 << 20


@dataclass(frozen=True)
class _Foreign:
    """Formats that are not read."""

    name: str  # as people call them
    endings: tuple[str, ...]  # lower case, with the dot
    starts: tuple[bytes, ...]  # first bytes of their content, where they are characteristic
    way: str  # what to do about such a file


# A new format is one more row.
_FOREIGN = (
    _Foreign(
        "E57", (".e57",), (b"ASTM-E57",),
        "CloudCompare opens it and saves it as PLY; in Python pye57 reads it, and save_points writes its arrays",
    ),
    _Foreign(
        "LAS or LAZ", (".las", ".laz"), (b"LASF",),
        "CloudCompare opens it and saves it as PLY; in Python laspy reads it, and save_points writes its arrays",
    ),
    _Foreign(
        "a scanner's own format",
        (".rcs", ".rcp", ".fls", ".lsproj", ".zfs", ".rxp", ".rdb", ".rdbx", ".ptg", ".ptz", ".3dd", ".cl3"), (),
        "export it as PTX or PLY from the scanner's program; CloudCompare reads some of these and saves them as PLY",
    ),
    _Foreign(
        "a ROS recording", (".bag", ".mcap", ".db3"), (b"#ROSBAG", b"\x89MCAP"),
        "export its clouds as PCD files, one per message, as pcl_ros does",
    ),
    _Foreign(
        "a scene of another program",
        (".fbx", ".blend", ".usd", ".usda", ".usdc", ".usdz", ".abc", ".3ds", ".dae", ".ma", ".mb", ".max", ".c4d"),
        (b"Kaydara FBX", b"BLENDER", b"PXR-USDC", b"#usda"),
        "export it as glTF (.glb), from Blender for example",
    ),
    _Foreign(
        "a CAD model", (".step", ".stp", ".iges", ".igs", ".sldprt", ".3dm", ".dwg", ".dxf"), (b"ISO-10303-21",),
        "export it as STL or OBJ from the CAD program, or from FreeCAD",
    ),
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class FileFormat:
    """One format of files: a row of the table that loaders look in, `torchreg formats` prints and the docs show."""

    name: str  # as people call it
    kind: str  # what it holds: one of `KINDS` in `torchreg.io.formats`
    endings: tuple[str, ...]  # lower case, with the dot; the first is the usual one
    read: Callable[..., Any]  # from the content, the path (for files beside it) and the limits
    holds: str  # what is read of it, in a few words
    loader: str  # name of the public function that reads it
    # whether content is of this format for sure; None where content does not decide
    sniff: Callable[[bytes], bool] | None = None
    write: Callable[[Any], bytes] | None = None  # a record to bytes; None for formats that are read only
    written: tuple[str, ...] = ()  # names of the parts that ``write`` keeps with the points


def begins(*starts: bytes) -> Callable[[bytes], bool]:
    """Return the test of content that begins with one of some bytes."""
    return lambda content: content.startswith(starts)


def ending_of(path: Path) -> str:
    """Return the ending of a file in lower case, that of the packed file where it is packed by gzip."""
    return Path(path.stem).suffix.lower() if path.suffix.lower() == ".gz" else path.suffix.lower()


def choose(formats: Sequence[FileFormat], content: bytes, path: Path) -> FileFormat:
    """Return the format of a file: that of its content for sure, else of its ending; FormatError without any."""
    check_stand_in(content)
    ending = ending_of(path)
    named = [row for row in formats if ending in row.endings]
    # The ending's own test comes first: contents of one format may look like another.
    for row in (*named, *formats):
        if row.sniff is not None and row.sniff(content):
            return row
    refuse_foreign(path, content)
    if named:
        return named[0]
    known = ", ".join(ending for row in formats for ending in row.endings)
    raise FormatError(f"has the unknown ending {path.suffix!r}, and its content tells no format; known: {known}")


def refuse_foreign(path: Path, content: bytes = b"") -> None:
    """Raise FormatError, with the way to convert it, if a file's ending or content is of a known format not read."""
    for row in _FOREIGN:
        if ending_of(path) in row.endings or (row.starts and content.startswith(row.starts)):
            raise FormatError(f"is of a format that is not read ({row.name}): {row.way}")


def check_stand_in(content: bytes) -> None:
    """Raise FormatError if content is a pointer or a web page in the place of a file."""
    start = content[:256].removeprefix(_UTF8_MARK).lstrip().lower()
    for mark, words in _STAND_INS.items():
        if start.startswith(mark):
            raise FormatError(words)


def unpacked(content: bytes, limits: FileLimits) -> bytes:
    """Return content, expanded within the limits where it is packed by gzip."""
    if not content.startswith(_GZIP):
        return content
    pieces, size = list[bytes](), 0
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(content)) as stream:
            while piece := stream.read(_CHUNK):
                size += len(piece)
                check_expansion(len(content), size, "the gzip file", limits)
                pieces.append(piece)
    except (OSError, EOFError, zlib.error) as error:
        raise FormatError(f"cannot be unpacked by gzip: it is cut off or damaged ({error})") from error
    return b"".join(pieces)


def plain_text(content: bytes) -> bytes:
    """Return text in UTF-8 without a byte order mark; also text that Windows wrote in UTF-16, by its mark."""
    if content.startswith(_UTF16_MARKS):
        try:
            return content.decode("utf-16").encode("utf-8")
        except UnicodeError as error:
            raise FormatError(f"begins as UTF-16 text but is none ({error}); save it as UTF-8") from error
    return content.removeprefix(_UTF8_MARK)


def warn(message: str) -> None:
    """Say what was left out or put right; `naming` adds the file."""
    warnings.warn(message, FileWarning, stacklevel=2)


@contextmanager
def naming(file: object) -> Iterator[None]:
    """Put the name of a file in front of the errors and the warnings about it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", FileWarning)
        try:
            yield
        except (FormatError, ModelError) as error:
            text = str(error)
            raise type(error)(text if text.startswith(str(file)) else f"{file}: {text}") from error
    for row in caught:
        text = str(row.message)
        is_ours = issubclass(row.category, FileWarning) and not text.startswith(str(file))
        warnings.warn(f"{file}: {text}" if is_ours else row.message, row.category, stacklevel=4)
