"""A running tracker in the browser: every frame is shown when it is done."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchreg.datasets.hand import faces_of
from torchreg.geometry.upright import Direction
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.tracking.results import FrameResult
from torchreg.viz.posed_scenes import frame_label, inlier_paint
from torchreg.viz.scene import PREDICTED_COLOR, SKIN_COLOR, Cloud, Layer, MovingMesh, Scene
from torchreg.viz.viser_nodes import as_bytes, as_floats
from torchreg.viz.viser_server import Page, point_camera

if TYPE_CHECKING:
    import viser


class LiveTrack(Page):
    """A page that shows the last frame of a tracker; usable in a ``with`` statement, at whose end the server stops."""

    def __init__(self, skin: LinearBlendSkin, *, port: int = 8080, up: Direction | None = None) -> None:
        self._skin, self._faces, self._up = skin, faces_of(skin).cpu(), up
        super().__init__("torchreg track", port)
        self._label = self.server.gui.add_markdown("waiting for the first frame")
        self._surface: viser.MeshHandle | None = None
        self._cloud: viser.PointCloudHandle | None = None

    def show(self, points: Tensor, frame: FrameResult) -> None:
        """Show the data (M, 3) of a frame and the tracker's result; the first frame with data places the camera."""
        known = points.isfinite().all(-1).cpu()
        data = points.detach().cpu()[known]
        paint = inlier_paint(frame.inliers.cpu()[known], torch.ones(len(data)))
        found = bool(frame.pose.isfinite().all())
        usable = frame.statuses[0].usable
        vertices = None
        if found:
            with torch.no_grad():
                vertices = self._skin(frame.pose).detach().cpu()
        if self._cloud is None and (len(data) or found):
            self._begin(data, paint, vertices)
        with self.server.atomic():
            self._update_surface(vertices, usable)
            if self._cloud is not None:
                self._cloud.points, self._cloud.colors = as_floats(data), as_bytes(paint)
        self._label.content = frame_label(frame.frame, frame.statuses[0], frame.acquired)

    def _begin(self, data: Tensor, paint: Tensor, vertices: Tensor | None) -> None:
        """Draw the first frame that is not empty, and point the camera at it."""
        layers: list[Layer] = [Cloud("data", [data], [paint])]
        if vertices is not None:
            layers.append(MovingMesh("shape", vertices, self._faces))
        scene = Scene("track", tuple(layers), up=self._up)
        self._cloud = self.server.scene.add_point_cloud(
            "/data", as_floats(data), as_floats(paint), point_size=0.006 * scene.diagonal, point_shape="circle",
            precision="float32", point_shading="flat",
        )  # fmt: skip
        point_camera(self.server, scene)

    def _update_surface(self, vertices: Tensor | None, usable: bool) -> None:
        if vertices is not None and self._surface is None:
            options: dict[str, Any] = {"side": "double", "cast_shadow": False, "receive_shadow": False}
            self._surface = self.server.scene.add_mesh_simple(
                "/shape", as_floats(vertices), self._faces.numpy(), color=SKIN_COLOR, **options
            )
        if self._surface is not None:
            self._surface.visible = vertices is not None
            if vertices is not None:
                self._surface.vertices = as_floats(vertices)
                red, green, blue = SKIN_COLOR if usable else PREDICTED_COLOR
                self._surface.color = round(255 * red), round(255 * green), round(255 * blue)
