"""Meshes of a robot description: found by relative path, file or package address, and read once."""

from __future__ import annotations

import importlib
import importlib.util
import io
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import torch

from torchreg.errors import FileWarning, FormatError, MissingExtraError
from torchreg.geometry.mesh import TriangleMesh, concatenate
from torchreg.io.file_format import check_stand_in, warn
from torchreg.io.limits import FileLimits, read_bytes
from torchreg.io.points import PARSER_ERRORS, load_mesh
from torchreg.io.urdf_file.strict_xml import parse_xml

# Elements of COLLADA files without which meshes are read.
_MATERIALS = ("library_images", "library_effects", "library_materials", "bind_material")


class MeshFiles:
    """Finds and reads the mesh files of a description, each once; ``package://`` names in folders given and above it.

    A file that is missing or needs a reader that is not installed is an error where it is required, else a warning.
    """

    def __init__(
        self, path: Path, package_dirs: Sequence[Path], require: bool, limits: FileLimits, *, warn: bool = False
    ) -> None:
        self._path, self._require, self._limits, self._warn = path, require, limits, warn
        self._folders = [*package_dirs, *path.resolve().parents]
        self._cache: dict[Path, TriangleMesh] = {}

    def read(self, filename: str, what: str) -> TriangleMesh | None:
        """Return the triangles of a mesh by path or address, float64; None if it is not there nor required."""
        tried = self._candidates(filename.replace("\\", "/"))
        found = next((file for path in tried if (file := _found(path)) is not None), None)
        if found is None:
            scheme, separator, _ = filename.partition("://")
            if separator and scheme not in ("file", *_PACKAGES):
                reason = f"mesh {filename!r} is remote; save it beside the URDF and give a relative path"
            else:
                places = ", ".join(map(str, dict.fromkeys(tried[:4])))
                reason = (
                    f"mesh file {filename!r} was not found (looked at {places}, ...); name its folder by package_dirs="
                )
            self._missing(FormatError(f"{what}: {reason}"))
            return None
        is_collada = found.suffix.lower() == ".dae"
        if is_collada and importlib.util.find_spec("collada") is None:
            self._missing(
                MissingExtraError(
                    f"{what}: COLLADA mesh {found} needs pycollada; install it with: "
                    "pip install 'torchreg-articulated[urdf]'"
                )
            )
            return None
        if found not in self._cache:
            content = read_bytes(found, self._limits)
            try:
                check_stand_in(content)
            except FormatError as error:
                self._missing(FormatError(f"{what}: {found} {error}"))
                return None
            self._cache[found] = _read_collada(found, content) if is_collada else self._load(found)
        return self._cache[found]

    def _load(self, file: Path) -> TriangleMesh:
        """Return the triangles of a file of any other format; what is said of its colors and normals is no concern."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FileWarning)
            return load_mesh(file, limits=self._limits, dtype=torch.float64)

    def _missing(self, error: FormatError | MissingExtraError) -> None:
        """Raise the error about a missing file, or warn, as was asked for."""
        if self._require:
            raise error
        if self._warn:
            warn(f"{error}; it is left out")

    def _candidates(self, filename: str) -> list[Path]:
        """Return the possible paths of a mesh, most likely first."""
        scheme, separator, rest = filename.partition("://")
        if separator and scheme in _PACKAGES:
            package, _, inner = rest.partition("/")
            named = [folder / inner for folder in self._folders if folder.name == package]
            return [*named, *(folder / package / inner for folder in self._folders), *self._below(inner)]
        name = unquote(rest) if scheme == "file" else rest if separator else filename
        place = self._path.parent / name
        # A path of another machine, or of Windows, ends as that of this one.
        return [place, *self._below(name)]

    def _below(self, name: str) -> list[Path]:
        """Return the places of a path, or of its end, below the folders that are searched."""
        parts = [part for part in name.split("/") if part not in ("", ".", "..")]
        ends = ["/".join(parts[k:]) for k in range(min(len(parts), _DEEPEST))]
        return [folder / end for end in ends for folder in self._folders]


_PACKAGES = ("package", "model")
# Folders of a path that are left out, at most, to find its end elsewhere.
_DEEPEST = 12


def _found(path: Path) -> Path | None:
    """Return the file of a path, also where only upper and lower case differ, as they may on Windows."""
    if _is_file(path):
        return path
    try:
        same = [file for file in path.parent.iterdir() if file.name.lower() == path.name.lower()]
    except OSError:
        return None
    return same[0] if len(same) == 1 and _is_file(same[0]) else None


def _is_file(path: Path) -> bool:
    """Return whether a path is that of a file, also where the path is invalid."""
    try:
        return path.is_file()
    except OSError:  # a name that the file system cannot hold
        return False


def _read_collada(path: Path, content: bytes) -> TriangleMesh:
    """Return the triangles of a COLLADA file in metres, read without materials, whose references may be broken."""
    import trimesh

    damaged = importlib.import_module("collada.common").DaeError
    try:
        root = parse_xml(content)
        unit = root.find("{*}asset/{*}unit")
        scale = 1.0 if unit is None else float(unit.get("meter", "1"))
        for parent in list(root.iter()):
            for child in list(parent):
                if child.tag.rpartition("}")[2] in _MATERIALS:
                    parent.remove(child)
        # From memory and without a resolver, so that no texture file is opened.
        with np.errstate(all="ignore"):  # what is not finite is refused with the triangles
            stream = io.BytesIO(ET.tostring(root))
            scene = trimesh.load_scene(stream, file_type="dae", process=False, maintain_order=True)
            pieces = list[TriangleMesh]()
            for transform, name in (scene.graph[node] for node in scene.graph.nodes_geometry):
                mesh = scene.geometry[name]
                if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
                    vertices = scale * (np.asarray(mesh.vertices) @ transform[:3, :3].T + transform[:3, 3])
                    faces = torch.from_numpy(mesh.faces.astype(np.int64))
                    pieces.append(TriangleMesh(torch.from_numpy(vertices), faces))
    except (*PARSER_ERRORS, AssertionError, damaged) as error:
        raise FormatError(f"{path}: not a readable dae mesh ({type(error).__name__}: {error})") from error
    if not pieces:
        raise FormatError(f"{path}: holds no triangles")
    return concatenate(pieces)
