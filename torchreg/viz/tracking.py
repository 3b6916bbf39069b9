"""Pictures of tracked sequences: one frame, all of them as a moving picture, the moving shape for glTF viewers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_positive, check_shape
from torchreg.alignment.problem import INLIER_SHARE
from torchreg.errors import InputError
from torchreg.geometry.visibility import View
from torchreg.result import Status
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.tracking.results import FrameResult, TrackResult
from torchreg.viz.animation import check_animation_path, coarse_skin, common_view, save_animation
from torchreg.viz.figures import (
    INLIER_COLOR,
    OUTLIER_COLOR,
    draw_mesh,
    draw_points,
    new_figure,
    posed_mesh,
    save_picture,
    watch,
)
from torchreg.viz.gltf import save_shape_animation

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# A pose that no data support is drawn in gray.
_HELD_COLOR = (0.72, 0.73, 0.76)
_POINT_SIZE, _FONT_SIZE = 2.8, 9.0
# Room left on each side, so that a shape that moves a little does not move the view.
_MARGIN = 0.2


def draw_track_frame(
    ax: Axes,
    shape: ArticulatedShape,
    pose: Tensor,
    data: Tensor,
    inliers: Tensor,
    *,
    skin: LinearBlendSkin,
    view: View,
    held: bool = False,
    label: str = "",
    point_size: float = _POINT_SIZE,
) -> None:
    """Put a tracked frame on axes: the surface, gray where no data support it, blue inliers, gray outliers, a label.

    Args:
        ax: where to draw; its coordinates become the view's pixels.
        shape: the articulated shape.
        pose: (num_dofs,); without a finite one only the data are drawn.
        data: (M, 3), metres; points that are not finite are left out.
        inliers: (M,) bool.
        skin: the surface to draw, with faces.
        view: camera and pixels.
        held: whether no data support the pose.
        label: text in the lower left corner.
        point_size: diameter of a data point, points (1/72 inch).

    Raises:
        InputError: if sizes do not fit.
    """
    data = as_float_tensor(data, "data").detach().cpu()
    check_shape(data, "data", ("M", 3))
    check_shape(inliers, "inliers", (len(data),))
    finite = data.isfinite().all(-1)
    data, inliers = data[finite], inliers.cpu()[finite]
    if bool(pose.isfinite().all()):
        mesh = posed_mesh(shape, pose, skin)
        paint = mesh.vertices.new_tensor(_HELD_COLOR).expand(mesh.num_vertices, 3) if held else None
        draw_mesh(ax, mesh, view, paint)
        draw_points(ax, mesh, view, data, inliers, tolerance=2 * shape.nu, point_size=point_size, color=INLIER_COLOR)
    else:
        at = view.project(data)[0].numpy()
        ax.scatter(at[:, 0], at[:, 1], s=(0.6 * point_size) ** 2, c=OUTLIER_COLOR, linewidths=0)
        ax.set_aspect("equal")
    ax.set_xlim(0, view.width)
    ax.set_ylim(view.height, 0)
    ax.text(0.02, 0.02, label, transform=ax.transAxes, fontsize=_FONT_SIZE, color="#444444", va="bottom")


def frame_label(frame: int, status: Status, acquired: str) -> str:
    """Return what a picture says about a frame: its number, and what led to its pose or why there is none."""
    return f"{frame}  {acquired if status.usable else status.value.replace('_', ' ')}"


class FrameOverlays:
    """Draws the frames of a running tracker, one picture each; the view stays until the shape leaves it.

    Args:
        shape: the articulated shape.
        skin: the surface to draw, with faces; by default a coarse one, which is made once.
        size: width and height, pixels.
    """

    def __init__(
        self, shape: ArticulatedShape, skin: LinearBlendSkin | None = None, size: tuple[int, int] = (480, 480)
    ) -> None:
        self._shape, self._size = shape, size
        self._skin = coarse_skin(shape) if skin is None else skin
        self._view: View | None = None

    def save(self, path: str | Path, data: Tensor, result: FrameResult) -> Path:
        """Return the path of a picture of a frame: the data (M, 3) and what the tracker made of them.

        Args:
            path: where to (.png, .pdf, .svg); the file is written whole or not at all.
            data: (M, 3) what the tracker was given, metres.
            result: what it returned.

        Raises:
            InputError: if sizes do not fit or the suffix is another.
            FileNotFoundError: if the folder does not exist.
        """
        self._view = self._follow(data, result.pose)
        figure, (ax,) = new_figure(*self._size)
        status = result.statuses[0]
        draw_track_frame(
            ax, self._shape, result.pose, data, result.inliers, skin=self._skin, view=self._view,
            held=not status.usable, label=frame_label(result.frame, status, result.acquired),
        )  # fmt: skip
        return save_picture(figure, path)

    def _follow(self, data: Tensor, pose: Tensor) -> View:
        if bool(pose.isfinite().all()):
            points = posed_mesh(self._shape, pose, self._skin).vertices
        else:
            points = data[data.isfinite().all(-1)]
        if self._view is not None and _shows(self._view, points):
            return self._view
        # A frame without anything in it has some view.
        return watch(points if len(points) else self._skin.points, size=self._size, margin=_MARGIN)


def animate_track(
    path: str | Path,
    shape: ArticulatedShape,
    result: TrackResult,
    frames: Sequence[Tensor],
    *,
    inliers: Sequence[Tensor] | None = None,
    inlier_distance: float | None = None,
    fps: float = 20.0,
    skin: LinearBlendSkin | None = None,
    camera: Tensor | None = None,
    up: Tensor | None = None,
    size: tuple[int, int] = (360, 360),
    on_frame: Callable[[int, int], None] | None = None,
) -> Path:
    """Return the path of a moving picture of a tracked sequence.

    Args:
        path: where to write; see `save_animation`.
        shape: the articulated shape.
        result: T frames of it.
        frames: T clouds (M_t, 3), metres, each read when it is drawn.
        inliers: T masks (M_t,); by default the data near the surface are inliers.
        inlier_distance: how near, metres; 2 % of the size of the skin by default.
        fps: frames per second.
        skin: the surface to draw, with faces; by default a coarse one.
        camera: (3,) position, see `watch`; it stays where it is.
        up: (3,) see `watch`.
        size: width and height, pixels.
        on_frame: is told (frames done, all frames) after each.

    Returns:
        The path written.

    Raises:
        InputError: if the numbers of poses, clouds and masks differ, or as for `save_animation`.

    Cost: about 0.1 s and 25 kB per frame.
    """
    path = check_animation_path(path)
    check_shape(result.poses, "result.poses", (len(frames), shape.num_dofs))
    if inliers is not None and len(inliers) != len(frames):
        raise InputError(f"inliers must hold one mask per frame ({len(frames)}), got {len(inliers)}")
    if not len(frames):
        raise InputError("frames must hold at least one cloud, got none")
    surface = coarse_skin(shape) if skin is None else skin
    reach = INLIER_SHARE * _size(surface) if inlier_distance is None else inlier_distance
    check_positive(reach, "inlier_distance")
    poses = result.poses.to(shape.rest)
    found = poses.isfinite().all(-1)
    if bool(found.any()):
        view = common_view(surface, poses[found], camera, up, size)
    else:
        view = watch(_first_points(frames, surface), camera=camera, up=up, size=size)

    def draw(index: int) -> Callable[[Axes], object]:
        def on(ax: Axes) -> None:
            data = frames[index].to(poses)
            near = _near(shape, poses[index], data, reach) if inliers is None else inliers[index]
            status = result.statuses[index]
            draw_track_frame(
                ax, shape, poses[index], data, near, skin=surface, view=view, held=not status.usable,
                label=frame_label(index, status, result.acquired[index]),
            )  # fmt: skip

        return on

    return save_animation(path, [draw(index) for index in range(len(frames))], fps, size=size, on_frame=on_frame)


def save_track_gltf(
    path: str | Path, shape: ArticulatedShape, result: TrackResult, *, skin: LinearBlendSkin | None = None
) -> Path:
    """Return the path of a .glb file in which the shape's skinned surface moves as tracked, from where it was found on.

    Args:
        path: where to write; the suffix must be .glb.
        shape: the articulated shape.
        result: of a tracker of it; its times are taken for seconds, the earliest for none.
        skin: the surface, with faces; by default `surface_skin`, which is made anew at every call.

    Raises:
        InputError: if sizes do not fit, the suffix is not .glb, the skin has no faces or the shape was never found.
    """
    check_shape(result.poses, "result.poses", ("T", shape.num_dofs))
    found = result.poses.isfinite().all(-1)
    if not bool(found.any()):
        raise InputError("result must hold a pose to be written, but the shape was never found")
    times = (result.times - result.times[0])[found]
    return save_shape_animation(path, shape, result.poses[found], times, skin=skin)


def _near(shape: ArticulatedShape, pose: Tensor, data: Tensor, reach: float) -> Tensor:
    near = data.isfinite().all(-1)
    if bool(near.any()) and bool(pose.isfinite().all()):
        with torch.no_grad():
            near[near.clone()] = shape.distance(data[near], pose).abs() < reach
        return near.cpu()
    return torch.zeros_like(near).cpu()


def _size(skin: LinearBlendSkin) -> float:
    return float((skin.points.amax(0) - skin.points.amin(0)).norm())


def _shows(view: View, points: Tensor) -> bool:
    pixels, _ = view.project(points)
    inside = (pixels >= 0) & (pixels <= pixels.new_tensor([view.width, view.height]))
    return bool(inside.all())


def _first_points(frames: Sequence[Tensor], skin: LinearBlendSkin) -> Tensor:
    """Return the finite points of the first frame that has any, else the skin's: a view needs something to show."""
    clouds = (frame[frame.isfinite().all(-1)] for frame in frames)
    return next((cloud for cloud in clouds if len(cloud)), skin.points)
