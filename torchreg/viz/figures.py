"""Pictures of articulated shapes: shaded surfaces with the points that were measured on them."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from torchreg._checks import as_float_tensor, check_points, check_shape
from torchreg.datasets.hand import hand_motion, make_hand_cloud, surface_skin
from torchreg.errors import InputError
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.mesh import TriangleMesh, interpolate
from torchreg.geometry.rigid import rigid_matrix
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
_DPI = 100
# Rendered pixels per pixel of the picture, each way: smooth outlines.
_OVERSAMPLING = 2
# Directions towards a main light (upper left, before the surface) and a weak one, in (right, down, forward).
_LIGHTS = (((-0.45, -0.65, -0.75), 0.66), ((0.8, 0.1, -0.5), 0.20))
_AMBIENT = 0.42
_NORMAL_PASSES = 2
_SHINE, _SHINE_POWER = 0.12, 24
_CREVICE_SHARE, _CREVICE_DEPTH, _BLUR_STEP = 0.02, 0.06, 4
# Points whose middle is farther from the origin than this share of their diagonal were measured from there.
_FAR_SHARE = 0.75


def render_mesh(mesh: TriangleMesh, view: View, paint: Tensor | None = None, *, oversampling: int = 2) -> Tensor:
    """Return a shaded picture of a surface, with smooth normals, two lights and dark crevices.

    Args:
        mesh: a surface that faces outwards.
        view: camera and rendered pixels, see `aim`; its sides must be multiples of ``oversampling``.
        paint: (V, 3) colors in [0, 1], or (view.height, view.width, 3) a color for every rendered pixel.
        oversampling: rendered pixels, each way, that are averaged into one.

    Returns:
        (height / oversampling, width / oversampling, 4) red, green, blue, opacity in [0, 1].

    Raises:
        InputError: if sizes do not fit.
    """
    if view.width % oversampling or view.height % oversampling:
        raise InputError(f"view must have sides divisible by {oversampling}, got {view.width} x {view.height}")
    raster = rasterize(mesh, view, cull_back=True)
    seen = raster.face_index >= 0
    face, weights = raster.face_index[seen], raster.barycentric[seen].float()
    normals = interpolate(_smooth_normals(mesh), mesh.faces, face, weights)
    normals = nn.functional.normalize(normals @ view.rotation.float().to(normals.device).mT, dim=-1)
    picture = torch.zeros(view.height, view.width, 4, device=normals.device)
    color = _surface_color(mesh, view, paint, seen, face, weights)
    shade, shine = _light(normals)
    shade = shade * (1 - _crevices(raster.depth, seen)[seen].unsqueeze(-1))
    picture[seen] = torch.cat([(color * shade + shine).clamp(0, 1), torch.ones_like(shade)], dim=-1)
    # Colors count by opacity, or the background's black would stain the outline.
    planes = torch.cat([picture[..., :3] * picture[..., 3:], picture[..., 3:]], dim=-1).permute(2, 0, 1)
    small = nn.functional.avg_pool2d(planes, oversampling).permute(1, 2, 0)
    return torch.cat([small[..., :3] / small[..., 3:].clamp(min=1e-6), small[..., 3:]], dim=-1)


def _smooth_normals(mesh: TriangleMesh) -> Tensor:
    """Return normals at the vertices averaged with their neighbors': meshed fields have uneven triangles."""
    normals = mesh.vertex_normals("area").float()
    for _ in range(_NORMAL_PASSES):
        around = normals[mesh.faces].sum(1, keepdim=True).expand(-1, 3, -1)
        total = torch.zeros_like(normals).index_add(0, mesh.faces.reshape(-1), around.reshape(-1, 3))
        normals = nn.functional.normalize(total, dim=-1)
    return normals


