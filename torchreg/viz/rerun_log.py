"""Scenes as recordings of the viewer rerun, which plays them next to other sensors."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from torchreg.errors import InputError, MissingExtraError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.io.atomic import write_atomic
from torchreg.viz.scene import Cloud, Color, Layer, Meshes, MovingMesh, Scene
from torchreg.viz.viser_nodes import as_bytes, as_floats

# Names of coordinates by what is upright: of cameras, whose y points down, of glTF, and of robots.
_COORDINATES = {(0, -1, 0): "RDF", (0, 1, 0): "RIGHT_HAND_Y_UP", (0, 0, 1): "RIGHT_HAND_Z_UP"}


def import_rerun() -> Any:
    """Return the module rerun; MissingExtraError, which names the extra, where it is not installed."""
    try:
        import rerun
    except ImportError as error:
        raise MissingExtraError(
            "recordings of rerun need rerun-sdk; install it with: pip install 'torchreg-articulated[rerun]'"
        ) from error
    return rerun


def scene_rrd(path: str | Path, scene: Scene) -> Path:
    """Return the path of a recording of a scene, an entity per layer, on the timeline "time" in seconds.

    Hidden layers are omitted; title and key figures are the entity "about".

    Args:
        path: to write, ending in .rrd; an existing file is replaced, whole or not at all.
        scene: to record.

    Raises:
        InputError: if the ending is another.
        FileNotFoundError: if the folder does not exist.
        MissingExtraError: if rerun is not installed.
    """
    path = Path(path)
    if path.suffix.lower() != ".rrd":
        raise InputError(f"path must end in .rrd, got {path.name!r}; rename the output file")
    rerun = import_rerun()
    layers = [layer for layer in scene.layers if layer.visible]
    facts = [f"{name}: {text}" for name, text in scene.facts.items()]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scene.rrd"
        record = rerun.RecordingStream("torchreg")
        record.save(str(file))
        up = tuple(round(value) for value in scene.camera()[2].tolist())
        if up in _COORDINATES:
            record.log("scene", getattr(rerun.ViewCoordinates, _COORDINATES[up]), static=True)
        record.log("about", rerun.TextDocument("\n".join([scene.title, *facts])), static=True)
        for layer in layers:
            if layer.num_frames == 1:
                record.log(["scene", layer.name], _drawn(rerun, layer, 0, scene.diagonal), static=True)
        for frame, seconds in enumerate(scene.seconds):
            record.set_time("time", duration=seconds)
            for layer in layers:
                if layer.num_frames > 1:
                    record.log(["scene", layer.name], _drawn(rerun, layer, frame, scene.diagonal))
        record.flush()
        record.disconnect()
        write_atomic(path, file.read_bytes())
    return path


def _drawn(rerun: Any, layer: Layer, frame: int, size: float) -> Any:
    """Return what shows a layer in a frame: nothing where a coordinate is not finite."""
    points = as_floats(layer.points(frame))
    if not bool(layer.points(frame).isfinite().all()):
        return rerun.Clear(recursive=False)
    if isinstance(layer, Cloud):
        return rerun.Points3D(points, colors=as_bytes(layer.paint(frame)), radii=0.5 * layer.size * size)
    if isinstance(layer, MovingMesh):
        return _mesh(rerun, points, layer.faces, layer.paint, layer.opacity)
    if isinstance(layer, Meshes):
        faces = layer.frames[frame if layer.num_frames > 1 else 0].faces
        return _mesh(rerun, points, faces, layer.color, layer.opacity)
    names = [*layer.labels, *[""] * (len(points) - len(layer.labels))] if layer.labels else None
    return rerun.LineStrips3D(
        list(points), colors=as_bytes(layer.paint), radii=0.5 * layer.thickness * size, labels=names
    )


def _mesh(rerun: Any, points: NDArray[Any], faces: Tensor, paint: Tensor | Color, opacity: float) -> Any:
    """Return a mesh in one color, or with one for every vertex."""
    mesh = TriangleMesh(torch.from_numpy(points), faces.cpu())
    color = {"vertex_colors": as_bytes(paint)} if isinstance(paint, Tensor) else {"albedo_factor": (*paint, opacity)}
    normals = mesh.vertex_normals().numpy()
    return rerun.Mesh3D(vertex_positions=points, triangle_indices=faces.cpu().numpy(), vertex_normals=normals, **color)
