"""Masks from pictures as programs write them: two values of any kind, labels, soft edges, transparency, palettes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from torchreg.io.clouds.raw_cloud import Array
from torchreg.io.file_format import warn


@dataclass(frozen=True)
class _Labels:
    """What distinguishes pictures of labels from masks with soft edges and halos."""

    interior: float = 0.5  # share of the pixels between dark and bright whose four neighbors are equal to them
    # Of a halo, which has regions of one value too: labels are fewer, touch what is around them, and are larger.
    white: int = 30  # least value inside
    contact: float = 0.05  # most of the border of what is brightest that touches what is darkest
    area: float = 1.5  # largest, as a share of that of what is brightest


_LABELS = _Labels()


def mask_of_picture(image: Any) -> Array:
    """Return the mask (H, W) of an open picture of PIL.

    Transparency that varies is the mask. Otherwise the brighter of two values is set, whatever they are; in a picture
    of labels all but black or zero; elsewhere, also where a halo surrounds what is white, what is at least as bright as
    half between the darkest and the brightest pixel.
    """
    kind = str(image.mode)
    if kind in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info:
        alpha = np.array(image.convert("RGBA"))[..., 3]
        if alpha.min() < alpha.max():
            return mask_of_numbers(alpha)
    if kind in ("P", "PA") or kind in ("RGBA", "RGBa", "CMYK", "YCbCr", "LAB", "HSV"):
        image = image.convert("RGB")
    elif kind in ("LA", "La"):
        image = image.convert("L")
    return mask_of_numbers(np.array(image))


def mask_of_numbers(values: Array) -> Array:
    """Return the mask (H, W) of numbers (H, W), or colors (H, W, 3); see `mask_of_picture`. NaN is not set."""
    if values.dtype == bool:
        return _told(values)
    is_gray = values.ndim == 2 or bool((values == values[..., :1])[..., :3].all())
    values = _brightness(values) if values.ndim == 3 else values
    known = np.isfinite(values) if values.dtype.kind == "f" else np.ones(values.shape, bool)
    if not known.any():
        return _told(known)
    low, high = (float(f(values[known])) for f in (np.min, np.max))
    if low == high:
        return _told(known & (values != 0))
    ends = known & ((values == low) | (values == high))
    if ends.sum() == known.sum():
        return _told(known & (values == high))
    if values.dtype.kind != "f" and low == 0 and _has_labels(values, ~ends):
        count = len(np.unique(values)) - 1
        if is_gray and _has_halo(values == 0, values == high, high):
            warn(f"what is {high:g} has a halo of {count - 1} other value(s): what is at least half as bright is set")
            return values >= 0.5 * high
        warn(f"holds {count} labels: all but 0 are set")
        return values != 0
    if values.dtype.kind == "f" and low < 0:  # scores whose sign decides
        return _told(known & (values > 0))
    with np.errstate(invalid="ignore"):
        return _told(known & (values >= 0.5 * (low + high)))


def _brightness(colors: Array) -> Array:
    """Return the largest channel (H, W); the sum of all where two colors share it."""
    colors = colors[..., :3].astype(np.int64)
    largest = colors.max(-1)
    return largest if largest.min() < largest.max() else colors.sum(-1)


def _has_labels(values: Array, between: Array) -> bool:
    """Return whether pixels (H, W) between the extremes lie in regions of one value, not along edges."""
    same = np.ones(values.shape, bool)
    for axis in (0, 1):
        step = np.diff(values.astype(np.int64), axis=axis) == 0
        border = np.ones_like(step[:1] if axis == 0 else step[:, :1])
        same &= np.concatenate((step, border), axis) & np.concatenate((border, step), axis)
    return bool((same & between).sum() > _LABELS.interior * between.sum())


def _has_halo(dark: Array, bright: Array, white: float) -> bool:
    """Return whether what is neither dark nor bright (H, W) surrounds what is bright as a soft edge does."""
    between = int((~dark & ~bright).sum())
    border = contact = 0
    for a, b in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        border += int((bright[a] ^ bright[b]).sum())
        contact += int((bright[a] & dark[b]).sum() + (dark[a] & bright[b]).sum())
    is_around = contact <= _LABELS.contact * border
    return white >= _LABELS.white and is_around and between <= _LABELS.area * int(bright.sum())


def _told(mask: Array) -> Array:
    """Return a mask, after a warning if it keeps all or nothing."""
    if mask.all() or not mask.any():
        warn(f"the mask {'keeps all' if mask.all() else 'keeps none'} of its {mask.size} pixels; is it the right file?")
    return mask
