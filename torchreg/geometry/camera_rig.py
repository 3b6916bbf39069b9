"""Several calibrated cameras: a rig of named ones, and two side by side that measure depth by disparity."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.camera import Camera

# Pixels by which rows of a rectified pair may differ.
_ROW_SLACK = 0.1


@dataclass(frozen=True, eq=False)
class CameraRig:
    """Cameras in a common world, by name.

    Args:
        cameras: at least one; those without a name are called camera0, camera1, ... by their number.

    Raises:
        InputError: if there are none or two share a name.
        InputTypeError: if an entry is not a camera.
    """

    cameras: tuple[Camera, ...]

    def __post_init__(self) -> None:
        for camera in self.cameras:
            if not isinstance(camera, Camera):
                raise InputTypeError(f"cameras must be Camera records, got {type(camera).__name__}")
        named = tuple(
            camera if camera.name else replace(camera, name=f"camera{number}")
            for number, camera in enumerate(self.cameras)
        )
        if not named:
            raise InputError("cameras must hold at least one camera, got none")
        repeated = sorted(name for name, times in Counter(camera.name for camera in named).items() if times > 1)
        if repeated:
            raise InputError(f"cameras must have different names, got {', '.join(repeated)} more than once")
        object.__setattr__(self, "cameras", named)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras, in order."""
        return tuple(camera.name for camera in self.cameras)

    def __len__(self) -> int:
        return len(self.cameras)

    def __iter__(self) -> Iterator[Camera]:
        return iter(self.cameras)

    def __getitem__(self, which: int | str) -> Camera:
        """Return a camera by its index or name."""
        if isinstance(which, int):
            return self.cameras[which]
        if which not in self.names:
            raise InputError(f"the rig has no camera {which!r}, it has {', '.join(self.names)}")
        return self.cameras[self.names.index(which)]

    def stereo(self, left: int | str = 0, right: int | str = 1) -> StereoPair:
        """Return two of the cameras as a pair.

        Raises:
            InputError: as `StereoPair`, and if the rig has fewer than two cameras.
        """
        if len(self) < 2:
            raise InputError(f"a stereo pair takes two cameras, the rig has {len(self)}")
        return StereoPair(self[left], self[right])


@dataclass(frozen=True, eq=False)
class StereoPair:
    """Two cameras side by side.

    In a rectified pair a point at depth z is at ``x_left - x_right = fx baseline / z + cx_left - cx_right`` in the same
    row of both pictures.

    Args:
        left: the camera on the left, seen from behind.
        right: the camera on the right.

    Raises:
        InputError: if the cameras stand at one position, look apart by more than 60 degrees, or are swapped.
    """

    left: Camera
    right: Camera

    def __post_init__(self) -> None:
        step, turn = self.displacement, self.rotation
        if not float(step.norm()) > 0:
            raise InputError("left and right must stand at different places, got both at one")
        if float(turn[2, 2]) < 0.5:
            raise InputError("left and right must look the same way, got more than 60 degrees between them")
        if float(step[0]) <= 0:
            raise InputError(
                f"left and right are swapped: the right camera stands {-float(step[0]):.4g} to the left of the left "
                f"one; exchange the cameras, and the pictures with them"
            )

    @property
    def displacement(self) -> Tensor:
        """Position (3,) float64 of the right camera in the coordinates of the left one."""
        return self._right_to_left()[:3, 3]

    @property
    def rotation(self) -> Tensor:
        """Rotation (3, 3) float64 of the right camera relative to the left one, ``R_left_right``."""
        return self._right_to_left()[:3, :3]

    def _right_to_left(self) -> Tensor:
        back = self.right.camera_to_world.to(self.left.intrinsics.device).double()
        return self.left.world_to_camera.double() @ back

    @property
    def baseline(self) -> float:
        """Distance between the cameras, metres."""
        return float(self.displacement.norm())

    def row_error(self) -> float:
        """Return the largest difference in pixels between rows or scales of the pictures; infinite if distorted."""
        left, right = self.left, self.right
        if left.is_distorted or right.is_distorted or (left.width, left.height) != (right.width, right.height):
            return torch.inf
        corners = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], dtype=torch.float64)
        pixels = corners * corners.new_tensor([left.width - 1, left.height - 1])
        left, right = left.to(device="cpu", dtype=torch.float64), right.to(device="cpu", dtype=torch.float64)
        far = left.unproject(pixels, torch.full((4,), 1e6 * self.baseline, dtype=torch.float64))
        near = left.unproject(pixels, torch.full((4,), 10 * self.baseline, dtype=torch.float64))
        (far_pixels, _), (near_pixels, _) = right.project(far), right.project(near)
        rows = torch.stack((far_pixels[:, 1], near_pixels[:, 1])) - pixels[:, 1]
        # Far away the disparity is that of the principal points alone, the same all over the picture.
        shift = far_pixels[:, 0] - pixels[:, 0] - (right.intrinsics[2] - left.intrinsics[2])
        return float(torch.cat((rows.flatten(), shift)).abs().nan_to_num(torch.inf).max())

    @property
    def is_rectified(self) -> bool:
        """Whether a point appears in the same row of both pictures, to a tenth of a pixel."""
        return self.row_error() <= _ROW_SLACK

    def check_rectified(self) -> None:
        """Raise InputError unless the pair is rectified."""
        if not self.is_rectified:
            raise InputError(
                f"the pair is not rectified: rows or scales differ by up to {self.row_error():.3g} pixels, or the "
                f"lenses distort; pass pictures and cameras through torchreg.capture.stereo.rectify first"
            )

    def disparity(self, depth: Tensor) -> Tensor:
        """Return the disparities (...,) in pixels of depths (...,) in front of a rectified pair."""
        return self._scale() / depth + self._shift()

    def depth(self, disparity: Tensor) -> Tensor:
        """Return the depths (...,) of disparities (...,) of a rectified pair; NaN for disparities beyond infinity."""
        parallax = disparity - self._shift()
        return torch.where(parallax > 0, self._scale() / torch.where(parallax > 0, parallax, 1.0), torch.nan)

    def depth_std(self, depth: Tensor, disparity_std: Tensor | float) -> Tensor:
        """Return the standard deviations (...,) of depths from those s of disparities, ``z^2 s / (fx baseline)``."""
        return depth**2 * disparity_std / self._scale()

    def _scale(self) -> float:
        return float(self.left.intrinsics[0]) * self.baseline

    def _shift(self) -> float:
        return float(self.left.intrinsics[2] - self.right.intrinsics[2])
