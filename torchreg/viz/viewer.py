"""Scenes in the browser, served by this machine to itself alone, or as one HTML file that needs no network."""

from __future__ import annotations

import contextlib
import io
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchreg.errors import InputError, MissingExtraError
from torchreg.io.atomic import write_atomic
from torchreg.viz.scene import FIELD_OF_VIEW, Cloud, Curves, Layer, Meshes, Scene, Surface

if TYPE_CHECKING:
    import viser

Place = NDArray[np.floating]

HOST = "127.0.0.1"
# How often the timeline looks whether to go on, seconds.
_TICK = 1 / 60
_HOLD = 0.5


def import_viser() -> Any:
    """Return the module viser; MissingExtraError, which names the extra, where it is not installed."""
    try:
        import viser
    except ImportError as error:
        raise MissingExtraError("the viewer needs viser; install it with: pip install 'torchreg[viewer]'") from error
    return viser


def start_server(title: str, port: int) -> viser.ViserServer:
    """Return a server on 127.0.0.1 that other machines cannot reach and that asks none for anything.

    Args:
        title: shown above the controls.
        port: where to listen; where it is taken, a later one.

    Raises:
        MissingExtraError: if viser is not installed.
    """
    library = import_viser()
    with contextlib.redirect_stdout(io.StringIO()):  # viser greets
        server: viser.ViserServer = library.ViserServer(host=HOST, port=port, label=title, verbose=False)
    # Sharing would open a tunnel through a server of others.
    setattr(server, "request_share_url", lambda verbose=True: None)  # noqa: B010
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    server.scene.configure_environment_map(None)
    return server


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server without a word."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def point_camera(server: viser.ViserServer, scene: Scene) -> None:
    """Let new windows see all of a scene."""
    position, target, up = scene.camera()
    server.scene.set_up_direction(tuple(up.tolist()))
    camera, size = server.initial_camera, scene.diagonal
    camera.fov, camera.near, camera.far = FIELD_OF_VIEW, 0.01 * size, 100 * size
    camera.position, camera.look_at, camera.up = position.numpy(), target.numpy(), up.numpy()
    _light(server, position.numpy(), target.numpy(), up.numpy())


def _light(server: viser.ViserServer, position: Place, target: Place, up: Place) -> None:
    """Light a scene from above and from the camera's side, with no shadows."""
    server.scene.configure_default_lights(enabled=False)
    server.scene.add_light_hemisphere(
        "/lights/sky", sky_color=(255, 255, 255), ground_color=(150, 150, 160), intensity=1.6
    )
    right = np.cross(target - position, up)
    for name, place, strength in (("key", position + 0.8 * right + up, 2.2), ("back", 2 * target - position + up, 0.7)):
        toward = tuple(place - target)
        server.scene.add_light_directional(
            f"/lights/{name}", color=(255, 255, 255), intensity=strength, position=toward, cast_shadow=False
        )


class SceneViewer:
    """A scene on a running server, with a control per layer, and a timeline where something moves.

    Usable in a ``with`` statement, at whose end the server stops.

    Args:
        scene: what to show.
        port: where to listen on 127.0.0.1; where it is taken, a later one.

    Raises:
        MissingExtraError: if viser is not installed.
    """

    def __init__(self, scene: Scene, *, port: int = 8080) -> None:
        self.scene = scene
        self.server = start_server(scene.title, port)
        self._drawn = DrawnScene(self.server.scene, scene)
        self._timeline = Timeline(self.server, scene.seconds, self._drawn.show) if scene.num_frames > 1 else None
        with self.server.gui.add_folder("Layers"):
            for layer in scene.layers:
                self._add_toggle(layer)
        point_camera(self.server, scene)

    @property
    def url(self) -> str:
        """Where a browser on this machine finds it."""
        return f"http://{HOST}:{self.server.get_port()}"

    @property
    def frame(self) -> int:
        """The frame that is shown."""
        return self._drawn.frame

    def show(self, frame: int) -> None:
        """Show a frame.

        Raises:
            InputError: if there is no such frame.
        """
        if not 0 <= frame < self.scene.num_frames:
            raise InputError(f"frame must be from 0 to {self.scene.num_frames - 1}, got {frame}")
        if self._timeline is not None:
            self._timeline.go_to(frame)

    def close(self) -> None:
        """Stop the timeline and the server."""
        if self._timeline is not None:
            self._timeline.close()
        stop_server(self.server)

    def __enter__(self) -> SceneViewer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _add_toggle(self, layer: Layer) -> None:
        box = self.server.gui.add_checkbox(layer.name, initial_value=layer.visible)
        box.on_update(lambda _: self._drawn.set_visible(layer.name, box.value))


