"""Lenses as other programs name them: those whose numbers are OpenCV's, and others, which are refused."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torchreg.errors import FormatError
from torchreg.io.clouds.raw_cloud import Array

LENS_MODELS = ("distortion_model", "model", "camera_model")
_PINHOLE = (
    "", "none", "pinhole", "perspective", "plumb_bob", "rational_polynomial", "brown_conrady", "modified_brown_conrady",
    "radtan", "opencv", "full_opencv", "opencv_pinhole", "simple_pinhole", "simple_radial", "radial",
)  # fmt: skip
# Entries that may name a kind of lens, and words in them for lenses whose numbers have another meaning.
_LENS_ENTRY = re.compile(r"model|type|lens|projection|distort", re.IGNORECASE)
_OTHER_LENS = re.compile(
    r"fish_?eye|equi_?(distant|solid|rect)|stereographic|orthographic|kannala|omni|double_?sphere|spherical|panoram"
    r"|(^|_)(kb\d?|mei|e?ucm|fov|ds|scaramuzza)(_|$)"
)
_UNSET = ("", "0", "0.0", "false", "no", "none")


def check_lens(given: Mapping[str, Any], numbers: Array, where: str, focal: float | None = None) -> None:
    """Raise FormatError if numbers (N,) are not OpenCV's for a pinhole lens; ``focal`` is in widths of the picture."""
    model = next((str(given[name]) for name in LENS_MODELS if isinstance(given.get(name), str)), "")
    known = _plain(model) in _PINHOLE or not numbers.any()
    other = _other_lens(given)
    if other is not None or not known:
        raise FormatError(
            f"{where}: the lens model {other or model!r} is not a pinhole camera's (plumb_bob, rational_polynomial), "
            f"so its numbers mean something else; undistort the pictures first, and give the camera of those"
        )
    wide = focal is not None and focal < _FOUR.focal
    if focal is None or model or numbers.size != 4 or not (wide or abs(numbers[2:]).max() > _FOUR.tangential):
        return
    raise FormatError(
        f"{where}: four numbers {numbers.tolist()} of a lens without a model may be k1 k2 p1 p2 or those of a fisheye, "
        f"and {'the view is as wide as its' if wide else 'p1 and p2 are hardly as large'}; add distortion_model: "
        f"plumb_bob to the file if they are k1 k2 p1 p2, else undistort the pictures first"
    )


@dataclass(frozen=True)
class _FourNumbers:
    """What four numbers of a lens without a model are like if they are k1 k2 p1 p2."""

    focal: float = 0.42  # widths of a picture; a lens that sees more than 100 degrees is shorter
    tangential: float = 0.03  # p1 and p2


_FOUR = _FourNumbers()


def _plain(model: str) -> str:
    """Return the name of a model of lenses without what programs put before it."""
    word = model.strip().lower().removeprefix("distortion.").removeprefix("rs2_distortion_")
    return word.replace(" ", "_").replace("-", "_")


def _other_lens(given: Mapping[str, Any]) -> str | None:
    """Return what the first entry that names a lens of another kind than a pinhole camera's calls it."""
    for name, value in given.items():
        is_lens = _LENS_ENTRY.search(name) is not None
        if isinstance(value, Mapping):
            found = _other_lens(value) if is_lens else None
        elif isinstance(value, str) and is_lens:
            found = value if _OTHER_LENS.search(_plain(value)) else None
        else:
            is_flag = name == "xi" or re.search(r"fish_?eye|omnidirectional", name.lower())
            found = name if is_flag and str(value).strip().lower() not in _UNSET else None
        if found is not None:
            return found
    return None
