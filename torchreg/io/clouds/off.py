"""OFF, read by trimesh once its counts are checked; colors and normals of its dialects are left out."""

from __future__ import annotations

import io
import re

import numpy as np

from torchreg.errors import FormatError
from torchreg.io.clouds.raw_cloud import RawCloud
from torchreg.io.file_format import plain_text
from torchreg.io.limits import FileLimits, check_allowed

_COMMENT = re.compile(rb"#.*")
_HEADER = re.compile(rb"\s*(ST)?C?N?OFF\s+(\d{1,12})[ \t]+(\d{1,12})\b")


def read_off(content: bytes, limits: FileLimits) -> RawCloud:
    """Return the vertices and faces of an OFF file, polygons cut into triangles."""
    text = plain_text(content)
    header = _HEADER.match(_COMMENT.sub(b"", text))
    if header is None:
        raise FormatError("must begin with OFF and the numbers of vertices and faces, as text")
    count, faces = int(header[2]), int(header[3])
    check_allowed(count, "points", limits)
    check_allowed(faces, "faces", limits)
    rows = [line for line in _COMMENT.sub(b"", text).splitlines() if line.strip()]
    if len(rows) < count + faces:
        raise FormatError(
            f"the header says {count} vertices and {faces} faces, the file holds {len(rows)} lines: it is cut off"
        )
    from trimesh.exchange.off import load_off

    found = load_off(io.BytesIO(text))
    triangles = np.asarray(found["faces"], dtype=np.int64).reshape(-1, 3)
    return RawCloud(np.asarray(found["vertices"]), faces=triangles if faces else None)