class DrawnScene:
    """The nodes that a scene has become on a server, of which one frame is shown.

    Args:
        api: ``scene`` of a server.
        scene: what to draw.
    """

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


class Timeline:
    """A slider, play and pause, speed; tells which frame to show.

    Args:
        server: whose controls to add to.
        seconds: (T,) when the frames are.
        show: is called with the number of a frame, by one thread at a time.
    """

    def __init__(self, server: viser.ViserServer, seconds: list[float], show: Callable[[int], None]) -> None:
        self._seconds, self._show = seconds, show
        with server.gui.add_folder("Timeline"):
            self._slider = server.gui.add_slider("Frame", min=0, max=len(seconds) - 1, step=1, initial_value=0)
            self._play = server.gui.add_button("Play")
            self._speed = server.gui.add_slider("Speed", min=0.1, max=4.0, step=0.1, initial_value=1.0)
        self._playing, self._stopped = threading.Event(), threading.Event()
        self._slider.on_update(lambda _: show(int(self._slider.value)))
        self._play.on_click(lambda _: self.pause() if self._playing.is_set() else self.play())
        self._thread = threading.Thread(target=self._run, name="torchreg timeline", daemon=True)
        self._thread.start()

    def play(self) -> None:
        """Go on from the frame shown, over and over."""
        self._play.label = "Pause"
        self._playing.set()

    def pause(self) -> None:
        """Stay at the frame shown."""
        self._play.label = "Play"
        self._playing.clear()

    def go_to(self, frame: int) -> None:
        """Show a frame and put the slider there."""
        self._slider.value = frame  # type: ignore[misc]
        self._show(frame)

    def close(self) -> None:
        """End the thread that plays."""
        self._stopped.set()
        self._playing.set()
        self._thread.join()

    def _run(self) -> None:
        while self._playing.wait() and not self._stopped.is_set():
            at, before = self._seconds[int(self._slider.value)], time.perf_counter()
            while self._playing.is_set() and not self._stopped.wait(_TICK):
                now = time.perf_counter()
                at += (now - before) * float(self._speed.value)
                before = now
                frame = self._frame_at(at)
                if frame is None:  # the last frame is held for a while
                    at, frame = self._seconds[0], 0
                if frame != int(self._slider.value):
                    self.go_to(frame)

    def _frame_at(self, at: float) -> int | None:
        if at > self._seconds[-1] + _HOLD:
            return None
        return int(np.searchsorted(self._seconds, at, side="right")) - 1


def scene_html(path: str | Path, scene: Scene, *, num_loops: int = 1) -> Path:
    """Return the path of an HTML file that shows a scene in any browser, without a server or a network.

    What moves is played in a loop, with a timeline. Layers hidden at first are left out.

    Args:
        path: where to write, ending in .html; an existing file is replaced, whole or not at all.
        scene: what to show.
        num_loops: how often what moves is recorded.

    Raises:
        InputError: if the ending is another.
        FileNotFoundError: if the folder does not exist.
        MissingExtraError: if viser is not installed.

    Cost: 1 MB and what the frames need, 12 bytes per vertex and frame before compression.
    """
    path = Path(path)
    if path.suffix.lower() != ".html":
        raise InputError(f"path must end in .html, got {path.name!r}; rename the output file")
    shown = Scene(scene.title, tuple(layer for layer in scene.layers if layer.visible), None, scene.up)
    server = start_server(scene.title, 0)
    try:
        drawn = DrawnScene(server.scene, shown)
        point_camera(server, scene)
        record = server.get_scene_serializer()
        for _ in range(num_loops if shown.num_frames > 1 else 0):
            for frame, seconds in _durations(scene.seconds[: shown.num_frames]):
                drawn.show(frame)
                record.insert_sleep(seconds)
        content = record.as_html()
    finally:
        stop_server(server)
    write_atomic(path, content.encode("utf-8"))
    return path


def _durations(seconds: list[float]) -> Iterator[tuple[int, float]]:
    """Yield each frame with how long it is shown."""
    for frame in range(len(seconds)):
        yield frame, seconds[frame + 1] - seconds[frame] if frame + 1 < len(seconds) else _HOLD


