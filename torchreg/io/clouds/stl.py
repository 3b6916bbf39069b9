"""STL, binary and ASCII."""

from __future__ import annotations

import numpy as np

from torchreg.errors import FormatError
from torchreg.io.clouds.raw_cloud import Array, RawCloud, parse_table
from torchreg.io.limits import FileLimits, check_allowed

# Bytes of the title and of the count of facets.
_HEADER = 84
_FACET = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(content: bytes, limits: FileLimits) -> RawCloud:
    """Return the surface of an STL file; corners at exactly one position become one vertex, by first occurrence."""
    claimed = _num_claimed(content)
    if is_binary_stl(content):
        check_allowed(claimed, "faces", limits)
        corners = np.frombuffer(content, _FACET, claimed, _HEADER)["corners"].reshape(-1, 3)
    elif content.lstrip()[:5].lower() == b"solid" and b"facet" in content[:4096].lower():
        corners = _read_ascii(content, limits)
    else:
        raise FormatError(
            f"must hold {_HEADER} + {_FACET.itemsize} x {claimed} bytes according to its count of facets, got "
            f"{len(content)}: it is cut off, damaged or not STL"
        )
    return _merge(corners)


def is_binary_stl(content: bytes) -> bool:
    """Return whether a file is as long as a binary STL file with its count of facets."""
    return len(content) >= _HEADER and len(content) == _HEADER + _num_claimed(content) * _FACET.itemsize


def _num_claimed(content: bytes) -> int:
    return int.from_bytes(content[_HEADER - 4 : _HEADER], "little")


def _read_ascii(content: bytes, limits: FileLimits) -> Array:
    rows, opened, closed, complete, ended = list[bytes](), 0, 0, True, False
    for line in content.splitlines():
        words = line.split(None, 1)
        key = words[0].lower() if words else b""
        if key == b"vertex":
            rows.append(words[1] if len(words) > 1 else b"")
        opened += key == b"facet"
        if key == b"endfacet":
            closed += 1
            complete = complete and len(rows) == 3 * closed
        ended = key == b"endsolid" if key else ended
    check_allowed(opened, "faces", limits)
    if not (ended and complete) or opened != closed or len(rows) != 3 * opened:
        raise FormatError(
            f"holds {opened} facets, {closed} of them closed, with {len(rows)} corners and "
            f"{'an' if ended else 'no'} 'endsolid' at its end: it is cut off or damaged"
        )
    return parse_table(rows, 3, "corner")


def _merge(corners: Array) -> RawCloud:
    """Return the mesh of corners (3 F, 3), equal ones as one vertex."""
    corners = corners + 0.0  # turns -0.0 into 0.0, so that bytes are equal where numbers are
    _, first, which = np.unique(_as_keys(corners), return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return RawCloud(corners[first[order]], faces=rank[which.reshape(-1)].reshape(-1, 3))


def _as_keys(rows: Array) -> Array:
    rows = np.ascontiguousarray(rows)
    return rows.view(np.dtype((np.void, rows.dtype.itemsize * 3))).reshape(-1)
