"""What loaders return, as each system takes it: points of clouds, scans and meshes; scans and meshes of clouds."""

from __future__ import annotations

from typing import Any

from torchreg.errors import InputTypeError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.range_scan import RangeScan


def points_of(value: Any) -> Any:
    """Return the points of a cloud or a scan, or the vertices of a mesh; anything else as it is."""
    for name in ("points", "vertices"):
        if hasattr(value, name) and not isinstance(value, type):
            return getattr(value, name)
    return value


def scan_of(value: Any, name: str) -> RangeScan:
    """Return a scan as it is, and a cloud or a mesh as one.

    Raises:
        InputTypeError: if it is something else; names the argument.
        InputError: if there is no surface in it.
    """
    if isinstance(value, RangeScan):
        return value
    points = points_of(value)
    if points is value:
        raise InputTypeError(
            f"{name} must be a RangeScan, got {type(value).__name__}; wrap points by RangeScan(...), or load a "
            f"file with load_scan"
        )
    return RangeScan(points, getattr(value, "faces", None), getattr(value, "normals", None))


def mesh_of(value: Any, name: str) -> TriangleMesh:
    """Return a mesh as it is, and a cloud or a scan with faces as one.

    Raises:
        InputTypeError: if it is something else, or has no faces; names the argument.
    """
    if isinstance(value, TriangleMesh):
        return value
    faces = getattr(value, "faces", None)
    if faces is None or not hasattr(value, "points"):
        raise InputTypeError(f"{name} must be a TriangleMesh, got {type(value).__name__}; load a file with load_mesh")
    return TriangleMesh(value.points, faces)
