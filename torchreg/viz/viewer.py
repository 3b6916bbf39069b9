"""Scenes in the browser, served to this machine alone, or as one HTML file that needs no network."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from torchreg.errors import InputError
from torchreg.io.atomic import write_atomic
from torchreg.viz.scene import Cloud, Layer, Meshes, Scene
from torchreg.viz.viser_nodes import DrawnScene
from torchreg.viz.viser_server import Page, point_camera, start_server, stop_server

if TYPE_CHECKING:
    import viser


@dataclass(frozen=True)
class _Pace:
    """Times of a timeline, seconds."""

    tick: float = 1 / 60  # between updates
    pause: float = 0.5  # at the last frame
    speeds: tuple[float, float] = (0.1, 4.0)  # seconds played per second


_PACE = _Pace()


def _bounded(value: float, low: float, high: float) -> float:
    """Return a number that a page sent within its bounds; the lower one for NaN."""
    return min(max(float(value), low), high) if value == value else low


class SceneViewer(Page):
    """A scene on a running server, with a control per layer, and a timeline if a layer moves.

    Usable in a ``with`` statement, at whose end the server stops.

    Args:
        scene: to show.
        port: to listen on at 127.0.0.1, or a later one if it is taken.
    """

    def __init__(self, scene: Scene, *, port: int = 8080) -> None:
        self.scene = scene
        super().__init__(scene.title, port)
        self._drawn = DrawnScene(self.server.scene, scene)
        self.server.gui.add_markdown(description(scene))
        self._timeline = Timeline(self.server, scene.seconds, self._drawn.show) if scene.num_frames > 1 else None
        with self.server.gui.add_folder("Layers"):
            for layer in scene.layers:
                self._add_toggle(layer)
        point_camera(self.server, scene)

    @property
    def frame(self) -> int:
        """The current frame."""
        return self._drawn.frame

    def show(self, frame: int) -> None:
        """Show a frame."""
        if not 0 <= frame < self.scene.num_frames:
            raise InputError(f"frame must be from 0 to {self.scene.num_frames - 1}, got {frame}")
        if self._timeline is not None:
            self._timeline.go_to(frame)

    def close(self) -> None:
        """Stop the timeline and the server."""
        if self._timeline is not None:
            self._timeline.close()
        super().close()

    def _add_toggle(self, layer: Layer) -> None:
        box = self.server.gui.add_checkbox(layer.name, initial_value=layer.visible)
        box.on_update(lambda _: self._drawn.set_visible(layer.name, box.value))


def description(scene: Scene) -> str:
    """Return title, key figures and a legend of the layers as Markdown."""
    facts = [f"{_plain(name)}: {_plain(text)}" for name, text in scene.facts.items()]
    legend = []
    for layer in scene.layers:
        legend.append(f"- {_mark(layer)} {_plain(layer.name)}")
    return "\n\n".join([f"### {_plain(scene.title)}", *facts, "\n".join(legend)])


def _mark(layer: Layer) -> str:
    """Return a square in the color of a layer, an open circle where it has several."""
    color = _one_color(layer)
    return "&#9676;" if color is None else f'<span style="color:{color}">&#9632;</span>'


def _one_color(layer: Layer) -> str | None:
    """Return the color of a layer as pages write it, None if it has several."""
    if isinstance(layer, Meshes):
        color: Any = layer.color
    elif isinstance(layer, Cloud):
        color = layer.paints if layer.one_color else None
    else:
        color = None if isinstance(layer.paint, Tensor) else layer.paint
    return None if color is None else "#" + "".join(f"{round(255 * share):02x}" for share in color)


def _plain(text: str) -> str:
    """Return text of a file without what Markdown or a page would take for its own."""
    return re.sub(r"[<>&`*_\[\]#\\]", " ", text)


class Timeline:
    """Controls for the frame: slider, play and pause, speed; one thread at a time calls ``show`` with its number."""

    def __init__(self, server: viser.ViserServer, seconds: list[float], show: Callable[[int], None]) -> None:
        self._seconds, self._show = seconds, show
        with server.gui.add_folder("Timeline"):
            self._slider = server.gui.add_slider("Frame", min=0, max=len(seconds) - 1, step=1, initial_value=0)
            self._play = server.gui.add_button("Play")
            self._speed = server.gui.add_slider(
                "Speed", min=_PACE.speeds[0], max=_PACE.speeds[1], step=0.1, initial_value=1.0
            )
        self._playing, self._stopped = threading.Event(), threading.Event()
        self._slider.on_update(lambda _: show(self._frame))
        self._play.on_click(lambda _: self.pause() if self._playing.is_set() else self.play())
        self._thread = threading.Thread(target=self._run, name="torchreg timeline", daemon=True)
        self._thread.start()

    def play(self) -> None:
        """Play from the current frame on, in a loop."""
        self._play.label = "Pause"
        self._playing.set()

    def pause(self) -> None:
        """Stop at the current frame."""
        self._play.label = "Play"
        self._playing.clear()

    def go_to(self, frame: int) -> None:
        """Show a frame and set the slider."""
        self._slider.value = frame  # type: ignore[misc]
        self._show(frame)

    def close(self) -> None:
        """End the thread that plays, also if a page presses its button meanwhile."""
        self._stopped.set()
        while self._thread.is_alive():
            self._playing.set()
            self._thread.join(_PACE.tick)

    @property
    def _frame(self) -> int:
        """Number on the slider; a page may send any."""
        return int(_bounded(self._slider.value, 0, len(self._seconds) - 1))

    def _run(self) -> None:
        while self._playing.wait() and not self._stopped.is_set():
            shown, before = self._seconds[self._frame], time.perf_counter()
            while self._playing.is_set() and not self._stopped.wait(_PACE.tick):
                now = time.perf_counter()
                shown += (now - before) * _bounded(self._speed.value, *_PACE.speeds)
                before = now
                frame = self._frame_at(shown)
                if frame is None:
                    shown, frame = self._seconds[0], 0
                if frame != self._frame:
                    self.go_to(frame)

    def _frame_at(self, seconds: float) -> int | None:
        """Return the frame at a time, None after the pause at the last one."""
        if seconds > self._seconds[-1] + _PACE.pause:
            return None
        return int(np.searchsorted(self._seconds, seconds, side="right")) - 1


def scene_html(path: str | Path, scene: Scene) -> Path:
    """Return the path of an HTML file that shows a scene in any browser, without a server or a network.

    Moving layers are played in a loop, with a timeline. Hidden layers are omitted.

    Args:
        path: to write, ending in .html; an existing file is replaced, whole or not at all.
        scene: to show.

    Raises:
        InputError: if the ending is another.
        FileNotFoundError: if the folder does not exist.
        MissingExtraError: if viser is not installed.

    Cost: 1 MB, and 12 bytes per vertex and frame before compression.
    """
    path = Path(path)
    if path.suffix.lower() != ".html":
        raise InputError(f"path must end in .html, got {path.name!r}; rename the output file")
    shown = replace(scene, layers=tuple(layer for layer in scene.layers if layer.visible), times=None)
    server = start_server(scene.title, 0)
    try:
        drawn = DrawnScene(server.scene, shown)
        point_camera(server, scene)
        record = server.get_scene_serializer()
        for frame, seconds in _durations(scene.seconds) if shown.num_frames > 1 else ():
            drawn.show(frame)
            record.insert_sleep(seconds)
        content = _titled(record.as_html(), scene)
    finally:
        stop_server(server)
    write_atomic(path, content.encode("utf-8"))
    return path


def _titled(page: str, scene: Scene) -> str:
    """Return a page with the title of a scene, its key figures and a legend in a corner."""
    facts = (f"{escape(name)}: {escape(text)}" for name, text in scene.facts.items())
    rows = [f"<b>{escape(scene.title)}</b>", *facts]
    for layer in scene.layers:
        if layer.visible:
            rows.append(f"{_mark(layer)} {escape(layer.name)}")
    box = (
        '<div style="position:fixed;left:12px;bottom:64px;z-index:9;font:13px sans-serif;background:#ffffffcc;'
        f'padding:8px;border-radius:6px;pointer-events:none">{"<br>".join(rows)}</div>'
    )
    page = re.sub(r"<title>.*?</title>", lambda _: f"<title>{escape(scene.title)}</title>", page, count=1, flags=re.S)
    before, body, after = page.rpartition("</body>")
    return f"{before}{box}{body}{after}" if body else page + box


def _durations(seconds: list[float]) -> Iterator[tuple[int, float]]:
    """Yield each frame with its duration."""
    for frame in range(len(seconds)):
        yield frame, seconds[frame + 1] - seconds[frame] if frame + 1 < len(seconds) else _PACE.pause
