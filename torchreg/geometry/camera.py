"""Calibrated pinhole cameras: where a point of space appears in the picture, and where a pixel looks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_count, check_finite, check_positive, check_shape
from torchreg.errors import InputError
from torchreg.geometry.rigid import invert_rigid, rigid_matrix, transform_points
from torchreg.geometry.visibility import View, view_rotation

# Sides of pictures and, further on, their number of pixels; more is a damaged file rather than a camera.
MAX_PIXELS = 64_000_000
_NUM_DISTORTIONS = (0, 4, 5, 8)
# Newton's method on two unknowns: from within a picture it takes about four steps.
_NEWTON_STEPS = 20
_RIGID_SLACK = 1e-6


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with its lens, its place and the size of its picture.

    A point ``(x, y, z)`` in camera coordinates (right, down, forward) has the picture ``(fx u + cx, fy v + cy)``, where
    ``(u, v)`` is ``(x / z, y / z)`` after the lens: with ``r^2 = u^2 + v^2`` and
    ``s = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)``

    ``u' = s u + 2 p1 u v + p2 (r^2 + 2 u^2)``, ``v' = s v + p1 (r^2 + 2 v^2) + 2 p2 u v``.

    Convention: OpenCV's. Pixels are (column, row), and whole numbers are the middles of pixels: the picture covers
    ``[-0.5, width - 0.5] x [-0.5, height - 0.5]``. The motion takes world coordinates to camera coordinates.

    Args:
        width: of the picture, pixels.
        height: of the picture, pixels.
        intrinsics: (4,) fx, fy, cx, cy, pixels.
        world_to_camera: (4, 4) rigid motion, metres; the identity by default.
        distortion: k1, k2, p1, p2, then k3, then k4, k5, k6: none, 4, 5 or 8 numbers; stored as (8,).
        name: what files call the camera.

    Raises:
        InputError: if a size does not fit, a number is not finite, a focal length not positive, the motion not rigid
            or the picture larger than 64 megapixels.

    References: Brown 1966 (the lens); Hartley and Zisserman 2004, chapter 6.
    """

    width: int
    height: int
    intrinsics: Tensor
    world_to_camera: Tensor = None  # type: ignore[assignment]  # filled in below
    distortion: Tensor = None  # type: ignore[assignment]  # filled in below
    name: str = ""

    def __post_init__(self) -> None:
        check_count(self.width, "width", 1)
        check_count(self.height, "height", 1)
        if self.width * self.height > MAX_PIXELS:
            raise InputError(f"pictures have at most 64 megapixels, got {self.width} x {self.height}")
        intrinsics = _numbers(self.intrinsics, "intrinsics (fx, fy, cx, cy)")
        check_shape(intrinsics, "intrinsics", (4,))
        for value, name in zip(intrinsics[:2].tolist(), ("fx", "fy"), strict=True):
            check_positive(value, f"intrinsics ({name})")
        motion = torch.eye(4, dtype=torch.float64) if self.world_to_camera is None else self.world_to_camera
        motion = _numbers(motion, "world_to_camera").to(intrinsics)
        check_rigid(motion, "world_to_camera")
        lens = _numbers(() if self.distortion is None else self.distortion, "distortion").to(intrinsics)
        if lens.ndim != 1 or len(lens) not in _NUM_DISTORTIONS:
            raise InputError(f"distortion must hold 0, 4, 5 or 8 numbers, got shape {tuple(lens.shape)}")
        object.__setattr__(self, "intrinsics", intrinsics)
        object.__setattr__(self, "world_to_camera", motion)
        object.__setattr__(self, "distortion", torch.nn.functional.pad(lens, (0, 8 - len(lens))))

    @classmethod
    def looking_at(
        cls, position: Any, target: Any, *, focal: float, width: int, height: int, up: Any = None, name: str = ""
    ) -> Camera:
        """Return a camera without distortion that has a target in the middle of its picture.

        Args:
            position: (3,) of the pinhole, metres.
            target: (3,) what it looks at.
            focal: focal length, pixels.
            width: of the picture, pixels.
            height: of the picture, pixels.
            up: (3,) what appears upright; -y by default.
            name: see `Camera`.

        Raises:
            InputError: if position and target coincide, and as `Camera`.
        """
        rotation = view_rotation(position, target, up)
        place = as_float_tensor(position, "position", like=rotation)
        middle = (0.5 * (width - 1), 0.5 * (height - 1))
        motion = rigid_matrix(rotation, -(rotation @ place))
        return cls(width, height, torch.tensor([focal, focal, *middle], dtype=torch.float64), motion, name=name)

    @property
    def matrix(self) -> Tensor:
        """The (3, 3) matrix ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]``."""
        fx, fy, cx, cy = self.intrinsics.unbind()
        zero, one = torch.zeros_like(fx), torch.ones_like(fx)
        return torch.stack((fx, zero, cx, zero, fy, cy, zero, zero, one)).reshape(3, 3)

    @property
    def camera_to_world(self) -> Tensor:
        """The (4, 4) rigid motion from camera to world coordinates."""
        return invert_rigid(self.world_to_camera)

    @property
    def position(self) -> Tensor:
        """Where the pinhole is, (3,)."""
        return self.camera_to_world[:3, 3]

    @property
    def is_distorted(self) -> bool:
        """Whether the lens bends straight lines."""
        return bool((self.distortion != 0).any())

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return the pixels (..., N, 2) as (column, row) and the depths (..., N) of points, NaN pixels behind it.

        Args:
            points: (..., N, 3) in world coordinates, metres.

        Differentiable: in ``points`` and all of the camera's tensors.
        """
        local = transform_points(self.world_to_camera.to(points), points)
        depth = local[..., 2]
        seen = depth > 0
        plane = local[..., :2] / torch.where(seen, depth, 1.0).unsqueeze(-1)
        focal, center = self.intrinsics.to(points).split(2)
        pixels = self.distorted(plane) * focal + center
        return torch.where(seen.unsqueeze(-1), pixels, torch.nan), depth

    def directions(self, pixels: Tensor) -> Tensor:
        """Return where pixels look, (..., N, 3) in world coordinates, as long as their depth is one.

        Args:
            pixels: (..., N, 2) as (column, row).

        Returns:
            NaN where the lens maps nothing to a pixel.

        Differentiable: once, in ``pixels`` and all of the camera's tensors.
        """
        focal, center = self.intrinsics.to(pixels).split(2)
        plane = self.undistorted((pixels - center) / focal)
        local = torch.cat((plane, torch.ones_like(plane[..., :1])), dim=-1)
        return local @ self.world_to_camera[:3, :3].to(pixels)

    def unproject(self, pixels: Tensor, depth: Tensor) -> Tensor:
        """Return the points (..., N, 3) in world coordinates that pixels show at given depths along the camera's axis.

        Args:
            pixels: (..., N, 2) as (column, row).
            depth: (..., N), metres.

        Differentiable: once, in both and all of the camera's tensors.
        """
        return self.position.to(pixels) + depth.unsqueeze(-1) * self.directions(pixels)

    def distorted(self, plane: Tensor) -> Tensor:
        """Return where the lens shows points (..., 2) of the plane at depth one.

        Differentiable: in ``plane`` and the distortion.
        """
        return _lens(plane, self.distortion.to(plane)) if self.is_distorted else plane

    def undistorted(self, plane: Tensor) -> Tensor:
        """Return the points (..., 2) of the plane at depth one that the lens shows at given ones; NaN if there is none.

        Differentiable: once, in ``plane`` and the distortion.
        """
        if not self.is_distorted:
            return plane
        lens = self.distortion.to(plane)
        with torch.no_grad():
            found = plane.clone()
            for _ in range(_NEWTON_STEPS):
                found = found - _solved(lens_jacobian(found, lens), _lens(found, lens) - plane)
            jacobian = lens_jacobian(found, lens)
            slack = 1e3 * torch.finfo(plane.dtype).eps * (1 + plane.norm(dim=-1))
            valid = ((_lens(found, lens) - plane).norm(dim=-1) <= slack) & (torch.linalg.det(jacobian) > 0)
            found = torch.where(valid.unsqueeze(-1), found, torch.zeros_like(found))
            jacobian = torch.where(valid[..., None, None], jacobian, torch.eye(2).to(jacobian))
        # One more step with the derivative of the solution (implicit function theorem).
        found = found - _solved(jacobian, _lens(found, lens) - plane)
        return torch.where(valid.unsqueeze(-1), found, torch.nan)

    def pixel_grid(self, *, like: Tensor | None = None) -> Tensor:
        """Return the middles (H, W, 2) of all pixels as (column, row), in the dtype and on the device of ``like``."""
        like = self.intrinsics if like is None else like
        row = torch.arange(self.height, dtype=like.dtype, device=like.device)
        column = torch.arange(self.width, dtype=like.dtype, device=like.device)
        rows, columns = torch.meshgrid(row, column, indexing="ij")
        return torch.stack((columns, rows), dim=-1)

    def contains(self, pixels: Tensor) -> Tensor:
        """Return which pixels (..., 2) lie in the picture, (...,) bool; NaN never does."""
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
        return Camera(size[0], size[1], intrinsics, self.world_to_camera, self.distortion, self.name)

    def moved(self, motion: Tensor) -> Camera:
        """Return the camera carried along with the world by a rigid motion (4, 4)."""
        check_rigid(motion, "motion")
        placed = self.world_to_camera @ invert_rigid(motion.to(self.world_to_camera))
        return Camera(self.width, self.height, self.intrinsics, placed, self.distortion, self.name)

    def to(self, *args: Any, **kwargs: Any) -> Camera:
        """Return the camera on another device or in another dtype; takes what ``Tensor.to`` takes."""
        parts = (self.intrinsics, self.world_to_camera, self.distortion)
        intrinsics, motion, lens = (part.to(*args, **kwargs) for part in parts)
        return Camera(self.width, self.height, intrinsics, motion, lens, self.name)

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
        return View(self.position.detach().double().cpu(), motion[:3, :3], corner, 1 / fx, self.width, self.height)


def check_rigid(motion: Tensor, name: str) -> None:
    """Raise InputError unless ``motion`` is a finite (4, 4) rotation and translation, to 1e-6 (float32: 1e-4)."""
    check_shape(motion, name, (4, 4))
    check_finite(motion, name)
    still = motion.detach().double()
    linear, eye = still[:3, :3], torch.eye(4, dtype=torch.float64, device=motion.device)
    slack = _RIGID_SLACK if motion.dtype == torch.float64 else 100 * _RIGID_SLACK
    off = float((linear @ linear.mT - eye[:3, :3]).abs().max())
    if off > slack or float(torch.linalg.det(linear)) < 0 or float((still[3] - eye[3]).abs().max()) > slack:
        raise InputError(
            f"{name} must be a rotation and a translation with the last row 0 0 0 1, got {still.tolist()}, whose "
            f"rotation is off by {off:.2g}"
        )


def _numbers(value: Any, name: str) -> Tensor:
    """Return a finite tensor of floating-point numbers, float64 unless it came as a floating-point tensor."""
    if not hasattr(value, "dtype"):
        value = _listed(value, name)
    value = as_float_tensor(value, name)
    check_finite(value, name)
    return value


def _listed(value: Any, name: str) -> Tensor:
    try:
        return torch.tensor(value, dtype=torch.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must hold numbers, got {value!r}") from error


def _lens(plane: Tensor, lens: Tensor) -> Tensor:
    k1, k2, p1, p2, k3, k4, k5, k6 = lens.unbind()
    u, v = plane.unbind(-1)
    square = u * u + v * v
    scale = (1 + square * (k1 + square * (k2 + square * k3))) / (1 + square * (k4 + square * (k5 + square * k6)))
    along = scale * u + 2 * p1 * u * v + p2 * (square + 2 * u * u)
    down = scale * v + p1 * (square + 2 * v * v) + 2 * p2 * u * v
    return torch.stack((along, down), dim=-1)


def lens_jacobian(plane: Tensor, lens: Tensor) -> Tensor:
    """Return the (..., 2, 2) derivative of what the lens does to points (..., 2) of the plane at depth one.

    Args:
        plane: (..., 2).
        lens: (8,) see `Camera`.
    """
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


def _solved(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return the solutions (..., 2) of 2 x 2 systems; singular ones give something large, never an exception."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    x, y = vector.unbind(-1)
    det = a * d - b * c
    det = torch.where(det.abs() > 1e-12, det, 1e-12)
    return torch.stack((d * x - b * y, a * y - c * x), dim=-1) / det.unsqueeze(-1)
