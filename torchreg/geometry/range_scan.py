"""Range scans: partial surfaces given by points, with or without triangles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import (
    as_float_tensor,
    as_tensor,
    check_count,
    check_finite,
    check_points,
    check_positive,
    check_shape,
)
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.boundary import BOUNDARY, boundary_of_faces, boundary_of_points
from torchreg.geometry.depth_image import unproject
from torchreg.geometry.far_origin import far_origin, to_local
from torchreg.geometry.mesh import TriangleMesh, distinct_faces
from torchreg.geometry.neighbors import distinct_positions, k_nearest_others, nearest_neighbor, sampling_distance
from torchreg.geometry.normals import (
    NORMALS,
    estimate_normals,
    face_vertex_normals,
    fit_normals,
    fit_normals_at,
    neighbors_disagree,
    orient_along_graph,
    orient_normals,
)
from torchreg.geometry.poisson_disk import poisson_disk, poisson_disk_count
from torchreg.geometry.rigid import RIGID_TOLERANCE, transform_points


@dataclass(frozen=True, eq=False, repr=False, init=False)
class RangeScan:
    """A partial surface from a scanner, with normals, boundary and spacing; what is not given is computed.

    Any unit will do: nothing is compared with an absolute length.

    Normals come from the faces (weighed by angle; triangles wound against their neighbors are flipped), or without
    faces from the nearest 16 points. They face the viewpoint; without one, the winding of faces decides, and points
    alone are oriented such that the surface is convex towards the camera, as the visible side of a body is. Given
    normals are kept, scaled to unit length; zero ones are estimated, and ones of random signs are oriented.

    A point is on the boundary if it is on an edge of a single triangle, or on no triangle; without faces, if its
    neighbors in the tangent plane leave an angle of more than 120 degrees empty.

    Coincident points are fine: they share normal and boundary, and triangles on them count as connected.

    Args:
        points: (N, 3) finite coordinates, float32 or float64, at three positions or more.
        faces: (F, 3) point indices, or None; an empty table counts as None.
        normals: (N, 3) outward, of any length, or None.
        viewpoint: (3,) position of the camera, or None if unknown.

    Attributes:
        points: (N, 3).
        faces: (F, 3) int64, or None.
        normals: (N, 3) unit vectors.
        boundary: (N,) bool.
        spacing: median distance of a point to its nearest neighbor, the sampling distance.
        diagonal: of the bounding box.
        viewpoint: (3,) or None.

    Raises:
        InputError: if a shape is wrong, a number is not finite, there are too few points, or a face names a point that
            does not exist.
        InputTypeError: if points or normals are not real numbers, or faces not integers.

    Differentiable: no; normals, boundary, spacing and diagonal are constants.

    Cost: 0.2 s for 20,000 points without faces, 0.05 s with.

    References: Chang and Zwicker 2009, section 4.1, on what correspondences need.
    """

    points: Tensor
    faces: Tensor | None
    normals: Tensor
    boundary: Tensor
    spacing: float
    diagonal: float
    viewpoint: Tensor | None
    # Uniform subsamples by their count: every stage of a registration asks for the same ones.
    _even: dict[int, Tensor]

    def __init__(self, points: Any, faces: Any = None, normals: Any = None, *, viewpoint: Any = None) -> None:
        points = as_float_tensor(points, "points")
        _check_precision(points)
        check_shape(points, "points", ("N", 3))
        check_finite(points, "points", "drop those points, and the faces that use them")
        check_points(points, "points", min_count=3, batch=False)
        faces = None if faces is None else TriangleMesh(points, faces).faces
        faces = None if faces is None or len(faces) == 0 else faces
        if normals is not None:
            normals = as_float_tensor(normals, "normals", like=points)
            check_shape(normals, "normals", tuple(points.shape))
            check_finite(normals, "normals", "pass normals=None to have them estimated")
        camera = None if viewpoint is None else _as_viewpoint(viewpoint)
        with torch.no_grad():
            origin = far_origin(points)  # products of large coordinates lose digits
            near, seen_from = to_local(points, origin), to_local(camera, origin)
            normals, boundary, spacing = _measure(near, faces, normals, seen_from)
        self._set(
            points=points,
            faces=faces,
            normals=normals,
            boundary=boundary,
            spacing=spacing,
            viewpoint=None if camera is None else camera.to(points),
        )

    def _set(self, *, points: Tensor, **values: Any) -> None:
        box = points.detach().double()
        diagonal = float((box.amax(dim=0) - box.amin(dim=0)).norm())
        for name, value in {"points": points, "diagonal": diagonal, "_even": {}, **values}.items():
            object.__setattr__(self, name, value)

    def replaced(self, **values: Any) -> RangeScan:
        """Return the scan with some fields replaced; the others are not computed anew."""
        names = ("points", "faces", "normals", "boundary", "spacing", "viewpoint")
        scan = RangeScan.__new__(RangeScan)
        scan._set(**{name: getattr(self, name) for name in names} | values)
        return scan

    @classmethod
    def from_depth(
        cls, depth: Any, intrinsics: Sequence[float], camera_to_world: Any = None, *, max_jump: float = 3.0
    ) -> RangeScan:
        """Return the scan of a depth image, its pixels joined by triangles except across jumps in depth.

        Convention: pixel (row i, column j) with depth z is at ``((j - cx) z / fx, (i - cy) z / fy, z)``: right, down
        and forward of the camera.

        Two neighboring pixels are joined unless their depths differ by more than ``max_jump`` pixel widths (at that
        depth; or the noise of the image, if that is more) from the linear continuation of the surface on either side,
        or by four times that in all. Pixels without a triangle are left out.

        Args:
            depth: (H, W) distances along the axis of the camera, any unit; zero, negative or not finite where nothing
                was measured.
            intrinsics: fx, fy, cx, cy in pixels.
            camera_to_world: (4, 4) rigid motion, or None for camera coordinates.
            max_jump: see above.

        Returns:
            The scan, its points in the order of the rows, its viewpoint the camera.

        Raises:
            InputError: if a size or number does not fit, or no three pixels join.

        Differentiable: no.
        """
        depth = as_float_tensor(depth, "depth")
        depth = depth if depth.dtype == torch.float64 else depth.float()
        check_shape(depth, "depth", ("H", "W"))
        numbers = _as_intrinsics(intrinsics)
        check_positive(max_jump, "max_jump")
        motion = torch.eye(4, dtype=depth.dtype, device=depth.device)
        if camera_to_world is not None:
            motion = as_float_tensor(camera_to_world, "camera_to_world", like=depth)
            if abs(_similarity_scale(motion, "camera_to_world") - 1) > RIGID_TOLERANCE.rounded:
                raise InputError("camera_to_world must be a rigid motion, got one that scales; scale the depth instead")
        with torch.no_grad():
            points, faces = unproject(depth, numbers, max_jump)
            # Wound towards the camera already.
            normals = TriangleMesh(points, faces).vertex_normals()
            points, normals = transform_points(motion, points), normals @ motion[:3, :3].mT
        return cls(points, faces, normals, viewpoint=motion[:3, 3])

    def shifted(self, offset: Tensor) -> RangeScan:
        """Return the scan moved by an offset (3,)."""
        viewpoint = None if self.viewpoint is None else self.viewpoint + offset.to(self.viewpoint)
        return self.replaced(points=self.points + offset.to(self.points), viewpoint=viewpoint)

    def __len__(self) -> int:
        return self.points.shape[0]

    def __repr__(self) -> str:
        faces = 0 if self.faces is None else len(self.faces)
        return f"RangeScan({len(self)} points, {faces} faces, spacing {self.spacing:.4g}, diagonal {self.diagonal:.4g})"

    def uniform_subsample(
        self, count: int | None = None, *, spacing: float | None = None, generator: torch.Generator | None = None
    ) -> Tensor:
        """Return indices (M,) of points spread evenly over the surface, however unevenly it was scanned; ascending.

        Args:
            count: number of points; all if there are no more. Either this or ``spacing``.
            spacing: least distance between two of them; as many as fit.
            generator: source of randomness; None draws from a fresh generator with seed 0, the same at every call.

        Raises:
            InputError: if not exactly one of the two is given, or it is not positive.

        Cost: 0.1 s for 20,000 points; nothing when it is asked for the same again without a generator.
        """
        if (count is None) == (spacing is None):
            raise InputError(f"give either count or spacing, got count={count} and spacing={spacing}")
        if spacing is not None:
            check_positive(spacing, "spacing")
            return poisson_disk(self.points, spacing, generator)
        number = 0 if count is None else count
        check_count(number, "count", 1)
        if generator is not None:
            return poisson_disk_count(self.points, number, generator)
        if number not in self._even:
            self._even[number] = poisson_disk_count(self.points, number)
        return self._even[number].clone()

    def subset(self, which: Any, *, mark_cut: bool = False) -> RangeScan:
        """Return the scan of a subset of the points: their normals and boundary as they are, and the faces among them.

        Args:
            which: (N,) bool mask, or (M,) indices, all different.
            mark_cut: the points are cut out of the surface, not a sample of it: those that lose a face, or without
                faces those next to an empty angle, become boundary too.

        Returns:
            The scan, with its own spacing and diagonal, and without faces if none keeps all its corners.

        Raises:
            InputError: if an index is out of range or repeated, or fewer than three positions remain.
            InputTypeError: if ``which`` holds neither bool nor integers.
        """
        index = self._indices(which)
        points, normals, boundary = self.points[index], self.normals[index], self.boundary[index]
        with torch.no_grad():
            positions, position = _three_positions(points)
            spacing = sampling_distance(positions)
            faces = None
            if self.faces is not None:
                new = torch.full((len(self),), -1, device=points.device)
                new[index] = torch.arange(len(index), device=points.device)
                moved = new[self.faces]
                kept = (moved >= 0).all(dim=-1)
                faces = moved[kept] if bool(kept.any()) else None
                if mark_cut:
                    corners = moved[~kept].reshape(-1)
                    boundary = boundary.index_fill(0, corners[corners >= 0], True)
            elif mark_cut:
                guide = torch.zeros_like(positions).index_copy(0, position, normals.detach().cpu().double())
                near, _ = k_nearest_others(positions, BOUNDARY.num_neighbors)
                boundary = boundary | boundary_of_points(positions, guide, near)[position].to(boundary.device)
        return self.replaced(points=points, faces=faces, normals=normals, boundary=boundary, spacing=spacing)

    def _indices(self, which: Any) -> Tensor:
        which = as_tensor(which, "which", "bool or integers")
        if which.numel() == 0 and which.dtype != torch.bool:
            which = which.long()
        which = which.to(self.points.device)
        if which.dtype == torch.bool:
            check_shape(which, "which", (len(self),))
            return which.nonzero()[:, 0]
        if which.is_floating_point() or which.is_complex():
            raise InputTypeError(f"which must hold bool or integers, got {which.dtype}")
        check_shape(which, "which", ("M",))
        which = which.long()
        if len(which) and not 0 <= int(which.min()) <= int(which.max()) < len(self):
            raise InputError(
                f"which must index the {len(self)} points (0 to {len(self) - 1}), got indices from {int(which.min())} "
                f"to {int(which.max())}"
            )
        if len(which.unique()) < len(which):
            raise InputError(f"which must hold every index once, got {len(which) - len(which.unique())} repeated")
        return which

    def transformed(self, motion: Any) -> RangeScan:
        """Return the scan moved, and scaled if the motion scales.

        Args:
            motion: (4, 4) rotation, one scale for all axes, and translation.

        Raises:
            InputError: if it shears, scales axes differently, mirrors or collapses.
        """
        motion = as_float_tensor(motion, "motion", like=self.points)
        scale = _similarity_scale(motion, "motion")
        normals = torch.nn.functional.normalize(self.normals @ motion[:3, :3].mT, dim=-1)
        return self.replaced(
            points=transform_points(motion, self.points),
            normals=normals,
            spacing=self.spacing * scale,
            viewpoint=None if self.viewpoint is None else transform_points(motion, self.viewpoint[None])[0],
        )

    def to(self, *args: Any, **kwargs: Any) -> RangeScan:
        """Return the scan on another device or in another dtype; takes what ``Tensor.to`` takes."""
        points = self.points.to(*args, **kwargs)
        _check_precision(points)
        return self.replaced(
            points=points,
            faces=None if self.faces is None else self.faces.to(points.device),
            normals=self.normals.to(points),
            boundary=self.boundary.to(points.device),
            viewpoint=None if self.viewpoint is None else self.viewpoint.to(points),
        )


def _check_precision(points: Tensor) -> None:
    if points.dtype not in (torch.float32, torch.float64):
        raise InputTypeError(f"points must be float32 or float64, got {points.dtype}; convert with .float()")


def _as_viewpoint(viewpoint: Any) -> Tensor:
    """Return a viewpoint (3,) as float64 on the CPU; InputError unless it is three finite numbers."""
    viewpoint = as_float_tensor(viewpoint, "viewpoint").detach().cpu().double()
    check_shape(viewpoint, "viewpoint", (3,))
    if not bool(viewpoint.isfinite().all()):
        raise InputError(f"viewpoint must be finite, got {viewpoint.tolist()}; pass None if it is not known")
    return viewpoint


def _as_intrinsics(intrinsics: Sequence[float]) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy; InputTypeError unless they are four numbers, InputError unless they are a camera's."""
    try:
        focal_x, focal_y, center_x, center_y = (float(value) for value in intrinsics)
    except (TypeError, ValueError) as error:
        raise InputTypeError(f"intrinsics must be the four numbers fx, fy, cx, cy, got {intrinsics!r}") from error
    check_positive(focal_x, "intrinsics[0] (fx)")
    check_positive(focal_y, "intrinsics[1] (fy)")
    if not math.isfinite(center_x) or not math.isfinite(center_y):
        raise InputError(f"intrinsics must be finite, got cx {center_x} and cy {center_y}")
    return focal_x, focal_y, center_x, center_y


