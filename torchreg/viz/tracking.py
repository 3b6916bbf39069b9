"""Tracked sequences as pictures of single frames, as moving pictures, and as moving shapes for glTF viewers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from torch import Tensor

from torchreg._checks import check_positive, check_shape
from torchreg.errors import InputError
from torchreg.geometry.upright import Direction
from torchreg.geometry.visibility import View
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.tracking.results import FrameResult, TrackResult
from torchreg.viz.animation import animate_scene, check_animation_path
from torchreg.viz.figures import save_scene, scene_view
from torchreg.viz.gltf import save_shape_animation
from torchreg.viz.posed_scenes import coarse_skin, frame_label, frame_labels, near_surface, posed_scene


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
        status = result.statuses[0]
        scene = posed_scene(
            self._shape, result.pose[None], [data], [result.inliers], skin=self._skin, usable=[status.usable],
            captions=[frame_label(result.frame, status, result.acquired)], up=self._up,
        )  # fmt: skip
        # The margin keeps the view while the shape moves a little.
        if self._view is None or not _shows(self._view, scene.sample()):
            self._view = scene_view(scene, size=self._size, margin=0.2)
        return save_scene(path, scene, view=self._view)


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
    up: Direction | None = None,
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
        inlier_distance: from the surface, metres; 2 % of the size of the shape by default.
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
    if not len(frames):
        raise InputError("frames must hold at least one cloud, got none")
    if inlier_distance is not None:
        check_positive(inlier_distance, "inlier_distance")
    masks = near_surface(shape, result.poses, inlier_distance) if inliers is None else inliers
    scene = posed_scene(
        shape, result.poses, frames, masks, skin=skin, usable=[status.usable for status in result.statuses],
        captions=frame_labels(result), up=up,
    )  # fmt: skip
    view = scene_view(scene, camera=camera, size=size, margin=0.1)
    return animate_scene(path, scene, fps, view=view, on_frame=on_frame)


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
    return save_shape_animation(path, shape, result.poses, result.times - result.times[0], skin=skin, up=up)


def _shows(view: View, points: Tensor) -> bool:
    """Return whether a view shows all points (N, 3)."""
    pixels, _ = view.project(points)
    return bool(((pixels >= 0) & (pixels <= pixels.new_tensor([view.width, view.height]))).all())
