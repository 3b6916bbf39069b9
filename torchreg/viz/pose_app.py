"""The posing application: a registered scan in the browser whose points are dragged."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchreg.errors import TorchregError
from torchreg.viz.latest_worker import LatestWorker
from torchreg.viz.picking import pick_vertex
from torchreg.viz.pose_editor import PoseEditor
from torchreg.viz.scene import Cloud, MovingMesh, Scene
from torchreg.viz.viser_nodes import as_floats, draw_patches
from torchreg.viz.viser_server import Page, point_camera

if TYPE_CHECKING:
    import viser

_HELP = (
    "Click a point of the shape to make it a handle, then drag its arrows. "
    "Pinned handles (blue) stay where they are while others are dragged; the rest follow."
)


@dataclass(frozen=True)
class _PageStyle:
    """Sizes, as shares of the diagonal of the scan, and colors of handles and points."""

    arrows: float = 0.12
    ball: float = 0.008
    point: float = 0.006
    free: tuple[int, int, int] = (230, 80, 40)
    pinned: tuple[int, int, int] = (40, 90, 200)
    frame_rate: int = 30  # of played key poses, per second


_STYLE = _PageStyle()


class PoseApp(Page):
    """A page on which a registered scan is posed; usable in a ``with`` statement, at whose end the server stops.

    Dragging only stores the newest target: one thread solves, from the previous pose, and moves the shape, so that no
    drag waits for a solution and none is solved twice.

    Args:
        editor: of the posed scan.
        output: name of files without their endings .safetensors, .ply and .glb; a number is added if one exists.
        port: to listen on at 127.0.0.1, or a later one if it is taken.
    """

    def __init__(self, editor: PoseEditor, *, output: str | Path = "posed", port: int = 8080) -> None:
        self.editor = editor
        self._output = Path(output)
        super().__init__("torchreg pose", port)
        self._lock = threading.RLock()
        self._gizmos: list[viser.TransformControlsHandle] = []
        self._balls: list[viser.IcosphereHandle] = []
        self._selected = -1
        self._stopped, self._playing = threading.Event(), threading.Event()
        self.worker: LatestWorker[int, Tensor] = LatestWorker(self._solve, self._tell_error, "torchreg pose solver")
        self._update_shape = self._draw_shape()
        self._add_controls()
        point_camera(self.server, self._scene())
        self._refresh()

    @property
    def selected(self) -> int:
        """Number of the handle that the buttons act on, -1 without one."""
        return self._selected

    def close(self) -> None:
        """Stop the threads and the server."""
        self._stopped.set()
        self._playing.clear()
        self.worker.close()
        super().close()

    def pick(self, origin: Tensor, direction: Tensor) -> int | None:
        """Make the point that a ray points at a handle and return its number; None if there is no such point."""
        vertex = pick_vertex(self.editor.moved(), self.editor.faces, origin, direction)
        if vertex is None:
            return None
        self.worker.drop()
        with self._lock:
            self._selected = self.editor.add_handle(vertex)
            self._refresh()
        return self._selected

    def drag(self, number: int, target: Tensor) -> None:
        """Ask for a handle to be moved to a target (3,), without waiting."""
        self._playing.clear()
        self.worker.submit(number, target)

    def release(self, number: int, target: Tensor) -> None:
        """Move a handle to a last target (3,) and make the whole drag a step of undo."""
        self.worker.submit(number, target)
        self.worker.flush()
        self.editor.commit()
        with self._lock:
            self._refresh()

    def play(self) -> None:
        """Play the key poses once, without changing the pose."""
        poses = self.editor.animation()
        self._playing.set()
        for pose in poses:
            if not self._playing.is_set() or self._stopped.wait(1 / _STYLE.frame_rate):
                break
            self._update_shape(self.editor.moved(pose))
        self._playing.clear()
        if not self._stopped.is_set():
            self._update_shape(self.editor.moved())

    def _solve(self, targets: Mapping[int, Tensor]) -> None:
        """Solve for the newest targets and show the solution; runs on the worker's thread alone."""
        self.editor.drag(targets)
        self._update_shape(self.editor.moved())
        with self._lock:
            for number, gizmo in enumerate(self._gizmos):
                if number not in targets:
                    gizmo.position = as_floats(self.editor.state.targets[number])

    def _scene(self) -> Scene:
        editor = self.editor
        if editor.faces is not None and len(editor.faces):
            return Scene("pose", (MovingMesh("shape", editor.moved(), editor.faces, editor.colors),), up=self.editor.up)
        return Scene("pose", (Cloud("shape", [editor.moved()], [editor.colors]),), up=self.editor.up)

    def _draw_shape(self) -> Callable[[Tensor], None]:
        """Draw the shape and return the function that moves its points."""
        (layer,) = self._scene().layers
        if isinstance(layer, MovingMesh):
            patches = draw_patches(self.server.scene, "/shape", layer)
            for node, _ in patches:
                node.on_click(self._clicked)

            def move(points: Tensor) -> None:
                positions = as_floats(points)
                for node, index in patches:
                    node.vertices = positions[index]

            return move
        node = self.server.scene.add_point_cloud(
            "/shape", as_floats(layer.points(0)), as_floats(self.editor.colors), precision="float32",
            point_size=_STYLE.point * self.editor.diagonal, point_shape="circle",
        )  # fmt: skip
        # Nodes of points take no clicks, the page does.
        self.server.scene.on_click()(self._clicked)

        def move_points(points: Tensor) -> None:
            node.points = as_floats(points)

        return move_points

    def _clicked(self, event: Any) -> None:
        origin, direction = _vector(event.ray_origin), _vector(event.ray_direction)
        if origin is not None and direction is not None:
            self.pick(origin, direction)

    def _add_controls(self) -> None:
        gui = self.server.gui
        gui.add_markdown(_HELP)
        with gui.add_folder("Handle"):
            self._name = gui.add_markdown("")
            self._pinned = gui.add_checkbox("Pinned", initial_value=False)
            self._pinned.on_update(lambda _: self._pin(bool(self._pinned.value)))
            self._button("Remove", self._remove)
        with gui.add_folder("Steps"):
            self._button("Undo", self._step(self.editor.undo))
            self._button("Redo", self._step(self.editor.redo))
            self._button("Reset", self._step(self.editor.reset))
        with gui.add_folder("Key poses"):
            self._keys = gui.add_markdown("none")
            self._button("Add key pose", self._keyed(self.editor.add_key))
            self._button("Remove last", self._keyed(self.editor.remove_key))
            self._button("Play", self.play)
        with gui.add_folder("Files"):
            self._button("Save pose", lambda: self._write(".safetensors", self.editor.save_pose))
            self._button("Export PLY", lambda: self._write(".ply", self.editor.save_ply))
            self._button("Export glTF", lambda: self._write(".glb", self.editor.save_gltf))
        self._status = gui.add_markdown("")

    def _button(self, label: str, act: Callable[[], object]) -> None:
        def clicked(_: object) -> None:
            try:
                act()
            except (TorchregError, OSError) as error:
                self._tell_error(error)

        self.server.gui.add_button(label).on_click(clicked)

    def _step(self, act: Callable[[], object]) -> Callable[[], None]:
        """Return the action of a button that changes the state: it waits for the running solution."""

        def go() -> None:
            self.worker.drop()
            act()
            with self._lock:
                self._selected = min(self._selected, len(self.editor.state.vertices) - 1)
                self._refresh()

        return go

    def _keyed(self, act: Callable[[], int]) -> Callable[[], None]:
        def go() -> None:
            self._keys.content = f"{act()} key poses"

        return go

    def _pin(self, pinned: bool) -> None:
        number = self._selected
        if number >= 0 and self.editor.state.pinned[number] != pinned:
            self._step(lambda: self.editor.pin(number, pinned))()

    def _remove(self) -> None:
        number = self._selected
        if number >= 0:
            self._step(lambda: self.editor.remove_handle(number))()

    def _write(self, ending: str, save: Callable[[Path], Path]) -> None:
        path = self._output.with_name(self._output.name + ending)
        number = 2
        while path.exists():
            path = self._output.with_name(f"{self._output.name}_{number}{ending}")
            number += 1
        self._status.content = f"wrote {save(path)}"

    def _tell_error(self, error: Exception) -> None:
        self._status.content = f"**{error}**"

    def _refresh(self) -> None:
        """Show shape, handles and buttons in the editor's state."""
        state = self.editor.state
        self._update_shape(self.editor.moved())
        while len(self._gizmos) > len(state.vertices):
            self._gizmos.pop().remove()
            self._balls.pop()
        while len(self._gizmos) < len(state.vertices):
            self._gizmos.append(self._add_gizmo(len(self._gizmos)))
        for number, (gizmo, pinned) in enumerate(zip(self._gizmos, state.pinned, strict=True)):
            gizmo.position = as_floats(state.targets[number])
            self._balls[number].color = _STYLE.pinned if pinned else _STYLE.free
        chosen = 0 <= self._selected < len(state.vertices)
        self._name.content = f"handle {self._selected + 1} of {len(state.vertices)}" if chosen else "none yet"
        self._pinned.value = chosen and state.pinned[self._selected]  # type: ignore[misc]
        if state.solution is not None:
            residual = float(state.solution.residuals.max()) / self.editor.diagonal
            milliseconds = 1000 * self.worker.median_seconds
            self._status.content = f"handles miss by {residual:.2%} of the size; {milliseconds:.0f} ms per pose"

    def _add_gizmo(self, number: int) -> viser.TransformControlsHandle:
        size = self.editor.diagonal
        gizmo = self.server.scene.add_transform_controls(
            f"/handles/{number}", scale=_STYLE.arrows * size, disable_rotations=True, depth_test=False
        )
        ball = self.server.scene.add_icosphere(
            f"/handles/{number}/ball", radius=_STYLE.ball * size, color=_STYLE.free, cast_shadow=False,
            receive_shadow=False,
        )  # fmt: skip
        ball.on_click(lambda _: self._select(number))
        self._balls.append(ball)

        # Runs on the loop of the server, in the order of the mouse, and must not wait.
        async def moved(event: viser.TransformControlsEvent) -> None:
            target = _vector(event.target.position)
            if target is None:
                return
            if event.phase == "start":
                self._select(number)
            elif event.phase == "end":
                threading.Thread(target=self.release, args=(number, target), daemon=True).start()
            else:
                self.drag(number, target)

        gizmo.on_update(moved)
        return gizmo

    def _select(self, number: int) -> None:
        with self._lock:
            self._selected = number
            state = self.editor.state
            self._name.content = f"handle {number + 1} of {len(state.vertices)}"
            self._pinned.value = state.pinned[number]  # type: ignore[misc]


def _vector(value: Any) -> Tensor | None:
    """Return three finite numbers that a page sent (3,), None for anything else."""
    try:
        numbers = torch.as_tensor(np.asarray(value, dtype=np.float64))
    except (TypeError, ValueError, OverflowError):
        return None
    return numbers if numbers.shape == (3,) and bool(numbers.isfinite().all()) else None