class _DrawnLayer:
    """Nodes of one layer.

    Args:
        nodes: its handles.
        update: puts them where a frame has them and returns those that the frame shows.
        num_frames: of the layer.
    """

    def __init__(self, nodes: list[Any], update: Callable[[int], list[Any]], num_frames: int) -> None:
        self._nodes, self._update, self._num_frames = nodes, update, num_frames
        self._frame = -1
        self._shown: set[int] = set()

    def show(self, frame: int, visible: bool) -> None:
        at = min(frame, self._num_frames - 1)
        if visible and at != self._frame:
            self._frame, self._shown = at, {id(node) for node in self._update(at)}
        for node in self._nodes:
            node.visible = visible and id(node) in self._shown


def _draw(api: viser.SceneApi, name: str, layer: Layer, size: float) -> _DrawnLayer:
    if isinstance(layer, Surface):
        return _draw_surface(api, name, layer)
    if isinstance(layer, Meshes):
        return _draw_meshes(api, name, layer)
    return _draw_cloud(api, name, layer, size) if isinstance(layer, Cloud) else _draw_curves(api, name, layer, size)


def draw_patches(api: viser.SceneApi, name: str, surface: Surface) -> list[tuple[Any, NDArray[Any]]]:
    """Return the nodes of a surface at its first frame, with which vertices each of them shows."""
    smooth = not isinstance(surface.paint, Tensor)
    points = _floats(surface.points(0))
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


def _draw_surface(api: viser.SceneApi, name: str, layer: Surface) -> _DrawnLayer:
    patches = draw_patches(api, name, layer)

    def update(frame: int) -> list[Any]:
        points = _floats(layer.points(frame))
        if not np.isfinite(points).all():
            return []
        for node, index in patches:
            node.vertices = points[index]
        return [node for node, _ in patches]

    return _DrawnLayer([node for node, _ in patches], update, layer.num_frames)


def _draw_meshes(api: viser.SceneApi, name: str, layer: Meshes) -> _DrawnLayer:
    nodes = [
        api.add_mesh_simple(
            f"{name}/{number}", _floats(mesh.vertices), mesh.faces.cpu().numpy(), color=layer.color, side="double",
            opacity=None if layer.opacity >= 1 else layer.opacity, cast_shadow=False, receive_shadow=False,
            visible=False,
        )
        for number, mesh in enumerate(layer.frames)
    ]  # fmt: skip
    return _DrawnLayer(nodes, lambda frame: [nodes[frame]], layer.num_frames)


def _draw_cloud(api: viser.SceneApi, name: str, layer: Cloud, size: float) -> _DrawnLayer:
    node = api.add_point_cloud(
        name, _floats(layer.points(0)), _floats(layer.paint(0)), point_size=layer.size * size, point_shape="circle",
        precision="float32", point_shading="flat", visible=layer.visible,
    )  # fmt: skip

    def update(frame: int) -> list[Any]:
        node.points, node.colors = _floats(layer.points(frame)), _bytes(layer.paint(frame))
        return [node] if len(layer.points(frame)) else []

    return _DrawnLayer([node], update, layer.num_frames)


def _draw_curves(api: viser.SceneApi, name: str, layer: Curves, size: float) -> _DrawnLayer:
    paint = np.repeat(_floats(layer.segment_paint())[:, None], 2, axis=1)
    node = api.add_line_segments(
        f"{name}/lines", np.nan_to_num(_floats(layer.segments(0))), paint, thickness=layer.thickness * size,
        visible=layer.visible,
    )  # fmt: skip
    first = np.nan_to_num(_floats(layer.points(0)))
    labels = [
        api.add_label(f"{name}/label_{number}", text, position=first[number, 0], visible=layer.visible)
        for number, text in enumerate(layer.labels)
    ]

    def update(frame: int) -> list[Any]:
        segments = _floats(layer.segments(frame))
        if not np.isfinite(segments).all():
            return []
        node.points = segments
        for label, curve in zip(labels, _floats(layer.points(frame)), strict=False):
            label.position = curve[0]
        return [node, *labels]

    return _DrawnLayer([node, *labels], update, layer.num_frames)


def _floats(values: Tensor) -> NDArray[np.float32]:
    return values.detach().cpu().float().numpy()


def _bytes(colors: Tensor) -> NDArray[np.uint8]:
    return (255 * colors.detach().cpu().float().clamp(0, 1)).round().byte().numpy()
