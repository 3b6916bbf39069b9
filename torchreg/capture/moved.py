"""What moved between two depth pictures of one scene; all else is background."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.capture.background_motion import background_motion, depth_noise
from torchreg.capture.depth import depth_scan
from torchreg.capture.depth_frame import DepthFrame, pooled
from torchreg.capture.depth_segments import SurfaceGrid
from torchreg.errors import FileWarning, InputTypeError
from torchreg.geometry.graphs import connected_components
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import invert_rigid


@dataclass(frozen=True)
class _Rule:
    """When depths differ, and when a surface moved."""

    deviations: float = 4.0  # of the noise, beyond which two depths differ: one pixel in 16,000 by chance
    gone: float = 0.1  # share of a surface that is gone: more than the edges of what stays
    carried: float = 0.3  # share that is gone, or is where the other picture shows what moved
    near: float = 0.5  # sizes of what moved; what hides a place from so near may be the same thing
    changed: float = 0.3  # share of a large plane that differs: it is no background
    least: int = 10  # pixels that say so
    most: int = 20_000  # pixels that stand for all: planes and surfaces are found in half a second
    patch: float = 0.25  # of the pixels of the largest patch that is gone: smaller ones do not count for the size
    trimmed: float = 0.02  # share of their points at each end that does not count either


_RULE = _Rule()


@dataclass(frozen=True, eq=False)
class MovedMasks:
    """What moved between two depth pictures; see `moved_masks`.

    Args:
        source: (H, W) bool, pixels of the first picture.
        target: (H', W') bool, pixels of the second one.
        noise: standard deviation of depths at one metre, metres; it grows with the square of the depth.
        motion: (4, 4) float64, the rigid motion of the background from the first picture to the second one; it is that
            of a camera in a hand, too.
    """

    source: Tensor
    target: Tensor
    noise: float
    motion: Tensor


@torch.no_grad()
def moved_masks(source: DepthFrame, target: DepthFrame) -> MovedMasks:
    """Return which pixels of two depth pictures show what moved between them, against their background.

    A place is gone if the other picture shows what is behind it. A surface is a set of pixels without a step in depth
    between them, after large planes that stay are removed. It moved, as a whole, if a tenth of it is gone. It also
    moved if three tenths are gone, show what moved in the other picture, or are hidden by that. The cameras may be in
    a hand, or the background may be a body that turns: its rigid motion, and the noise of depths, are estimated from
    the pictures, see `background_motion`.

    Args:
        source: H x W pixels; those off its mask count as background.
        target: H' x W' pixels of the same scene.

    Returns:
        a `MovedMasks`, with empty masks if nothing moved.

    Raises:
        InputTypeError: if one is no `DepthFrame`.

    Differentiable: no.

    Cost: 0.5 s for 320 x 240 pixels.
    """
    for name, frame in (("source", source), ("target", target)):
        if not isinstance(frame, DepthFrame):
            raise InputTypeError(f"{name} must be a DepthFrame, got {type(frame).__name__}")
    motion = background_motion(source, target)
    target = DepthFrame(target.depth, target.camera.moved(invert_rigid(motion)), target.mask)
    views = _Comparison.of(source, target), _Comparison.of(target, source)
    size = max(view.size_of_change() for view in views)
    if size == 0:
        return MovedMasks(torch.zeros_like(views[0].gone), torch.zeros_like(views[1].gone), views[0].noise, motion)
    surfaces = [_Surfaces.of(view, size) for view in views]
    gone = [found.mask(found.gone, found.same, _RULE.gone) for found in surfaces]
    both = []
    for found, own, other in zip(surfaces, gone, gone[::-1], strict=True):
        carried = found.grid.at(found.view.shows(other, _RULE.near * size))
        both.append(own | found.mask(found.gone | carried, found.same & ~carried, _RULE.carried))
    return MovedMasks(both[0], both[1], views[0].noise, motion)


@dataclass(frozen=True, eq=False)
class _Comparison:
    """The pixels (H, W) of a picture, each against what another picture shows at its place.

    Args:
        frame: the picture.
        gone: (H, W) bool, the other picture shows something behind.
        same: (H, W) bool, it shows the place.
        hidden: (H, W) metres by which it shows something in front; zero where it does not.
        pixel: (H, W) int64 number of the other picture's pixel, -1 outside of it.
        noise: standard deviation of depths at one metre, metres.
    """

    frame: DepthFrame
    gone: Tensor
    same: Tensor
    hidden: Tensor
    pixel: Tensor
    noise: float

    @classmethod
    def of(cls, frame: DepthFrame, other: DepthFrame) -> _Comparison:
        row, column = frame.measured.nonzero().unbind(-1)
        pixels = torch.stack((column, row), dim=-1).double()
        points = frame.camera.unproject(pixels, frame.depth[row, column].double())
        place, depth = other.camera.project(points)
        at_column, at_row = place.round().long().unbind(-1)
        height, width = other.depth.shape
        inside = (depth > 0) & (at_column >= 0) & (at_column < width) & (at_row >= 0) & (at_row < height)
        number = torch.where(inside, at_row * width + at_column, 0)
        shown = other.depth.double()
        # Edges are ruffled: the nearest and the farthest of the pixels around count.
        nearest = -pooled(torch.where(shown > 0, -shown, -torch.inf), 1).reshape(-1)[number]
        farthest = pooled(torch.where(shown > 0, shown, -torch.inf), 1).reshape(-1)[number]
        measured = inside & (shown.reshape(-1)[number] > 0)
        off = ((shown.reshape(-1)[number] - depth) / depth.square())[measured]
        noise = depth_noise(off) / 2**0.5
        reach = _RULE.deviations * 2**0.5 * noise * depth.square()
        known = inside & farthest.isfinite()
        gone, hidden = known & (depth < nearest - reach), known & (depth > farthest + reach)

        def picture(values: Tensor, empty: float) -> Tensor:
            found = torch.full(frame.depth.shape, empty, dtype=values.dtype, device=values.device)
            found[row, column] = values
            return found

        return cls(
            frame=frame,
            gone=picture(gone, False),
            same=picture(known & ~gone & ~hidden, False),
            hidden=picture(torch.where(hidden, depth - farthest, 0.0), 0.0),
            pixel=picture(torch.where(inside, number, -1), -1),
            noise=noise,
        )

    def size_of_change(self) -> float:
        """Return the diagonal, metres, of the large patches that are gone; zero if there are none."""
        index = self.gone.nonzero()
        if len(index) < _RULE.least:
            return 0.0
        number = torch.full(self.gone.shape, -1, dtype=torch.int64, device=index.device)
        number[self.gone] = torch.arange(len(index), device=index.device)
        pairs = [
            torch.stack((first, second), dim=-1)[(first >= 0) & (second >= 0)]
            for first, second in ((number[:, :-1], number[:, 1:]), (number[:-1], number[1:]))
        ]
        patch = connected_components(torch.cat(pairs), len(index))
        counts = torch.bincount(patch)
        if int(counts.max()) < _RULE.least:
            return 0.0
        row, column = index[counts[patch] >= _RULE.patch * counts.max()].unbind(-1)
        pixels = torch.stack((column, row), dim=-1).double()
        points = self.frame.camera.unproject(pixels, self.frame.depth[row, column].double())
        span = torch.tensor([_RULE.trimmed, 1 - _RULE.trimmed]).to(points)
        return float(points.quantile(span, dim=0).diff(dim=0).norm())

    def shows(self, mask: Tensor, near: float) -> Tensor:
        """Return where (H, W) the other picture shows its mask (H', W') at a place, or in front of it but near."""
        masked = mask.reshape(-1)[self.pixel.clamp_min(0)] & (self.pixel >= 0)
        return masked & (self.same | ((self.hidden > 0) & (self.hidden < near)))


@dataclass(frozen=True, eq=False)
class _Surfaces:
    """The surfaces of a picture without its background planes.

    Args:
        view: the picture against the other one.
        grid: of V pixels.
        number: (V,) of their surfaces.
    """

    view: _Comparison
    grid: SurfaceGrid
    number: Tensor

    @classmethod
    def of(cls, view: _Comparison, size: float) -> _Surfaces:
        depth = view.frame.depth[view.frame.measured]
        grid = SurfaceGrid.of(view.frame, size, view.noise * float(depth.median()) ** 2, _RULE.most)
        changed, same = grid.at(view.gone | (view.hidden > 0)), grid.at(view.same)

        def moved(nodes: Tensor) -> bool:
            return float(changed[nodes].sum()) > _RULE.changed * float((changed | same)[nodes].sum())

        grid = grid.without_planes(size, moved)
        return cls(view=view, grid=grid, number=grid.graph.components())

    @property
    def gone(self) -> Tensor:
        """Which nodes (V,) are gone."""
        return self.grid.at(self.view.gone)

    @property
    def same(self) -> Tensor:
        """Which nodes (V,) stay."""
        return self.grid.at(self.view.same)

    def mask(self, moved: Tensor, stays: Tensor, least: float) -> Tensor:
        """Return the mask (H, W) of the surfaces of whose nodes (V,) at least a share moved, not stays."""
        if not len(self.number):
            return torch.zeros_like(self.view.gone)
        number = self.number.to(moved.device)
        moves, rests = (torch.bincount(number, values.double()) for values in (moved, stays))
        chosen = (moves >= _RULE.least) & (moves > least * (moves + rests))
        return self.grid.mask(chosen[number])


def moved_scans(
    source: DepthFrame, target: DepthFrame, *, smoothing: float | None = None, stacklevel: int = 1
) -> tuple[RangeScan, RangeScan]:
    """Return scans of what moved between two depth pictures, of all that counts if nothing did, and warn.

    Pictures with masks are scanned as these say. ``smoothing`` is that of `depth_scan`; by default the noise of the
    depths where it is known, from the background.
    """
    frames, masks = (source, target), (source.measured, target.measured)
    if source.mask is None and target.mask is None:
        moved = moved_masks(source, target)
        if bool(moved.source.any()) and bool(moved.target.any()):
            smoothing = moved.noise if smoothing is None else smoothing
            left = [int((whole & ~mask).sum()) for whole, mask in zip(masks, (moved.source, moved.target), strict=True)]
            masks = (moved.source, moved.target)
            what = (
                f"{left[0]} of {left[0] + int(masks[0].sum())} pixels of source and {left[1]} of "
                f"{left[1] + int(masks[1].sum())} of target show what did not move, and are left out; pass "
                f"support='keep' to keep them"
            )
        else:
            what = "nothing is found to move between source and target, so all that they show counts; pass masks"
        warnings.warn(what, FileWarning, stacklevel=stacklevel + 1)
    first, second = (
        depth_scan(torch.where(mask, frame.depth, 0.0), frame.camera, smoothing=smoothing or 0.0)
        for frame, mask in zip(frames, masks, strict=True)
    )
    return first, second
