"""Pictures and depth images from files, their size and bit depth looked at before they are decoded."""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from torchreg.errors import FileWarning, FormatError, MissingExtraError
from torchreg.geometry.budget import BUDGET
from torchreg.geometry.camera import Camera
from torchreg.io.atomic import write_atomic
from torchreg.io.clouds.npz import ARRAY_START, array_of, read_npy_header
from torchreg.io.file_format import check_stand_in, naming, warn
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, local_path, read_bytes
from torchreg.io.masks import mask_of_numbers, mask_of_picture
from torchreg.io.natural_order import last_number, natural_sorted

Found = TypeVar("Found")
ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
# Metres per unit of most depth images.
MILLIMETER = 1e-3
# Modes in which PIL sees depth, and those of pictures with what they are converted to.
_DEPTH_KINDS = ("I;16", "I;16B", "I;16L", "I", "F")
_COLOR_KINDS = {"1": "L", "L": "L", "P": "RGB", "RGB": "RGB", "RGBA": "RGB", "LA": "L"}
# Names of the depth channel of an EXR file.
_EXR_CHANNELS = ("Z", "depth.Z", "Depth.Z", "Y", "V", "R", "RGB")


def list_pictures(folder: str | os.PathLike[str]) -> list[Path]:
    """Return the pictures in a folder, in the order of the numbers in their names."""
    directory = local_path(folder)
    if not directory.exists():
        raise FileNotFoundError(f"the folder {directory} does not exist")
    if not directory.is_dir():
        raise FormatError(f"{directory}: must be a folder of pictures")
    files = [file for file in directory.iterdir() if file.suffix.lower() in ENDINGS and not file.name.startswith(".")]
    if not files:
        raise FormatError(f"{directory} holds no pictures: no file ends in one of {', '.join(ENDINGS)}")
    return natural_sorted(files)


def list_frames(folders: Sequence[str | os.PathLike[str]]) -> list[tuple[Path, ...]]:
    """Return the pictures of several cameras frame by frame: one folder per camera, in the order of their numbers."""
    files = [list_pictures(folder) for folder in folders]
    if len({len(found) for found in files}) > 1:
        counts = ", ".join(f"{os.fspath(folder)} {len(found)}" for folder, found in zip(folders, files, strict=True))
        raise FormatError(f"folders must hold equally many pictures, one per frame; got {counts}")
    numbers = [[last_number(file) for file in found] for found in files]
    for listed, found in zip(numbers, files, strict=True):
        if listed != numbers[0] and set(listed) & set(numbers[0]):
            frame = next(k for k, pair in enumerate(zip(listed, numbers[0], strict=True)) if pair[0] != pair[1])
            raise FormatError(f"a frame is missing: {files[0][frame]} and {found[frame]} have different numbers")
    return list(zip(*files, strict=True))


def load_image(path: str | os.PathLike[str], *, limits: FileLimits = DEFAULT_LIMITS) -> Tensor:
    """Return a picture of 8 bits per channel, (H, W) gray or (H, W, 3) color, as float32 from 0 to 1."""
    pixels = _read_pixels(local_path(path), limits)
    return torch.from_numpy(pixels).to(torch.float32).div_(255)


def _read_pixels(file: Path, limits: FileLimits) -> Any:
    """Return the pixels (H, W) or (H, W, 3) of a picture, uint8."""
    kind, pixels = _decoded(read_bytes(file, limits), file)
    if kind not in _COLOR_KINDS:
        raise FormatError(f"{file}: pictures must have 8 bits per channel, gray or color; got PIL mode {kind}")
    return pixels


def load_mask(path: str | os.PathLike[str], *, limits: FileLimits = DEFAULT_LIMITS) -> Tensor:
    """Return a mask (H, W), bool, of a picture, see `mask_of_picture`, or of an ``.npy`` array."""
    file = local_path(path)
    content = read_bytes(file, limits)
    with naming(file):
        check_stand_in(content)
        if content.startswith(ARRAY_START):
            return torch.from_numpy(mask_of_numbers(_read_npy(content, file)).copy())
        return torch.from_numpy(_opened(content, file, mask_of_picture))


