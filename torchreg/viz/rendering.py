"""Shaded pictures of surfaces: smooth normals, two lights, dark crevices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchreg.geometry.mesh import TriangleMesh, interpolate
from torchreg.geometry.visibility import View, rasterize
from torchreg.viz.scene import SKIN_COLOR, Color

Paint = Callable[[Tensor, Tensor], Tensor]
# Rendered pixels per pixel of a picture, each way: smooth outlines.
OVERSAMPLING = 2


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


def render_mesh(mesh: TriangleMesh, view: View, paint: Tensor | Color | Paint = SKIN_COLOR) -> Tensor:
    """Return a shaded picture (view.height / 2, view.width / 2, 4) of a surface: red, green, blue, opacity in [0, 1].

    Colors are given per vertex (V, 3), as one, or by a function of faces (N,) and barycentric coordinates (N, 3).
    Triangles that face away are shaded from behind; `watch` gives the view of 2 x 2 pixels for each of the picture.
    """
    raster = rasterize(mesh, view)
    seen = raster.face_index >= 0
    face, weights = raster.face_index[seen], raster.barycentric[seen].float()
    normals = interpolate(_smooth_normals(mesh), mesh.faces, face, weights) * _side(mesh, view)[face, None]
    normals = nn.functional.normalize(normals @ view.rotation.float().to(normals.device).mT, dim=-1)
    picture = torch.zeros(view.height, view.width, 4, device=normals.device)
    if callable(paint):
        color = paint(face, weights)
    elif isinstance(paint, Tensor):
        color = interpolate(paint.to(weights), mesh.faces, face, weights)
    else:
        color = weights.new_tensor(paint)
    shade, shine = _light(normals)
    shade = shade * (1 - _crevices(raster.depth, seen)[seen].unsqueeze(-1))
    picture[seen] = torch.cat([(color * shade + shine).clamp(0, 1), torch.ones_like(shade)], dim=-1)
    # Colors are weighted by opacity, or the background's black would stain the outline.
    planes = torch.cat([picture[..., :3] * picture[..., 3:], picture[..., 3:]], dim=-1).permute(2, 0, 1)
    small = nn.functional.avg_pool2d(planes, OVERSAMPLING).permute(1, 2, 0)
    return torch.cat([small[..., :3] / small[..., 3:].clamp(min=1e-6), small[..., 3:]], dim=-1)


def _smooth_normals(mesh: TriangleMesh) -> Tensor:
    """Return vertex normals (V, 3) averaged with those of their neighbors."""
    normals = mesh.vertex_normals("area").float()
    for _ in range(_SHADING.normal_passes):
        around = normals[mesh.faces].sum(1, keepdim=True).expand(-1, 3, -1)
        total = torch.zeros_like(normals).index_add(0, mesh.faces.reshape(-1), around.reshape(-1, 3))
        normals = nn.functional.normalize(total, dim=-1)
    return normals


def _side(mesh: TriangleMesh, view: View) -> Tensor:
    """Return 1 for triangles that face the camera, -1 for others, (F,)."""
    corner, second, third = mesh.vertices.double()[mesh.faces].unbind(1)
    normal = torch.linalg.cross(second - corner, third - corner)
    ray = view.rotation[2] if view.parallel else corner - view.position.to(corner)
    return 1.0 - 2.0 * ((ray.to(normal) * normal).sum(-1) > 0).float()


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
    """Return the darkening (H, W) of pixels behind their surroundings, 0 to 0.5 (Luft, Colditz and Deussen 2006)."""
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
