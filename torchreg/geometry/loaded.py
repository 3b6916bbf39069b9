"""Loaded clouds, scans and meshes in the form that each system takes."""

from __future__ import annotations

from typing import Any

from torchreg.errors import InputTypeError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.range_scan import RangeScan


def as_points(value: Any) -> Any:
    """Return the points of a cloud or a scan, or the vertices of a mesh; anything else as it is."""
    for name in ("points", "vertices"):
        if hasattr(value, name) and not isinstance(value, type):
            return getattr(value, name)
    return value


def as_scan(value: Any, name: str) -> RangeScan:
    """Return a scan as it is, and a cloud or a mesh as one; errors name the argument."""
    if isinstance(value, RangeScan):
        return value
    points = as_points(value)
    if points is value:
        raise InputTypeError(
            f"{name} must be a RangeScan, got {type(value).__name__}; wrap points by RangeScan(...), or load a "
            f"file with load_scan"
        )
    return RangeScan(points, getattr(value, "faces", None), getattr(value, "normals", None))


def as_mesh(value: Any, name: str) -> TriangleMesh:
    """Return a mesh as it is, and a cloud or a scan with faces as one; errors name the argument."""
    if isinstance(value, TriangleMesh):
        return value
    if not hasattr(value, "points"):
        raise InputTypeError(f"{name} must be a TriangleMesh, got {type(value).__name__}; load a file with load_mesh")
    faces = getattr(value, "faces", None)
    if faces is None:
        raise InputTypeError(
            f"{name} must be a TriangleMesh, or a scan with faces, got the points of a {type(value).__name__} alone; "
            f"mesh them first"
        )
    return TriangleMesh(value.points, faces)