def load_depth(
    path: str | os.PathLike[str],
    scale: float | None = None,
    *,
    camera: Camera | None = None,
    limits: FileLimits = DEFAULT_LIMITS,
) -> Tensor:
    """Return a depth image (H, W) in metres, float32, zero where nothing was measured.

    Not measured are zero, negative and infinite numbers, and the largest ones of formats (65535, 65504, 1e9 and more).
    ``scale`` is metres per unit; by default whole numbers are millimeters, others metres, or millimeters where no
    camera would see that far.
    """
    file = local_path(path)
    content = read_bytes(file, limits)
    with naming(file):
        check_stand_in(content)
        values = _depth_reader(content)(content, file)
        if values.dtype.kind not in "fiu" or values.dtype.itemsize < 2:
            raise FormatError(f"depth takes 16 bits or floating-point numbers, got {values.dtype}")
        if camera is not None and values.shape != (camera.height, camera.width):
            raise FormatError(
                f"is {values.shape[1]} x {values.shape[0]} pixels, the camera's pictures are "
                f"{camera.width} x {camera.height}"
            )
        measured = _measured(values)
        if not measured.any():
            raise FormatError(f"holds no depth, all of {values.size} pixels are zero, negative or not finite")
        scale = _unit(values[measured], scale)
        # In place: pictures of 61 megapixels take a quarter of a gigabyte.
        depth = np.zeros(values.shape, np.float32)
        np.copyto(depth, values, where=measured, casting="unsafe")
        depth *= np.float32(scale)
        return torch.from_numpy(depth)


@dataclass(frozen=True)
class _Sight:
    """What depth cameras see, by the median of a picture, metres."""

    least: float = 5e-3
    most: float = 100.0  # beyond is unlikely
    impossible: float = 10_000.0


_SIGHT = _Sight()
# Numbers that say that nothing was measured: the largest of 16 bits, of half precision, and Blender's horizon.
_NOTHING = (65535, 65504.0, 1e9)


def _measured(values: Any) -> Any:
    """Return where numbers (H, W) are depths."""
    if values.dtype == np.float16:
        return np.isfinite(values) & (values > 0) & (values != np.float16(_NOTHING[1]))
    with np.errstate(invalid="ignore"):
        known = (values > 0) & (values < _NOTHING[2])  # neither of which NaN is
    return known & (values != _NOTHING[0]) if values.dtype.kind in "iu" else known


def _unit(values: Any, scale: float | None) -> float:
    """Return the metres per unit of measured numbers; raise or warn if no camera sees such depths."""
    middle = float(np.median(values))
    if scale is None:
        if values.dtype.kind != "f":
            scale = MILLIMETER
        elif middle <= _SIGHT.most:
            scale = 1.0
        else:
            warn(f"numbers around {middle:.4g} are taken for millimeters; the camera's depth_scale says otherwise")
            scale = MILLIMETER
    depth = middle * scale
    if depth > _SIGHT.impossible:
        raise FormatError(
            f"depths around {depth:.3g} m are none of a camera: depth_scale is metres per unit, got {scale:g}; "
            f"if it is units per metre write {1 / scale:g}"
        )
    if not _SIGHT.least <= depth <= _SIGHT.most:
        factor = "0.001" if depth > _SIGHT.most else "1"
        warn(
            f"depths around {depth:.3g} m are unlikely: with depth_scale {scale:g} the file's {middle:.4g} is in other "
            f"units; write depth_scale {factor} if they are {'millimeters' if depth > _SIGHT.most else 'metres'}"
        )
    return scale


def save_depth(path: str | os.PathLike[str], depth: Tensor, scale: float = MILLIMETER) -> None:
    """Write a depth image (H, W) in metres as 16-bit PNG, rounded to ``scale``; depths out of range become zero."""
    from PIL import Image

    steps = (depth.detach().cpu().double() / scale).round().nan_to_num(0, 0, 0)
    steps = torch.where((steps > 0) & (steps < _NOTHING[0]), steps, 0.0)
    _save_png(path, Image.fromarray(steps.numpy().astype(np.uint16)))


def save_image(path: str | os.PathLike[str], image: Tensor) -> None:
    """Write a picture (H, W), (H, W, 3) from 0 to 1, or a mask (H, W) bool, as 8-bit PNG."""
    from PIL import Image

    values = (image.detach().cpu().double().clamp(0, 1) * 255).round().numpy().astype(np.uint8)
    _save_png(path, Image.fromarray(values))


def _save_png(path: str | os.PathLike[str], image: Any) -> None:
    file = local_path(path)
    if file.suffix.lower() != ".png":
        raise FormatError(f"{file}: must end in .png")
    stream = io.BytesIO()
    image.save(stream, format="PNG")
    write_atomic(file, stream.getvalue())


