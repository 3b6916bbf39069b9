"""The layers of a scene as nodes of a viser page, and their changes from frame to frame."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchreg.viz.scene import Cloud, Curves, Layer, Meshes, MovingMesh, Scene

if TYPE_CHECKING:
    import viser


class DrawnScene:
    """A scene drawn on a server (by its ``scene``), one frame at a time."""

    def __init__(self, api: viser.SceneApi, scene: Scene) -> None:
        self._api, self._scene = api, scene
        self._lock = threading.Lock()
        self._visible = {layer.name: layer.visible for layer in scene.layers}
        self._drawn: dict[str, _DrawnLayer] = {}
        self.frame = 0
        for number, layer in enumerate(scene.layers):
            self._drawn[layer.name] = _draw(api, f"/layers/{number}", layer, scene.diagonal)
        self.show(0)

    def show(self, frame: int) -> None:
        """Show a frame."""
        with self._lock:
            self.frame = frame
            for name, drawn in self._drawn.items():
                drawn.show(frame, self._visible[name])

    def set_visible(self, name: str, visible: bool) -> None:
        """Show or hide a layer."""
        with self._lock:
            self._visible[name] = visible
            self._drawn[name].show(self.frame, visible)


class _DrawnLayer:
    """Nodes of one layer; ``update`` moves them to a frame and returns the visible ones."""

    def __init__(self, nodes: list[Any], update: Callable[[int], list[Any]], num_frames: int) -> None:
        self._nodes, self._update, self._num_frames = nodes, update, num_frames
        self._frame = -1
        self._shown: set[int] = set()

    def show(self, frame: int, visible: bool) -> None:
        frame = min(frame, self._num_frames - 1)
        if visible and frame != self._frame:
            self._frame, self._shown = frame, {id(node) for node in self._update(frame)}
        for node in self._nodes:
            node.visible = visible and id(node) in self._shown


def _draw(api: viser.SceneApi, name: str, layer: Layer, size: float) -> _DrawnLayer:
    if isinstance(layer, MovingMesh):
        return _draw_surface(api, name, layer)
    if isinstance(layer, Meshes):
        return _draw_meshes(api, name, layer)
    return _draw_cloud(api, name, layer, size) if isinstance(layer, Cloud) else _draw_curves(api, name, layer, size)


def draw_patches(api: viser.SceneApi, name: str, surface: MovingMesh) -> list[tuple[Any, NDArray[Any]]]:
    """Return the nodes of a mesh at its first frame, each with the indices of its vertices."""
    smooth = not isinstance(surface.paint, Tensor)
    points = as_floats(surface.points(0))
    found = []
    for number, (used, faces, color) in enumerate(surface.patches()):
        index = used.numpy()
        node = api.add_mesh_simple(
            f"{name}/{number}", np.nan_to_num(points[index]), faces.cpu().numpy(), color=color, side="double",
            opacity=None if surface.opacity >= 1 else surface.opacity, flat_shading=not smooth, cast_shadow=False,
            receive_shadow=False, visible=surface.visible,
        )  # fmt: skip
        found.append((node, index))
    return found


def _draw_surface(api: viser.SceneApi, name: str, layer: MovingMesh) -> _DrawnLayer:
    patches = draw_patches(api, name, layer)

    def update(frame: int) -> list[Any]:
        points = as_floats(layer.points(frame))
        if not np.isfinite(points).all():
            return []
        for node, index in patches:
            node.vertices = points[index]
        return [node for node, _ in patches]

    return _DrawnLayer([node for node, _ in patches], update, layer.num_frames)


def _draw_meshes(api: viser.SceneApi, name: str, layer: Meshes) -> _DrawnLayer:
    nodes = [
        api.add_mesh_simple(
            f"{name}/{number}", as_floats(mesh.vertices), mesh.faces.cpu().numpy(), color=layer.color, side="double",
            opacity=None if layer.opacity >= 1 else layer.opacity, cast_shadow=False, receive_shadow=False,
            visible=False,
        )
        for number, mesh in enumerate(layer.frames)
    ]  # fmt: skip
    return _DrawnLayer(nodes, lambda frame: [nodes[frame]], layer.num_frames)


def _draw_cloud(api: viser.SceneApi, name: str, layer: Cloud, size: float) -> _DrawnLayer:
    node = api.add_point_cloud(
        name, as_floats(layer.points(0)), as_floats(layer.paint(0)), point_size=layer.size * size, point_shape="circle",
        precision="float32", point_shading="flat", visible=layer.visible,
    )  # fmt: skip

    def update(frame: int) -> list[Any]:
        node.points, node.colors = as_floats(layer.points(frame)), as_bytes(layer.paint(frame))
        return [node] if len(layer.points(frame)) else []

    return _DrawnLayer([node], update, layer.num_frames)


def _draw_curves(api: viser.SceneApi, name: str, layer: Curves, size: float) -> _DrawnLayer:
    pieces = layer.curves.shape[-2] - 1  # of a curve
    paint = np.repeat(as_floats(layer.paint), pieces, axis=0)[:, None].repeat(2, axis=1)

    def segments_of(frame: int) -> NDArray[np.float32]:
        points = as_floats(layer.points(frame))
        return np.stack((points[:, :-1], points[:, 1:]), axis=2).reshape(-1, 2, 3)

    node = api.add_line_segments(
        f"{name}/lines", np.nan_to_num(segments_of(0)), paint, thickness=layer.thickness * size,
        visible=layer.visible,
    )  # fmt: skip
    first = np.nan_to_num(as_floats(layer.points(0)))
    labels = [
        api.add_label(f"{name}/label_{number}", text, position=first[number, 0], visible=layer.visible)
        for number, text in enumerate(layer.labels)
    ]

    def update(frame: int) -> list[Any]:
        segments = segments_of(frame)
        if not np.isfinite(segments).all():
            return []
        node.points = segments
        for label, curve in zip(labels, as_floats(layer.points(frame)), strict=False):
            label.position = curve[0]
        return [node, *labels]

    return _DrawnLayer([node, *labels], update, layer.num_frames)


def as_floats(values: Tensor) -> NDArray[np.float32]:
    """Return a tensor as numpy's float32, on the CPU and without gradients."""
    return values.detach().cpu().float().numpy()


def as_bytes(colors: Tensor) -> NDArray[np.uint8]:
    """Return colors in [0, 1] as numpy's bytes, on the CPU."""
    return (255 * colors.detach().cpu().float().clamp(0, 1)).round().byte().numpy()
