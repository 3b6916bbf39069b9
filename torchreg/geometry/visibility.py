"""Visibility of meshes from a camera: views, z-buffers, visible points and samples of the visible side."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_finite, check_shape
from torchreg.errors import InputError
from torchreg.geometry.budget import BUDGET
from torchreg.geometry.mesh import TriangleMesh, interpolate, sample_surface
from torchreg.geometry.z_buffer import FlatMesh, Raster, View, draw, flatten


@dataclass(frozen=True)
class _Visibility:
    """Numbers by which points are hidden and samples drawn."""

    # Depth behind the nearest surface up to which a point counts as on it, in pixel widths.
    tolerance_pixels: float = 2.0
    # Rounds of samples drawn until enough of them are visible.
    max_rounds: int = 32
    # Pixels along the longer side of the z-buffer that decides which points are hidden.
    resolution: int = 256


_VISIBILITY = _Visibility()


def view_rotation(camera: Tensor, target: Tensor, up: Tensor | None = None) -> Tensor:
    """Return ``R_camera_world`` (3, 3) float64 of a camera that looks at a target: rows right, down, forward.

    ``up`` is -y by default, for a camera that looks along +z; a coordinate axis replaces it if the view runs along it.
    """
    camera, target = as_float_tensor(camera, "camera").double(), as_float_tensor(target, "target").double()
    for value, name in ((camera, "camera"), (target, "target")):
        check_shape(value, name, (3,))
        check_finite(value, name)
    forward = target.to(camera.device) - camera
    length = forward.norm()
    if not float(length) > 0:
        raise InputError(f"camera must lie away from the target, got both at {camera.tolist()}")
    forward = forward / length
    upright = camera.new_tensor([0.0, -1.0, 0.0]) if up is None else as_float_tensor(up, "up", like=camera)
    check_shape(upright, "up", (3,))
    check_finite(upright, "up")
    right = torch.linalg.cross(forward, upright)
    if float(right.norm()) < 1e-6 * float(upright.norm()) or float(upright.norm()) == 0:
        axis = torch.zeros_like(forward)
        axis[forward.abs().argmin()] = 1.0
        right = torch.linalg.cross(forward, axis)
    right = right / right.norm()
    return torch.stack((right, torch.linalg.cross(forward, right), forward))


def aim(
    points: Tensor,
    camera: Tensor,
    *,
    parallel: bool = False,
    up: Tensor | None = None,
    size: int | tuple[int, int] = 256,
    margin: float = 0.0,
) -> View:
    """Return the view from a camera that fits all points and looks at the center of their bounding box.

    For a parallel view ``camera`` is the direction in which it looks. ``size`` is the pixels of the longer side of a
    tight grid, or (width, height); ``margin`` the empty share on each side.
    """
    camera = as_float_tensor(camera, "camera").detach().to(device=points.device, dtype=torch.float64)
    check_shape(camera, "camera", (3,))
    check_finite(camera, "camera")
    points = points.detach().double()
    middle = (points.amin(0) + points.amax(0)) / 2
    position = middle - camera if parallel else camera
    rotation = view_rotation(position, middle, up)
    plain = View(
        position=position,
        rotation=rotation,
        corner=torch.zeros_like(camera[:2]),
        pitch=1.0,
        width=1,
        height=1,
        parallel=parallel,
    )
    plane, depth = plain.project(points)
    if not parallel and not float(depth.min()) > 1e-9 * float(depth.abs().max()):
        raise InputError(
            f"camera must have all of the points before it, got {camera.tolist()} with {int((depth <= 0).sum())} of "
            f"{len(points)} beside or behind it; move it away from them"
        )
    return _fit_grid(plain, plane, size, margin)


def _fit_grid(plain: View, plane: Tensor, size: int | tuple[int, int], margin: float) -> View:
    """Return the view with the pixels of a grid that fits points (N, 2) of its image plane."""
    sides = (size, size) if isinstance(size, int) else tuple(size)
    if len(sides) != 2 or not all(isinstance(side, int) and 1 <= side <= BUDGET.view_side for side in sides):
        raise InputError(f"size must be 1 to {BUDGET.view_side} pixels, or that for width and height, got {size}")
    lower, upper = plane.amin(0), plane.amax(0)
    extent = [float(side) / (1 - 2 * margin) for side in upper - lower]
    pitch = max(extent[0] / sides[0], extent[1] / sides[1], 1e-12)
    width, height = sides
    if isinstance(size, int):
        width, height = (max(1, math.ceil(side / pitch - 1e-9)) for side in extent)
    corner = (lower + upper) / 2 - pitch / 2 * lower.new_tensor([width, height])
    return replace(plain, corner=corner, pitch=pitch, width=width, height=height)


def rasterize(mesh: TriangleMesh, view: View, *, cull_back: bool = False) -> Raster:
    """Return the nearest face at the center of every pixel, by a z-buffer."""
    with torch.no_grad():
        return draw(flatten(mesh, view), view, cull_back)


def _used_vertices(mesh: TriangleMesh) -> Tensor:
    used = torch.zeros(mesh.num_vertices, dtype=torch.bool, device=mesh.faces.device)
    used[mesh.faces.reshape(-1)] = True
    return mesh.vertices[used]


def visible_points(mesh: TriangleMesh, points: Tensor, camera: Tensor, *, tolerance: float | None = None) -> Tensor:
    """Return a mask (N,) of the points that a mesh does not hide from a camera; points behind the camera are hidden."""
    points = points.to(mesh.vertices)
    with torch.no_grad():
        view = aim(_used_vertices(mesh), camera, size=_VISIBILITY.resolution)
        flat = flatten(mesh, view)
        return _unhidden(flat, view, draw(flat, view, False), points, tolerance)


def _unhidden(
    flat: FlatMesh,
    view: View,
    raster: Raster,
    points: Tensor,
    tolerance: float | None = None,
    faces: Tensor | None = None,
) -> Tensor:
    """Return a mask of the points that no surface hides; faces that touch a point's own face do not hide it."""
    pixels, depth = view.project(points)
    limit = pixels.new_tensor([view.width, view.height])
    framed = ((pixels >= 0) & (pixels < limit)).all(-1).nonzero()[:, 0]
    column, row = pixels[framed].long().unbind(-1)
    face = raster.face_index[row, column]
    framed, face = framed[face >= 0], face[face >= 0]
    # The face's own plane at the point itself, not at the pixel's middle: slanted surfaces do not hide themselves.
    near = view.nearness(flat.depths[face])
    surface = (flat.weights(face, pixels[framed]) * near).sum(-1).clamp(near.amin(-1), near.amax(-1))
    slack = _VISIBILITY.tolerance_pixels * view.footprint(depth[framed]) if tolerance is None else tolerance
    seen = torch.ones_like(depth, dtype=torch.bool) if view.parallel else depth > 0
    clear = depth[framed] <= view.nearness(surface) + slack
    if faces is not None:
        touching = flat.faces[face].unsqueeze(-1) == flat.faces[faces[framed]].unsqueeze(-2)
        clear |= touching.flatten(1).any(-1)
    seen[framed] = clear
    return seen


