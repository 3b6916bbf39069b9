"""Calibrated pinhole cameras: projection of points to pixels, and viewing rays of pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_count, check_finite, check_positive, check_shape
from torchreg.errors import InputError
from torchreg.geometry.budget import BUDGET
from torchreg.geometry.rigid import RIGID_TOLERANCE, invert_rigid, rigid_matrix, rotation_error, transform_points
from torchreg.geometry.visibility import View, view_rotation

# Steps of Newton's method on two unknowns: within a picture about four are taken.
_NEWTON_STEPS = 20


@dataclass(frozen=True, eq=False, init=False)
class Camera:
    """A pinhole camera: the size of its picture, its intrinsics, its pose and the distortion of its lens.

    A point ``(x, y, z)`` in camera coordinates (right, down, forward) has the pixel ``(fx u + cx, fy v + cy)``, where
    ``(u, v)`` is ``(x / z, y / z)`` after the lens: with ``r^2 = u^2 + v^2`` and
    ``s = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)``

    ``u' = s u + 2 p1 u v + p2 (r^2 + 2 u^2)``, ``v' = s v + p1 (r^2 + 2 v^2) + 2 p2 u v``.

    Convention: OpenCV's. Pixels are (column, row) and have their centers at integers: the picture covers
    ``[-0.5, width - 0.5] x [-0.5, height - 0.5]``. ``world_to_camera`` takes world to camera coordinates.

    Args:
        width: of the picture, pixels.
        height: of the picture, pixels.
        intrinsics: (4,) fx, fy, cx, cy, pixels.
        world_to_camera: (4, 4) rigid motion, metres; the identity by default.
        distortion: k1, k2, p1, p2, then k3, then k4, k5, k6: none, 4, 5 or 8 numbers; stored as (8,).
        name: name of the camera in files.

    Raises:
        InputError: if a size does not fit, a number is not finite, a focal length not positive, the motion not rigid
            or the picture larger than 64 megapixels.

    References: Brown 1966 (the lens); Hartley and Zisserman 2004, chapter 6.
    """

    width: int
    height: int
    intrinsics: Tensor
    world_to_camera: Tensor
    distortion: Tensor
    name: str

    def __init__(
        self,
        width: int,
        height: int,
        intrinsics: Any,
        world_to_camera: Any = None,
        distortion: Any = None,
        name: str = "",
    ) -> None:
        check_count(width, "width", 1)
        check_count(height, "height", 1)
        if width * height > BUDGET.picture_pixels:
            raise InputError(f"pictures have at most 64 megapixels, got {width} x {height}")
        intrinsics = _finite_numbers(intrinsics, "intrinsics (fx, fy, cx, cy)")
        check_shape(intrinsics, "intrinsics", (4,))
        for value, part in zip(intrinsics[:2].tolist(), ("fx", "fy"), strict=True):
            check_positive(value, f"intrinsics ({part})")
        motion = torch.eye(4, dtype=torch.float64) if world_to_camera is None else world_to_camera
        motion = _finite_numbers(motion, "world_to_camera").to(intrinsics)
        check_rigid_motion(motion, "world_to_camera")
        lens = _finite_numbers(() if distortion is None else distortion, "distortion").to(intrinsics)
        if lens.ndim != 1 or len(lens) not in (0, 4, 5, 8):
            raise InputError(f"distortion must hold 0, 4, 5 or 8 numbers, got shape {tuple(lens.shape)}")
        lens = torch.nn.functional.pad(lens, (0, 8 - len(lens)))
        values = {"width": width, "height": height, "intrinsics": intrinsics, "name": name}
        for field, value in (values | {"world_to_camera": motion, "distortion": lens}).items():
            object.__setattr__(self, field, value)

    @classmethod
    def looking_at(
        cls, position: Any, target: Any, *, focal: float, width: int, height: int, up: Any = None, name: str = ""
    ) -> Camera:
        """Return a camera without distortion that has a target at the center of its picture.

        Args:
            position: (3,) of the pinhole, metres.
            target: (3,) point looked at, metres.
            focal: focal length, pixels.
            width: of the picture, pixels.
            height: of the picture, pixels.
            up: (3,) direction that appears upright; -y by default.
            name: see `Camera`.

        Raises:
            InputError: if position and target coincide, and as `Camera`.
        """
        rotation = view_rotation(position, target, up)
        pinhole = as_float_tensor(position, "position", like=rotation)
        center = (0.5 * (width - 1), 0.5 * (height - 1))
        motion = rigid_matrix(rotation, -(rotation @ pinhole))
        return cls(width, height, torch.tensor([focal, focal, *center], dtype=torch.float64), motion, name=name)

    @property
    def matrix(self) -> Tensor:
        """The (3, 3) matrix ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]``."""
        fx, fy, cx, cy = self.intrinsics.unbind()
        zero = torch.zeros_like(fx)
        return torch.stack((fx, zero, cx, zero, fy, cy, zero, zero, torch.ones_like(fx))).reshape(3, 3)

    @property
    def camera_to_world(self) -> Tensor:
        """The (4, 4) rigid motion from camera to world coordinates."""
        return invert_rigid(self.world_to_camera)

    @property
    def position(self) -> Tensor:
        """Position (3,) of the pinhole, metres."""
        return self.camera_to_world[:3, 3]

    @property
    def is_distorted(self) -> bool:
        """Whether the lens bends straight lines."""
        return bool((self.distortion != 0).any())

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return the pixels (..., N, 2) of points as (column, row), NaN behind the camera, and their depths (..., N).

        Args:
            points: (..., N, 3) in world coordinates, metres.

        Differentiable: in ``points`` and all of the camera's tensors.
        """
        local = transform_points(self.world_to_camera.to(points), points)
        depth = local[..., 2]
        in_front = depth > 0
        plane = local[..., :2] / torch.where(in_front, depth, 1.0).unsqueeze(-1)
        focal, center = self.intrinsics.to(points).split(2)
        pixels = self.distorted(plane) * focal + center
        return torch.where(in_front.unsqueeze(-1), pixels, torch.nan), depth

    def directions(self, pixels: Tensor) -> Tensor:
        """Return the viewing directions (..., N, 3) of pixels in world coordinates, scaled to unit depth.

        Args:
            pixels: (..., N, 2) as (column, row).

        Returns:
            Directions (..., N, 3); NaN at pixels that no ray through the lens reaches.

        Differentiable: once, in ``pixels`` and all of the camera's tensors.
        """
        focal, center = self.intrinsics.to(pixels).split(2)
        plane = self.undistorted((pixels - center) / focal)
        local = torch.cat((plane, torch.ones_like(plane[..., :1])), dim=-1)
        return local @ self.world_to_camera[:3, :3].to(pixels)

    def unproject(self, pixels: Tensor, depth: Tensor) -> Tensor:
        """Return the points (..., N, 3) of pixels at given depths along the optical axis, in world coordinates.

        Args:
            pixels: (..., N, 2) as (column, row).
            depth: (..., N), metres.

        Differentiable: once, in both and all of the camera's tensors.
        """
        return self.position.to(pixels) + depth.unsqueeze(-1) * self.directions(pixels)

    def distorted(self, plane: Tensor) -> Tensor:
        """Return the distorted positions (..., 2) of points (..., 2) of the plane at depth one.

        Differentiable: in ``plane`` and the distortion.
        """
        return distort(plane, self.distortion.to(plane)) if self.is_distorted else plane

    def undistorted(self, plane: Tensor) -> Tensor:
        """Return the points (..., 2) of the plane at depth one with given distorted positions; NaN if there are none.

        Differentiable: once, in ``plane`` and the distortion.
        """
        if not self.is_distorted:
            return plane
        lens = self.distortion.to(plane)
        with torch.no_grad():
            found = plane.clone()
            for _ in range(_NEWTON_STEPS):
                found = found - _solve_2x2(lens_jacobian(found, lens), distort(found, lens) - plane)
            jacobian = lens_jacobian(found, lens)
            slack = 1e3 * torch.finfo(plane.dtype).eps * (1 + plane.norm(dim=-1))
            valid = ((distort(found, lens) - plane).norm(dim=-1) <= slack) & (torch.linalg.det(jacobian) > 0)
            found = torch.where(valid.unsqueeze(-1), found, torch.zeros_like(found))
            jacobian = torch.where(valid[..., None, None], jacobian, torch.eye(2).to(jacobian))
        # One more step with the derivative of the solution (implicit function theorem).
        found = found - _solve_2x2(jacobian, distort(found, lens) - plane)
        return torch.where(valid.unsqueeze(-1), found, torch.nan)

    def pixel_grid(self, *, like: Tensor | None = None) -> Tensor:
        """Return the centers (H, W, 2) of all pixels as (column, row), in the dtype and on the device of ``like``."""
        like = self.intrinsics if like is None else like
        row = torch.arange(self.height, dtype=like.dtype, device=like.device)
        column = torch.arange(self.width, dtype=like.dtype, device=like.device)
        rows, columns = torch.meshgrid(row, column, indexing="ij")
        return torch.stack((columns, rows), dim=-1)

    def contains(self, pixels: Tensor) -> Tensor:
        """Return a mask (...,) of the pixels (..., 2) that lie in the picture; NaN never does."""
        limit = pixels.new_tensor([self.width, self.height]) - 0.5
        return ((pixels >= -0.5) & (pixels <= limit)).all(-1)

    def scaled(self, factor: float) -> Camera:
        """Return the camera of the picture made ``factor`` times as wide and high, rounded to whole pixels.

        Raises:
            InputError: if ``factor`` is not positive or no pixel is left.
        """
        check_positive(factor, "factor")
        size = [round(side * factor) for side in (self.width, self.height)]
        if min(size) < 1:
            raise InputError(f"factor must leave a pixel of {self.width} x {self.height}, got {factor}")
        ratio = self.intrinsics.new_tensor([size[0] / self.width, size[1] / self.height])
        focal, center = self.intrinsics.split(2)
        intrinsics = torch.cat((focal * ratio, (center + 0.5) * ratio - 0.5))
        return replace(self, width=size[0], height=size[1], intrinsics=intrinsics)

    def moved(self, motion: Tensor) -> Camera:
        """Return the camera after a rigid motion (4, 4) of the world that it stands in."""
        check_rigid_motion(motion, "motion")
        return replace(self, world_to_camera=self.world_to_camera @ invert_rigid(motion.to(self.world_to_camera)))

    def to(self, *args: Any, **kwargs: Any) -> Camera:
        """Return the camera on another device or in another dtype; takes what ``Tensor.to`` takes."""
        names = ("intrinsics", "world_to_camera", "distortion")
        return replace(self, **{name: getattr(self, name).to(*args, **kwargs) for name in names})

    def view(self) -> View:
        """Return the camera as a view to rasterize with.

        Raises:
            InputError: if the lens distorts or pixels are not square.
        """
        fx, fy, cx, cy = self.intrinsics.detach().double().tolist()
        if self.is_distorted or abs(fx - fy) > 1e-9 * fx:
            raise InputError(f"camera must have square pixels and no distortion to rasterize, got fx {fx} and fy {fy}")
        motion = self.world_to_camera.detach().double().cpu()
        corner = torch.tensor([-0.5 - cx, -0.5 - cy], dtype=torch.float64) / fx
        return View(
            position=self.position.detach().double().cpu(),
            rotation=motion[:3, :3],
            corner=corner,
            pitch=1 / fx,
            width=self.width,
            height=self.height,
        )