def _surface_color(
    mesh: TriangleMesh, view: View, paint: Tensor | None, seen: Tensor, face: Tensor, weights: Tensor
) -> Tensor:
    if paint is None:
        return weights.new_tensor(SKIN_COLOR)
    paint = as_float_tensor(paint, "paint", like=weights)
    if paint.ndim == 3:
        check_shape(paint, "paint", (view.height, view.width, 3))
        return paint[seen]
    check_shape(paint, "paint", (mesh.num_vertices, 3))
    return interpolate(paint, mesh.faces, face, weights)


def _light(normals: Tensor) -> tuple[Tensor, Tensor]:
    """Return brightness (n, 1) and highlight (n, 1) of unit normals in camera coordinates."""
    shade = _AMBIENT * (1 - 0.25 * normals[:, 1:2])
    for direction, strength in _LIGHTS:
        towards = nn.functional.normalize(normals.new_tensor(direction), dim=0)
        shade = shade + strength * (normals @ towards).clamp(min=0).unsqueeze(-1)
    main = nn.functional.normalize(normals.new_tensor(_LIGHTS[0][0]), dim=0)
    halfway = nn.functional.normalize(main + normals.new_tensor([0.0, 0.0, -1.0]), dim=0)
    return shade, _SHINE * (normals @ halfway).clamp(min=0).pow(_SHINE_POWER).unsqueeze(-1)


def _crevices(depth: Tensor, seen: Tensor) -> Tensor:
    """Return how much darker each pixel is for lying behind its surroundings, 0 to 0.5.

    References: Luft, Colditz and Deussen 2006, unsharp masking of the depth buffer.
    """
    if not bool(seen.any()):
        return torch.zeros(depth.shape, device=depth.device)
    known = depth[seen]
    height = torch.where(seen, (depth.nan_to_num(posinf=0.0) - known.min()) / (known.max() - known.min() + 1e-12), 0.0)
    stack = torch.stack([height.float(), seen.float()]).unsqueeze(0)
    # A blur this wide needs no full resolution.
    coarse = nn.functional.avg_pool2d(stack, _BLUR_STEP, ceil_mode=True)
    radius = max(1, round(_CREVICE_SHARE * max(depth.shape) / _BLUR_STEP))
    for _ in range(2):
        coarse = nn.functional.avg_pool2d(coarse, 2 * radius + 1, stride=1, padding=radius)
    blurred = nn.functional.interpolate(coarse, size=depth.shape, mode="bilinear")[0]
    around = blurred[0] / blurred[1].clamp(min=1e-6)
    return ((height.float() - around) / _CREVICE_DEPTH).clamp(0, 1) * 0.5


def watch(
    points: Tensor,
    *,
    camera: Tensor | None = None,
    up: Tensor | None = None,
    size: tuple[int, int] = (480, 480),
    margin: float = 0.08,
) -> View:
    """Return a view for pictures that shows all given points.

    Args:
        points: (N, 3), metres.
        camera: (3,) position. By default, points away from the origin are taken for measurements of a camera there
            that looks along +z with -y up, and are seen from a little right of and above it; others from before and
            above, with z up.
        up: (3,) what appears upright; by default as said for ``camera``, or -y when a camera is given.
        size: width and height of the picture, pixels.
        margin: share left free on each side.

    Returns:
        a view with twice as many pixels each way, as `render_mesh` averages.

    Raises:
        InputError: if a point lies beside or behind the camera.
    """
    points = as_float_tensor(points, "points").detach().double()
    check_points(points, "points", batch=False)
    if camera is None:
        lower, upper = points.amin(0), points.amax(0)
        middle, length = (lower + upper) / 2, float((upper - lower).norm().clamp(min=1e-6))
        away = float(middle.norm())
        if away > _FAR_SHARE * length:
            camera = points.new_tensor([0.35 * away, -0.25 * away, 0.0])
        else:
            camera = middle + 3 * length * nn.functional.normalize(points.new_tensor([0.6, -1.0, 0.5]), dim=0)
            up = points.new_tensor([0.0, 0.0, 1.0]) if up is None else up
    width, height = size
    return aim(points, camera, up=up, size=(_OVERSAMPLING * width, _OVERSAMPLING * height), margin=margin)