def _three_positions(points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distinct positions, and the index of each point's; InputError if there are fewer than three."""
    check_points(points, "points", min_count=3, batch=False)
    positions, index = distinct_positions(points)
    if len(positions) < 3:
        raise InputError(f"points must lie at 3 places or more, got {len(points)} points at {len(positions)}")
    return positions, index


def _similarity_scale(motion: Tensor, name: str) -> float:
    check_shape(motion, name, (4, 4))
    check_finite(motion, name)
    linear = motion[:3, :3].detach().double()
    volume = float(torch.linalg.det(linear))
    scale = abs(volume) ** (1 / 3)
    shear = linear.mT @ linear - scale**2 * torch.eye(3, dtype=linear.dtype, device=linear.device)
    last_row = motion[3].detach().double() - linear.new_tensor([0.0, 0.0, 0.0, 1.0])
    is_sheared = float(shear.abs().max()) > RIGID_TOLERANCE.rounded * scale**2
    if not volume > 0 or is_sheared or float(last_row.abs().max()) > RIGID_TOLERANCE.double:
        raise InputError(
            f"{name} must be a rotation, a scale and a translation with the last row 0 0 0 1, got {motion.tolist()}"
        )
    return scale


def _measure(
    points: Tensor, faces: Tensor | None, normals: Tensor | None, viewpoint: Tensor | None
) -> tuple[Tensor, Tensor, float]:
    """Return normals and boundary on the device of the points, and the spacing."""
    positions, which = _three_positions(points)
    corners = None if faces is None else distinct_faces(which[faces.cpu()])
    if corners is not None and normals is None:
        near, spacing = which.new_zeros(0, 1), sampling_distance(positions)
    else:
        near, distance = k_nearest_others(positions, 1 if corners is not None else BOUNDARY.num_neighbors)
        spacing = float(distance[:, 0].median())
    if normals is not None:
        normals = _given_normals(points, normals.detach(), near, which, viewpoint)
    elif corners is not None:
        normals = face_vertex_normals(positions, corners, viewpoint)[which].to(points)
    else:
        nearest = near[:, : NORMALS.num_neighbors]
        fitted = fit_normals(positions, nearest)
        normals = orient_along_graph(positions, fitted, nearest, viewpoint)[which].to(points)
    normals = _without_zeros(points, normals, viewpoint)
    if corners is not None:
        edge = boundary_of_faces(corners, len(positions))
    else:
        guide = torch.zeros_like(positions).index_copy(0, which, normals.cpu().double())
        edge = boundary_of_points(positions, guide, near)
    return normals, edge[which].to(points.device), spacing


def _given_normals(points: Tensor, normals: Tensor, near: Tensor, which: Tensor, viewpoint: Tensor | None) -> Tensor:
    # Scaled by the largest component first: squares of tiny lengths underflow.
    normals = normals / normals.abs().amax(dim=-1, keepdim=True).clamp(min=torch.finfo(normals.dtype).tiny)
    normals = torch.nn.functional.normalize(normals, dim=-1)
    guide = torch.zeros(len(near), 3, dtype=torch.float64).index_copy(0, which, normals.cpu().double())
    if neighbors_disagree(guide, near) > NORMALS.unoriented:
        return orient_normals(points, normals, viewpoint=viewpoint)
    return normals


def _without_zeros(points: Tensor, normals: Tensor, viewpoint: Tensor | None) -> Tensor:
    """Return normals with estimates instead of zeros, each on the side of the nearest given normal."""
    empty = normals.norm(dim=-1) < 0.5
    if not bool(empty.any()):
        return normals
    if bool(empty.all()):
        return estimate_normals(points, viewpoint=viewpoint)
    estimate = fit_normals_at(points, empty.nonzero()[:, 0])
    nearest, _ = nearest_neighbor(points[empty].detach(), points[~empty].detach())
    flip = (estimate * normals[~empty][nearest]).sum(-1, keepdim=True) < 0
    return normals.index_put((empty,), torch.where(flip, -estimate, estimate))
