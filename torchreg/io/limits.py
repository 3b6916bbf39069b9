"""Limits of files, checked before they are opened: local regular files only, bounded in bytes, counts, expansion."""

from __future__ import annotations

import io
import os
import re
import stat
import struct
import zipfile
import zlib
from dataclasses import dataclass, fields
from pathlib import Path

from torchreg.errors import FormatError, InputError, InputTypeError

# pathlib folds "//" into "/", so one slash after a scheme of two letters or more is enough (C:/ is a drive).
_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.\-]+:/")

ZIP_ERRORS = (
    zipfile.BadZipFile, zlib.error, struct.error, NotImplementedError, EOFError, RuntimeError, ValueError,
    OverflowError, OSError,
)  # fmt: skip


@dataclass(frozen=True)
class FileLimits:
    """Upper bounds that every loader checks before it allocates memory.

    Args:
        max_bytes: size of one file in bytes.
        max_points: points or vertices of one cloud or mesh.
        max_faces: triangles (or polygons) of one mesh.
        max_zip_ratio: expanded over packed bytes of a compressed file; beyond 32 MB, a twentieth of it.
        max_expanded_bytes: sum of the expanded sizes in one archive.
    """

    max_bytes: int = 2 * 1024**3
    max_points: int = 20_000_000
    max_faces: int = 40_000_000
    max_zip_ratio: float = 200.0
    max_expanded_bytes: int = 4 * 1024**3

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
                raise InputError(f"{field.name} must be a positive number, got {value!r}")


DEFAULT_LIMITS = FileLimits()


@dataclass(frozen=True)
class FileBudget:
    """What a file may ask for beyond `FileLimits`, such that none below 10 MB takes 500 MB or 3 s."""

    # Frames of one archive: an hour at 25 per second.
    frames: int = 100_000
    # Members of one archive, whose headers are read one by one.
    members: int = 20_000
    # Cameras of one file, at 0.5 ms each.
    cameras: int = 2_000
    # Laser scans of one file, at 0.2 ms each.
    scans: int = 2_000
    # Nodes of one glTF document; at 10 us each.
    nodes: int = 100_000
    # Joints of one skin.
    joints: int = 1000
    # Skin weights, vertices times joints, per byte of the file, and in small files.
    weights_per_byte: int = 2
    weights: int = 20_000_000
    # Elements of one XML document, each seen by Python.
    elements: int = 200_000
    # Bytes of one XML document.
    xml_bytes: int = 64 * 1024**2
    # Links of one robot.
    links: int = 2000
    # Bytes that a file of any size may expand to.
    expanded_bytes: int = 32 * 1024**2
    # Beyond, the share of the allowed ratio: what is large is measured, and hardly gets smaller.
    expansion_share: float = 0.05
    # Times that the bytes of a document may be used: accessors may overlap, and be used over and over.
    uses: int = 4
    # Digits of one number: more take time that grows with their square.
    digits: int = 400


FILE_BUDGET = FileBudget()


def local_path(path: str | os.PathLike[str]) -> Path:
    """Return ``path`` as a local path; FormatError if it is an address."""
    if not isinstance(path, (str, os.PathLike)) or isinstance(os.fspath(path), bytes):
        raise InputTypeError(f"path must be a str or a pathlib.Path, got {type(path).__name__}")
    text = os.fspath(path)
    if _ADDRESS.match(text) or text.startswith("\\\\"):
        raise FormatError(f"{text!r} is an address, not a local file: download it first and pass the file's path")
    if not text or "\0" in text:
        raise FormatError(f"{text!r} is not the name of a file")
    return Path(text)


def read_bytes(path: str | os.PathLike[str], limits: FileLimits = DEFAULT_LIMITS) -> bytes:
    """Return the content of a local regular file, once its size is checked."""
    file = local_path(path)
    mode = file.stat().st_mode  # before open(), which waits forever on a pipe
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(f"{file} is a folder; pass one file of it")
    if not stat.S_ISREG(mode):
        raise FormatError(f"{file} is not a regular file (a device, pipe or socket); copy its content into a file")
    with file.open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        check_size(size, file, limits)
        return stream.read(size)  # a size, because the file may be growing


def check_size(size: int, path: Path, limits: FileLimits) -> None:
    """Raise FormatError if ``size`` bytes exceed ``limits.max_bytes``."""
    if size > limits.max_bytes:
        raise FormatError(
            f"{path} holds {size} bytes, the limit is {limits.max_bytes}; if you trust it pass "
            f"FileLimits(max_bytes=...)"
        )


def check_budget(count: int, allowed: int, what: str) -> None:
    """Raise FormatError if a file holds more things of a kind than are read, such as "cameras"."""
    if count > allowed:
        raise FormatError(f"holds {count} {what}, at most {allowed} are read; split it into several files")


def check_allowed(count: int, what: str, limits: FileLimits) -> None:
    """Raise FormatError if a file claims more items than allowed; ``what`` is "faces", or names points."""
    name = "max_faces" if what == "faces" else "max_points"
    if not 0 <= count <= getattr(limits, name):
        raise FormatError(
            f"claims {count} {what}, allowed are 0 to {getattr(limits, name)}; if you trust it pass "
            f"FileLimits({name}=...)"
        )


def check_expansion(packed: int, expanded: int, what: str, limits: FileLimits) -> None:
    """Raise FormatError if ``packed`` bytes claim to expand beyond the allowed ratio or size."""
    packed = max(packed, 1)
    bound = FILE_BUDGET.expanded_bytes + FILE_BUDGET.expansion_share * limits.max_zip_ratio * packed
    if expanded > min(limits.max_expanded_bytes, limits.max_zip_ratio * packed, bound):
        raise FormatError(
            f"{what} would expand {packed} bytes to {expanded}; allowed are {limits.max_expanded_bytes} bytes and "
            f"{limits.max_zip_ratio:g}-fold, and of this file {bound:.0f}; if you trust it pass "
            f"FileLimits(max_zip_ratio=..., max_expanded_bytes=...)"
        )


def open_zip(content: bytes, limits: FileLimits = DEFAULT_LIMITS) -> zipfile.ZipFile:
    """Return the zip archive in ``content``; the claimed sizes of all members are checked before any is expanded."""
    try:
        archive = zipfile.ZipFile(io.BytesIO(content))
    except ZIP_ERRORS as error:
        raise FormatError(f"is not a readable zip archive ({error})") from error
    members = archive.infolist()
    if len(members) > FILE_BUDGET.members:
        raise FormatError(f"is a zip archive of {len(members)} members; at most {FILE_BUDGET.members} are read")
    names = [member.filename for member in members]
    if len(set(names)) != len(names):
        raise FormatError("is a zip archive with several members of one name")
    for member in members:
        if member.flag_bits & 1:
            raise FormatError(f"member {member.filename!r} is encrypted; save the archive without a password")
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise FormatError(f"member {member.filename!r} is packed by method {member.compress_type}; use deflate")
    packed, expanded = (sum(getattr(m, size) for m in members) for size in ("compress_size", "file_size"))
    check_expansion(packed, expanded, f"the archive of {len(members)} members", limits)
    return archive
