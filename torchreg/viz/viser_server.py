"""Pages served to this machine alone: a viser server, its camera and its lights."""

from __future__ import annotations

import contextlib
import io
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from torchreg.errors import MissingExtraError
from torchreg.viz.page_guard import PageGuard
from torchreg.viz.scene import FIELD_OF_VIEW, Scene

if TYPE_CHECKING:
    import viser

Point = NDArray[np.floating]

HOST = "127.0.0.1"


class Page:
    """A page on a server; usable in a ``with`` statement, at whose end the server stops."""

    def __init__(self, title: str, port: int) -> None:
        self.server = start_server(title, port)

    @property
    def url(self) -> str:
        """Address for a browser on this machine."""
        return page_url(self.server)

    def close(self) -> None:
        """Stop the server, and what draws on it."""
        stop_server(self.server)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def import_viser() -> Any:
    """Return the module viser; MissingExtraError, which names the extra, where it is not installed."""
    try:
        import viser
    except ImportError as error:
        raise MissingExtraError(
            "the viewer needs viser; install it with: pip install 'torchreg-articulated[viewer]'"
        ) from error
    return viser


def start_server(title: str, port: int) -> viser.ViserServer:
    """Return a server on 127.0.0.1, which other machines cannot reach, which contacts none, and lets in `page_url`."""
    library = import_viser()
    guard = PageGuard()
    with contextlib.redirect_stdout(io.StringIO()), guard.around_start():  # viser greets
        server: viser.ViserServer = library.ViserServer(host=HOST, port=port, label=title, verbose=False)
    if not guard.engaged:
        stop_server(server)
        raise MissingExtraError("the viewer cannot be guarded with this viser; install viser 1.1 to 1.x")
    setattr(server, "page_guard", guard)  # noqa: B010
    # Sharing would open a tunnel through a foreign server.
    setattr(server, "request_share_url", lambda verbose=True: None)  # noqa: B010
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    server.gui.main_panel.dock_right()  # beside the scene, whose middle it would cover in small windows
    server.scene.configure_environment_map(None)
    return server


def page_url(server: viser.ViserServer) -> str:
    """Return the address of the page for a browser on this machine, the only one that lets in."""
    guard: PageGuard = getattr(server, "page_guard")  # noqa: B009
    return guard.url(HOST, server.get_port())


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server without printing."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def point_camera(server: viser.ViserServer, scene: Scene) -> None:
    """Point the camera of new windows at a scene, with all of it in view."""
    position, target, up = scene.camera()
    server.scene.set_up_direction(tuple(up.tolist()))
    camera, size = server.initial_camera, scene.diagonal
    camera.fov, camera.near, camera.far = FIELD_OF_VIEW, 0.01 * size, 100 * size
    camera.position, camera.look_at, camera.up = position.numpy(), target.numpy(), up.numpy()
    _add_lights(server, position.numpy(), target.numpy(), up.numpy())


def _add_lights(server: viser.ViserServer, position: Point, target: Point, up: Point) -> None:
    """Light a scene from above and from the camera's side, without shadows."""
    server.scene.configure_default_lights(enabled=False)
    server.scene.add_light_hemisphere(
        "/lights/sky", sky_color=(255, 255, 255), ground_color=(150, 150, 160), intensity=1.6
    )
    right = np.cross(target - position, up)
    for name, lamp, strength in (("key", position + 0.8 * right + up, 2.2), ("back", 2 * target - position + up, 0.7)):
        direction = tuple(lamp - target)
        server.scene.add_light_directional(
            f"/lights/{name}", color=(255, 255, 255), intensity=strength, position=direction, cast_shadow=False
        )
