"""Pictures of articulated shapes: shaded surfaces with the measured points."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from torchreg._checks import as_float_tensor, check_points, check_shape
from torchreg.datasets.hand import faces_of, hand_motion, make_hand_cloud, surface_skin
from torchreg.errors import InputError
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.mesh import TriangleMesh, interpolate
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.upright import Direction, guess_up, is_before_camera
from torchreg.geometry.visibility import View, aim, rasterize, visible_points
from torchreg.io.atomic import write_atomic
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.skin import BendingSkin, LinearBlendSkin

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SKIN_COLOR = (0.90, 0.76, 0.66)
INLIER_COLOR = "#0b4f9e"
OUTLIER_COLOR = "#8d8d8d"
DATA_COLOR = "#157f6b"
# Rendered pixels per pixel of a picture, each way: smooth outlines.
_OVERSAMPLING = 2


@dataclass(frozen=True)
class _Shading:
    """Light and material of rendered surfaces."""

    # Direction towards each light as (right, down, forward), and its strength: a main one from the upper left before
    # the surface, and a weak one.
    lights: tuple[tuple[tuple[float, float, float], float], ...] = (
        ((-0.45, -0.65, -0.75), 0.66),
        ((0.8, 0.1, -0.5), 0.20),
    )
    ambient: float = 0.42
    shine: float = 0.12  # strength of the highlight of the main light
    shine_power: int = 24  # the larger, the smaller the highlight
    normal_passes: int = 2  # of averaging over neighbors: meshed fields have uneven triangles
    crevice_radius: float = 0.02  # of the surroundings of a pixel, as a share of the picture
    crevice_depth: float = 0.06  # behind its surroundings at which a pixel is darkest, as a share of all depths
    blur_step: int = 4  # pixels that a wide blur needs as one


_SHADING = _Shading()


def render_mesh(mesh: TriangleMesh, view: View, paint: Tensor | None = None) -> Tensor:
    """Return a shaded picture of a surface, with smooth normals, two lights and dark crevices.

    Args:
        mesh: a surface that faces outwards.
        view: camera and rendered pixels, 2 x 2 for each pixel of the picture, see `watch`.
        paint: (V, 3) colors in [0, 1], or (view.height, view.width, 3), one for every rendered pixel.

    Returns:
        Red, green, blue and opacity (view.height / 2, view.width / 2, 4) in [0, 1].
    """
    raster = rasterize(mesh, view, cull_back=True)
    seen = raster.face_index >= 0
    face, weights = raster.face_index[seen], raster.barycentric[seen].float()
    normals = interpolate(_smooth_normals(mesh), mesh.faces, face, weights)
    normals = nn.functional.normalize(normals @ view.rotation.float().to(normals.device).mT, dim=-1)
    picture = torch.zeros(view.height, view.width, 4, device=normals.device)
    color = _surface_color(mesh, paint, seen, face, weights)
    shade, shine = _light(normals)
    shade = shade * (1 - _crevices(raster.depth, seen)[seen].unsqueeze(-1))
    picture[seen] = torch.cat([(color * shade + shine).clamp(0, 1), torch.ones_like(shade)], dim=-1)
    # Colors are weighted by opacity, or the background's black would stain the outline.
    planes = torch.cat([picture[..., :3] * picture[..., 3:], picture[..., 3:]], dim=-1).permute(2, 0, 1)
    small = nn.functional.avg_pool2d(planes, _OVERSAMPLING).permute(1, 2, 0)
    return torch.cat([small[..., :3] / small[..., 3:].clamp(min=1e-6), small[..., 3:]], dim=-1)


def _smooth_normals(mesh: TriangleMesh) -> Tensor:
    """Return vertex normals (V, 3) averaged with those of their neighbors."""
    normals = mesh.vertex_normals("area").float()
    for _ in range(_SHADING.normal_passes):
        around = normals[mesh.faces].sum(1, keepdim=True).expand(-1, 3, -1)
        total = torch.zeros_like(normals).index_add(0, mesh.faces.reshape(-1), around.reshape(-1, 3))
        normals = nn.functional.normalize(total, dim=-1)
    return normals


def _surface_color(mesh: TriangleMesh, paint: Tensor | None, seen: Tensor, face: Tensor, weights: Tensor) -> Tensor:
    """Return the colors (n, 3) of n seen pixels, before any light."""
    if paint is None:
        return weights.new_tensor(SKIN_COLOR)
    paint = paint.to(weights)
    return paint[seen] if paint.ndim == 3 else interpolate(paint, mesh.faces, face, weights)


def _light(normals: Tensor) -> tuple[Tensor, Tensor]:
    """Return brightness (n, 1) and highlight (n, 1) of unit normals in camera coordinates."""
    shade = _SHADING.ambient * (1 - 0.25 * normals[:, 1:2])
    for direction, strength in _SHADING.lights:
        towards = nn.functional.normalize(normals.new_tensor(direction), dim=0)
        shade = shade + strength * (normals @ towards).clamp(min=0).unsqueeze(-1)
    main = nn.functional.normalize(normals.new_tensor(_SHADING.lights[0][0]), dim=0)
    halfway = nn.functional.normalize(main + normals.new_tensor([0.0, 0.0, -1.0]), dim=0)
    highlight = (normals @ halfway).clamp(min=0).pow(_SHADING.shine_power)
    return shade, _SHADING.shine * highlight.unsqueeze(-1)


def _crevices(depth: Tensor, seen: Tensor) -> Tensor:
    """Return the darkening (H, W) of pixels that lie behind their surroundings, 0 to 0.5.

    References: Luft, Colditz and Deussen 2006, unsharp masking of the depth buffer.
    """
    if not bool(seen.any()):
        return torch.zeros(depth.shape, device=depth.device)
    known = depth[seen]
    height = torch.where(seen, (depth.nan_to_num(posinf=0.0) - known.min()) / (known.max() - known.min() + 1e-12), 0.0)
    stack = torch.stack([height.float(), seen.float()]).unsqueeze(0)
    # A blur this wide needs no full resolution.
    coarse = nn.functional.avg_pool2d(stack, _SHADING.blur_step, ceil_mode=True)
    radius = max(1, round(_SHADING.crevice_radius * max(depth.shape) / _SHADING.blur_step))
    for _ in range(2):
        coarse = nn.functional.avg_pool2d(coarse, 2 * radius + 1, stride=1, padding=radius)
    blurred = nn.functional.interpolate(coarse, size=depth.shape, mode="bilinear")[0]
    around = blurred[0] / blurred[1].clamp(min=1e-6)
    return ((height.float() - around) / _SHADING.crevice_depth).clamp(0, 1) * 0.5


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
        camera: (3,) position. By default, points away from the origin are taken for measurements of a camera at the
            origin that looks along +z with -y up, and are viewed from a little right of and above it; other points
            from before and above.
        up: (3,) upright direction; by default as `geometry.upright.guess_up` tells it, or -y when a camera is given.
        size: width and height of the picture, pixels.
        margin: on each side, as a share of the picture.

    Returns:
        The view, with the pixels that `render_mesh` averages.
    """
    points = as_float_tensor(points, "points").detach().double()
    check_points(points, "points", batch=False)
    upright = None if up is None else as_float_tensor(up, "up", like=points)
    if camera is None:
        lower, upper = points.amin(0), points.amax(0)
        middle, length = (lower + upper) / 2, float((upper - lower).norm().clamp(min=1e-6))
        if is_before_camera(lower, upper):
            away = float(middle.norm())
            camera = points.new_tensor([0.35 * away, -0.25 * away, 0.0])
        else:
            upright = points.new_tensor(guess_up([points])) if upright is None else upright
            camera = middle + 3 * length * _from_before(upright, points)
    width, height = size
    return aim(points, camera, up=upright, size=(_OVERSAMPLING * width, _OVERSAMPLING * height), margin=margin)


