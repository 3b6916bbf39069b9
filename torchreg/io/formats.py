"""The table of all file formats that are read: `torchreg formats` prints it, the docs show it, fuzzing goes over it.

Formats that several readers share a kind with stand beside their readers; loaders look in the rows of their kind.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from torchreg.io import calibration
from torchreg.io.cameras.colmap import load_colmap
from torchreg.io.clouds.cloud_formats import FORMATS as CLOUDS
from torchreg.io.file_format import FileFormat
from torchreg.io.frames import load_frames
from torchreg.io.gltf import load_rig
from torchreg.io.images import ENDINGS as PICTURES
from torchreg.io.images import load_depth, load_image, load_mask
from torchreg.io.limits import FileLimits, read_bytes
from torchreg.io.pose_table import load_pose_table
from torchreg.io.swc import load_swc
from torchreg.io.tensors import load_tensors
from torchreg.io.urdf import load_urdf


def _row(
    name: str, kind: str, endings: tuple[str, ...], holds: str, loader: Callable[..., Any], shown: str = ""
) -> FileFormat:
    """Return the row of a format whose loader opens the file itself."""

    def read(_: bytes, path: Path, limits: FileLimits) -> Any:
        return loader(path, limits=limits)

    return FileFormat(name=name, kind=kind, endings=endings, read=read, holds=holds, loader=shown or loader.__name__)


def _colmap(path: Path, *, limits: FileLimits) -> Any:
    return load_colmap(path if path.is_dir() else path.parent, limits=limits)


def _document(path: Path, *, limits: FileLimits) -> Any:
    return calibration.json_object(read_bytes(path, limits), path)


def _table(path: Path, *, limits: FileLimits) -> Any:
    return load_pose_table(path, ("base_x",), limits=limits)


FORMATS: tuple[FileFormat, ...] = (
    *CLOUDS,
    _row(
        "stacks of frames",
        "sequences of clouds",
        (".npz", ".npy"),
        "(T, M, 3), one array per frame, or vertices (T, V, 3) and faces",
        load_frames,
    ),
    _row(
        "rigged glTF",
        "shapes",
        (".glb", ".gltf"),
        "skeleton, skin weights, mesh",
        load_rig,
        "ArticulatedShape.from_gltf",
    ),
    _row("URDF", "shapes", (".urdf",), "links, joints, meshes", load_urdf, "ArticulatedShape.from_urdf"),
    _row(
        "depth pictures",
        "depth images",
        (".png", ".tif", ".tiff"),
        "16 bits, or floating point",
        load_depth,
        "load_depth_scan",
    ),
    _row("depth arrays", "depth images", (".npy",), "(H, W), 16 bits or floating point", load_depth, "load_depth_scan"),
    _row("OpenEXR", "depth images", (".exr",), "channel Z, Y or R; needs the extra exr", load_depth, "load_depth_scan"),
    _row("pictures", "pictures", PICTURES, "8 bits per channel, gray or color", load_image, "StereoFrames"),
    _row(
        "masks",
        "masks",
        (*PICTURES, ".npy"),
        "two values, labels, soft edges, halos, transparency",
        load_mask,
        "SilhouetteFrames",
    ),
    *calibration.FORMATS,
    _row(
        "COLMAP",
        calibration.CAMERAS,
        ("cameras.txt",),
        "the folder with cameras.txt and images.txt",
        _colmap,
        "load_cameras",
    ),
    _row("JSON", "poses", (".json",), "numbers, or numbers by name; also written", _document, "--start"),
    _row("tables", "poses", (".csv",), "a row per pose below a line of names; also written", _table, "--start"),
    _row("SWC", "curves", (".swc",), "trees of nodes with radii; also written", load_swc, "load_swc"),
    _row("safetensors", "results", (".safetensors",), "with its JSON beside it; also written", load_tensors, "load"),
)
KINDS = tuple(dict.fromkeys(row.kind for row in FORMATS))


def table_rows() -> list[tuple[str, str, str, str, str]]:
    """Return kind, format, endings, what is read and by which function, of every row."""
    return [
        (row.kind, row.name, " ".join(row.endings), row.holds + ("; also written" if row.write else ""), row.loader)
        for row in FORMATS
    ]
