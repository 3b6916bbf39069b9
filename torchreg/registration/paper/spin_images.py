"""Spin images: what a surface looks like from one of its points, whatever the turn about the normal there."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchreg._checks import (
    as_float_tensor,
    check_choice,
    check_count,
    check_finite,
    check_points,
    check_positive,
    check_same_kind,
    check_shape,
)

# Pairs of a point and a scan point looked at in one go: in cache on a CPU.
_CHUNK_ENTRIES = 200_000
# From here on two images count as equal; atanh(1) is infinite.
_LARGEST_R = 0.999
SIMILARITIES = ("correlation", "overlap", "l2", "distance")


def spin_images(
    points: Tensor,
    normals: Tensor,
    scan_points: Tensor,
    scan_normals: Tensor | None = None,
    *,
    bin_size: float,
    image_size: int = 15,
    support_angle: float = math.pi / 2,
    weights: Tensor | None = None,
    interpolate: bool = True,
) -> Tensor:
    """Return how much of a scan lies at each radius and height of the cylinders around oriented points.

    A scan point x seen from the point p with normal n has the radius ``alpha = sqrt(|x - p|^2 - (n . (x - p))^2)`` and
    the height ``beta = n . (x - p)``; it counts if its own normal is less than the support angle from n (Johnson 1997,
    "Spin-images: a representation for 3-D surface matching", chapter 2).
    """
    inputs = {"points": points, "normals": normals, "scan_points": scan_points, "scan_normals": scan_normals}
    tensors = {name: as_float_tensor(value, name) for name, value in inputs.items() if value is not None}
    for name, value in tensors.items():
        check_points(value, name, batch=False)
        check_same_kind(value, name, tensors["points"], "points")
    check_shape(tensors["normals"], "normals", tuple(tensors["points"].shape))
    if scan_normals is not None:
        check_shape(tensors["scan_normals"], "scan_normals", tuple(tensors["scan_points"].shape))
    mass = tensors["scan_points"].new_ones(len(scan_points)) if weights is None else as_float_tensor(weights, "weights")
    check_shape(mass, "weights", (len(scan_points),))
    check_finite(mass, "weights")
    check_positive(bin_size, "bin_size")
    check_count(image_size, "image_size", 1)
    check_positive(support_angle, "support_angle")
    with torch.no_grad():
        seen = tensors["scan_points"]
        center = seen.mean(0)  # squares below lose digits far from zero
        around = (seen - center) / bin_size
        scene = _Scene(around, tensors.get("scan_normals"), mass.to(seen), image_size, support_angle, interpolate)
        step = max(1, _CHUNK_ENTRIES // len(seen))
        places = (tensors["points"] - center) / bin_size
        parts = zip(places.split(step), tensors["normals"].split(step), strict=True)
        return torch.cat([scene.images(*part) for part in parts])


class _Scene:
    """A scan in units of bins, centered."""

    def __init__(
        self,
        points: Tensor,
        normals: Tensor | None,
        weights: Tensor,
        size: int,
        support_angle: float,
        interpolate: bool,
    ) -> None:
        self._points, self._normals, self._weights = points, normals, weights
        self._squares = points.square().sum(-1)
        self._size, self._interpolate = size, interpolate
        # Beyond -1, so that half a turn of support leaves nothing out by rounding.
        self._least_cosine = math.cos(support_angle) if support_angle < math.pi else -2.0

    def images(self, points: Tensor, normals: Tensor) -> Tensor:
        """Return images (C, S, S) from points (C, 3)."""
        size = self._size
        height = torch.addmm((normals * points).sum(-1, keepdim=True), normals, self._points.mT, beta=-1)
        square = torch.addmm(self._squares, points, self._points.mT, alpha=-2)
        square = square.add_(points.square().sum(-1, keepdim=True)).addcmul_(height, height, value=-1)
        inside = (height.abs() < size / 2) & (square < size**2)
        if self._normals is not None:
            inside &= normals @ self._normals.mT > self._least_cosine
        # Flat indices: a mask would be searched anew for every tensor it picks from.
        flat = inside.reshape(-1).nonzero()[:, 0]
        image = flat.div(len(self._points), rounding_mode="floor")
        seen = flat - image * len(self._points)
        row = size / 2 - height.reshape(-1).index_select(0, flat)
        column = square.reshape(-1).index_select(0, flat).clamp_min_(0).sqrt_()
        share = self._weights[seen]
        if self._interpolate:
            return self._shared_out(len(points), image, row - 0.5, column - 0.5, share)
        row, column = (value.long().clamp_(0, size - 1) for value in (row, column))
        counts = points.new_zeros(len(points) * size * size)
        return counts.scatter_add_(0, (image * size + row) * size + column, share).reshape(-1, size, size)

    def _shared_out(self, count: int, image: Tensor, row: Tensor, column: Tensor, share: Tensor) -> Tensor:
        """Return images to which every point gave to the four bins whose middles surround it."""
        # A frame of bins around each image takes what falls beyond its rims.
        framed = self._size + 2
        upper, left = row.floor(), column.floor()
        below, right = (row - upper).mul_(share), column - left
        above = share - below
        place = image.mul_(framed).add_(upper.long()).add_(1).mul_(framed).add_(left.long()).add_(1)
        counts = share.new_zeros(count * framed * framed)
        for part, line in ((above, 0), (below, framed)):
            far = part * right
            counts.scatter_add_(0, place + line if line else place, part - far)
            counts.scatter_add_(0, place + (line + 1), far)
        counts = counts.view(count, framed, framed)[:, 1:-1]
        images = counts[:, :, 1:-1].clone()
        images[:, :, 0] += counts[:, :, 0]
        return images


def image_similarity(
    source: Tensor, target: Tensor, similarity: str = "correlation", *, overlap: float = 3.0
) -> Tensor:
    """Return how alike any two images are, larger for more.

    References: Johnson 1997, section 2.4 for "overlap", his similarity measure C.
    """
    source, target = as_float_tensor(source, "source"), as_float_tensor(target, "target")
    check_same_kind(target, "target", source, "source")
    check_shape(target, "target", ("K", *source.shape[1:]))
    check_choice(similarity, "similarity", SIMILARITIES)
    first, second = source.flatten(1), target.flatten(1)
    if similarity == "overlap":
        return _overlap_similarity(first, second, overlap)
    if similarity == "distance":
        return -torch.cdist(first, second)
    if similarity == "l2":
        first, second = (torch.nn.functional.normalize(value, dim=-1) for value in (first, second))
        return -(2 - 2 * first @ second.mT).clamp_min(0).sqrt()
    first, second = (value - value.mean(-1, keepdim=True) for value in (first, second))
    return torch.nn.functional.normalize(first, dim=-1) @ torch.nn.functional.normalize(second, dim=-1).mT


def _overlap_similarity(source: Tensor, target: Tensor, overlap: float) -> Tensor:
    # One scale for all keeps float32 sums of squares apart from zero.
    unit = source.mean().clamp_min(torch.finfo(source.dtype).tiny)
    source, target = source / unit, target / unit
    here, there = (source != 0).to(source), (target != 0).to(target)
    count = here @ there.mT
    number = count.clamp_min(1)
    first, second = source @ there.mT / number, here @ target.mT / number
    covariance = source @ target.mT / number - first * second
    spread = source.square() @ there.mT / number - first.square()
    spread_there = here @ target.square().mT / number - second.square()
    variance = spread * spread_there
    # Below this, rounding alone makes a variance of equal numbers.
    noise = (torch.finfo(source.dtype).eps * 16) ** 2
    r = torch.where(variance > noise, covariance / variance.clamp_min(noise).sqrt(), 0.0)
    r = r.clamp(-_LARGEST_R, _LARGEST_R)
    score = r.sign() * torch.atanh(r).square() - overlap / (count - 3).clamp_min(1)
    return score.masked_fill(count < 4, -math.inf)
