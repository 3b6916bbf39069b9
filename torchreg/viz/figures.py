"""Pictures of scenes: shaded surfaces with points and curves, and those of the README and of the paper."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_points
from torchreg.datasets.hand import hand_motion, make_hand_cloud, surface_skin
from torchreg.errors import InputError
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.mesh import TriangleMesh, concatenate, interpolate
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.upright import Direction
from torchreg.geometry.visibility import View, aim, visible_points
from torchreg.io.atomic import write_atomic
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.skin import BendingSkin
from torchreg.viz.posed_scenes import posed_scene
from torchreg.viz.rendering import OVERSAMPLING, render_mesh
from torchreg.viz.scene import SKIN_COLOR, Cloud, Curves, Meshes, MovingMesh, Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class _Marks:
    """Points and curves in pictures."""

    point: float = 1.7  # diameter of points, in those of pages
    hidden: float = 0.2  # opacity of points behind a surface
    behind: float = 0.02  # depth behind the surface from which they are, as a share of the diagonal of the scene
    curve: float = 2.2  # width of curves, points (1/72 inch)


_MARKS = _Marks()


def watch(
    points: Tensor,
    *,
    camera: Tensor | None = None,
    up: Tensor | Direction | None = None,
    size: tuple[int, int] = (480, 480),
    margin: float = 0.08,
) -> View:
    """Return a view for pictures that shows all given points.

    Args:
        points: (N, 3), metres.
        camera: (3,) position; by default that of `Scene.camera`.
        up: (3,) upright direction; by default that of `geometry.upright.guess_up`, or -y when a camera is given.
        size: width and height of the picture, pixels.
        margin: on each side, as a share of the picture.

    Returns:
        The view, with the pixels that `render_mesh` averages.
    """
    points = as_float_tensor(points, "points").detach().double().cpu()
    check_points(points, "points", batch=False)
    upright = None if up is None else as_float_tensor(up, "up", like=points)
    if camera is None:
        axis = None if upright is None else (float(upright[0]), float(upright[1]), float(upright[2]))
        camera, _, upright = Scene("points", (Cloud("points", [points], SKIN_COLOR),), up=axis).camera()
    width, height = size
    return aim(points, camera, up=upright, size=(OVERSAMPLING * width, OVERSAMPLING * height), margin=margin)


def scene_view(
    scene: Scene, *, camera: Tensor | None = None, size: tuple[int, int] = (480, 480), margin: float = 0.08
) -> View:
    """Return the view that shows all frames of a scene, from its own camera by default; see `watch`."""
    if camera is not None:
        return watch(scene.sample(), camera=camera, up=scene.up, size=size, margin=margin)
    camera, _, up = scene.camera()
    return watch(scene.sample(), camera=camera, up=up, size=size, margin=margin)


def new_figure(width: int, height: int, columns: int = 1) -> tuple[Figure, list[Axes]]:
    """Return a figure of a size in pixels, outside of pyplot's state, and its frameless axes side by side."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    dpi = 100
    figure = Figure(figsize=(width / dpi, height / dpi), dpi=dpi, facecolor="white")
    FigureCanvasAgg(figure)
    axes = [figure.add_axes((column / columns, 0.0, 1.0 / columns, 1.0)) for column in range(columns)]
    for ax in axes:
        ax.set_axis_off()
    return figure, axes


def show_pixels(ax: Axes, view: View) -> None:
    """Make the coordinates of axes the view's pixels."""
    ax.set_xlim(0, view.width)
    ax.set_ylim(view.height, 0)


def picture_size(view: View) -> tuple[int, int]:
    """Return width and height of the picture of a view, pixels."""
    return view.width // OVERSAMPLING, view.height // OVERSAMPLING


def draw_scene(
    scene: Scene, frame: int = 0, ax: Axes | None = None, *, size: tuple[int, int] = (480, 480),
    view: View | None = None,
) -> Axes:  # fmt: skip
    """Return axes with a picture of the visible layers of a scene in one frame; points behind surfaces are pale.

    Args:
        scene: to draw.
        frame: number of the frame.
        ax: to draw on; its coordinates become the view's pixels. By default axes of a new figure, ``ax.figure``.
        size: width and height, pixels, of the default view.
        view: camera and pixels; by default `scene_view`, which shows all frames.
    """
    view = scene_view(scene, size=size) if view is None else view
    if ax is None:
        ax = new_figure(*picture_size(view))[1][0]
    ax.set_axis_off()
    layers = [layer for layer in scene.layers if layer.visible]
    solid: list[TriangleMesh] = []
    for layer in layers:
        if isinstance(layer, (MovingMesh, Meshes)):
            solid += _draw_surface(ax, view, layer, frame)
    for layer in layers:
        if isinstance(layer, Cloud):
            _draw_cloud(ax, view, layer, frame, solid, _MARKS.behind * scene.diagonal)
        elif isinstance(layer, Curves):
            _draw_curves(ax, view, layer, frame)
    show_pixels(ax, view)
    ax.set_aspect("equal")
    ax.set_title(scene.title, fontsize=9, y=0.95)
    if scene.captions:
        ax.text(0.02, 0.02, scene.captions[frame], transform=ax.transAxes, fontsize=9.0, color="#444444", va="bottom")
    return ax


