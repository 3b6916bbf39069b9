"""Range scans: a surface seen from one or more sides, by points with or without triangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, as_tensor, check_finite, check_points, check_positive, check_shape
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.depth_image import unproject
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.neighbors import distinct_places, k_nearest_others, nearest_neighbor, sampling_distance
from torchreg.geometry.normals import (
    check_viewpoint,
    estimate_normals,
    face_vertex_normals,
    fit_normals,
    fit_normals_at,
    neighbors_disagree,
    orient_along_graph,
    orient_normals,
)
from torchreg.geometry.poisson_disk import poisson_disk, poisson_disk_count
from torchreg.geometry.rigid import transform_points

_NORMAL_NEIGHBORS, _BOUNDARY_NEIGHBORS = 16, 24
# Widest angle without a neighbor that is no boundary yet; of 24 directions at random 1 in 500 leave one that wide.
_BOUNDARY_GAP = torch.pi * 2 / 3
# Share of opposed neighbors from which given normals count as unoriented; at random it is a half.
_UNORIENTED = 0.25

# The largest number whose third power is an int64.
_LARGEST_CUBED = 2_097_151


@dataclass(frozen=True, eq=False, repr=False, init=False)
class RangeScan:
    """A partial surface as a scanner sees it, with all that registration asks of it; what is not given is computed.

    Any unit will do: nothing here compares with an absolute length.

    Normals come from the faces (weighed by angle; triangles wound against their neighbors are turned), or without faces
    from the nearest 16 points. They look to the viewpoint; if there is none, faces decide by their winding, and points
    alone turn so that the surface bulges towards the camera, as what one sees of a body does. Given normals are kept,
    scaled to unit length; where they are zero they are estimated, and where their signs are random they are oriented.

    A point is on the boundary if an edge of one triangle alone ends there, or no triangle does; without faces, if its
    neighbors in the tangent plane leave a gap of more than 120 degrees.

    Points at one place are fine: they share normal and boundary, and triangles on them count as connected.

    Args:
        points: (N, 3) finite coordinates, float32 or float64, at three places or more.
        faces: (F, 3) point indices, or None; none at all is None.
        normals: (N, 3) outward, of any length, or None.
        viewpoint: (3,) where the camera was, or None if that is not known.

    Attributes:
        points: (N, 3).
        faces: (F, 3) int64, or None.
        normals: (N, 3) unit vectors.
        boundary: (N,) bool.
        spacing: median distance of a point to the nearest other one, the sampling distance.
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
    # Even samples that were asked for, by their count: every stage of a registration asks anew.
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
        eye = check_viewpoint(viewpoint)
        with torch.no_grad():
            normals, boundary, spacing = _measure(points, faces, normals, eye)
        self._set(points, faces, normals, boundary, spacing, None if eye is None else eye.to(points))

    def _set(
        self,
        points: Tensor,
        faces: Tensor | None,
        normals: Tensor,
        boundary: Tensor,
        spacing: float,
        viewpoint: Tensor | None,
    ) -> None:
        box = points.detach().double()
        values: dict[str, Any] = {
            "points": points,
            "faces": faces,
            "normals": normals,
            "boundary": boundary,
            "spacing": spacing,
            "diagonal": float((box.amax(dim=0) - box.amin(dim=0)).norm()),
            "viewpoint": viewpoint,
            "_even": {},
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @classmethod
    def _of(cls, *values: Any) -> RangeScan:
        scan = cls.__new__(cls)
        scan._set(*values)
        return scan

    @classmethod
    def from_depth(
        cls, depth: Any, intrinsics: Sequence[float], camera_to_world: Any = None, *, max_jump: float = 3.0
    ) -> RangeScan:
        """Return the scan that a depth image holds, its pixels joined by triangles except across jumps in depth.

        Convention: pixel (row i, column j) with depth z is at ``((j - cx) z / fx, (i - cy) z / fy, z)``: right, down
        and forward of the camera.

        Two neighboring pixels are joined unless their depths differ by more than ``max_jump`` pixel widths (at that
        depth; or the noise of the image, if that is more) from what the surface on either side continues to, or by four
        times that in all. Pixels that nothing joins are left out.

        Args:
            depth: (H, W) distances along the axis of the camera, any unit; zero, negative or not finite where nothing
                was measured.
            intrinsics: fx, fy, cx, cy in pixels.
            camera_to_world: (4, 4) rigid motion, or None for camera coordinates.
            max_jump: see above.

        Returns:
            the scan, its points in the order of the rows, its viewpoint the camera.

        Raises:
            InputError: if a size or number does not fit, or no three pixels join.

        Differentiable: no.
        """
        depth = as_float_tensor(depth, "depth")
        depth = depth if depth.dtype == torch.float64 else depth.float()
        check_positive(max_jump, "max_jump")
        motion = torch.eye(4, dtype=depth.dtype, device=depth.device)
        if camera_to_world is not None:
            motion = as_float_tensor(camera_to_world, "camera_to_world", like=depth)
            if abs(_similarity_scale(motion, "camera_to_world") - 1) > 1e-3:
                raise InputError("camera_to_world must be a rigid motion, got one that scales; scale the depth instead")
        with torch.no_grad():
            points, faces = unproject(depth, intrinsics, max_jump)
            # Wound towards the camera already.
            normals = TriangleMesh(points, faces).vertex_normals()
            points, normals = transform_points(motion, points), normals @ motion[:3, :3].mT
        return cls(points, faces, normals, viewpoint=motion[:3, 3])

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
            count: how many; all where there are no more. Either this or ``spacing``.
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
        number = count or 0
        if generator is not None:
            return poisson_disk_count(self.points, number, generator)
        if number not in self._even:
            self._even[number] = poisson_disk_count(self.points, number)
        return self._even[number].clone()

    def subset(self, which: Any, *, mark_cut: bool = False) -> RangeScan:
        """Return the scan of some of the points: their normals and boundary as they are, and the faces among them.

        Args:
            which: (N,) bool mask, or (M,) indices, all different.
            mark_cut: the points are cut out of the surface, not a sample of it: those that lose a face, or without
                faces those next to a gap, become boundary too.

        Returns:
            the scan, with its own spacing and diagonal, and no faces if none has kept all its corners.

        Raises:
            InputError: if an index is out of range or there twice, or fewer than three places are left.
            InputTypeError: if ``which`` holds neither bool nor integers.
        """
        index = self._indices(which)
        points, normals, boundary = self.points[index], self.normals[index], self.boundary[index]
        with torch.no_grad():
            places, place = distinct_places(points)
            spacing = sampling_distance(places)
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
                guide = torch.zeros_like(places).index_copy(0, place, normals.detach().cpu().double())
                near, _ = k_nearest_others(places, _BOUNDARY_NEIGHBORS)
                boundary = boundary | _boundary_of_points(places, guide, near)[place].to(boundary.device)
        return RangeScan._of(points, faces, normals, boundary, spacing, self.viewpoint)

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
        eye = None if self.viewpoint is None else transform_points(motion, self.viewpoint[None])[0]
        return RangeScan._of(
            transform_points(motion, self.points), self.faces, normals, self.boundary, self.spacing * scale, eye
        )

    def to(self, *args: Any, **kwargs: Any) -> RangeScan:
        """Return the scan on another device or in another dtype; takes what ``Tensor.to`` takes."""
        points = self.points.to(*args, **kwargs)
        _check_precision(points)
        faces = None if self.faces is None else self.faces.to(points.device)
        eye = None if self.viewpoint is None else self.viewpoint.to(points)
        return RangeScan._of(points, faces, self.normals.to(points), self.boundary.to(points.device), self.spacing, eye)


def _check_precision(points: Tensor) -> None:
    if points.dtype not in (torch.float32, torch.float64):
        raise InputTypeError(f"points must be float32 or float64, got {points.dtype}; convert with .float()")


def _similarity_scale(motion: Tensor, name: str) -> float:
    check_shape(motion, name, (4, 4))
    check_finite(motion, name)
    linear = motion[:3, :3].detach().double()
    volume = float(torch.linalg.det(linear))
    scale = abs(volume) ** (1 / 3)
    rest = linear.mT @ linear - scale**2 * torch.eye(3, dtype=linear.dtype, device=linear.device)
    bottom = motion[3].detach().double() - torch.eye(4, dtype=linear.dtype, device=linear.device)[3]
    if not volume > 0 or float(rest.abs().max()) > 1e-3 * scale**2 or float(bottom.abs().max()) > 1e-6:
        raise InputError(
            f"{name} must be a rotation, a scale and a translation with the last row 0 0 0 1, got {motion.tolist()}"
        )
    return scale


def _measure(
    points: Tensor, faces: Tensor | None, normals: Tensor | None, eye: Tensor | None
) -> tuple[Tensor, Tensor, float]:
    """Return normals and boundary on the device of the points, and the spacing."""
    places, which = distinct_places(points)
    count = 1 if faces is not None else _BOUNDARY_NEIGHBORS
    near, distance = k_nearest_others(places, count)
    corners = None if faces is None else _plain_faces(which[faces.cpu()])
    if normals is not None:
        normals = _given_normals(points, normals.detach(), near, which, eye)
    elif corners is not None:
        normals = face_vertex_normals(places, corners, eye)[which].to(points)
    else:
        few = near[:, :_NORMAL_NEIGHBORS]
        normals = orient_along_graph(places, fit_normals(places, few), few, eye)[which].to(points)
    normals = _without_zeros(points, normals, eye)
    if corners is not None:
        edge = _boundary_of_faces(corners, len(places))
    else:
        guide = torch.zeros_like(places).index_copy(0, which, normals.cpu().double())
        edge = _boundary_of_points(places, guide, near)
    return normals, edge[which].to(points.device), float(distance[:, 0].median())


def _given_normals(points: Tensor, normals: Tensor, near: Tensor, which: Tensor, eye: Tensor | None) -> Tensor:
    # Scaled by the largest component first: squares of tiny lengths underflow.
    normals = normals / normals.abs().amax(dim=-1, keepdim=True).clamp(min=torch.finfo(normals.dtype).tiny)
    normals = torch.nn.functional.normalize(normals, dim=-1)
    guide = torch.zeros(len(near), 3, dtype=torch.float64).index_copy(0, which, normals.cpu().double())
    if neighbors_disagree(guide, near) > _UNORIENTED:
        return orient_normals(points, normals, viewpoint=eye)
    return normals


def _without_zeros(points: Tensor, normals: Tensor, eye: Tensor | None) -> Tensor:
    """Return normals with estimates where there were none, on the side of the nearest that there is."""
    empty = normals.norm(dim=-1) < 0.5
    if not bool(empty.any()):
        return normals
    if bool(empty.all()):
        return estimate_normals(points, viewpoint=eye)
    estimate = fit_normals_at(points, empty.nonzero()[:, 0])
    nearest, _ = nearest_neighbor(points[empty].detach(), points[~empty].detach())
    turn = (estimate * normals[~empty][nearest]).sum(-1, keepdim=True) < 0
    return normals.index_put((empty,), torch.where(turn, -estimate, estimate))


def _plain_faces(faces: Tensor) -> Tensor:
    """Return the faces without those that name a point twice, and each once."""
    ordered = faces.sort(dim=-1).values
    plain = (ordered[:, 0] != ordered[:, 1]) & (ordered[:, 1] != ordered[:, 2])
    faces, ordered = faces[plain], ordered[plain]
    if len(faces) == 0:
        return faces
    size = int(ordered.max()) + 1
    if size <= _LARGEST_CUBED:
        _, which = ((ordered[:, 0] * size + ordered[:, 1]) * size + ordered[:, 2]).unique(return_inverse=True)
    else:
        _, which = ordered.unique(dim=0, return_inverse=True)  # slower by far
    first = torch.full((int(which.max()) + 1,), len(faces)).scatter_reduce(0, which, torch.arange(len(faces)), "amin")
    return faces[first.sort().values]


def _boundary_of_faces(faces: Tensor, count: int) -> Tensor:
    """Return a mask (N,) of the points on an edge of one face alone, or on no face."""
    sides = torch.stack((faces, faces.roll(-1, dims=1)), dim=-1).sort(dim=-1).values.reshape(-1, 2)
    key, uses = (sides[:, 0] * count + sides[:, 1]).unique(return_counts=True)
    rim = key[uses == 1]
    boundary = torch.ones(count, dtype=torch.bool).index_fill(0, faces.reshape(-1), False)
    return boundary.index_fill(0, torch.cat((rim // count, rim % count)), True)


def _boundary_of_points(points: Tensor, normals: Tensor, near: Tensor) -> Tensor:
    """Return a mask (N,) of the points whose neighbors (N, K) leave a wide gap around them in the tangent plane."""
    axis = torch.zeros_like(normals).scatter(1, normals.abs().argmin(dim=1, keepdim=True), 1.0)
    first = torch.nn.functional.normalize(torch.linalg.cross(normals, axis), dim=-1)
    second = torch.linalg.cross(normals, first)
    offset = points[near] - points[:, None]
    frame = torch.stack((first, second, normals), dim=-1)
    right, up, out = (offset @ frame).unbind(-1)
    # What lies steeply above or below is another surface behind or before this one.
    level = out.abs() <= torch.hypot(right, up)
    angle = torch.where(level, torch.atan2(up, right), torch.inf).sort(dim=-1).values
    number = level.sum(dim=-1)
    last = angle.gather(1, (number - 1).clamp(min=0)[:, None])[:, 0]
    around = 2 * torch.pi + angle[:, 0] - last
    between = torch.where(angle[:, 1:].isfinite(), angle[:, 1:] - angle[:, :-1], 0.0)
    widest = torch.maximum(around, between.amax(dim=-1)) if angle.shape[1] > 1 else around
    return (widest > _BOUNDARY_GAP) | (number == 0)
