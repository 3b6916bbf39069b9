"""Free space of depth pictures: nothing is in front of the measured surface or outside of the mask."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from torch import Tensor

from torchreg.capture.mask_distance import beside_mask
from torchreg.geometry.camera import Camera, distort, lens_jacobian


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """The free space of F depth pictures, for B problems, each of which uses one of them.

    A point at depth z whose pixel has a surface at depth D intrudes by ``D - z`` if that is positive; outside of the
    mask by the smaller of that and ``z / f`` times its distance from the mask in pixels. Nothing is known behind the
    surface, without a measurement within the mask, outside of the picture and behind the camera.
    """

    depth: Tensor  # (F, H, W) metres, zero where nothing was measured
    beside: Tensor  # (F, H, W) distance from the mask, pixels, zero inside
    extent: Tensor  # (F, 2) width and height of the pictures, pixels; smaller ones are padded
    intrinsics: Tensor  # (F, 4) fx, fy, cx, cy, pixels
    world_to_camera: Tensor  # (F, 4, 4) rigid motions
    lens: Tensor  # (F, 8) see `Camera`
    picture: Tensor  # (B,) int64 number of each problem's picture
    origin: Tensor  # (B, 3) of each problem's coordinates, in the world, metres
    datum_area: Tensor  # (B,) area that a datum stands for at a depth of one metre, square metres

    @classmethod
    def of_picture(cls, depth: Tensor, camera: Camera, mask: Tensor | None, stride: int) -> FreeSpace:
        """Return the free space of one picture (H, W), metres, whose data are every ``stride``-th pixel each way."""
        beside = torch.zeros_like(depth) if mask is None else beside_mask(mask).to(depth)
        fx, fy = camera.intrinsics[:2].tolist()
        return cls(
            depth=depth[None],
            beside=beside[None],
            extent=depth.new_tensor([[camera.width, camera.height]]),
            intrinsics=camera.intrinsics[None].to(depth),
            world_to_camera=camera.world_to_camera[None].to(depth.device, torch.float64),
            lens=camera.distortion[None].to(depth),
            picture=torch.zeros(1, dtype=torch.int64, device=depth.device),
            origin=torch.zeros(1, 3, dtype=torch.float64, device=depth.device),
            datum_area=depth.new_tensor([stride**2 / (fx * fy)]),
        )

    @classmethod
    def stacked(cls, parts: Sequence[FreeSpace]) -> FreeSpace:
        """Return the free space of several pictures, one after another; smaller ones are padded."""
        height, width = (max(part.depth.shape[axis] for part in parts) for axis in (1, 2))
        values = {item.name: [getattr(part, item.name) for part in parts] for item in fields(cls)}
        for name in ("depth", "beside"):
            values[name] = [
                torch.nn.functional.pad(value, (0, width - value.shape[2], 0, height - value.shape[1]))
                for value in values[name]
            ]
        starts = torch.tensor([0, *(len(part.depth) for part in parts)]).cumsum(0).tolist()
        values["picture"] = [part.picture + start for part, start in zip(parts, starts, strict=False)]
        return cls(**{name: torch.cat(value) for name, value in values.items()})

    def rows(self, index: Tensor) -> FreeSpace:
        """Return the free space of some problems, which may repeat."""
        return replace(self, picture=self.picture[index], origin=self.origin[index], datum_area=self.datum_area[index])

    def moved(self, origin: Tensor) -> FreeSpace:
        """Return the free space with coordinates whose origin is moved by (B, 3) or (3,), metres."""
        return replace(self, origin=self.origin + origin.to(self.origin))

    def thinned(self, factor: Tensor) -> FreeSpace:
        """Return the free space for data of which each stands for (B,) times as many."""
        return replace(self, datum_area=self.datum_area * factor.to(self.datum_area))

    def to(self, like: Tensor) -> FreeSpace:
        """Return the free space on the device and in the dtype of a tensor; motions and origins stay in float64."""
        exact = ("picture", "origin", "world_to_camera")
        return replace(
            self,
            **{
                item.name: value.to(like.device) if item.name in exact else value.to(like)
                for item in fields(self)
                if isinstance(value := getattr(self, item.name), Tensor)
            },
        )

    def intrusion(self, points: Tensor) -> Tensor:
        """Return the depths (B, ...), metres, by which points (B, ..., 3) of the problems intrude into free space."""
        return self._look(points.reshape(len(points), -1, 3)).intrusion.reshape(points.shape[:-1])

    def intrusion_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return the intrusion of points (B, N, 3) and its gradient (B, N, 3) by their coordinates."""
        seen = self._look(points)
        return seen.intrusion, self._gradient(seen)

    def intruding(self, points: Tensor, tolerance: float) -> tuple[Tensor, Tensor, Tensor]:
        """Return the indices (K,) of points that intrude in any problem, by how much (B, K), and its gradients."""
        seen = self._look(points)
        index = (seen.intrusion > tolerance).any(0).nonzero()[:, 0]
        seen = seen.part(index)
        return index, seen.intrusion, self._gradient(seen)

    def _gradient(self, seen: _Look) -> Tensor:
        """Return the gradients (B, N, 3) of the intrusion by the coordinates of points."""
        intrinsics = self.intrinsics[self.picture].unsqueeze(1)
        scale = intrinsics[..., :2].prod(-1).rsqrt()
        by_plane = seen.slope * intrinsics[..., :2]
        if self._is_distorted:
            lens = self.lens[self.picture].mT.unsqueeze(-1)
            by_plane = (by_plane.unsqueeze(-2) @ lens_jacobian(seen.plane, lens)).squeeze(-2)
        across = by_plane * scale.unsqueeze(-1)
        along = seen.distance * scale - (across * seen.plane).sum(-1)
        sideways = torch.cat((across, along.unsqueeze(-1)), dim=-1)
        ahead = torch.zeros_like(sideways)
        ahead[..., 2] = -1
        local = torch.where((seen.ahead <= seen.sideways).unsqueeze(-1), ahead, sideways)
        local = torch.where(seen.counts.unsqueeze(-1), local, 0.0)
        return local @ self.world_to_camera[self.picture, :3, :3].to(local)

    @cached_property
    def _is_distorted(self) -> bool:
        return bool(self.lens.any())

    def depths(self, points: Tensor) -> Tensor:
        """Return the depths (B, N) of points (B, N, 3) before the cameras, metres."""
        return self._local(points)[..., 2]

    def _local(self, points: Tensor) -> Tensor:
        motion = self.world_to_camera[self.picture]
        # The offset in full precision: worlds may be large.
        offset = (motion[:, :3, :3] @ self.origin.unsqueeze(-1)).squeeze(-1) + motion[:, :3, 3]
        return points @ motion[:, :3, :3].mT.to(points) + offset.unsqueeze(1).to(points)

    def _look(self, points: Tensor) -> _Look:
        """Return the pictures' values at points (B, N, 3)."""
        local = self._local(points)
        depth = local[..., 2]
        plane = local[..., :2] / torch.where(depth > 0, depth, 1.0).unsqueeze(-1)
        focal, center = self.intrinsics[self.picture].unsqueeze(1).split(2, dim=-1)
        bent = distort(plane, self.lens[self.picture].mT.unsqueeze(-1)) if self._is_distorted else plane
        pixels = bent * focal + center
        extent = self.extent[self.picture].unsqueeze(1)
        framed = (depth > 0) & ((pixels >= -0.5) & (pixels < extent - 0.5)).all(-1)
        pixels = torch.where(framed.unsqueeze(-1), pixels, 0.0)
        measured = self._at(self.depth, pixels.round().long())
        distance, slope = self._distance(pixels, extent)
        outside = distance > 0
        ahead = torch.where(measured > 0, measured - depth, torch.where(outside, torch.inf, 0.0))
        sideways = torch.where(outside, distance * depth * focal.prod(-1).rsqrt(), torch.inf)
        return _Look(
            plane=plane, distance=distance, slope=slope, ahead=ahead, sideways=sideways, counts=framed & (ahead > 0)
        )

    def _at(self, pictures: Tensor, pixels: Tensor) -> Tensor:
        """Return the numbers (B, N) of pictures (F, H, W) at pixels (B, N, 2) within them."""
        height, width = pictures.shape[1:]
        index = (self.picture.unsqueeze(-1) * height + pixels[..., 1]) * width + pixels[..., 0]
        return pictures.flatten()[index]

    def _distance(self, pixels: Tensor, extent: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distance (B, N) from the mask, linear between pixels (B, N, 2), and its slope (B, N, 2)."""
        corner = torch.minimum(pixels.floor().clamp_min(0), extent - 2).clamp_min(0)
        right, down = (pixels - corner).unbind(-1)
        first, step = corner.long(), torch.eye(2, dtype=torch.int64, device=pixels.device)
        last = (extent - 1).long()
        values = [
            self._at(self.beside, torch.minimum(first + shift, last))
            for shift in (0 * step[0], step[0], step[1], step[0] + step[1])
        ]
        top, bottom = values[1] - values[0], values[3] - values[2]
        left = values[2] - values[0]
        slope = torch.stack((top + down * (bottom - top), left + right * (bottom - top)), dim=-1)
        return values[0] + right * top + down * left + right * down * (bottom - top), slope


@dataclass(frozen=True, eq=False)
class _Look:
    """What pictures show at points, (B, N): distance from the mask (pixels) and its slope, margins (metres).

    ``ahead`` of the measured surface, ``sideways`` outside of the mask, infinite inside; ``counts`` in free space.
    """

    plane: Tensor
    distance: Tensor
    slope: Tensor
    ahead: Tensor
    sideways: Tensor
    counts: Tensor

    @property
    def intrusion(self) -> Tensor:
        """How far points lie in free space, (B, N), metres."""
        return torch.where(self.counts, torch.minimum(self.ahead, self.sideways), 0.0)

    def part(self, index: Tensor) -> _Look:
        """Return the values at some of the points (K,)."""
        return _Look(**{item.name: getattr(self, item.name)[:, index] for item in fields(self)})
