"""Where a camera saw nothing, beyond the outline of a range scan, and what it would have seen."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_positive, check_same_kind, check_shape
from torchreg.geometry.neighbors import NeighborTree, k_nearest
from torchreg.registration.dense.occlusion import PinholeView

# Neighbors in the picture that a normal is averaged over, and that tell how it changes towards the outline.
_FEW, _MANY = 6, 16
# An outline is where nothing is seen so many spacings farther out; neighbors at other depths are another surface.
_PROBE, _EMPTY, _SAME_DEPTH = 2.0, 1.4, 4.0
# Sine of the slant at the outline below which the surface did not end by turning away.
_TURNED = 0.3
# Cosine of the slant beside the outline: above the first nothing is known of what is beyond, below the other all.
_FACING = (0.7, 0.5)
# A sample hides what is behind it within so many spacings; with less than this cosine a surface may not be seen.
_HIDES, _SEEN = 2.0, 0.1


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """The space in front of a range scan and beyond its outline, seen from its camera; made by `of`.

    Args:
        picture: what the camera sees.
        flat: (S, 2) places of the samples in it.
        depth: (S,) of the samples, along the view.
        spacing: typical distance of those.
        trust: (S,) in [0, 1], whether beside a sample the surface ended by turning away from the camera.
    """

    picture: PinholeView
    flat: Tensor
    depth: Tensor
    spacing: float
    trust: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, points: Tensor, normals: Tensor, viewpoint: Tensor, most_cut: float) -> FreeSpace:
        """Return the free space of a scan.

        A scan whose outline in more than a share of its length faces the camera lacks data there: then nothing is
        known about what its empty pixels hold.

        Args:
            points: (S, 3) samples of the scan, spread evenly.
            normals: (S, 3) unit vectors.
            viewpoint: (3,) where the camera was.
            most_cut: the share.

        Raises:
            InputError: if a shape does not fit, or the share is not positive.
            InputTypeError: if dtypes or devices differ.

        Differentiable: no.
        """
        check_shape(points, "points", ("S", 3))
        check_shape(normals, "normals", tuple(points.shape))
        check_shape(viewpoint, "viewpoint", (3,))
        check_same_kind(normals, "normals", points, "points")
        check_same_kind(viewpoint, "viewpoint", points, "points")
        check_positive(most_cut, "most_cut")
        picture = PinholeView.of(points, viewpoint)
        flat, depth = picture.project(points)
        trust = torch.zeros_like(depth)
        if len(points) <= _MANY:
            return cls(picture, flat, depth, 0.0, trust)
        index, apart = k_nearest(flat, flat, _MANY)
        spacing = float(apart[:, 1].median())
        if _share_cut(flat, depth, normals @ picture.rotation.mT, index, spacing) > most_cut:
            return cls(picture, flat, depth, spacing, trust)
        facing = -(normals @ picture.rotation[2])[index[:, :_FEW]].mean(1)
        return cls(picture, flat, depth, spacing, ((_FACING[0] - facing) / (_FACING[0] - _FACING[1])).clamp(0, 1))

    @torch.no_grad()
    def beyond(self, points: Tensor, margin: float) -> tuple[Tensor, Tensor, Tensor]:
        """Return how far points (N, 3) are beyond the outline.

        Args:
            points: (N, 3).
            margin: lengths up to this do not count, in the unit of the points: at least a spacing of the samples.

        Returns:
            distances (N,), 0 for those that may be where they are; unit directions (N, 3) back, along the picture; and
            trusts (N,) in [0, 1].

        Differentiable: no.
        """
        flat, depth = self.picture.project(points)
        index, apart = NeighborTree(self.flat).nearest(flat)
        apart = apart.to(points)
        back = (self.flat[index] - flat) / apart.clamp_min(torch.finfo(flat.dtype).tiny).unsqueeze(1)
        # What is twice as far as the picture moves twice as far.
        distance = (apart * depth / self.picture.distance).clamp_min(0)
        distance = torch.where(distance > margin, distance, 0.0)
        return distance, back @ self.picture.rotation[:2], self.trust[index] * (distance > 0)

    @torch.no_grad()
    def in_view(self, points: Tensor, normals: Tensor, behind: float) -> Tensor:
        """Return which points (N,) bool the camera would have seen, had they been there.

        Not those that are behind the scan, nor those that look away from the camera or along the picture.

        Args:
            points: (N, 3).
            normals: (N, 3) unit vectors.
            behind: from how far behind a sample points count as hidden, in their unit.

        Raises:
            InputError: if a shape does not fit, or the distance is not positive.
            InputTypeError: if dtypes or devices differ, also from those of the scan.

        Differentiable: no.
        """
        check_shape(points, "points", ("N", 3))
        check_shape(normals, "normals", tuple(points.shape))
        check_same_kind(normals, "normals", points, "points")
        check_same_kind(points, "points", self.flat, "the scan")
        check_positive(behind, "behind")
        flat, depth = self.picture.project(points)
        index, apart = NeighborTree(self.flat).nearest(flat)
        hidden = (apart < _HIDES * self.spacing) & (depth > self.depth[index] + behind)
        rays = torch.nn.functional.normalize(points - self.picture.viewpoint, dim=-1)
        return ~hidden & (-(normals * rays).sum(-1) >= _SEEN)


def _share_cut(flat: Tensor, depth: Tensor, normals: Tensor, index: Tensor, spacing: float) -> float:
    """Return the share of an outline at which the surface does not end by turning away.

    Args:
        flat: (S, 2) places in the picture.
        depth: (S,) along the view.
        normals: (S, 3) in camera coordinates.
        index: (S, K) neighbors in the picture.
        spacing: typical distance of the places.
    """
    outward = torch.nn.functional.normalize(flat - flat[index].mean(1), dim=-1)
    probe = flat + _PROBE * spacing * outward
    rim = NeighborTree(flat).nearest(probe)[1].to(flat) > _EMPTY * spacing
    if not rim.any():
        return 1.0
    flat_rim, outward, index = flat[rim], outward[rim], index[rim]
    # A line through slants over places, outwards, tells the slant at the outline itself.
    same = ((depth[index] - depth[rim].unsqueeze(1)).abs() < _SAME_DEPTH * spacing).to(flat)
    same = same / same.sum(1, keepdim=True)
    place = ((flat[index] - flat_rim.unsqueeze(1)) * outward.unsqueeze(1)).sum(-1)
    slant = (normals[index][..., :2] * outward.unsqueeze(1)).sum(-1)
    middle, level = ((same * value).sum(1, keepdim=True) for value in (place, slant))
    rise = (same * (place - middle) * (slant - level)).sum(1)
    slope = rise / (same * (place - middle).square()).sum(1).clamp_min(1e-6 * spacing**2)
    return float((level[:, 0] - slope * middle[:, 0] < _TURNED).to(flat).mean())
