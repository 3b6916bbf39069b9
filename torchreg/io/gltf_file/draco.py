"""Geometry of glTF files that Draco compresses (KHR_draco_mesh_compression), by the library DracoPy."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from torchreg.errors import FormatError
from torchreg.io.clouds.raw_cloud import Array

NAME = "KHR_draco_mesh_compression"


class Document(Protocol):
    """What is asked of a glTF document."""

    @staticmethod
    def entry(owner: dict[str, Any], key: str, kind: type, default: Any = None) -> Any:
        """Return an entry of an object of the file."""

    def items(self, collection: str) -> list[dict[str, Any]]:
        """Return the objects of a list of the file."""

    def view(self, owner: dict[str, Any], what: str) -> memoryview:
        """Return the bytes of the buffer view of an object."""


@dataclass(frozen=True)
class _Source:
    """Where an accessor's numbers are: the number of a buffer view, and of an attribute (None: the triangles)."""

    view: int
    attribute: int | None


class DracoGeometry:
    """The compressed primitives of a document, each unpacked once, when it is asked for."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._unpacked: dict[int, Any] = {}

    @cached_property
    def _sources(self) -> dict[int, _Source]:
        """Where the numbers of accessors are."""
        entry, found = self._document.entry, dict[int, _Source]()
        for mesh in self._document.items("meshes"):
            for primitive in entry(mesh, "primitives", list):
                if not isinstance(primitive, dict):
                    continue
                packed = entry(entry(primitive, "extensions", dict), NAME, dict)
                if not packed:
                    continue
                view, attributes = packed.get("bufferView"), entry(packed, "attributes", dict)
                accessors: dict[Any, Any] = entry(primitive, "attributes", dict)
                pairs = [(accessors.get(name), number) for name, number in attributes.items()]
                for accessor, number in [*pairs, (primitive.get("indices"), None)]:
                    if type(accessor) is int and type(view) is int and type(number) in (int, type(None)):
                        found[accessor] = _Source(view, number)
        return found

    def numbers(self, accessor: int, what: str, shape: tuple[int, int]) -> Array | None:
        """Return the numbers of an accessor that claims the shape (N, W), None where it is not compressed."""
        source = self._sources.get(accessor)
        if source is None:
            return None
        if source.view not in self._unpacked:
            self._unpacked[source.view] = _decoded(bytes(self._document.view({"bufferView": source.view}, what)), what)
        mesh = self._unpacked[source.view]
        rows = [one["data"] for one in mesh.attributes if one["unique_id"] == source.attribute]
        if source.attribute is None:
            rows = [mesh.faces]
        if not rows or np.size(rows[0]) != shape[0] * shape[1]:
            raise FormatError(f"{what} must be {shape[0]} x {shape[1]} numbers, which its Draco data are not")
        return np.asarray(rows[0]).reshape(shape)


def _decoded(content: bytes, what: str) -> Any:
    """Return the mesh of DracoPy of compressed bytes."""
    try:
        import DracoPy
    except ImportError:
        raise FormatError(
            f"{what} is compressed by {NAME}: install its reader with pip install 'torchreg-articulated[draco]', or "
            f"save the file again without mesh compression"
        ) from None
    try:
        mesh = DracoPy.decode(content)
    except (DracoPy.FileTypeException, ValueError, RuntimeError) as error:
        raise FormatError(f"the Draco data of {what} are damaged ({error})") from error
    if getattr(mesh, "faces", None) is None:
        raise FormatError(f"the Draco data of {what} hold no triangles")
    return mesh