def new_figure(width: int, height: int, columns: int = 1) -> tuple[Figure, list[Axes]]:
    """Return a figure of the given size in pixels, outside pyplot's state, and its frameless axes side by side."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    axes = [figure.add_axes((column / columns, 0.0, 1.0 / columns, 1.0)) for column in range(columns)]
    for ax in axes:
        ax.set_axis_off()
    return figure, axes


def draw_mesh(ax: Axes, mesh: TriangleMesh, view: View, paint: Tensor | None = None) -> None:
    """Put a shaded picture of a mesh on axes whose coordinates become the view's pixels."""
    picture = render_mesh(mesh, view, paint, oversampling=_OVERSAMPLING).cpu().numpy()
    ax.imshow(picture, extent=(0, view.width, view.height, 0), interpolation="antialiased", zorder=1)
    ax.set_xlim(0, view.width)
    ax.set_ylim(view.height, 0)
    ax.set_aspect("equal")
    ax.set_axis_off()


def draw_alignment(
    ax: Axes | None,
    shape: ArticulatedShape,
    pose: Tensor,
    data: Tensor | None = None,
    inliers: Tensor | None = None,
    *,
    skin: LinearBlendSkin | None = None,
    view: View | None = None,
    point_size: float = 5.0,
) -> Axes:
    """Return axes with a shaded picture of a shape in a pose and of the data.

    Inliers are blue, outliers gray, data of unknown kind green; behind the surface pale, or for outliers left out.

    Args:
        ax: where to draw; None makes a figure of its own, reached as ``ax.figure``.
        shape: the articulated shape.
        pose: (num_dofs,).
        data: (M, 3) measured points, metres.
        inliers: (M,) bool; unknown by default.
        skin: the surface to draw, with faces; by default `surface_skin`, which is made anew at every call.
        view: camera and pixels, see `watch`; by default one that shows shape and inliers.
        point_size: diameter of a data point, points (1/72 inch).

    Raises:
        InputError: if sizes do not fit or the skin has no faces.
    """
    mesh = posed_mesh(shape, pose, skin)
    color = DATA_COLOR if inliers is None else INLIER_COLOR
    data, inliers = _checked_data(mesh, data, inliers)
    view = watch(torch.cat([mesh.vertices, data[inliers]])) if view is None else view
    if ax is None:
        ax = new_figure(view.width // _OVERSAMPLING, view.height // _OVERSAMPLING)[1][0]
    draw_mesh(ax, mesh, view)
    draw_points(ax, mesh, view, data, inliers, tolerance=2 * shape.nu, point_size=point_size, color=color)
    return ax


def posed_mesh(shape: ArticulatedShape, pose: Tensor, skin: LinearBlendSkin | None = None) -> TriangleMesh:
    """Return the surface of a shape in a pose (num_dofs,), moved by ``skin`` or by a new `surface_skin`, on the CPU."""
    skin = surface_skin(shape) if skin is None else skin
    if skin.faces is None:
        raise InputError("skin must have faces to be drawn; make it with surface_skin(shape)")
    pose = shape.check_pose(pose)
    check_shape(pose, "pose", (shape.num_dofs,))
    with torch.no_grad():
        return TriangleMesh(skin(pose).detach().cpu(), skin.faces.cpu())


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
    """Put data points (M, 3) on axes with the view's pixels as coordinates; see `draw_alignment`."""
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
        at = pixels[chosen].numpy()
        if len(at):
            area = (scale * point_size) ** 2
            ax.scatter(at[:, 0], at[:, 1], s=area, c=paint, alpha=alpha, linewidths=0, zorder=2)


def save_picture(figure: Figure, path: str | Path, *, dpi: float | None = None) -> Path:
    """Return the path of a figure saved as a picture; the file is written whole or not at all.

    Args:
        figure: a matplotlib figure.
        path: where to; the suffix (.png, .pdf, .svg) decides about the format.
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


def bending_figure(path: str | Path, sharpness: Sequence[float] = (2.0, 10.0), *, bend_deg: float = 80.0) -> Path:
    """Return the path of a picture of a bent, checkered finger, once for each sharpness of the bending skin.

    At a = 2 the pattern compresses and stretches over the whole bend, at a = 10 it follows the nearest part and breaks
    at the joint.

    Args:
        path: the picture to write.
        sharpness: a of each finger, left to right.
        bend_deg: angle of the joint, degrees.

    Returns:
        The path written.

    Raises:
        InputError: if there is no sharpness or one is not positive.

    References: Dewaele et al. 2006, figure 2.
    """
    if not len(sharpness):
        raise InputError("sharpness must hold at least one number, got none")
    figure, axes = new_figure(400 * len(sharpness), 400, len(sharpness))
    for ax, value in zip(axes, sharpness, strict=True):
        draw_bending(ax, float(value), bend_deg=bend_deg)
        ax.text(0.5, 0.03, f"a = {value:g}", transform=ax.transAxes, ha="center", fontsize=14)
    return save_picture(figure, path)


def draw_bending(ax: Axes, sharpness: float, *, bend_deg: float = 80.0, size: tuple[int, int] = (400, 400)) -> None:
    """Draw a checkered finger with its joint bent under a `BendingSkin` of the given sharpness."""
    finger = _finger()
    mesh = finger.surface_mesh(spacing=0.0012)
    skin = BendingSkin(finger, mesh.vertices, sharpness=sharpness, faces=mesh.faces)
    pose = finger.rest_pose()
    pose[6:] = math.radians(bend_deg)
    bent = posed_mesh(finger, pose, skin)
    camera = bent.vertices.new_tensor([0.40, 0.12, 0.09])
    view = watch(bent.vertices, camera=camera, up=camera.new_tensor([0.0, 1.0, 0.0]), size=size, margin=0.05)
    draw_mesh(ax, bent, view, _checkers(mesh, bent, view))


def readme_picture(path: str | Path) -> Path:
    """Return the path of a picture of what the library does: a start, the alignment found, and the bending skin.

    Args:
        path: the picture to write.

    Returns:
        The path written.
    """
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
    for place, caption in ((0.175, f"start; {share}"), (0.525, "aligned; outliers in gray"), (0.86, "bending skin")):
        figure.text(place, 0.04, caption, ha="center", fontsize=12)
    return save_picture(figure, path)


def _finger() -> ArticulatedShape:
    """Return two phalanges along z that bend about x."""
    eye, length, radius = torch.eye(3, dtype=torch.float64), 0.036, 0.010
    joints, primitives = [], []
    for index in range(2):
        offset = rigid_matrix(eye, torch.tensor([0.0, 0.0, index * length], dtype=torch.float64))
        kind = "revolute" if index else "fixed"
        joints.append(Joint(f"phalanx_{index}", index - 1, offset, kind, (1.0, 0.0, 0.0), 0.0, 2.0))
        center = rigid_matrix(eye, torch.tensor([0.0, 0.0, length / 2], dtype=torch.float64))
        primitives.append(Primitive("capsule", (length / 2, radius), center))
    return ArticulatedShape(KinematicTree(tuple(joints)), ["phalanx_0", "phalanx_1"], primitives, nu=0.005)


def _checkers(rest: TriangleMesh, bent: TriangleMesh, view: View) -> Tensor:
    """Return (height, width, 3) colors of a checkered pattern that lies on the mesh at rest and moves with it."""
    raster = rasterize(bent, view, cull_back=True)
    seen = raster.face_index >= 0
    x, y, z = interpolate(rest.vertices, rest.faces, raster.face_index[seen], raster.barycentric[seen].float()).unbind(
        -1
    )
    row = (z / 0.0026).floor().long()
    column = (torch.atan2(x, y) / (math.pi / 9)).floor().long()
    dark = (row + column) % 2 == 0
    paint = torch.ones(view.height, view.width, 3)
    paint[seen] = torch.where(dark.unsqueeze(-1), torch.tensor([0.20, 0.36, 0.58]), torch.tensor([0.97, 0.95, 0.90]))
    return paint
