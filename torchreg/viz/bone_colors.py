"""Colors of bones and of errors, and PLY files painted with them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_finite, check_positive, check_shape
from torchreg.errors import InputError
from torchreg.io.points import save_points
from torchreg.registration.bones.grid_lbs import GridLBS

# From no error to the largest: blue, green, yellow, red, dark.
_ERROR_COLORS = ((0.16, 0.31, 0.66), (0.18, 0.66, 0.44), (0.98, 0.86, 0.26), (0.86, 0.24, 0.16), (0.45, 0.05, 0.12))


@dataclass(frozen=True)
class _Palette:
    """Colors of bones by their number."""

    turn: float = 0.61803398875  # of the hue circle from bone to bone: never comes back near an earlier hue
    saturations: tuple[float, ...] = (0.65, 0.45, 0.85)
    values: tuple[float, ...] = (0.9, 0.7, 0.55)


_PALETTE = _Palette()


def bone_palette(count: int) -> Tensor:
    """Return colors (count, 3) in [0, 1], the first ones as different as possible."""
    number = torch.arange(count)
    hue = (number * _PALETTE.turn) % 1.0
    saturation = torch.tensor(_PALETTE.saturations)[number % 3]
    value = torch.tensor(_PALETTE.values)[number // 3 % 3]
    # The usual piecewise linear hue circle: red at 0, green at 1/3, blue at 2/3.
    wave = torch.stack([(hue * 6 + offset) % 6 for offset in (5.0, 3.0, 1.0)], dim=-1)
    drop = torch.minimum(wave, 4 - wave).clamp(0, 1)
    return value.unsqueeze(-1) * (1 - saturation.unsqueeze(-1) * drop)


def weight_colors(weights: Tensor) -> Tensor:
    """Return colors (..., N, 3) of weights (..., N, B): those of the bones, mixed by the weights."""
    total = weights.sum(-1, keepdim=True).clamp_min(torch.finfo(weights.dtype).tiny)
    return (weights / total) @ bone_palette(weights.shape[-1]).to(weights)


def error_colors(errors: Tensor, largest: float) -> Tensor:
    """Return colors (..., 3) of errors (...): blue at zero, red to dark at the largest and beyond.

    Args:
        errors: (...) not negative.
        largest: the error at the end of the scale, positive, so that pictures can be compared.

    Differentiable: in ``errors``.
    """
    return scale_colors((errors / largest).clamp(0, 1), _ERROR_COLORS)


def scale_colors(shares: Tensor, scale: Sequence[tuple[float, float, float]]) -> Tensor:
    """Return the colors (..., 3) at shares (...) from 0 to 1 of a scale of colors, linear in between."""
    colors = torch.tensor(scale, dtype=shares.dtype, device=shares.device)
    position = shares * (len(colors) - 1)
    index = position.detach().floor().long().clamp(max=len(colors) - 2)
    rest = (position - index).unsqueeze(-1)
    return (1 - rest) * colors[index] + rest * colors[index + 1]


def save_weight_ply(
    path: str | os.PathLike[str], model: GridLBS, points: Tensor, faces: Tensor | None = None, *, moved: bool = False
) -> None:
    """Write points painted with the weights of the bones to a PLY file.

    Args:
        path: a local file ending in .ply; an existing one is replaced.
        model: with the weights.
        points: (N, 3) before they are moved.
        faces: (F, 3) over the points, if any.
        moved: whether the points are written as moved by the model.
    """
    points = as_float_tensor(points, "points", like=model.weights)
    check_shape(points, "points", ("N", 3))
    check_finite(points, "points")
    with torch.no_grad():
        colors = weight_colors(model.weights_at(points)).clamp(0, 1)
        if moved and model.base_transforms.ndim > 3:
            raise InputError("the model holds several poses; call set_transforms_ with one, or leave moved False")
        positions = model(points) if moved else points
    _save_ply(path, positions, faces, colors)


def save_error_ply(
    path: str | os.PathLike[str],
    points: Tensor,
    errors: Tensor,
    faces: Tensor | None = None,
    *,
    largest: float | None = None,
) -> None:
    """Write points painted with their errors to a PLY file.

    Args:
        path: a local file ending in .ply; an existing one is replaced.
        points: (N, 3).
        errors: (N,) not negative, such as distances from the target; those that are not finite are painted gray.
        faces: (F, 3) over the points, if any.
        largest: the error at the end of the scale; the largest one by default.
    """
    points = as_float_tensor(points, "points")
    check_shape(points, "points", ("N", 3))
    errors = as_float_tensor(errors, "errors", like=points).detach()
    check_shape(errors, "errors", (len(points),))
    known = errors.isfinite()
    if bool((errors[known] < 0).any()):
        raise InputError("errors must not be negative; take their absolute values")
    if largest is None:
        largest = float(errors[known].max()) if bool(known.any()) else 1.0
    check_positive(largest, "largest", allow_zero=True)
    colors = error_colors(torch.where(known, errors, 0.0), largest or 1.0)
    _save_ply(path, points.detach(), faces, torch.where(known.unsqueeze(-1), colors, 0.5))


def _save_ply(path: str | os.PathLike[str], points: Tensor, faces: Tensor | None, colors: Tensor) -> None:
    if not os.fspath(path).lower().endswith(".ply"):
        raise InputError(f"path must end in .ply, got {os.fspath(path)!r}")
    save_points(path, points, colors=colors, faces=faces)