def sample_visible(
    mesh: TriangleMesh, camera: Tensor, count: int, generator: torch.Generator | None = None, *, density: str = "area"
) -> tuple[Tensor, Tensor, Tensor]:
    """Return points of the side that faces a camera, uniform by "area" or "pixel", with faces and weights."""
    still = TriangleMesh(mesh.vertices.detach().double(), mesh.faces)
    view = aim(_used_vertices(still), camera, size=_VISIBILITY.resolution)
    flat = flatten(still, view)
    raster = draw(flat, view, True)
    shown = flat.drawn(True)
    if len(shown) == 0:
        raise InputError("mesh must turn a face to the camera, got none; move the camera or turn the faces")
    vertices = still.vertices
    if density == "pixel":
        vertices = torch.nn.functional.pad(view.project(vertices)[0].nan_to_num(), (0, 1))
    source = TriangleMesh(vertices, still.faces[shown])
    if generator is None:
        generator = torch.Generator(device=mesh.vertices.device).manual_seed(0)
    faces, weights, num_found, num_drawn, batch = [shown[:0]], [flat.area.new_zeros(0, 3)], 0, 0, 2 * count
    for _ in range(_VISIBILITY.max_rounds):
        _, drawn, barycentric = sample_surface(source, batch, generator)
        if density == "pixel":
            barycentric = barycentric / flat.depths[shown[drawn]]
            barycentric = barycentric / barycentric.sum(-1, keepdim=True)
        points = interpolate(still.vertices, source.faces, drawn, barycentric)
        kept = _unhidden(flat, view, raster, points, faces=shown[drawn]).nonzero()[:, 0]
        faces.append(shown[drawn[kept]])
        weights.append(barycentric[kept])
        num_found, num_drawn = num_found + len(kept), num_drawn + batch
        if num_found >= count:
            break
        batch = min(BUDGET.raster_pixels, 1 + int(1.2 * (count - num_found) * num_drawn / max(num_found, 1)))
    else:
        raise InputError(
            f"camera must see the mesh, but of {num_drawn} points of its surface only {num_found} are visible"
        )
    face_index, barycentric = torch.cat(faces)[:count], torch.cat(weights)[:count].to(mesh.vertices.dtype)
    return interpolate(mesh.vertices, mesh.faces, face_index, barycentric), face_index, barycentric
