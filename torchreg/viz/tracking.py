"""Tracked sequences as pictures of single frames, as moving pictures, and as moving shapes for glTF viewers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchreg._checks import check_positive, check_shape
from torchreg.alignment.problem import INLIER_SHARE
from torchreg.errors import InputError
from torchreg.geometry.upright import Direction
from torchreg.geometry.visibility import View
from torchreg.result import Status
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.tracking.results import FrameResult, TrackResult
from torchreg.viz.animation import (
    MOVIE_POINT_SIZE,
    check_animation_path,
    coarse_skin,
    common_view,
    save_animation,
)
from torchreg.viz.figures import (
    OUTLIER_COLOR,
    draw_mesh,
    draw_points,
    new_figure,
    posed_mesh,
    save_picture,
    show_pixels,
    watch,
)
from torchreg.viz.gltf import save_shape_animation

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Gray of a surface whose pose is predicted, without support by data.
PREDICTED_COLOR = (0.72, 0.73, 0.76)


def draw_track_frame(
    ax: Axes,
    shape: ArticulatedShape,
    pose: Tensor,
    data: Tensor,
    inliers: Tensor,
    *,
    skin: LinearBlendSkin,
    view: View,
    predicted: bool = False,
    label: str = "",
) -> None:
    """Draw a tracked frame: the surface, gray if its pose is predicted, blue inliers, gray outliers, a label.

    Args:
        ax: to draw on; its coordinates become the view's pixels.
        shape: the articulated shape.
        pose: (num_dofs,); without a finite one only the data are drawn.
        data: (M, 3), metres; points that are not finite are omitted.
        inliers: (M,) bool.
        skin: the surface to draw, with faces.
        view: camera and pixels.
        predicted: whether the pose is predicted, without support by data.
        label: text in the lower left corner.
    """
    data = data.detach().cpu()
    check_shape(inliers, "inliers", (len(data),))
    finite = data.isfinite().all(-1)
    data, inliers = data[finite], inliers.cpu()[finite]
    if bool(pose.isfinite().all()):
        mesh = posed_mesh(shape, pose, skin)
        paint = mesh.vertices.new_tensor(PREDICTED_COLOR).expand(mesh.num_vertices, 3) if predicted else None
        draw_mesh(ax, mesh, view, paint)
        draw_points(ax, mesh, view, data, inliers, tolerance=2 * shape.nu, point_size=MOVIE_POINT_SIZE)
    else:
        x, y = view.project(data)[0].numpy().T
        ax.scatter(x, y, s=(0.6 * MOVIE_POINT_SIZE) ** 2, c=OUTLIER_COLOR, linewidths=0)
        ax.set_aspect("equal")
    show_pixels(ax, view)
    ax.text(0.02, 0.02, label, transform=ax.transAxes, fontsize=9.0, color="#444444", va="bottom")


def frame_label(frame: int, status: Status, acquired: str) -> str:
    """Return the label of a frame: its number, and the stage that acquired its pose, or its status without one."""
    return f"frame {frame}: {acquired if status.usable else status.value}"


class FrameOverlays:
    """Draws the frames of a running tracker, one picture each, in one view until the shape leaves it.

    Args:
        shape: the articulated shape.
        skin: the surface to draw, with faces; by default a coarse one, which is made once.
        size: width and height, pixels.
        up: the upright direction, see `watch`.
    """

    def __init__(
        self, shape: ArticulatedShape, skin: LinearBlendSkin | None = None, size: tuple[int, int] = (480, 480),
        up: Direction | None = None,
    ) -> None:  # fmt: skip
        self._shape, self._size, self._up = shape, size, up
        self._skin = coarse_skin(shape) if skin is None else skin
        self._view: View | None = None

    def save(self, path: str | Path, data: Tensor, result: FrameResult) -> Path:
        """Return the path of a picture of a frame: its data (M, 3) and the tracker's result for them.

        Args:
            path: to write (.png, .pdf, .svg); the file is written whole or not at all.
            data: (M, 3) of the frame, metres.
            result: of the tracker.
        """
        self._view = self._follow(data, result.pose)
        figure, (ax,) = new_figure(*self._size)
        status = result.statuses[0]
        draw_track_frame(
            ax, self._shape, result.pose, data, result.inliers, skin=self._skin, view=self._view,
            predicted=not status.usable, label=frame_label(result.frame, status, result.acquired),
        )  # fmt: skip
        return save_picture(figure, path)

    def _follow(self, data: Tensor, pose: Tensor) -> View:
        """Return the view of the frame before, or a new one if it does not show the shape, or the data without it."""
        if bool(pose.isfinite().all()):
            points = posed_mesh(self._shape, pose, self._skin).vertices
        else:
            points = data[data.isfinite().all(-1)]
        if self._view is not None and _shows(self._view, points):
            return self._view
        # The margin keeps the view while the shape moves a little; an empty frame shows the skin's reference pose.
        return watch(points if len(points) else self._skin.points, up=self._up, size=self._size, margin=0.2)


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
    up: Tensor | Direction | None = None,
    size: tuple[int, int] = (360, 360),
    on_frame: Callable[[int, int], None] | None = None,
) -> Path:
    """Return the path of a moving picture of a tracked sequence.

    Args:
        path: to write; see `save_animation`.
        shape: the articulated shape.
        result: T frames of it.
        frames: T clouds (M_t, 3), metres, each read when it is drawn.
        inliers: T masks (M_t,); by default data near the surface.
        inlier_distance: from the surface, metres; 2 % of the size of the skin by default.
        fps: frames per second.
        skin: the surface to draw, with faces; by default a coarse one.
        camera: (3,) position in all frames, see `watch`.
        up: (3,) see `watch`.
        size: width and height, pixels.
        on_frame: called with (frames done, all frames) after each.

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
        def draw_frame(ax: Axes) -> None:
            data = frames[index].to(poses)
            near = _near(shape, poses[index], data, reach) if inliers is None else inliers[index]
            status = result.statuses[index]
            draw_track_frame(
                ax, shape, poses[index], data, near, skin=surface, view=view, predicted=not status.usable,
                label=frame_label(index, status, result.acquired[index]),
            )  # fmt: skip

        return draw_frame

    return save_animation(path, [draw(index) for index in range(len(frames))], fps, size=size, on_frame=on_frame)


