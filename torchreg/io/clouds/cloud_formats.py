"""The formats of point clouds and meshes, and how their content is recognized."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

from torchreg.io.clouds.npz import ARCHIVE_START, ARRAY_START, read_npy, read_npz, write_npz
from torchreg.io.clouds.off import read_off
from torchreg.io.clouds.pcd import read_pcd, write_pcd
from torchreg.io.clouds.ply import read_ply, write_ply
from torchreg.io.clouds.ptx import is_ptx, read_ptx
from torchreg.io.clouds.raw_cloud import RawCloud
from torchreg.io.clouds.stl import is_binary_stl, read_stl
from torchreg.io.clouds.text_formats import looks_like_table, read_obj, read_table, write_csv, write_xyz
from torchreg.io.file_format import FileFormat, begins, ending_of
from torchreg.io.gltf_file.glb import read_gltf
from torchreg.io.limits import FileLimits

CLOUDS = "point clouds and meshes"
# Of Wavefront's lines, those that may come before the first vertex.
_OBJ_NAMES = (b"mtllib", b"usemtl", b"o", b"g", b"s")


def _from_content(read: Callable[[bytes, FileLimits], RawCloud]) -> Callable[[bytes, Path, FileLimits], RawCloud]:
    """Return a reader that needs no path."""
    return lambda content, _, limits: read(content, limits)


def _read_text(content: bytes, path: Path, limits: FileLimits) -> RawCloud:
    """Return the points of a table of text."""
    return read_table(content, limits, intensity_first=ending_of(path) == ".pts")


def _is_obj(content: bytes) -> bool:
    """Return whether the first line of a text that is no comment and no name is one of Wavefront's."""
    for line in content[:4096].splitlines():
        words = line.split(None, 2)
        if not words or words[0].startswith(b"#") or words[0] in _OBJ_NAMES:
            continue
        return len(words) > 1 and words[0] in (b"v", b"vn") and words[1][:1] in b"-+.0123456789"
    return False


def _is_glb(content: bytes) -> bool:
    return content.startswith(b"glTF") or (
        content.lstrip()[:1] == b"{" and b'"asset"' in content and b'"meshes"' in content
    )


def _is_pcd(content: bytes) -> bool:
    return re.match(rb"\s*(#[^\n]*\n\s*)*VERSION\s+\S+\s+FIELDS\s", content[:4096]) is not None


def _is_stl(content: bytes) -> bool:
    start = content[:1024].lstrip().lower()
    return is_binary_stl(content) or (start.startswith(b"solid") and b"facet" in start)


_cloud_format = partial(FileFormat, kind=CLOUDS, loader="load_points")
# Told by content in this order, after the row of the ending. A new format is one more row.
FORMATS: tuple[FileFormat, ...] = (
    _cloud_format(
        name="PLY",
        endings=(".ply",),
        read=_from_content(read_ply),
        holds="ASCII, binary of both byte orders; polygons and triangle strips are cut",
        sniff=begins(b"ply\n", b"ply\r", b"ply "),
        write=write_ply,
        written=("normals", "colors", "faces"),
    ),
    _cloud_format(
        name="PCD",
        endings=(".pcd",),
        read=_from_content(read_pcd),
        holds="ASCII, binary, binary_compressed",
        sniff=_is_pcd,
        write=write_pcd,
        written=("normals", "colors"),
    ),
    _cloud_format(
        name="PTX",
        endings=(".ptx",),
        read=_from_content(read_ptx),
        holds="x y z, colors, each scan moved to its registered place",
        sniff=is_ptx,
    ),
    _cloud_format(
        name="XYZ and other tables",
        endings=(".xyz", ".txt", ".pts", ".asc", ".xyzn", ".xyzrgb", ".tsv", ".dat"),
        read=_read_text,
        holds="x y z, normals, colors, intensity, with or without names of columns",
        sniff=looks_like_table,
        write=write_xyz,
        written=("normals",),
    ),
    _cloud_format(
        name="CSV",
        endings=(".csv",),
        read=_read_text,
        holds="the same tables; also those of pandas, CloudCompare and ParaView",
        write=write_csv,
        written=("normals", "colors"),
    ),
    _cloud_format(
        name="OBJ",
        endings=(".obj",),
        read=_from_content(read_obj),
        holds="vertices, faces, normals, colors; no materials",
        sniff=_is_obj,
    ),
    _cloud_format(
        name="STL",
        endings=(".stl",),
        read=_from_content(read_stl),
        holds="binary, ASCII; corners at one place become one vertex",
        sniff=_is_stl,
    ),
    _cloud_format(
        name="OFF",
        endings=(".off",),
        read=_from_content(read_off),
        holds="vertices and faces",
        sniff=begins(b"OFF", b"COFF", b"NOFF", b"CNOFF"),
    ),
    _cloud_format(
        name="glTF",
        endings=(".glb", ".gltf"),
        read=read_gltf,
        holds="the default scene as viewers show it, skins and clips posed",
        sniff=_is_glb,
    ),
    _cloud_format(
        name="NPZ",
        endings=(".npz",),
        read=_from_content(read_npz),
        holds="points (or vertices, verts, v), normals, colors, faces (or f)",
        sniff=begins(ARCHIVE_START),
        write=write_npz,
        written=("normals", "colors", "faces"),
    ),
    _cloud_format(
        name="NPY",
        endings=(".npy",),
        read=_from_content(read_npy),
        holds="(N, 3) or more columns, (H, W, 3), fields x y z",
        sniff=begins(ARRAY_START),
    ),
)
ENDINGS = tuple(ending for row in FORMATS for ending in row.endings)
