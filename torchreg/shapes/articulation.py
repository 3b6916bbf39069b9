"""The fused surface of articulated shapes: solids on the parts of a kinematic tree."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor, nn

from torchreg._checks import check_direction, check_finite, check_positive, check_shape
from torchreg.errors import InputError, ModelError
from torchreg.geometry.budget import BUDGET
from torchreg.geometry.isosurface import isosurface
from torchreg.geometry.kinematic_tree import KinematicTree
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.primitives import Planes
from torchreg.geometry.rigid import invert_rigid, rigid_matrix
from torchreg.geometry.upright import Z_UP, Direction
from torchreg.shapes.material_points import MaterialPoints, ShapeOutput, fused_points, mesh_points, onto_fused
from torchreg.shapes.posed_tree import PosedTree, frozen
from torchreg.shapes.primitives import DeferredSolids, Primitive, PrimitiveSet, fuse
from torchreg.shapes.shape_space import ShapeSpace
from torchreg.shapes.spec import RigSurface


@dataclass(frozen=True)
class _HeldSizes:
    """Sizes of one shape that do not change for a while."""

    shape: Articulation
    offset_scales: Tensor
    scaled_sizes: list[Tensor]
    solid_poses: Tensor
    fusion_length: Tensor


# Belongs to the running thread, not to the shape, which other threads may use at the same time.
_HELD: ContextVar[_HeldSizes | None] = ContextVar("torchreg held sizes", default=None)


@dataclass(frozen=True)
class _KeptMeshes:
    """How many meshes of fused surfaces are kept."""

    count: int = 8  # shapes in use at a time, two meshes each at most, of a megabyte or less


_KEPT_MESHES = _KeptMeshes()
# The latest ones: every call of `align` or `find_pose` without model points asks for the same one.
_MESHES: dict[tuple[object, ...], TriangleMesh] = {}


class Articulation(PosedTree):
    """Parts on a kinematic tree and their fused surface; `ArticulatedShape` explains conventions and arguments."""

    _started: Tensor

    def __init__(
        self,
        tree: KinematicTree,
        part_frames: Sequence[str],
        primitives: Sequence[Primitive] | DeferredSolids,
        *,
        nu: float = 0.003,
        sharpness: float = 2.0,
        part_names: Sequence[str] | None = None,
        free_base: bool = True,
        surface: RigSurface | None = None,
        space: ShapeSpace | None = None,
        up: Direction = Z_UP,
        dtype: torch.dtype | None = None,
    ) -> None:
        check_positive(nu, "nu")
        check_positive(sharpness, "sharpness")
        if not part_frames or len(part_frames) != len(primitives):
            raise ModelError(
                f"a shape needs one primitive per part, got {len(primitives)} for {len(part_frames)} part frames"
            )
        super().__init__(tree, part_frames, part_names, free_base)
        self._deferred = primitives if isinstance(primitives, DeferredSolids) else None
        first = primitives.guess if isinstance(primitives, DeferredSolids) else primitives
        self._modules["primitives"] = PrimitiveSet(first)
        self.surface = surface
        self.space = space
        self.up = check_direction(up, "up")
        self.log_radius_scales = frozen(torch.zeros(len(primitives), dtype=torch.float64))
        self.log_nu = frozen(torch.tensor(math.log(nu), dtype=torch.float64))
        self.log_sharpness = frozen(torch.tensor(math.log(sharpness), dtype=torch.float64))
        # What they were at first: until they change, the numbers themselves count, without the rounding of logarithms.
        self.start_nu, self.start_sharpness = float(nu), float(sharpness)
        self.register_buffer("_started", torch.stack([self.log_nu, self.log_sharpness]), persistent=False)
        self.surface_points = self._bound_points()
        self.to(dtype or torch.get_default_dtype())

    def _bound_points(self) -> MaterialPoints:
        """Return the points of the surface as it came: of the file's mesh, where there is one, else of the solids."""
        reference = self.rest if self.surface is None else torch.zeros_like(self.rest)
        transforms = self.part_transforms(reference)
        to_parts = invert_rigid(transforms)
        if self.surface is not None:
            return mesh_points(self.surface, to_parts)
        # In the precision of files, so that a shape that comes back from one has the same samples.
        solids = copy.deepcopy(self.primitives).float().double()
        frames = transforms @ rigid_matrix(solids.rotations, solids.centers)
        return fused_points(solids, frames, self.adjacency, self.start_nu, to_parts)

    @property
    def primitives(self) -> PrimitiveSet:
        """The solids of all parts; those of a rig are refined when they are first asked for."""
        if self._deferred is not None:
            self._make_solids(self._deferred)
        return cast(PrimitiveSet, self._modules["primitives"])

    @torch.compiler.assume_constant_result
    def _make_solids(self, deferred: DeferredSolids) -> None:
        """Put the solids that were deferred in the place of their guess."""
        self._modules["primitives"] = PrimitiveSet(deferred.made).to(self.rest).train(self.training)
        self._deferred = None

    def state_dict(self, *args: Any, **kwargs: Any) -> Any:
        """Return the state, see `torch.nn.Module.state_dict`."""
        _ = self.primitives
        return super().state_dict(*args, **kwargs)

    def named_modules(self, *args: Any, **kwargs: Any) -> Iterator[tuple[str, nn.Module]]:
        """Yield names and modules, see `torch.nn.Module.named_modules`; parameters and buffers are found by it."""
        _ = self.primitives
        return super().named_modules(*args, **kwargs)

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        _ = self.primitives  # the state does not hold how they are turned
        super()._load_from_state_dict(*args, **kwargs)

    @property
    def nu(self) -> float:
        """Fusion length, metres; `fusion_length` is the same with gradients."""
        return float(self.fusion_length().detach())

    @property
    def sharpness(self) -> float:
        """Sharpness of the bending skin; `bending_sharpness` is the same with gradients."""
        return float(self.bending_sharpness().detach())

    @property
    def faces(self) -> Tensor | None:
        """Triangles (F, 3) over the points of `forward`; None where these are samples."""
        if self.surface is None or self.surface.is_rigid:
            return None
        return self.surface.faces.to(self.rest.device)

    def fusion_length(self) -> Tensor:
        """Return nu (), float64, metres."""
        held = self._held()
        if held is not None:
            return held.fusion_length
        return (self.log_nu - self._started[0]).double().exp() * self.start_nu

    def bending_sharpness(self) -> Tensor:
        """Return the sharpness of the bending skin (), float64."""
        return (self.log_sharpness - self._started[1]).double().exp() * self.start_sharpness

    def forward(self, pose: Tensor) -> ShapeOutput:
        """Return the shape in a pose: points of its surface, keypoints and part transforms.

        The points are always the same ones: the vertices of the file's mesh, in their order, with `faces`; samples of
        a robot's meshes; or samples of the fused surface as it came, which its bending skin (eq. 3) moves and one
        Newton step puts back onto the surface ``d = 0`` of eq. 2. With a part's scales its points grow along and
        across its solid.

        Args:
            pose: (..., num_dofs).

        Returns:
            A `ShapeOutput`: points (..., N, 3), keypoints (..., K, 3), metres, and transforms (..., P, 4, 4).

        References: Dewaele et al. 2006, eqs. 1 to 3.
        """
        transforms, growth = self.part_transforms(pose), self._growth()
        if self.surface is not None:
            points = self.surface_points(transforms, growth)
        else:
            nu = self.fusion_length()
            points = self.surface_points(transforms, growth, self._bending_shares(growth, nu))
            fuses = self.adjacency[self.surface_points.weights.argmax(-1)]
            frames = self._solid_frames(transforms)
            points = onto_fused(self.primitives, self._scaled_sizes(), frames, points, fuses, nu)
        return ShapeOutput(points, self.placed_keypoints(transforms), transforms)

    def _bending_shares(self, growth: Tensor, nu: Tensor) -> Tensor:
        """Return the shares (N,) of the neighbors in the motions of the surface's points, by the fields at rest."""
        bound, transforms = self.surface_points, self.part_transforms(self.rest)
        distances = self.placed_distances(bound(transforms, growth), transforms).mT
        partners = bound.weights if bound.partners is None else bound.partners
        gaps = ((partners - bound.weights) * distances).sum(-1)
        return torch.sigmoid(-gaps * (self.bending_sharpness() / nu))

    @contextmanager
    def held_sizes(self) -> Iterator[None]:
        """Evaluate bone lengths and radii once, not for every pose, in a ``with`` block; they must not change in it."""
        held = _HeldSizes(self, self._offset_scales(), self._scaled_sizes(), self._solid_poses(), self.fusion_length())
        token = _HELD.set(held)
        try:
            yield
        finally:
            _HELD.reset(token)

    def part_distances(self, points: Tensor, pose: Tensor) -> Tensor:
        """Return the distance of points to the solid of every part, before fusion.

        Args:
            points: (..., N, 3), metres.
            pose: (..., num_dofs).

        Returns:
            (..., N, P), metres, negative inside.
        """
        return self.placed_distances(points, self.part_transforms(pose)).mT

    def placed_distances(self, points: Tensor, transforms: Tensor, parts: Sequence[int] | None = None) -> Tensor:
        """Return distances (..., P, N) of points to solids, metres, negative inside, whatever the joints allow.

        ``transforms`` (..., P, 4, 4) are ``T_world_part`` of the given parts, by default of all.
        """
        local = self._local_planes(points, self._solid_frames(transforms, parts))
        return self.primitives.plane_distance(local, self._scaled_sizes(), parts)

    def distance(self, points: Tensor, pose: Tensor, *, parts: Sequence[int] | None = None) -> Tensor:
        """Return the signed distance of points to the fused surface, ``d = -nu log phi``.

        phi sums the fields ``exp(-d_q / nu)`` of the dominating part and its neighbors only, in the log domain.

        Args:
            points: (..., N, 3), metres.
            pose: (..., num_dofs).
            parts: indices of the parts to evaluate, as those of a limb; all by default.

        Returns:
            Distances (..., N), metres, negative inside; first-order accurate near the surface.

        References: Dewaele et al. 2006, eqs. 1 and 2.
        """
        check_shape(points, "points", ("N", 3), batch=True)
        transforms = self.part_transforms(pose)
        if parts is not None:
            transforms = transforms[..., list(parts), :, :]
        return fuse(self.placed_distances(points, transforms, parts).mT, self._neighbors(parts), self.fusion_length())[
            0
        ]

    def distances_without(self, points: Tensor, pose: Tensor, left_out: Sequence[Sequence[int]]) -> Tensor:
        """Return distances (L, ..., N) of points to the surface fused without each of L sets of parts.

        They are infinite where all parts are left out.
        """
        each = self.part_distances(points, pose)
        gone = torch.zeros(len(left_out), each.shape[-1], dtype=torch.bool, device=each.device)
        for row, parts in zip(gone, left_out, strict=True):
            row[list(parts)] = True
        gone = gone.reshape(len(gone), *[1] * (each.ndim - 1), -1)
        fused = fuse(each.masked_fill(gone, torch.inf), self.adjacency, self.fusion_length())[0]
        return fused.masked_fill(gone.all(-1), torch.inf)

    def distance_jacobian(
        self,
        points: Tensor,
        pose: Tensor,
        *,
        chart: str = "pose",
        parts: Sequence[int] | None = None,
        dofs: Sequence[int] | slice = slice(None),
    ) -> tuple[Tensor, Tensor]:
        """Return the fused distances (..., N) and their analytic Jacobian (..., N, num_dofs), or its columns ``dofs``.

        The points (..., N, 3) are fixed in the world; ``chart`` as in `part_twists`, ``parts`` as in `distance`.
        """
        transforms, linear, angular = self._twists(pose, chart)
        moves = self._part_moves
        if parts is not None:
            transforms, moves = transforms[..., list(parts), :, :], moves[list(parts)]
        solids = self._solid_frames(transforms, parts)
        local = x, y, z = self._local_planes(points, solids)
        distances, gradient = self.primitives.plane_gradient(local, self._scaled_sizes(), parts)
        fused, shares = fuse(distances.mT, self._neighbors(parts), self.fusion_length())
        # A fixed point moves backwards relative to a solid that moves by a twist; the wrench is in the solid's frame.
        fx, fy, fz = (plane * shares.mT for plane in gradient)
        moment = (_minor(y, fz, z, fy), _minor(z, fx, x, fz), _minor(x, fy, y, fx))
        wrench = torch.cat([fx, fy, fz, *moment], dim=-2)
        twists = self._solid_twists(linear, angular, solids, moves)[..., dofs]
        return fused, (twists.mT @ wrench).mT

    def _solid_twists(self, linear: Tensor, angular: Tensor, solids: Tensor, moves: Tensor) -> Tensor:
        """Return the negative twists (..., 6 P, num_dofs) of solids in their frames, a row per component and part."""
        angular = angular.unsqueeze(-3)
        linear = linear.unsqueeze(-3) + torch.linalg.cross(angular, solids[..., None, :, 3])
        local = torch.cat([linear, angular.expand_as(linear)], dim=-2) @ -solids[..., :3]
        moved = local.unflatten(-2, (2, -1)) * moves[:, None, :, None]
        twists = moved.movedim((-3, -1), (-4, -3)).flatten(-4, -2)
        return twists @ self._couplings if self.kinematics.has_mimics else twists

    def surface_mesh(self, pose: Tensor | None = None, spacing: float | None = None) -> TriangleMesh:
        """Return a mesh of the fused surface.

        Args:
            pose: (num_dofs,); the rest pose by default.
            spacing: edge length of the grid, metres; by default `nu`, but at most 1.5 million grid points.

        Returns:
            A closed mesh in the module's dtype and device.
        """
        pose = self.rest_pose() if pose is None else self.check_pose(pose)
        check_finite(pose, "pose")
        if spacing is not None:
            check_positive(spacing, "spacing")
        lower, upper = self._surface_box(pose)
        spacing = max(self.nu, _least_spacing(lower, upper)) if spacing is None else spacing
        key = self._surface_key(pose, spacing)
        mesh = _MESHES.get(key)
        if mesh is None:
            mesh = _MESHES[key] = isosurface(lambda points: self.distance(points, pose), lower, upper, spacing)
            for old in list(_MESHES)[: -_KEPT_MESHES.count]:
                _MESHES.pop(old, None)
        return TriangleMesh(mesh.vertices.clone(), mesh.faces.clone())

    def coarse_surface_mesh(self) -> TriangleMesh:
        """Return a mesh of the fused surface at rest as `surface_mesh`, on a grid of 1.5 fusion lengths or wider."""
        pose = self.rest_pose()
        return self.surface_mesh(pose, max(1.5 * self.nu, _least_spacing(*self._surface_box(pose))))

    @torch.no_grad()
    def _surface_key(self, pose: Tensor, spacing: float) -> tuple[object, ...]:
        """Return everything that the mesh of the fused surface depends on."""
        frames = self._solid_frames(self.part_transforms(pose))
        values = [frames, *self._scaled_sizes(), self.adjacency, self.fusion_length()]
        numbers = tuple(value.double().cpu().numpy().tobytes() for value in values)
        return self.primitives.part_kinds, spacing, self.rest.dtype, self.rest.device, numbers

    @torch.no_grad()
    def _surface_box(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Return the lower and the upper corner (3,) of a box around the fused surface."""
        positions = self._solid_frames(self.part_transforms(pose))[..., 3]
        reach = self.primitives.reaches(self._scaled_sizes()).unsqueeze(-1) + 3 * self.nu
        return (positions - reach).amin(0), (positions + reach).amax(0)

    def _held(self) -> _HeldSizes | None:
        """Return the sizes that the running thread holds of this shape."""
        held = None if torch.compiler.is_compiling() else _HELD.get()
        return held if held is not None and held.shape is self else None

    def _offset_scales(self) -> Tensor:
        held = self._held()
        return super()._offset_scales() if held is None else held.offset_scales

    def _scaled_sizes(self) -> list[Tensor]:
        held = self._held()
        if held is not None:
            return held.scaled_sizes
        return self.primitives.scaled_sizes(self.log_length_scales.exp(), self.log_radius_scales.exp())

    def _neighbors(self, parts: Sequence[int] | None) -> Tensor:
        return self.adjacency if parts is None else self.adjacency[list(parts)][:, list(parts)]

    def _solid_frames(self, transforms: Tensor, parts: Sequence[int] | None = None) -> Tensor:
        """Return ``[R | t]`` (..., P, 3, 4) of every solid in the world, or of those of given parts."""
        poses = self._solid_poses()
        return transforms[..., :3, :] @ (poses if parts is None else poses[list(parts)])

    def _growth(self) -> Tensor:
        """Return the affine map (P, 4, 4) of each part in its coordinates: its solid becomes its scaled solid."""
        lengths, radii = self.log_length_scales.exp(), self.log_radius_scales.exp()
        rotations, centers = self.primitives.rotations, self.primitives.centers
        stretch = torch.stack([radii, radii, lengths], dim=-1) - 1
        linear = (rotations * stretch.unsqueeze(-2)) @ rotations.mT + torch.eye(3).to(rotations)
        shift = centers * lengths.unsqueeze(-1) - (linear @ centers.unsqueeze(-1)).squeeze(-1)
        return rigid_matrix(linear, shift)

    def _solid_poses(self) -> Tensor:
        """Return the pose (P, 4, 4) of each solid in its part."""
        held = self._held()
        if held is not None:
            return held.solid_poses
        centers = self.primitives.centers * self.log_length_scales.exp().unsqueeze(-1)
        return rigid_matrix(self.primitives.rotations, centers)

    def _local_planes(self, points: Tensor, solids: Tensor) -> Planes:
        """Return points (..., N, 3) in every solid's frame, as planes (..., P, N)."""
        _check_kind(points, self.rest)
        rotations = solids[..., :3]
        offsets = (solids[..., None, :, 3] @ rotations).movedim(-1, -3).flatten(-3, -2)
        # In place: a difference would write all points again.
        local = (rotations.movedim(-1, -3).flatten(-3, -2) @ points.mT).sub_(offsets)
        x, y, z = local.unflatten(-2, (3, -1)).unbind(-3)
        return x, y, z


def _least_spacing(lower: Tensor, upper: Tensor) -> float:
    """Return the edge length of the finest grid in a box that is evaluated without being asked for."""
    return float((upper - lower).prod() / BUDGET.surface_samples) ** (1 / 3)


def _minor(a: Tensor, d: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Return ``a d - b c``."""
    return torch.addcmul(a * d, b, c, value=-1)


def _check_kind(points: Tensor, like: Tensor) -> None:
    """Raise InputError unless ``points`` has the dtype and device of the module: mixed dtypes lose precision."""
    if points.dtype != like.dtype or points.device != like.device:
        raise InputError(
            f"points are {points.dtype} on {points.device} but the shape is {like.dtype} on {like.device}; "
            f"convert one of them with .to()"
        )
