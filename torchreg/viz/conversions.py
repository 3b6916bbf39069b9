"""Meshes, scans and results as objects of trimesh, Open3D and PyVista."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchreg._checks import as_float_tensor, check_points
from torchreg.alignment.results import AlignResult
from torchreg.errors import InputError, InputTypeError, MissingExtraError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.skeleton import Skeleton
from torchreg.io.points import PointCloud
from torchreg.registration.results import ScanRegistration, SequenceRegistration
from torchreg.spines.results import SpineSequence
from torchreg.viz.bone_colors import bone_palette, weight_colors

Array = NDArray[Any]


def to_trimesh(value: Any, frame: int = 0) -> Any:
    """Return a ``trimesh.Trimesh`` where there are triangles, a ``PointCloud`` of points, a ``Path3D`` of curves.

    Args:
        value: a `TriangleMesh`, `RangeScan`, point cloud, tensor (N, 3) or `Skeleton`; an `AlignResult` for its
            registered points; a `ScanRegistration` or `SequenceRegistration` for the moved scan, colored by bones; a
            `SpineSequence` for its curves.
        frame: of a sequence.

    Raises:
        InputError: if there is no such frame.
        InputTypeError: if ``value`` has another type.
    """
    import trimesh

    lines = _lines(value, frame)
    if lines is not None:
        points, edges, paint = lines
        entities = [trimesh.path.entities.Line(pair) for pair in edges]
        return trimesh.path.Path3D(entities, points, colors=paint, process=False)
    cloud = _cloud(value, frame)
    colors = None if cloud.colors is None else _bytes(cloud.colors)
    if cloud.faces is None:
        return trimesh.PointCloud(_array(cloud.points), colors=colors)
    return trimesh.Trimesh(_array(cloud.points), _array(cloud.faces), vertex_colors=colors, process=False)


def to_open3d(value: Any, frame: int = 0) -> Any:
    """Return an Open3D ``TriangleMesh``, ``PointCloud`` or ``LineSet`` of a value that `to_trimesh` takes.

    Raises:
        InputError: if there is no such frame.
        InputTypeError: if ``value`` has another type.
        MissingExtraError: if Open3D is not installed.
    """
    open3d = _extra("open3d")
    vectors, indices = open3d.utility.Vector3dVector, open3d.utility.Vector3iVector
    lines = _lines(value, frame)
    if lines is not None:
        points, edges, paint = lines
        found = open3d.geometry.LineSet(vectors(points), open3d.utility.Vector2iVector(edges))
        found.colors = vectors(paint[:, :3] / 255.0)
        return found
    cloud = _cloud(value, frame)
    if cloud.faces is None:
        found = open3d.geometry.PointCloud(vectors(_array(cloud.points)))
        normals, colors = "normals", "colors"
    else:
        found = open3d.geometry.TriangleMesh(vectors(_array(cloud.points)), indices(_array(cloud.faces)))
        normals, colors = "vertex_normals", "vertex_colors"
    if cloud.normals is not None:
        setattr(found, normals, vectors(_array(cloud.normals)))
    if cloud.colors is not None:
        setattr(found, colors, vectors(_array(cloud.colors)))
    return found


def to_pyvista(value: Any, frame: int = 0) -> Any:
    """Return a PyVista ``PolyData``, colors as its array ``rgb``, of a value that `to_trimesh` takes.

    Raises:
        InputError: if there is no such frame.
        InputTypeError: if ``value`` has another type.
        MissingExtraError: if PyVista is not installed.
    """
    pyvista = _extra("pyvista")
    lines = _lines(value, frame)
    if lines is not None:
        points, edges, colors = lines
        found = pyvista.PolyData(points, lines=_counted(edges))
        found.cell_data["rgb"] = colors[:, :3]
        return found
    cloud = _cloud(value, frame)
    found = pyvista.PolyData(_array(cloud.points), **({} if cloud.faces is None else {"faces": _counted(cloud.faces)}))
    if cloud.normals is not None:
        found.point_data["normals"] = _array(cloud.normals)
    if cloud.colors is not None:
        found.point_data["rgb"] = _bytes(cloud.colors)
    return found


def _extra(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingExtraError(
            f"this needs {name}; install it with: pip install 'torchreg-articulated[{name}]'"
        ) from error


def _cloud(value: Any, frame: int) -> PointCloud:
    """Return points, with triangles, normals and colors where the value has them."""
    if isinstance(value, PointCloud):
        return value
    if isinstance(value, TriangleMesh):
        return PointCloud(value.vertices.detach(), faces=value.faces)
    if isinstance(value, RangeScan):
        return PointCloud(value.points.detach(), value.normals.detach(), value.faces)
    if isinstance(value, AlignResult):
        points = value.registered.detach()
        return PointCloud(points[_in(frame, len(points))] if points.ndim == 3 else points)
    if isinstance(value, (ScanRegistration, SequenceRegistration)):
        points = value.deformed.detach()
        points = points[_in(frame, len(points))] if points.ndim == 3 else points
        return PointCloud(points, faces=value.faces, colors=weight_colors(value.weights).clamp(0, 1))
    if isinstance(value, (Tensor, np.ndarray)):
        points = as_float_tensor(value, "value").detach()
        check_points(points, "value", batch=False)
        return PointCloud(points)
    raise InputTypeError(
        f"value must be a mesh, scan, skeleton, tensor of points or a result, got {type(value).__name__}"
    )


def _lines(value: Any, frame: int) -> tuple[Array, Array, Array] | None:
    """Return points (N, 3), edges (E, 2) and their colors (E, 4) of curves; None of other values."""
    if isinstance(value, Skeleton):
        edges = value.edges
        color = torch.tensor([0.2, 0.2, 0.25]).expand(len(edges), 3)
        return _array(value.nodes), _array(edges), _opaque(color)
    if not isinstance(value, SpineSequence):
        return None
    curves = value.curves[_in(frame, len(value.curves))]
    there = ~curves.isnan().flatten(1).any(1)
    hues, curves = bone_palette(len(curves))[there], curves[there]
    limbs, samples = curves.shape[:2]
    index = torch.arange(limbs * samples).reshape(limbs, samples)
    edges = torch.stack([index[:, :-1], index[:, 1:]], dim=-1).reshape(-1, 2)
    colors = hues.repeat_interleave(samples - 1, dim=0)
    return _array(curves.reshape(-1, 3)), _array(edges), _opaque(colors)


def _in(frame: int, count: int) -> int:
    if not 0 <= frame < count:
        raise InputError(f"frame must be from 0 to {count - 1}, got {frame}")
    return frame


def _array(values: Tensor) -> Array:
    values = values.detach().cpu()
    return np.ascontiguousarray(values.double().numpy() if values.is_floating_point() else values.int().numpy())


def _bytes(colors: Tensor) -> Array:
    return (255 * colors.detach().cpu()).round().byte().numpy()


def _opaque(colors: Tensor) -> Array:
    return np.concatenate([_bytes(colors), np.full((len(colors), 1), 255, np.uint8)], axis=1)


def _counted(rows: Tensor | Array) -> Array:
    """Return cells in the flat form of VTK: the number of corners, then the corners, of each."""
    array = _array(rows) if isinstance(rows, Tensor) else rows
    return np.insert(array, 0, array.shape[1], axis=1).reshape(-1)