def _check_pixels(shape: tuple[int, ...], file: Path) -> None:
    """Raise FormatError unless a shape is that of a picture of allowed size."""
    pixels = shape[0] * shape[1] if len(shape) == 2 and min(shape) > 0 else 0
    if not 0 < pixels <= BUDGET.picture_pixels:
        raise FormatError(f"{file}: must be (H, W) with 1 to 64 million pixels, got shape {shape}")


def _decoded(content: bytes, file: Path) -> tuple[str, Any]:
    """Return the PIL mode of a picture, and its pixels."""

    def pixels(image: Any) -> tuple[str, Any]:
        kind = str(image.mode)
        return kind, np.array(image.convert(_COLOR_KINDS[kind]) if kind in _COLOR_KINDS else image)

    return _opened(content, file, pixels)


def _opened(content: bytes, file: Path, use: Callable[[Any], Found]) -> Found:
    """Return what ``use`` makes of the open picture."""
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            # The size is checked here, before anything is decoded; damage raises.
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", FileWarning)
            with Image.open(io.BytesIO(content), formats=("PNG", "TIFF", "JPEG", "BMP")) as image:
                _check_pixels(image.size, file)
                return use(image)
    except FormatError:
        raise
    except Image.DecompressionBombError as error:
        raise FormatError(f"{file}: has more than 64 megapixels") from error
    except UnidentifiedImageError as error:
        raise FormatError(f"{file}: is no PNG, TIFF, JPEG or BMP picture") from error
    except (OSError, SyntaxError, ValueError, EOFError, IndexError, KeyError, TypeError) as error:
        raise FormatError(f"{file}: is cut off or damaged ({error})") from error


def _decoded_depth(content: bytes, file: Path) -> Any:
    """Return the numbers (H, W) of a PNG or TIFF depth image."""
    kind, values = _decoded(content, file)
    if kind not in _DEPTH_KINDS:
        raise FormatError(f"{file}: depth takes 16 bits or floating-point numbers, got PIL mode {kind} of 8 bits")
    return values


def _read_npy(content: bytes, file: Path) -> Any:
    """Return the array (H, W) of a ``.npy`` file."""
    _check_pixels(read_npy_header(io.BytesIO(content), f"{file}:", "biuf")[0], file)
    return array_of(content, f"{file}:", "biuf")


def _read_exr(content: bytes, file: Path) -> Any:
    """Return the depth channel (H, W) of an OpenEXR file."""
    try:
        import OpenEXR
    except ImportError as error:
        raise MissingExtraError(
            f"{file}: EXR files take the extra exr: pip install 'torchreg-articulated[exr]'"
        ) from error
    try:
        with OpenEXR.File(str(file), header_only=True) as header:
            first, last = (corner.tolist() for corner in header.header()["dataWindow"])
            size = (last[1] - first[1] + 1, last[0] - first[0] + 1)
            _check_pixels(size, file)
            known = [channel.name for channel in header.header()["channels"]]
            _check_channels(known, size, file)
        with OpenEXR.File(str(file)) as picture:
            channels = {name: np.array(channel.pixels) for name, channel in picture.channels().items()}
    except (RuntimeError, ValueError, OSError) as error:
        raise FormatError(f"{file}: is cut off or damaged, {len(content)} bytes ({error})") from error
    name = next(name for name in _EXR_CHANNELS if name in channels)
    return channels[name] if channels[name].ndim == 2 else channels[name][..., 0]


def _check_channels(known: Sequence[str], size: tuple[int, int], file: Path) -> None:
    """Raise FormatError unless one of the channels is the depth, and all together are not too many."""
    # Red, green and blue are read as one.
    if not {*known, *(["RGB"] if {"R", "G", "B"} <= set(known) else [])} & set(_EXR_CHANNELS):
        raise FormatError(f"{file}: has none of the channels {', '.join(_EXR_CHANNELS)}, but {', '.join(known)}")
    if len(known) * size[0] * size[1] > BUDGET.picture_pixels:
        raise FormatError(f"{file}: has {len(known)} channels, together more than 64 megapixels; save the depth alone")


def _depth_reader(content: bytes) -> Callable[[bytes, Path], Any]:
    """Return the reader of a depth image by its first bytes; PIL's where no other fits."""
    return next((read for start, read in _DEPTH_READERS.items() if content.startswith(start)), _decoded_depth)


_DEPTH_READERS = {ARRAY_START: _read_npy, b"v/1\x01": _read_exr}