def _from_before(up: Tensor, points: Tensor) -> Tensor:
    """Return the direction (3,) from which upright points (N, 3) are seen: from before, a little right and above.

    The less they spread along up, beside their width, the further above.
    """
    along_z = -1.0 if float(up[1]) < 0 else 1.0  # a camera's y points down, and it looks along z
    front = up.new_tensor([0.0, -1.0, 0.0] if abs(float(up[2])) > 0.5 else [0.0, 0.0, along_z])
    right = torch.linalg.cross(up, front)
    level = nn.functional.normalize(0.6 * right + front, dim=0)
    height, width = (float((points @ axis).std()) for axis in (up, torch.linalg.cross(up, level)))
    sine = min(max(0.4, 0.9 - height / max(width, 1e-9)), 0.8)  # of the elevation: 24 to 53 degrees
    return math.sqrt(1 - sine**2) * level + sine * up


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


def draw_mesh(ax: Axes, mesh: TriangleMesh, view: View, paint: Tensor | None = None) -> None:
    """Draw a shaded picture of a mesh on axes whose coordinates become the view's pixels."""
    draw_rendered(ax, render_mesh(mesh, view, paint), view)


def draw_rendered(ax: Axes, picture: Tensor, view: View) -> None:
    """Draw a picture of `render_mesh` on axes whose coordinates become the view's pixels."""
    ax.imshow(picture.cpu().numpy(), extent=(0, view.width, view.height, 0), interpolation="antialiased", zorder=1)
    show_pixels(ax, view)
    ax.set_aspect("equal")
    ax.set_axis_off()