def save_scene(
    path: str | Path, scene: Scene, frame: int = 0, *, size: tuple[int, int] = (480, 480), view: View | None = None
) -> Path:
    """Return the path of a picture of a scene in one frame; see `draw_scene` and `save_picture`."""
    shown = scene_view(scene, size=size) if view is None else view
    figure, (ax,) = new_figure(*picture_size(shown))
    draw_scene(scene, frame, ax, view=shown)
    return save_picture(figure, path)


def _draw_surface(ax: Axes, view: View, layer: MovingMesh | Meshes, frame: int) -> list[TriangleMesh]:
    """Draw a surface, and return it if it hides what is behind it; without a position it is not shown."""
    points = layer.points(frame).detach().cpu().double()
    faces = layer.faces if isinstance(layer, MovingMesh) else layer.frames[frame if layer.num_frames > 1 else 0].faces
    if not len(faces) or not bool(points.isfinite().all()):
        return []
    mesh = TriangleMesh(points, faces.cpu())
    paint = layer.paint if isinstance(layer, MovingMesh) else layer.color
    picture = render_mesh(mesh, view, paint)
    picture[..., 3] *= layer.opacity
    _show(ax, picture, view)
    return [mesh] if layer.opacity >= 1 else []


def _show(ax: Axes, picture: Tensor, view: View) -> None:
    """Draw a picture of `render_mesh` on axes whose coordinates become the view's pixels."""
    ax.imshow(picture.cpu().numpy(), extent=(0, view.width, view.height, 0), interpolation="antialiased", zorder=1)
    show_pixels(ax, view)
    ax.set_axis_off()
    ax.set_aspect("equal")


def _draw_cloud(
    ax: Axes, view: View, layer: Cloud, frame: int, solid: Sequence[TriangleMesh], tolerance: float
) -> None:
    points, paint = layer.points(frame).detach().cpu().double(), layer.paint(frame)
    pixels, depth = view.project(points)
    opacity = torch.ones(len(points), 1)
    if solid and len(points) and not view.parallel:
        seen = visible_points(concatenate(solid), points, view.position, tolerance=tolerance)
        opacity[~seen] = _MARKS.hidden
    order = opacity[:, 0].argsort(stable=True)  # what is in front is drawn last
    order = order[depth[order] > 0]
    size = max(1.5, 72 * _MARKS.point * layer.size * min(picture_size(view)) / ax.figure.dpi)
    scale = torch.where(opacity < 1, 0.6, 1.0)[order, 0]  # what is hidden is smaller
    x, y = pixels[order].mT.numpy()
    ax.scatter(
        x, y, s=(size * scale).square().numpy(), c=torch.cat([paint, opacity], 1)[order].numpy(), linewidths=0, zorder=2
    )


def _draw_curves(ax: Axes, view: View, layer: Curves, frame: int) -> None:
    curves = layer.points(frame).detach().cpu()
    for number, (curve, color) in enumerate(zip(curves, layer.paint.tolist(), strict=True)):
        if not bool(curve.isfinite().all()) or bool((curve == curve[0]).all()):
            continue  # an organ that is not there
        x, y = view.project(curve)[0].mT.numpy()
        dashed = layer.dashed is not None and bool(layer.dashed[frame, number])
        ax.plot(x, y, "--" if dashed else "-", color=color, linewidth=_MARKS.curve, zorder=3)
        if number < len(layer.labels):
            ax.plot(x[:1], y[:1], "o", color=color, markersize=6, zorder=4)
            ax.annotate(
                layer.labels[number], (x[0], y[0]), xytext=(4, -4), textcoords="offset points", fontsize=7, zorder=5
            )


def save_picture(figure: Figure, path: str | Path, *, dpi: float | None = None) -> Path:
    """Return the path of a figure saved as a picture; the file is written whole or not at all.

    Args:
        figure: a matplotlib figure.
        path: to write; the suffix (.png, .pdf, .svg) determines the format.
        dpi: pixels per inch; the figure's own by default.

    Raises:
        InputError: if the suffix names no format known to matplotlib.
        FileNotFoundError: if the folder does not exist.
    """
    path = Path(path)
    kind = path.suffix.lower().removeprefix(".")
    if kind not in figure.canvas.get_supported_filetypes():
        raise InputError(f"path must end in .png, .pdf or .svg, got {path.name!r}; rename the output file")
    content = io.BytesIO()
    # Pillow packs more tightly on request.
    options: dict[str, Any] = {"pil_kwargs": {"optimize": True}} if kind == "png" else {}
    figure.savefig(content, format=kind, dpi="figure" if dpi is None else dpi, **options)
    write_atomic(path, content.getvalue())
    return path


