"""PCD (point cloud library): ASCII, binary and LZF-compressed binary."""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass

import numpy as np

from torchreg.errors import FormatError
from torchreg.io.clouds.columns import stack_named
from torchreg.io.clouds.raw_cloud import Array, RawCloud, as_integers, parse_table
from torchreg.io.limits import FileLimits, check_allowed, check_expansion

_DATA_LINE = re.compile(rb"^DATA[ \t]+(\w+)[ \t]*\r?(\n|$)", re.MULTILINE)
_KINDS = {"I": "i", "U": "u", "F": "f"}
# Largest ratio of expanded to packed bytes in LZF: three bytes for 264.
_LZF_RATIO = 264 / 3


@dataclass(frozen=True)
class _Field:
    name: str
    dtype: np.dtype
    count: int


def read_pcd(content: bytes, limits: FileLimits) -> RawCloud:
    """Return the points of a PCD file, in the order of the file (organized clouds row by row)."""
    match = _DATA_LINE.search(content[: 1 << 16])  # headers are shorter
    if match is None:
        raise FormatError("must have a header closed by a line 'DATA ascii', 'DATA binary' or 'DATA binary_compressed'")
    fields, count = _parse_header(content[: match.start()].decode("latin-1"), limits)
    body, data = content[match.end() :], match.group(1)
    if data == b"ascii":
        columns = _read_ascii(body, fields, count)
    elif data == b"binary":
        columns = _read_rows(body, fields, count)
    elif data == b"binary_compressed":
        columns = _read_compressed(body, fields, count, limits)
    else:
        raise FormatError(f"DATA {data.decode('latin-1')!r} is unknown; known: ascii, binary, binary_compressed")
    points = stack_named(columns, "points")
    if points is None:
        raise FormatError(f"must have the fields x, y and z, got {', '.join(f.name for f in fields)}")
    return RawCloud(points, stack_named(columns, "normals"), _colors(columns))


def _parse_header(text: str, limits: FileLimits) -> tuple[list[_Field], int]:
    entries: dict[str, list[str]] = {}
    for line in text.split("\n"):
        words = line.split("#")[0].split()
        if words and words[0] in entries:
            raise FormatError(f"the header says {words[0]} twice")
        if words:
            entries[words[0]] = words[1:]
    names = entries.get("FIELDS", [])
    if not names or len(set(names) - {"_"}) + names.count("_") != len(names):
        raise FormatError("the header's FIELDS are missing or not unique")
    sizes, kinds = entries.get("SIZE", []), entries.get("TYPE", [])
    counts = entries.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise FormatError("the header's FIELDS, SIZE, TYPE and COUNT must be equally long")
    fields = [_field(*words) for words in zip(names, sizes, kinds, counts, strict=True)]
    points = _number(entries, "POINTS", entries.get("WIDTH", []))
    if "WIDTH" in entries and _number(entries, "WIDTH", []) * _number(entries, "HEIGHT", ["1"]) != points:
        raise FormatError("the header's POINTS is not WIDTH x HEIGHT")
    check_allowed(points, "points", limits)
    if points == 0:
        raise FormatError("holds no points")
    return fields, points


def _number(entries: dict[str, list[str]], name: str, otherwise: list[str]) -> int:
    words = entries.get(name, otherwise)
    if len(words) != 1 or not words[0].isdecimal() or len(words[0]) > 18:
        raise FormatError(f"the header's {name} must be a number, got {' '.join(words)[:40]!r}")
    return int(words[0])


def _field(name: str, size: str, kind: str, count: str) -> _Field:
    if kind not in _KINDS or size not in ("1", "2", "4", "8") or (kind == "F" and size == "1"):
        raise FormatError(f"the header's field {name!r} has an unknown TYPE {kind!r} of SIZE {size!r}")
    if not count.isdecimal() or not 1 <= len(count) <= 6 or int(count) == 0:
        raise FormatError(f"the header's field {name!r} has the COUNT {count!r}; 1 or more is needed")
    return _Field(name, np.dtype(f"<{_KINDS[kind]}{size}"), int(count))


def _check_length(got: int, expected: int, what: str) -> None:
    if got != expected:
        raise FormatError(f"the header's counts need {expected} {what}, the file holds {got}: it is cut off or damaged")


def _read_ascii(body: bytes, fields: list[_Field], count: int) -> dict[str, Array]:
    lines = [line for line in body.splitlines() if line.strip()]
    _check_length(len(lines), count, "points")
    table = parse_table(lines, sum(field.count for field in fields), "point")
    columns, column = dict[str, Array](), 0
    for field in fields:
        values = table[:, column]
        # PCL writes packed colors as the float that has their bits, or as an integer.
        integer = field.dtype.kind != "f" and field.count == 1
        columns[field.name] = as_integers(values, field.dtype.str, field.name) if integer else values
        if field.name in ("rgb", "rgba") and not integer:
            columns[field.name] = values.astype("<f4")
        column += field.count
    return columns