def check_rigid_motion(motion: Tensor, name: str) -> None:
    """Raise InputError unless ``motion`` is a finite (4, 4) rotation and translation, to 1e-6 (float32: 1e-4)."""
    check_shape(motion, name, (4, 4))
    check_finite(motion, name)
    still = motion.detach().double()
    error, last_row = rotation_error(still[:3, :3]), still[3] - still.new_tensor([0.0, 0.0, 0.0, 1.0])
    tolerance = RIGID_TOLERANCE.double if motion.dtype == torch.float64 else RIGID_TOLERANCE.single
    if error > tolerance or float(torch.linalg.det(still[:3, :3])) < 0 or float(last_row.abs().max()) > tolerance:
        raise InputError(
            f"{name} must be a rotation and a translation with the last row 0 0 0 1, got {still.tolist()}, whose "
            f"rotation is off by {error:.2g}"
        )


def _finite_numbers(value: Any, name: str) -> Tensor:
    """Return the numbers as a finite floating-point tensor, float64 unless they came as a floating-point tensor."""
    if not hasattr(value, "dtype"):
        value = _float64(value, name)
    value = as_float_tensor(value, name)
    check_finite(value, name)
    return value


def _float64(value: Any, name: str) -> Tensor:
    try:
        return torch.tensor(value, dtype=torch.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must hold numbers, got {value!r}") from error


def distort(plane: Tensor, lens: Tensor) -> Tensor:
    """Return the distorted positions of points (..., 2) at depth one; lens (8,) as in `Camera`, or (8, ...)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = lens.unbind()
    u, v = plane.unbind(-1)
    square = u * u + v * v
    scale = (1 + square * (k1 + square * (k2 + square * k3))) / (1 + square * (k4 + square * (k5 + square * k6)))
    along = scale * u + 2 * p1 * u * v + p2 * (square + 2 * u * u)
    down = scale * v + p1 * (square + 2 * v * v) + 2 * p2 * u * v
    return torch.stack((along, down), dim=-1)


def lens_jacobian(plane: Tensor, lens: Tensor) -> Tensor:
    """Return the derivative (..., 2, 2) of `distort` in the points (..., 2) at depth one."""
    k1, k2, p1, p2, k3, k4, k5, k6 = lens.unbind()
    u, v = plane.unbind(-1)
    square = u * u + v * v
    above = 1 + square * (k1 + square * (k2 + square * k3))
    below = 1 + square * (k4 + square * (k5 + square * k6))
    scale = above / below
    slope = ((k1 + square * (2 * k2 + 3 * square * k3)) - scale * (k4 + square * (2 * k5 + 3 * square * k6))) / below
    uu = scale + 2 * u * u * slope + 2 * p1 * v + 6 * p2 * u
    uv = 2 * u * v * slope + 2 * p1 * u + 2 * p2 * v
    vv = scale + 2 * v * v * slope + 6 * p1 * v + 2 * p2 * u
    return torch.stack((uu, uv, uv, vv), dim=-1).unflatten(-1, (2, 2))


def _solve_2x2(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return the solutions (..., 2) of 2 x 2 systems; large ones, not an exception, where the matrix is singular."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    x, y = vector.unbind(-1)
    det = a * d - b * c
    det = torch.where(det.abs() > 1e-12, det, 1e-12)
    return torch.stack((d * x - b * y, a * y - c * x), dim=-1) / det.unsqueeze(-1)