def bending_picture(path: str | Path, sharpness: Sequence[float] = (2.0, 10.0)) -> Path:
    """Return the path of a picture of a bent, checkered finger, once for each sharpness of the bending skin.

    At a = 2 the pattern compresses and stretches over all of the bend, at a = 10 it follows the nearest part and breaks
    at the joint.

    Args:
        path: the picture to write.
        sharpness: a of each finger, left to right.

    Raises:
        InputError: if there is no sharpness or one is not positive.

    References: Dewaele et al. 2006, figure 2.
    """
    if not len(sharpness):
        raise InputError("sharpness must hold at least one number, got none")
    figure, axes = new_figure(400 * len(sharpness), 400, len(sharpness))
    for ax, value in zip(axes, sharpness, strict=True):
        draw_bending(ax, float(value))
        ax.text(0.5, 0.03, f"a = {value:g}", transform=ax.transAxes, ha="center", fontsize=14)
    return save_picture(figure, path)


def draw_bending(ax: Axes, sharpness: float, *, size: tuple[int, int] = (400, 400)) -> None:
    """Draw a checkered finger with its joint bent by 80 degrees under a `BendingSkin` of the given sharpness."""
    finger = _finger()
    mesh = finger.surface_mesh(spacing=0.0012)
    skin = BendingSkin(finger, mesh.vertices, sharpness=sharpness, faces=mesh.faces)
    pose = finger.rest_pose()
    pose[6:] = math.radians(80.0)
    bent = TriangleMesh(skin(pose).detach(), mesh.faces)
    camera = bent.vertices.new_tensor([0.40, 0.12, 0.09])
    view = watch(bent.vertices, camera=camera, up=camera.new_tensor([0.0, 1.0, 0.0]), size=size, margin=0.05)
    picture = render_mesh(
        bent, view, lambda face, share: _checkers(interpolate(mesh.vertices, mesh.faces, face, share))
    )
    _show(ax, picture, view)


def readme_picture(path: str | Path) -> Path:
    """Return the path of a picture for the README: a start, the alignment found, and the bending skin."""
    from torchreg.alignment.align import align

    hand = Hand()
    skin = surface_skin(hand)
    truth = hand_motion(hand, "bend", 10)[9]
    cloud = make_hand_cloud(hand, truth, num_points=600, camera=torch.zeros(3), skin=skin)
    start = truth.clone()
    start[:3] += torch.tensor([0.015, 0.02, 0.0])
    start[6:] = hand.rest_pose()[6:]
    result = align(hand, cloud.points, start)
    figure, _ = new_figure(1200, 400)
    view = watch(torch.cat([skin(truth), skin(start)]).detach(), size=(420, 350), margin=0.12)
    for number, (pose, inliers) in enumerate(((start, None), (result.pose, [result.inliers]))):
        ax = figure.add_axes((0.35 * number, 0.125, 0.35, 0.875))
        draw_scene(posed_scene(hand, pose[None], [cloud.points], inliers, skin=skin), ax=ax, view=view)
    for number, sharpness in enumerate((2.0, 10.0)):
        ax = figure.add_axes((0.73, 0.57 - 0.445 * number, 0.26, 0.42))
        draw_bending(ax, sharpness, size=(312, 168))
        ax.text(0.72, 0.25, f"a = {sharpness:g}", transform=ax.transAxes, fontsize=11)
    share = f"{len(cloud.points)} points, {int((~cloud.inliers).sum())} of them wrong"
    for x, caption in ((0.175, f"start; {share}"), (0.525, "aligned; outliers in gray"), (0.86, "bending skin")):
        figure.text(x, 0.04, caption, ha="center", fontsize=12)
    return save_picture(figure, path)


def _finger() -> ArticulatedShape:
    """Return two phalanges along z that bend about x."""
    eye, length, radius = torch.eye(3, dtype=torch.float64), 0.036, 0.010
    joints, primitives = [], []
    for index in range(2):
        offset = rigid_matrix(eye, torch.tensor([0.0, 0.0, index * length], dtype=torch.float64))
        joint = Joint(f"phalanx_{index}", index - 1, offset, "fixed")
        joints.append(replace(joint, kind="revolute", axis=(1.0, 0.0, 0.0), lower=0.0, upper=2.0) if index else joint)
        center = rigid_matrix(eye, torch.tensor([0.0, 0.0, length / 2], dtype=torch.float64))
        primitives.append(Primitive("capsule", (length / 2, radius), center))
    return ArticulatedShape(KinematicTree(tuple(joints)), ["phalanx_0", "phalanx_1"], primitives, nu=0.005)


def _checkers(rest: Tensor) -> Tensor:
    """Return colors (V, 3) of a checkered pattern on points at rest."""
    x, y, z = rest.unbind(-1)
    row, column = (z / 0.0026).floor(), (torch.atan2(x, y) / (math.pi / 9)).floor()
    dark = ((row + column) % 2 == 0).unsqueeze(-1)
    return torch.where(dark, torch.tensor([0.20, 0.36, 0.58]), torch.tensor([0.97, 0.95, 0.90]))