def show_pixels(ax: Axes, view: View) -> None:
    """Make the coordinates of axes the view's pixels."""
    ax.set_xlim(0, view.width)
    ax.set_ylim(view.height, 0)


def picture_size(view: View) -> tuple[int, int]:
    """Return width and height of the picture of a view, pixels."""
    return view.width // _OVERSAMPLING, view.height // _OVERSAMPLING


def draw_alignment(
    ax: Axes | None,
    shape: ArticulatedShape,
    pose: Tensor,
    data: Tensor | None = None,
    inliers: Tensor | None = None,
    *,
    skin: LinearBlendSkin | None = None,
    view: View | None = None,
    up: Direction | None = None,
    point_size: float = 5.0,
) -> Axes:
    """Return axes with a shaded picture of a shape in a pose and of the data.

    Inliers are blue, outliers gray, other data green; hidden inliers and data are pale, hidden outliers omitted.

    Args:
        ax: to draw on; None makes a new figure, ``ax.figure``.
        shape: the articulated shape.
        pose: (num_dofs,).
        data: (M, 3) measured points, metres.
        inliers: (M,) bool; unknown by default.
        skin: the surface to draw, with faces; by default `surface_skin`, which is made anew at every call.
        view: camera and pixels, see `watch`; by default of shape and inliers.
        up: the upright direction of the default view, see `watch`.
        point_size: diameter of a data point, points (1/72 inch).

    Raises:
        InputError: if sizes do not fit or the skin has no faces.
    """
    mesh = posed_mesh(shape, pose, skin)
    color = DATA_COLOR if inliers is None else INLIER_COLOR
    data, inliers = _checked_data(mesh, data, inliers)
    view = watch(torch.cat([mesh.vertices, data[inliers]]), up=up) if view is None else view
    if ax is None:
        ax = new_figure(*picture_size(view))[1][0]
    draw_mesh(ax, mesh, view)
    draw_points(ax, mesh, view, data, inliers, tolerance=2 * shape.nu, point_size=point_size, color=color)
    return ax


