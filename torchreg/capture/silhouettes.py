"""Silhouettes to surfaces: the visual hull of calibrated masks, refined only near its surface, and its mesh."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_count, check_finite, check_shape
from torchreg.capture.mask_distance import signed_mask_distance
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.camera import Camera, lens_jacobian
from torchreg.geometry.camera_rig import CameraRig
from torchreg.geometry.marching_cubes import marching_cubes
from torchreg.geometry.mesh import TriangleMesh

# Points looked up at a time; bounds memory at about 50 MB.
_CHUNK = 1 << 20


@dataclass(frozen=True)
class _Carving:
    """Search for a hull."""

    num_levels: int = 4  # of blocks above voxels: the largest, 16^3 voxels, are decided first, then their eighths
    max_resolution: int = 512  # voxels along the longest side
    border: int = 2  # empty layers of voxels around the box
    interpolation: float = 1.5  # pixels by which bilinear interpolation may change more than the distance itself
    box_resolution: int = 32  # cells along the longest side of the box while it is shrunk
    box_rounds: int = 3  # in which it is shrunk
    min_mask: int = 4  # pixels of a mask that is not empty
    min_covered: float = 0.6  # share of each mask that its hull covers: all if masks fit, below a half if exchanged


_CARVING = _Carving()


@dataclass(frozen=True, eq=False)
class VisualHull:
    """The largest body with given silhouettes, as a signed distance field on a grid."""

    field: Tensor  # (X, Y, Z) largest distance to the outlines, negative inside; far off only its sign counts
    origin: Tensor  # (3,) of sample (0, 0, 0), in the unit of the cameras
    spacing: float  # between samples

    def mesh(self) -> TriangleMesh:
        """Return the watertight surface, oriented outwards."""
        return marching_cubes(self.field, self.origin, self.spacing)

    def volume(self) -> float:
        """Return the volume inside the surface."""
        mesh = self.mesh()
        corners = (mesh.vertices - mesh.vertices.mean(0)).double()[mesh.faces]
        return float(torch.linalg.det(corners).sum()) / 6


def visual_hull(
    masks: Sequence[Tensor], cameras: CameraRig | Sequence[Camera], *, resolution: int = 256, box: Tensor | None = None
) -> VisualHull:
    """Return the visual hull of calibrated silhouettes: all points that every camera sees inside its mask.

    Blocks of the grid whose picture lies clear of every outline are decided at once; the others are split into eight.
    Points that a camera does not see, beside its picture or behind it, count as outside.

    Args:
        masks: one (H, W) bool per camera; True on the object.
        cameras: one per mask.
        resolution: samples along the longest side of the box.
        box: (2, 3) lower and upper corner of what may hold the object; found from the masks by default.

    Returns:
        The hull, float32.

    Raises:
        InputError: if numbers or sizes do not fit, a mask is (nearly) empty or touches the border of its picture, or
            the masks do not fit together: no point is inside all, or the hull, unless a box cuts it, covers less than
            60 % of one.
        InputTypeError: if a mask is not Boolean.

    Differentiable: no.

    Cost: proportional to the surface, resolution^2 times the number of cameras.

    References: Laurentini 1994 (the hull); Szeliski 1993 (octrees from silhouettes).
    """
    silhouettes = [_Silhouette.from_mask(mask, camera) for mask, camera in _paired(masks, cameras)]
    check_count(resolution, "resolution", 8)
    if resolution > _CARVING.max_resolution:
        raise InputError(f"resolution must be at most {_CARVING.max_resolution}, got {resolution}")
    with torch.no_grad():
        bounds = _found_box(silhouettes) if box is None else _checked_box(box)
        hull = _carved(silhouettes, bounds, resolution)
    if not bool((hull.field < 0).any()):
        raise InputError(
            "masks must have a point of space in common, but no point is inside all of them; check that masks and "
            "cameras are in the same order and the motions are world to camera"
        )
    if box is None:
        _check_covered(hull, silhouettes, masks)
    return hull


def _paired(masks: Sequence[Tensor], cameras: CameraRig | Sequence[Camera]) -> list[tuple[Tensor, Camera]]:
    """Return each mask with its camera; InputError unless every mask shows the whole object."""
    cameras = list(cameras)
    if len(masks) != len(cameras) or len(cameras) < 2:
        raise InputError(f"masks must be one per camera, two or more, got {len(masks)} and {len(cameras)} cameras")
    for mask, camera in zip(masks, cameras, strict=True):
        if not isinstance(mask, Tensor) or mask.dtype != torch.bool:
            raise InputTypeError(f"masks must be Boolean, got {getattr(mask, 'dtype', type(mask).__name__)}")
        if mask.shape != (camera.height, camera.width):
            raise InputError(
                f"masks must have the size of their camera's picture: {camera.name or 'camera'} has {camera.width} x "
                f"{camera.height} pixels, the mask has shape {tuple(mask.shape)}"
            )
        rim = torch.cat((mask[0], mask[-1], mask[:, 0], mask[:, -1]))
        if int(mask.sum()) < _CARVING.min_mask or bool(rim.any()):
            defect = "touches the border of the picture" if bool(rim.any()) else "is empty"
            raise InputError(
                f"masks must show the whole object, that of {camera.name or 'a camera'} {defect}; leave it out"
            )
    return list(zip(masks, cameras, strict=True))


@dataclass(frozen=True, eq=False)
class _Silhouette:
    """A mask as signed distance (1, 1, H, W) to its outline, pixels, and the largest stretch by the lens."""

    camera: Camera
    distance: Tensor
    stretch: float

    @classmethod
    def from_mask(cls, mask: Tensor, camera: Camera) -> _Silhouette:
        """Return the silhouette of a mask (H, W)."""
        camera = camera.to(device=mask.device, dtype=torch.float32)
        # Averaged over 3 x 3 pixels, the steps of the outline vanish, and its curves lose a hundredth of a pixel.
        distance = torch.nn.functional.pad(signed_mask_distance(mask)[None, None], (1, 1, 1, 1), mode="replicate")
        distance = torch.nn.functional.avg_pool2d(distance, 3, stride=1).to(mask.device)
        stretch = 1.0
        if camera.is_distorted:
            focal, center = camera.intrinsics.split(2)
            plane = (camera.pixel_grid()[::8, ::8] - center) / focal
            jacobian = lens_jacobian(camera.undistorted(plane), camera.distortion)
            stretch = 1.1 * float(torch.linalg.matrix_norm(jacobian.nan_to_num(0.0), 2).max())
        return cls(camera, distance, stretch)

    def look_up(self, points: Tensor, radius: float) -> tuple[Tensor, Tensor]:
        """Return signed distances (N,) of points (N, 3), and bounds (N,) of their change within a radius, pixels."""
        local = points @ self.camera.world_to_camera[:3, :3].mT + self.camera.world_to_camera[:3, 3]
        depth = local[:, 2]
        plane = local[:, :2] / depth.clamp(min=1e-9).unsqueeze(-1)
        focal, center = self.camera.intrinsics.split(2)
        pixels = self.camera.distorted(plane) * focal + center
        size = pixels.new_tensor([self.camera.width, self.camera.height])
        normalized = (2 * pixels + 1) / size - 1
        sampled = torch.nn.functional.grid_sample(
            self.distance, normalized[None, None], mode="bilinear", padding_mode="border", align_corners=False
        )[0, 0, 0]
        # Beside the picture it is at least as far outside as from the border.
        beyond = (pixels - pixels.clamp(torch.zeros_like(size), size - 1)).norm(dim=-1)
        sampled = torch.where((beyond > 0) | (depth <= 0), sampled.clamp(min=0.5) + beyond, sampled)
        slope = float(focal.max()) * self.stretch * (1 + (plane**2).sum(-1)).sqrt()
        change = torch.where(depth > 1.001 * radius, slope * radius / (depth - radius).clamp(min=1e-9), torch.inf)
        return sampled, change

    def pixel_size(self, points: Tensor) -> Tensor:
        """Return the widths (N,) of a pixel at the depths of points (N, 3)."""
        depth = points @ self.camera.world_to_camera[2, :3] + self.camera.world_to_camera[2, 3]
        return depth.clamp(min=0.0) / self.camera.intrinsics[0]


def _carved(silhouettes: list[_Silhouette], box: Tensor, resolution: int) -> VisualHull:
    """Return the hull within a box, by blocks that are split while an outline passes through their picture."""
    spacing = float((box[1] - box[0]).max()) / (resolution - 1)
    edge, border = 1 << _CARVING.num_levels, 2 * _CARVING.border
    counts = [math.ceil((math.ceil(side / spacing) + 1 + border) / edge) for side in (box[1] - box[0]).tolist()]
    middle = 0.5 * (box[0] + box[1])
    origin = middle - 0.5 * spacing * (middle.new_tensor(counts) * edge - 1)
    state = torch.zeros(counts, dtype=torch.int8, device=box.device)
    for level in range(_CARVING.num_levels + 1):
        edge = 1 << (_CARVING.num_levels - level)
        if level:
            state = state.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)
        open_blocks = (state == 0).nonzero()
        if edge == 1:
            break
        centers = origin + spacing * (open_blocks.to(box) * edge + 0.5 * (edge - 1))
        state[tuple(open_blocks.unbind(-1))] = _decided(silhouettes, centers, spacing * 0.5 * (edge - 1) * 3**0.5)
    field = state.to(box) * (10 * spacing)
    field[tuple(open_blocks.unbind(-1))] = _sampled(silhouettes, origin + spacing * open_blocks.to(box))
    # The field is cut at the sides of the box, so that the surface is closed.
    for axis in range(3):
        along = origin[axis] + spacing * torch.arange(field.shape[axis]).to(box)
        beyond = torch.maximum(box[0, axis] - along, along - box[1, axis])
        field = torch.maximum(field, beyond.reshape([-1 if k == axis else 1 for k in range(3)]))
    return VisualHull(field, origin, spacing)


def _decided(silhouettes: list[_Silhouette], centers: Tensor, radius: float) -> Tensor:
    """Return states (N,) int8 of blocks in balls: 1 outside of a mask, -1 inside all of them, 0 undecided."""
    state = torch.full(centers.shape[:1], -1, dtype=torch.int8, device=centers.device)
    remaining = torch.arange(len(centers), device=centers.device)
    for silhouette in silhouettes:
        distance, change = silhouette.look_up(centers[remaining], radius)
        outside = distance > change + _CARVING.interpolation
        inside = distance < -change - _CARVING.interpolation
        state[remaining] = torch.where(outside, 1, torch.where(inside, state[remaining], 0)).to(torch.int8)
        remaining = remaining[~outside]
    return state


def _check_covered(hull: VisualHull, silhouettes: list[_Silhouette], masks: Sequence[Tensor]) -> None:
    """Raise InputError if the hull leaves much of a mask empty, as it does where masks or cameras are exchanged."""
    points = hull.origin + 2 * hull.spacing * (hull.field[::2, ::2, ::2] < 0).nonzero()
    for silhouette, mask in zip(silhouettes, masks, strict=True):
        camera = silhouette.camera
        pixels, depth = camera.project(points)
        pixels = pixels[camera.contains(pixels)]
        # Cells of the picture that are wider than the spacing of the points.
        side = max(2, math.ceil(4 * hull.spacing * float(camera.intrinsics[0] / depth.median())))
        wanted = torch.nn.functional.avg_pool2d(mask[None, None].float(), side, ceil_mode=True)[0, 0] > 0.5
        covered = torch.zeros_like(wanted)
        column, row = ((pixels + 0.5) / side).floor().long().unbind(-1)
        covered[row, column] = True
        share = float((covered & wanted).sum() / wanted.sum().clamp(min=1))
        if bool(wanted.any()) and share < _CARVING.min_covered:
            raise InputError(
                f"masks must fit together, but what all of them have in common fills {100 * share:.0f} % of that of "
                f"{camera.name or 'a camera'}; check that masks and cameras are in the same order"
            )


def _sampled(silhouettes: list[_Silhouette], points: Tensor) -> Tensor:
    """Return the field at points (N, 3): the largest signed distance of all silhouettes, in the unit of space."""
    parts = []
    for chunk in points.split(_CHUNK):
        field = chunk.new_full(chunk.shape[:1], -torch.inf)
        for silhouette in silhouettes:
            distance, _ = silhouette.look_up(chunk, 0.0)
            field = torch.maximum(field, distance * silhouette.pixel_size(chunk))
        parts.append(field)
    return torch.cat(parts) if parts else points.new_zeros(0)


def _found_box(silhouettes: list[_Silhouette]) -> Tensor:
    """Return a box (2, 3) around the hull: about the point nearest to the rays of all masks' middles, then shrunk."""
    positions = torch.stack([silhouette.camera.position for silhouette in silhouettes])
    middles = []
    for silhouette in silhouettes:
        inside = (silhouette.distance[0, 0] < 0).nonzero().flip(-1).to(positions)
        middles.append(silhouette.camera.directions(inside.mean(0, keepdim=True))[0])
    rays = torch.nn.functional.normalize(torch.stack(middles), dim=-1)
    across = torch.eye(3).to(rays) - rays.unsqueeze(-1) * rays.unsqueeze(-2)
    center = torch.linalg.lstsq(across.sum(0), (across @ positions.unsqueeze(-1)).sum(0)).solution[:, 0]
    half = (positions - center).norm(dim=-1).min()
    # Rays within half a degree of each other do not determine the depth.
    if float(torch.linalg.eigvalsh(across.mean(0))[0]) < 1e-4:
        raise InputError("cameras must stand around the object; pass box= where they do not")
    box = torch.stack((center - half, center + half))
    for _ in range(_CARVING.box_rounds):
        box = _shrunk(silhouettes, box)
    return box


def _shrunk(silhouettes: list[_Silhouette], box: Tensor) -> Tensor:
    """Return the bounds (2, 3) of the cells of a box, 32 to its longest side, in which part of the hull may lie."""
    size = float((box[1] - box[0]).max()) / _CARVING.box_resolution
    counts = [max(1, math.ceil(side / size - 1e-6)) for side in (box[1] - box[0]).tolist()]
    cells = torch.ones(counts, dtype=torch.bool).nonzero().to(box)
    kept = cells[_decided(silhouettes, box[0] + size * (cells + 0.5), 0.5 * size * 3**0.5) < 1]
    if not len(kept):
        return box
    return torch.stack((box[0] + size * kept.amin(0), box[0] + size * (kept.amax(0) + 1)))


def _checked_box(box: Tensor) -> Tensor:
    box = as_float_tensor(box, "box").float()
    check_shape(box, "box", (2, 3))
    check_finite(box, "box")
    if not bool((box[1] > box[0]).all()):
        raise InputError(f"box must hold its lower and its upper corner, got {box.tolist()}")
    return box