def _read_rows(body: bytes, fields: list[_Field], count: int) -> dict[str, Array]:
    needed = count * sum(field.count * field.dtype.itemsize for field in fields)
    _check_length(
        needed + len(body[needed:].strip(b"\0 \t\r\n")) if len(body) >= needed else len(body), needed, "bytes"
    )
    rows = np.frombuffer(body[:needed], [(f"f{k}", f.dtype, (f.count,)) for k, f in enumerate(fields)])
    return {field.name: rows[f"f{k}"][:, 0] for k, field in enumerate(fields)}


def _read_compressed(body: bytes, fields: list[_Field], count: int, limits: FileLimits) -> dict[str, Array]:
    needed = count * sum(field.count * field.dtype.itemsize for field in fields)
    if len(body) < 8:
        raise FormatError("is cut off before its compressed block")
    packed, expanded = struct.unpack_from("<II", body)
    _check_length(expanded, needed, "bytes")
    _check_length(8 + packed + len(body[8 + packed :].strip(b"\0 \t\r\n")), 8 + packed, "bytes")
    if packed > len(body) - 8 or expanded > math.ceil(_LZF_RATIO * packed):
        raise FormatError(f"the compressed block of {packed} bytes is cut off or damaged")
    check_expansion(packed, expanded, "the compressed block", limits)
    block, offset = decompress_lzf(body[8 : 8 + packed], expanded), 0
    columns = dict[str, Array]()
    for field in fields:  # one field after the other, not point after point
        size = count * field.count * field.dtype.itemsize
        columns[field.name] = np.frombuffer(block[offset : offset + size], field.dtype).reshape(count, -1)[:, 0]
        offset += size
    return columns


def decompress_lzf(packed: bytes, size: int) -> bytes:
    """Return the ``size`` bytes of an expanded LZF block.

    A control byte below 32 announces that many plus one literal bytes; any other is a copy: 3 bits of length (7: one
    more byte to add) and 13 bits of distance back into the bytes expanded so far.
    """
    expanded, position, end = bytearray(), 0, len(packed)
    while position < end and len(expanded) <= size:
        control = packed[position]
        position += 1
        if control < 32:
            expanded += packed[position : position + control + 1]
            position += control + 1
            continue
        length = control >> 5
        more = 1 if length == 7 else 0
        if position + more >= end:
            break
        length += 2 + (packed[position] if more else 0)
        distance = ((control & 31) << 8) + packed[position + more] + 1
        position += more + 1
        if distance > len(expanded):
            raise FormatError("the compressed block points before its beginning: it is damaged")
        source = expanded[len(expanded) - distance : len(expanded) - distance + length]
        # A copy may overlap its target: the piece repeats.
        expanded += (source * (length // len(source) + 1))[:length]
    if position != end or len(expanded) != size:
        raise FormatError(f"the compressed block does not expand to the {size} bytes it announces: it is damaged")
    return bytes(expanded)


def _colors(columns: dict[str, Array]) -> Array | None:
    for name in ("rgb", "rgba"):
        packed = columns.get(name)
        if packed is not None and packed.dtype.itemsize == 4:
            bits = np.ascontiguousarray(packed).view("<u4")
            return np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)], axis=-1).astype(np.uint8)
    return stack_named(columns, "colors")


def write_pcd(cloud: RawCloud) -> bytes:
    """Return a binary PCD file; points and normals keep their precision, colors are packed bytes."""
    size, kind = cloud.points.dtype.itemsize, cloud.points.dtype.newbyteorder("<")
    columns = [(name, kind, cloud.points[:, k]) for k, name in enumerate("xyz")]
    if cloud.normals is not None:
        columns += [(f"normal_{name}", kind, cloud.normals[:, k]) for k, name in enumerate("xyz")]
    if cloud.colors is not None:
        red, green, blue = cloud.colors.astype("<u4").T
        columns.append(("rgb", np.dtype("<u4"), (red << 16) | (green << 8) | blue))
    rows = np.zeros(len(cloud.points), [(name, dtype) for name, dtype, _ in columns])
    for name, _, values in columns:
        rows[name] = values
    floats = [dtype.kind == "f" for _, dtype, _ in columns]
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(name for name, _, _ in columns)}\n"
        f"SIZE {' '.join(str(size if is_float else 4) for is_float in floats)}\n"
        f"TYPE {' '.join('F' if is_float else 'U' for is_float in floats)}\n"
        f"COUNT {' '.join('1' for _ in columns)}\nWIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(rows)}\nDATA binary\n"
    )
    return header.encode("ascii") + rows.tobytes()
