"""The meshes that a robot description names: found by relative path, file or package address, and read once."""

from __future__ import annotations

import importlib
import importlib.util
import io
import struct
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import torch

from torchreg.errors import FormatError, MissingExtraError
from torchreg.geometry.mesh import TriangleMesh, concatenate
from torchreg.io.limits import FileLimits, read_bytes
from torchreg.io.strict_xml import parse_xml

_MESH_SUFFIXES = (".stl", ".obj", ".dae", ".glb", ".ply", ".off")
_DAE_LOOKS = ("library_images", "library_effects", "library_materials", "bind_material")
_PARSER_ERRORS = (
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    RuntimeError,
    ArithmeticError,
    AssertionError,
    SyntaxError,
    EOFError,
    ImportError,  # trimesh asks for an encoding detector when text is not UTF-8
    struct.error,
)


class MeshFiles:
    """Finds and reads mesh files, each once.

    Args:
        path: the description that names them.
        package_dirs: folders to search for ``package://`` and ``model://`` names, as are those above the description.
        require: whether a file that is missing, or needs a reader not installed, is an error.
        limits: largest size of a file.
    """

    def __init__(self, path: Path, package_dirs: Sequence[Path], require: bool, limits: FileLimits) -> None:
        self._path, self._require, self._limits = path, require, limits
        self._folders = [*package_dirs, *path.resolve().parents]
        self._cache: dict[Path, TriangleMesh] = {}

    def read(self, filename: str, what: str) -> TriangleMesh | None:
        """Return the triangles of a mesh file, float64; None if it may be left out and has to be.

        Args:
            filename: as the description gives it: relative to its folder, or ``file://``, ``package://``, ``model://``.
            what: names it, for messages.

        Raises:
            FormatError: if the file is required and missing, or damaged, oversized, remote or of unknown kind.
            MissingExtraError: if a COLLADA (.dae) mesh is required and pycollada is not installed.
        """
        tried = self._candidates(filename, what)
        found = next((place for place in tried if _is_file(place)), None)
        if found is None:
            if not self._require:
                return None
            raise FormatError(
                f"{what}: mesh file {filename!r} was not found (looked at {', '.join(map(str, tried[:3]))}, ...); pass "
                f"package_dirs=, or meshes='skip' to go without"
            )
        if found.suffix.lower() == ".dae" and importlib.util.find_spec("collada") is None:
            if not self._require:
                return None
            raise MissingExtraError(
                f"{what}: reading COLLADA mesh {found} needs pycollada; install torchreg[urdf], or pass meshes='skip'"
            )
        if found not in self._cache:
            self._cache[found] = _read_mesh(found, self._limits)
        return self._cache[found]

    def _candidates(self, filename: str, what: str) -> list[Path]:
        """Return the places where a mesh may lie, likeliest first."""
        scheme, separator, rest = filename.partition("://")
        if not separator:
            return [self._path.parent / filename]
        if scheme == "file":
            return [self._path.parent / unquote(rest)]
        if scheme not in ("package", "model"):
            raise FormatError(f"{what}: mesh {filename!r} is remote; save it beside the URDF and give a relative path")
        package, _, inner = rest.partition("/")
        places = [folder / package / inner for folder in self._folders]
        named = [folder / inner for folder in self._folders if folder.name == package]
        return [*named, *places]


def _is_file(place: Path) -> bool:
    try:
        return place.is_file()
    except OSError:  # a name that the file system cannot hold
        return False


def _read_mesh(path: Path, limits: FileLimits) -> TriangleMesh:
    """Return the triangles of a mesh file, in metres where the file knows its unit."""
    kind = path.suffix.lower()
    if kind not in _MESH_SUFFIXES:
        raise FormatError(f"{path}: meshes of kind {kind!r} are not read; known: {', '.join(_MESH_SUFFIXES)}")
    content = read_bytes(path, limits)
    unit = 1.0
    import trimesh
    from trimesh.exchange.stl import HeaderError

    errors: tuple[type[BaseException], ...] = (*_PARSER_ERRORS, HeaderError)
    if kind == ".dae":
        errors = (*errors, importlib.import_module("collada.common").DaeError)
    try:
        if kind == ".dae":
            content, unit = _bare_collada(content)
        elif kind == ".stl":
            _check_stl(content)
        # From memory and without a resolver, so that no material or texture file is opened.
        scene = trimesh.load_scene(io.BytesIO(content), file_type=kind[1:], process=False, maintain_order=True)
        parts = [
            (
                np.asarray(piece.vertices, dtype=np.float64),
                np.asarray(piece.faces, dtype=np.int64),
                scene.graph[node][0],
            )
            for node in scene.graph.nodes_geometry
            if isinstance(piece := scene.geometry[scene.graph[node][1]], trimesh.Trimesh)
        ]
        pieces = [
            TriangleMesh(torch.from_numpy((v @ matrix[:3, :3].T + matrix[:3, 3]) * unit), torch.from_numpy(f.copy()))
            for v, f, matrix in parts
            if len(f)
        ]
    except errors as error:
        raise FormatError(f"{path}: not a readable {kind[1:]} mesh ({type(error).__name__}: {error})") from error
    if not pieces:
        raise FormatError(f"{path}: holds no triangles")
    return concatenate(pieces)


def _check_stl(content: bytes) -> None:
    """Raise a ValueError unless a file is as long as its binary header says, or text.

    What trimesh makes of others depends on which detectors of encodings happen to be installed.
    """
    if len(content) != 84 + 50 * int.from_bytes(content[80:84], "little"):
        content.decode("utf-8")


def _bare_collada(content: bytes) -> tuple[bytes, float]:
    """Return a COLLADA document without materials, whose broken references would take the mesh along, and its unit."""
    root = parse_xml(content)
    unit = root.find("{*}asset/{*}unit")
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag.rpartition("}")[2] in _DAE_LOOKS:
                parent.remove(child)
    return ET.tostring(root), 1.0 if unit is None else float(unit.get("meter", "1"))