def posed_mesh(shape: ArticulatedShape, pose: Tensor, skin: LinearBlendSkin | None = None) -> TriangleMesh:
    """Return the surface of a shape in a pose (num_dofs,), moved by ``skin`` or by a new `surface_skin`, on the CPU."""
    skin = surface_skin(shape) if skin is None else skin
    faces = faces_of(skin)
    pose = shape.check_pose(pose)
    check_shape(pose, "pose", (shape.num_dofs,))
    with torch.no_grad():
        return TriangleMesh(skin(pose).detach().cpu(), faces.cpu())


def _checked_data(mesh: TriangleMesh, data: Tensor | None, inliers: Tensor | None) -> tuple[Tensor, Tensor]:
    data = mesh.vertices.new_zeros(0, 3) if data is None else as_float_tensor(data, "data", like=mesh.vertices).detach()
    check_points(data, "data", min_count=0, batch=False)
    inliers = torch.ones(len(data), dtype=torch.bool) if inliers is None else torch.as_tensor(inliers).cpu()
    check_shape(inliers, "inliers", (len(data),))
    if inliers.dtype != torch.bool:
        raise InputError(f"inliers must be bool, got {inliers.dtype}; compare with a threshold first")
    return data, inliers


def draw_points(
    ax: Axes,
    mesh: TriangleMesh,
    view: View,
    data: Tensor,
    inliers: Tensor,
    *,
    tolerance: float | None = None,
    point_size: float = 5.0,
    color: str = INLIER_COLOR,
) -> None:
    """Draw data points (M, 3) on axes with the view's pixels as coordinates; see `draw_alignment`."""
    if not len(data):
        return
    pixels, _ = view.project(data)
    seen = torch.ones_like(inliers)
    if not view.parallel:
        seen = visible_points(mesh, data, view.position, tolerance=tolerance)
    for chosen, paint, alpha, scale in (
        (~inliers & seen, OUTLIER_COLOR, 0.9, 0.6),
        (inliers & ~seen, color, 0.22, 0.8),
        (inliers & seen, color, 1.0, 1.0),
    ):
        if bool(chosen.any()):
            x, y = pixels[chosen].numpy().T
            ax.scatter(x, y, s=(scale * point_size) ** 2, c=paint, alpha=alpha, linewidths=0, zorder=2)


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
    bent = posed_mesh(finger, pose, skin)
    camera = bent.vertices.new_tensor([0.40, 0.12, 0.09])
    view = watch(bent.vertices, camera=camera, up=camera.new_tensor([0.0, 1.0, 0.0]), size=size, margin=0.05)
    draw_mesh(ax, bent, view, _checkers(mesh, bent, view))


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
    view = watch(torch.cat([skin(truth), skin(start)]).detach(), size=(420, 350), margin=0.07)
    before, after = (figure.add_axes((0.35 * number, 0.125, 0.35, 0.875)) for number in range(2))
    draw_alignment(before, hand, start, cloud.points, skin=skin, view=view, point_size=3.5)
    draw_alignment(after, hand, result.pose, cloud.points, result.inliers, skin=skin, view=view, point_size=3.5)
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


def _checkers(rest: TriangleMesh, bent: TriangleMesh, view: View) -> Tensor:
    """Return colors (height, width, 3) of a checkered pattern that moves with the mesh."""
    raster = rasterize(bent, view, cull_back=True)
    seen = raster.face_index >= 0
    points = interpolate(rest.vertices, rest.faces, raster.face_index[seen], raster.barycentric[seen].float())
    x, y, z = points.unbind(-1)
    row = (z / 0.0026).floor().long()
    column = (torch.atan2(x, y) / (math.pi / 9)).floor().long()
    dark = (row + column) % 2 == 0
    paint = torch.ones(view.height, view.width, 3)
    paint[seen] = torch.where(dark.unsqueeze(-1), torch.tensor([0.20, 0.36, 0.58]), torch.tensor([0.97, 0.95, 0.90]))
    return paint
