"""OFF: vertices and faces; colors and normals of its dialects are left out."""

from __future__ import annotations

import re

from torchreg.errors import FormatError
from torchreg.io.clouds.raw_cloud import RawCloud, as_indices, fan_triangles, parse_table
from torchreg.io.file_format import plain_text
from torchreg.io.limits import FileLimits, check_allowed

_COMMENT = re.compile(rb"#.*")
_HEADER = re.compile(rb"\s*(ST)?C?N?OFF\s+(\d{1,12})[ \t]+(\d{1,12})\b")


def read_off(content: bytes, limits: FileLimits) -> RawCloud:
    """Return the vertices and faces of an OFF file, polygons cut into triangles."""
    text = _COMMENT.sub(b"", plain_text(content))
    header = _HEADER.match(text)
    if header is None:
        raise FormatError("must begin with OFF and the numbers of vertices and faces, as text")
    count, faces = int(header[2]), int(header[3])
    check_allowed(count, "points", limits)
    check_allowed(faces, "faces", limits)
    rows = [line.split() for line in text[header.end() :].splitlines()[1:] if line.strip()]
    if len(rows) < count + faces:
        raise FormatError(
            f"the header says {count} vertices and {faces} faces, {len(rows)} lines follow: it is cut off"
        )
    vertices = parse_table([b" ".join(row[:3]) for row in rows[:count]], 3, "vertex")
    if not faces:
        return RawCloud(vertices)
    polygons = rows[count : count + faces]
    counts = as_indices(parse_table([row[0] for row in polygons], 1, "face")[:, 0], "counts of corners")
    if any(len(row) <= size for row, size in zip(polygons, counts.tolist(), strict=True)) or counts.min() < 0:
        raise FormatError("a face has fewer corners than it says: the file is cut off or damaged")
    corners = [word for row, size in zip(polygons, counts.tolist(), strict=True) for word in row[1 : size + 1]]
    indices = as_indices(parse_table(corners, 1, "vertex index").reshape(-1), "vertex indices")
    return RawCloud(vertices, faces=fan_triangles(counts, indices))