def save_track_gltf(
    path: str | Path, shape: ArticulatedShape, result: TrackResult, *, skin: LinearBlendSkin | None = None,
    up: Direction | None = None,
) -> Path:  # fmt: skip
    """Return the path of a .glb file in which the shape's skinned surface moves as tracked, in frames with a pose.

    Args:
        path: to write; the suffix must be .glb.
        shape: the articulated shape.
        result: of a tracker of it, with times in seconds, counted from the first.
        skin: the surface, with faces; by default `surface_skin`, which is made anew at every call.
        up: the axis that is upright, turned to glTF's y; left as it is by default.

    Raises:
        InputError: if sizes do not fit, the suffix is not .glb, the skin has no faces or the shape was never found.
    """
    check_shape(result.poses, "result.poses", ("T", shape.num_dofs))
    found = result.poses.isfinite().all(-1)
    if not bool(found.any()):
        raise InputError("result must hold a pose to be written, but the shape was never found")
    times = (result.times - result.times[0])[found]
    return save_shape_animation(path, shape, result.poses[found], times, skin=skin, up=up)


def _near(shape: ArticulatedShape, pose: Tensor, data: Tensor, reach: float) -> Tensor:
    """Return the mask (M,) of data within a distance of the surface; none without a pose."""
    near = data.isfinite().all(-1)
    if bool(near.any()) and bool(pose.isfinite().all()):
        with torch.no_grad():
            near[near.clone()] = shape.distance(data[near], pose).abs() < reach
        return near.cpu()
    return torch.zeros_like(near).cpu()


def _size(skin: LinearBlendSkin) -> float:
    return float((skin.points.amax(0) - skin.points.amin(0)).norm())


def _shows(view: View, points: Tensor) -> bool:
    """Return whether a view shows all points (N, 3)."""
    pixels, _ = view.project(points)
    inside = (pixels >= 0) & (pixels <= pixels.new_tensor([view.width, view.height]))
    return bool(inside.all())


def _first_points(frames: Sequence[Tensor], skin: LinearBlendSkin) -> Tensor:
    """Return the finite points (N, 3) of the first frame that has any, else those of the skin."""
    clouds = (frame[frame.isfinite().all(-1)] for frame in frames)
    return next((cloud for cloud in clouds if len(cloud)), skin.points)
