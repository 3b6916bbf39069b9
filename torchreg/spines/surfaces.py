"""What spines are drawn from: meshes as they are, clouds as the surface around their points."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from torchreg._checks import as_float_tensor, check_points
from torchreg.geometry.cloud_surface import cloud_surface, enough_places
from torchreg.geometry.loaded import as_mesh
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.poisson_body import poisson_body
from torchreg.geometry.spread import SPREADS, spread_dimensions

ONE_SIDED = "the points do not enclose a body, as those of a single view: limbs follow the side that they show"


def as_surface(value: Any, name: str) -> tuple[TriangleMesh, tuple[str, ...]]:
    """Return the surface of a mesh, or of points without faces, and notes on it.

    Points that show most of a body from both sides have that of `poisson_body`; others, as of leaves or of a single
    view, that of `cloud_surface`.

    Raises:
        InputTypeError: if it is neither; names the argument.
        InputError: if there are too few points or one is not finite.
    """
    has_points = hasattr(value, "points") and not isinstance(value, TriangleMesh)
    points = value.points if has_points and getattr(value, "faces", None) is None else value
    if not isinstance(points, Tensor):
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
