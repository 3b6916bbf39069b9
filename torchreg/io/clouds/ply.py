"""PLY: ASCII and both binary byte orders, any scalar properties, polygons and strips cut into triangles."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from torchreg.errors import FormatError
from torchreg.io.clouds.columns import named_columns, stack_named
from torchreg.io.clouds.raw_cloud import (
    Array,
    RawCloud,
    as_indices,
    as_integers,
    fan_triangles,
    parse_table,
    strip_triangles,
)
from torchreg.io.limits import FileLimits, check_allowed

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
_FORMATS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
_HEADER_END = re.compile(rb"^end_header[ \t]*\r?(\n|$)", re.MULTILINE)
# -1 in 32 bits without a sign, which begins a new strip.
_RESTART = 2**32 - 1


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str
    count_kind: str | None = None  # set for lists


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]

    @property
    def has_lists(self) -> bool:
        return any(p.count_kind for p in self.properties)


@dataclass(frozen=True)
class _Ragged:
    """A list property: the number of values per row, and all values in order."""

    counts: Array
    values: Array


_Columns = dict[str, "Array | _Ragged"]


def read_ply(content: bytes, limits: FileLimits) -> RawCloud:
    """Return the vertices (and faces) of a PLY file."""
    end = _HEADER_END.search(content[: 1 << 20])  # headers are shorter
    if not content.startswith(b"ply") or end is None:
        raise FormatError("must start with 'ply' and a header closed by 'end_header'")
    order, elements = _parse_header(content[: end.start()].decode("latin-1").split("\n"), limits)
    body = content[end.end() :]
    tables = _read_ascii(body, elements) if order is None else _read_binary(body, elements, order)
    return _to_cloud(tables, {e.name: {p.name: p.kind for p in e.properties} for e in elements})


def _parse_header(lines: list[str], limits: FileLimits) -> tuple[str | None, list[_Element]]:
    formats, elements = [], list[_Element]()
    for line in lines[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, "1.0"] if name in _FORMATS:
                formats.append(_FORMATS[name])
            case ["element", name, count] if count.isdecimal():
                check_allowed(int(count), "faces" if name == "face" else "points", limits)
                elements.append(_Element(name, int(count), []))
            case ["property", "list", count_kind, kind, name] if elements and count_kind in _TYPES and kind in _TYPES:
                if _TYPES[count_kind].startswith("f"):
                    raise FormatError(f"the list {name!r} is counted in {count_kind}; an integer type is needed")
                elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[count_kind]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append(_Property(name, _TYPES[kind]))
            case _:
                raise FormatError(f"the header line {line[:80]!r} is not understood")
    if len(formats) != 1:
        raise FormatError(f"the header must name one format of {', '.join(_FORMATS)} in version 1.0")
    for element in elements:
        names = [p.name for p in element.properties]
        if not names or len(set(names)) != len(names):
            raise FormatError(f"the header's element {element.name!r} has no properties, or two of one name")
    if len({element.name for element in elements}) != len(elements):
        raise FormatError("the header declares two elements of one name")
    return formats[0], elements


def _to_cloud(tables: dict[str, _Columns], kinds: dict[str, dict[str, str]]) -> RawCloud:
    vertex = {name: values for name, values in tables.get("vertex", {}).items() if not isinstance(values, _Ragged)}
    points = stack_named(vertex, "points")
    if points is None:
        raise FormatError("must have an element 'vertex' with the properties x, y and z")
    colors, channels = stack_named(vertex, "colors"), named_columns(list(vertex), "colors")
    if colors is not None and channels and colors.dtype.kind == "f":  # text, of whole numbers too
        kind = kinds["vertex"][list(vertex)[channels[0]]]
        colors = colors if kind[0] == "f" else as_integers(colors, kind, "colors")
    parts = [part for element, cut in _FACES.items() if (part := _triangles(tables.get(element, {}), cut)) is not None]
    faces = np.concatenate(parts) if len(parts) > 1 else parts[0] if parts else None
    return RawCloud(points, stack_named(vertex, "normals"), colors, faces)


# Elements whose lists of vertices are faces, and how these are cut.
_FACES = {"face": fan_triangles, "tristrips": strip_triangles}


def _triangles(columns: _Columns, cut: Callable[[Array, Array], Array]) -> Array | None:
    """Return the triangles (F, 3) of an element, None if it has no lists of vertices."""
    lists = next((columns[name] for name in ("vertex_indices", "vertex_index") if name in columns), None)
    if not isinstance(lists, _Ragged):
        return None
    indices = as_indices(lists.values, "vertex indices")
    return cut(lists.counts, np.where(indices == _RESTART, -1, indices) if cut is strip_triangles else indices)


def _read_ascii(body: bytes, elements: list[_Element]) -> dict[str, _Columns]:
    lines = [line for line in body.splitlines() if line.strip()]
    claimed = sum(element.count for element in elements)
    if len(lines) != claimed:
        raise FormatError(f"the header says {claimed} rows, the file holds {len(lines)}: it is cut off or damaged")
    tables, start = dict[str, _Columns](), 0
    for element in elements:
        rows = lines[start : start + element.count]
        start += element.count
        if element.has_lists:
            tables[element.name] = _ascii_lists(rows, element)
        else:
            table = parse_table(rows, len(element.properties), f"row of element {element.name!r}")
            tables[element.name] = {p.name: table[:, k] for k, p in enumerate(element.properties)}
    return tables


def _ascii_lists(rows: list[bytes], element: _Element) -> _Columns:
    # All numbers in one flat array, then one pass over the rows to find the start of each property.
    words = [row.split() for row in rows]
    flat = parse_table([word for row in words for word in row], 1, f"entry of element {element.name!r}")[:, 0]
    starts: list[list[int]] = [[] for _ in element.properties]
    counts: list[list[int]] = [[] for _ in element.properties]
    position = 0
    for row in words:
        end = position + len(row)
        for prop, begin, length in zip(element.properties, starts, counts, strict=True):
            size = 1
            if prop.count_kind:
                size = int(flat[position]) if position < end and 0 <= flat[position] <= len(row) else -1
                position += 1
            if size < 0 or position + size > end:
                raise FormatError(f"a row of element {element.name!r} is shorter than its list says")
            begin.append(position)
            length.append(size)
            position += size
        if position != end:
            raise FormatError(f"a row of element {element.name!r} is longer than its list says")
    return {
        prop.name: _gather(prop, np.array(begin, np.int64), np.array(length, np.int64), flat)
        for prop, begin, length in zip(element.properties, starts, counts, strict=True)
    }


def _gather(prop: _Property, starts: Array, counts: Array, flat: Array) -> Array | _Ragged:
    if prop.count_kind is None:
        return flat[starts]
    return _Ragged(counts, flat[_spread(starts, counts, 1)])


def _spread(starts: Array, counts: Array, stride: int) -> Array:
    """Return the positions of all list entries, given the starts and lengths of the lists."""
    within = np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.repeat(starts, counts) + stride * within


def _read_binary(body: bytes, elements: list[_Element], order: str) -> dict[str, _Columns]:
    tables, offset = dict[str, _Columns](), 0
    for element in elements:
        least = sum(np.dtype(p.count_kind or p.kind).itemsize for p in element.properties)
        if element.count * least > len(body) - offset:
            raise _cut_off(element)
        if element.has_lists:
            found = _binary_equal_lists(body, offset, element, order)
            tables[element.name], offset = found or _binary_lists(body, offset, element, order)
        else:
            dtype = np.dtype([(p.name, order + p.kind) for p in element.properties])
            rows = np.frombuffer(body, dtype, element.count, offset)
            tables[element.name] = {p.name: rows[p.name] for p in element.properties}
            offset += rows.nbytes
    if body[offset:].strip():
        raise FormatError(f"holds {len(body) - offset} bytes more than its header says: it is damaged")
    return tables


def _cut_off(element: _Element) -> FormatError:
    return FormatError(
        f"the header says {element.count} rows of {element.name!r}, the file holds fewer: it is cut off or damaged"
    )


def _binary_equal_lists(body: bytes, offset: int, element: _Element, order: str) -> tuple[_Columns, int] | None:
    """Return an element whose lists are equally long in all rows, as in a triangle mesh, and its end; else None."""
    if element.count == 0:
        return None
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    sizes, scan = list[int](), offset
    for k, prop in enumerate(element.properties):
        size = 1
        if prop.count_kind:
            count = np.dtype(order + prop.count_kind)
            if scan + count.itemsize > len(body):
                return None
            size = int(np.frombuffer(body, count, 1, scan)[0])
            fields.append((f"count{k}", order + prop.count_kind, ()))
            scan += count.itemsize
        if not 0 <= size <= len(body):
            return None
        fields.append((f"value{k}", order + prop.kind, (size,) if prop.count_kind else ()))
        sizes.append(size)
        scan += size * np.dtype(prop.kind).itemsize
    if (scan - offset) * element.count > len(body) - offset:
        return None
    rows = np.frombuffer(body, np.dtype(fields), element.count, offset)
    columns: _Columns = {}
    for k, (prop, size) in enumerate(zip(element.properties, sizes, strict=True)):
        values = rows[f"value{k}"]
        if prop.count_kind and np.any(rows[f"count{k}"] != size):
            return None
        columns[prop.name] = (
            _Ragged(np.full(element.count, size, np.int64), values.reshape(-1)) if prop.count_kind else values
        )
    return columns, offset + rows.nbytes


def _binary_lists(body: bytes, offset: int, element: _Element, order: str) -> tuple[_Columns, int]:
    starts: list[list[int]] = [[] for _ in element.properties]
    counts: list[list[int]] = [[] for _ in element.properties]
    byte_order: Literal["little", "big"] = "little" if order == "<" else "big"
    end = len(body)
    layout = [
        (np.dtype(p.kind).itemsize, p.count_kind and (np.dtype(p.count_kind).itemsize, p.count_kind[0] == "i"))
        for p in element.properties
    ]
    for _ in range(element.count):
        for (width, counter), begin, length in zip(layout, starts, counts, strict=True):
            size = 1
            if counter:
                size = int.from_bytes(body[offset : offset + counter[0]], byte_order, signed=counter[1])
                offset += counter[0]
            if size < 0 or offset + size * width > end:
                raise _cut_off(element)
            begin.append(offset)
            length.append(size)
            offset += size * width
    raw = np.frombuffer(body, np.uint8)
    columns: _Columns = {}
    for prop, begin, length in zip(element.properties, starts, counts, strict=True):
        dtype, size_of = np.dtype(order + prop.kind), np.array(length, np.int64)
        where = _spread(np.array(begin, np.int64), size_of, dtype.itemsize)
        values = raw[where[:, None] + np.arange(dtype.itemsize)].reshape(-1).view(dtype)
        columns[prop.name] = _Ragged(size_of, values) if prop.count_kind else values
    return columns, offset


def write_ply(cloud: RawCloud) -> bytes:
    """Return a binary little-endian PLY file; points and normals keep their precision, colors are bytes."""
    fields = [(name, cloud.points.dtype, cloud.points[:, k]) for k, name in enumerate("xyz")]
    if cloud.normals is not None:
        fields += [(f"n{name}", cloud.points.dtype, cloud.normals[:, k]) for k, name in enumerate("xyz")]
    if cloud.colors is not None:
        fields += [(name, np.dtype("u1"), cloud.colors[:, k]) for k, name in enumerate(("red", "green", "blue"))]
    rows = np.zeros(len(cloud.points), [(name, dtype.newbyteorder("<")) for name, dtype, _ in fields])
    for name, _, values in fields:
        rows[name] = values
    words = {"f4": "float", "f8": "double", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {words[dtype.str[1:]]} {name}" for name, dtype, _ in fields]
    body = rows.tobytes()
    if cloud.faces is not None:
        header += [f"element face {len(cloud.faces)}", "property list uchar int vertex_indices"]
        triangles = np.zeros(len(cloud.faces), [("count", "u1"), ("corners", "<i4", (3,))])
        triangles["count"], triangles["corners"] = 3, cloud.faces
        body += triangles.tobytes()
    return ("\n".join([*header, "end_header"]) + "\n").encode("ascii") + body
