"""Colors of pictures: their brightness, and masks of objects before a screen of one color."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_positive, check_shape

# Shares of red, green and blue in brightness (ITU-R BT.601).
_LUMA = (0.299, 0.587, 0.114)


def brightness(colors: Tensor) -> Tensor:
    """Return the brightness (...) of colors (..., 3), both from 0 to 1."""
    return colors @ colors.new_tensor(_LUMA)


def chroma_key(image: Tensor, background: Sequence[float] | None = None, *, tolerance: float = 0.12) -> Tensor:
    """Return the masks (..., H, W) of pixels of images (..., H, W, 3) that differ from a background of one color.

    Pixels differ by chroma ``(B - Y, R - Y)`` from the background scaled to their own brightness, as a screen keeps its
    hue in shade. The background is the median of each border by default; specks and pinholes are removed.
    """
    image = as_float_tensor(image, "image")
    check_shape(image, "image", ("H", "W", 3), batch=True)
    check_positive(tolerance, "tolerance")
    with torch.no_grad():
        if background is None:
            sides = (image[..., 0, :, :], image[..., -1, :, :], image[..., :, 0, :], image[..., :, -1, :])
            screen = torch.cat(sides, dim=-2).median(dim=-2).values[..., None, None, :]
        else:
            screen = torch.as_tensor(background).to(image)
            check_shape(screen, "background", (3,))
        light = brightness(image).unsqueeze(-1)
        shaded = screen * (light / brightness(screen).unsqueeze(-1).clamp(min=1e-3)).clamp(max=1.5)
        difference = (image - light) - (shaded - brightness(shaded).unsqueeze(-1))
        return _opened_and_closed(difference[..., [0, 2]].norm(dim=-1) > tolerance)


def _opened_and_closed(mask: Tensor) -> Tensor:
    """Return masks (..., H, W) opened and then closed by squares of 3 x 3."""
    flat = mask.reshape(-1, 1, *mask.shape[-2:]).float()

    def grown(values: Tensor) -> Tensor:
        return torch.nn.functional.max_pool2d(values, 3, stride=1, padding=1)

    def shrunk(values: Tensor) -> Tensor:
        return -grown(-values)

    return (shrunk(grown(grown(shrunk(flat)))) > 0.5).reshape(mask.shape)
