"""The surface of one frame: a mesh as it is, a cloud as the surface around its points."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from torchreg._checks import as_float_tensor, check_points
from torchreg.geometry.cloud_surface import cloud_surface, enough_places
from torchreg.geometry.loaded import as_mesh
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.poisson_body import poisson_body
from torchreg.geometry.spread import SPREADS, spread_dimensions
from torchreg.geometry.support import SupportSplit, split_support

ONE_SIDED = "the points do not enclose a body, as those of a single view: limbs follow the side that they show"


def split_surface(value: Any, name: str, support: str) -> tuple[TriangleMesh | Tensor, SupportSplit | None]:
    """Return a mesh, or points without faces, without its support, and that; None for no support."""
    points = points_without_faces(value)
    if points is None:
        mesh = as_mesh(value, name)
        split = split_support(mesh) if support == "auto" and mesh.num_faces else None
        return (mesh, None) if split is None or split.plane is None else (split.rest(mesh), split)
    points = as_float_tensor(points, name)
    check_points(points, name, batch=False)
    split = split_support(points) if support == "auto" else None
    return (points, None) if split is None or split.plane is None else (points[~split.mask], split)


def as_surface(value: Any, name: str) -> tuple[TriangleMesh, tuple[str, ...]]:
    """Return the surface of a mesh, or of points without faces, and notes on it."""
    points = points_without_faces(value)
    if points is None:
        return as_mesh(value, name), ()
    points = as_float_tensor(points, name)
    check_points(points, name, batch=False)
    places = enough_places(points, name)
    size = (places.amax(0) - places.amin(0)).norm()
    body = poisson_body(places) if int(spread_dimensions(places, size)) == len(SPREADS) else None
    if body is not None and body.is_whole:
        notes = (f"{body.joined} piece(s) joined across gaps between points",) if body.joined else ()
        return TriangleMesh(body.mesh.vertices.to(points), body.mesh.faces.to(points.device)), notes
    found = cloud_surface(points.detach(), name)
    return found.mesh, () if found.encloses else (ONE_SIDED,)


def points_without_faces(value: Any) -> Tensor | None:
    """Return the points of a value without faces; None if it has some."""
    has_points = hasattr(value, "points") and not isinstance(value, TriangleMesh)
    points = value.points if has_points and getattr(value, "faces", None) is None else value
    return points if isinstance(points, Tensor) else None
