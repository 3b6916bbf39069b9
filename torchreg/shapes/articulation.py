"""The kinematics and the surface of articulated shapes: a kinematic tree whose parts are solids that fuse."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from torchreg._checks import as_float_tensor, check_choice, check_positive, check_shape
from torchreg.errors import InputError, ModelError
from torchreg.geometry.isosurface import isosurface
from torchreg.geometry.kinematic_tree import KinematicTree
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.primitives import Planes
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation import left_jacobian, so3_exp, wrap_rotation_vector
from torchreg.shapes.kinematics import KinematicChain, neighbor_matrix, part_parents
from torchreg.shapes.pose_algebra import BASE_DOF_NAMES, BASE_DOFS, difference, retract
from torchreg.shapes.primitives import Primitive, PrimitiveSet, fuse
from torchreg.shapes.rigs import RigSurface

_MAX_SURFACE_CELLS = 1_500_000


class Articulation(nn.Module):
    """Parts on a kinematic tree and their fused surface, in any pose: what skins and files build on.

    See `ArticulatedShape`, which is made from files as well, for conventions and arguments.

    Attributes:
        is_sliding: (num_dofs,) bool, degrees of freedom in metres: the base's translation and joints that slide.
    """

    adjacency: Tensor
    part_index: Tensor
    rest: Tensor
    lower: Tensor
    upper: Tensor
    is_sliding: Tensor
    _owners: Tensor
    _part_moves: Tensor
    _row_moves: Tensor
    _couplings: Tensor

    def __init__(
        self,
        tree: KinematicTree,
        part_frames: Sequence[str],
        primitives: Sequence[Primitive],
        *,
        nu: float = 0.003,
        part_names: Sequence[str] | None = None,
        free_base: bool = True,
        surface: RigSurface | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        check_positive(nu, "nu")
        if not part_frames or len(part_frames) != len(primitives):
            raise ModelError(
                f"a shape needs one primitive per part, got {len(primitives)} for {len(part_frames)} part frames"
            )
        if len(set(part_frames)) != len(part_frames):
            raise ModelError("two parts share a frame; give each part a frame of its own (a fixed joint will do)")
        names = tuple(part_frames if part_names is None else part_names)
        if len(names) != len(part_frames) or len(set(names)) != len(names):
            raise ModelError(f"{len(part_frames)} parts need {len(part_frames)} different names, got {len(set(names))}")
        self.nu = float(nu)
        self.chain = KinematicChain(tree)
        self.primitives = PrimitiveSet(primitives)
        self.part_names = names
        self.surface = surface
        frames = [tree.index(name) for name in part_frames]
        parents = part_parents(tree, frames)
        self.part_parents = tuple(parents)
        self.register_buffer("part_index", torch.tensor(frames), persistent=False)
        self.register_buffer("adjacency", neighbor_matrix(parents), persistent=False)
        self.register_buffer("_owners", torch.tensor(_offset_owners(tree, frames)), persistent=False)
        moves = nn.functional.pad(self.chain.moves[frames], (6, 0), value=1.0)
        self.register_buffer("_part_moves", moves, persistent=False)
        self.register_buffer("_row_moves", moves.repeat_interleave(4, 0).unsqueeze(-2), persistent=False)
        couplings = torch.block_diag(torch.eye(6, dtype=torch.float64), self.chain.couplings)
        self.register_buffer("_couplings", couplings, persistent=False)
        slides = self.chain.couplings.abs().mT @ (1 - self.chain.is_revolute) > 0
        base_slides = torch.arange(BASE_DOFS) < 3
        self.register_buffer("is_sliding", torch.cat([base_slides, slides]), persistent=False)
        base = torch.zeros(6, dtype=torch.float64) if not free_base else torch.full((6,), math.inf, dtype=torch.float64)
        self.register_buffer("lower", torch.cat([-base, self.chain.lower]), persistent=False)
        self.register_buffer("upper", torch.cat([base, self.chain.upper]), persistent=False)
        rest = torch.zeros(self.num_dofs, dtype=torch.float64).clamp(self.lower, self.upper)
        self.register_buffer("rest", rest, persistent=False)
        self.log_length_scales = nn.Parameter(torch.zeros(len(frames), dtype=torch.float64))
        self.log_radius_scales = nn.Parameter(torch.zeros(len(frames), dtype=torch.float64))
        self._held: tuple[Tensor, list[Tensor], Tensor] | None = None
        self.to(dtype or torch.get_default_dtype())

    @property
    def num_dofs(self) -> int:
        """Number of degrees of freedom: 6 of the base, then the joints."""
        return 6 + self.chain.num_dofs

    @property
    def num_parts(self) -> int:
        """Number of parts."""
        return len(self.part_names)

    @property
    def dof_names(self) -> tuple[str, ...]:
        """Names of the degrees of freedom, in the order of a pose."""
        return BASE_DOF_NAMES + self.chain.dof_names

    def rest_pose(self) -> Tensor:
        """Return the pose (num_dofs,) with every joint at zero, or at the limit nearest to zero."""
        return self.rest.clone()

    @contextmanager
    def held_sizes(self) -> Iterator[None]:
        """Within it, bone lengths and radii are looked up once, not for every pose; they must not change meanwhile.

        Poses of few points take a fifth less time then.
        """
        before, self._held = self._held, None
        self._held = self._offset_scales(), self._scaled_sizes(), self._solid_poses()
        try:
            yield
        finally:
            self._held = before

    def check_pose(self, pose: Tensor, name: str = "pose") -> Tensor:
        """Return ``pose`` as a tensor of this module's dtype and device; raise InputError if its size is wrong."""
        pose = as_float_tensor(pose, name, like=self.rest)
        check_shape(pose, name, (self.num_dofs,), batch=True)
        return pose

    def clamp(self, pose: Tensor) -> Tensor:
        """Return the pose with joints moved to their nearest limit and the base rotation wrapped to at most pi."""
        pose = torch.cat([pose[..., :3], wrap_rotation_vector(pose[..., 3:6]), pose[..., 6:]], dim=-1)
        return torch.minimum(torch.maximum(pose, self.lower), self.upper)

    def retract(self, pose: Tensor, step: Tensor) -> Tensor:
        """Return the pose moved by a tangent step; the base rotation is updated by composition, ``exp(step) exp(w)``.

        Args:
            pose: (..., num_dofs).
            step: (..., num_dofs), in the coordinates of `part_twists` with ``chart="tangent"``.

        Returns:
            (..., num_dofs).

        Differentiable: in both.
        """
        return retract(pose, step)

    def difference(self, start: Tensor, end: Tensor) -> Tensor:
        """Return the tangent step that `retract` takes from one pose to another.

        Args:
            start: (..., num_dofs).
            end: (..., num_dofs), with batch dimensions that broadcast with the start's.

        Returns:
            (..., num_dofs); the base's rotation by an angle of at most pi.

        Differentiable: in both, where that angle is below pi.
        """
        return difference(start, end)

    def frame_transforms(self, pose: Tensor) -> Tensor:
        """Return ``T_world_frame`` of every frame of the tree.

        Args:
            pose: (..., num_dofs).

        Returns:
            (..., F, 4, 4).

        Raises:
            InputError: if the pose has the wrong size.

        Differentiable: in ``pose`` and `log_length_scales`.
        """
        check_shape(pose, "pose", (self.num_dofs,), batch=True)
        base = rigid_matrix(so3_exp(pose[..., 3:6]), pose[..., :3])
        return base.unsqueeze(-3) @ self.chain(pose[..., 6:], self._offset_scales())

    def part_transforms(self, pose: Tensor) -> Tensor:
        """Return ``T_world_part`` of every part, ``p_world = T_world_part @ p_part``.

        Args:
            pose: (..., num_dofs).

        Returns:
            (..., P, 4, 4).

        Raises:
            InputError: if the pose has the wrong size.

        Differentiable: in ``pose`` and `log_length_scales`.
        """
        return self.frame_transforms(pose).index_select(-3, self.part_index)

    def keypoints(self, pose: Tensor) -> Tensor:
        """Return the keypoints of the shape: the origins of the parts.

        Args:
            pose: (..., num_dofs).

        Returns:
            (..., P, 3), metres.

        Raises:
            InputError: if the pose has the wrong size.

        Differentiable: in ``pose`` and `log_length_scales`.
        """
        return self.placed_keypoints(self.part_transforms(pose))

    def placed_keypoints(self, transforms: Tensor) -> Tensor:
        """Return the keypoints for given part transforms.

        Args:
            transforms: (..., P, 4, 4) ``T_world_part``.

        Returns:
            (..., K, 3), metres, as `keypoints`.

        Differentiable: in ``transforms`` and `log_length_scales`.
        """
        return transforms[..., :3, 3]

    def part_twists(self, pose: Tensor, *, chart: str = "pose") -> tuple[Tensor, Tensor]:
        """Return the part transforms and the twist each degree of freedom gives to each part.

        A point x of part p moves by ``twist[p, k, :3] + twist[p, k, 3:] x x`` per unit of degree of freedom k.

        Args:
            pose: (..., num_dofs).
            chart: "pose" for derivatives with respect to the pose vector, "tangent" for steps taken with `retract`.

        Returns:
            transforms (..., P, 4, 4) and twists (..., P, num_dofs, 6) as (translation, rotation).

        Differentiable: in ``pose``.
        """
        transforms, linear, angular = self._twists(pose, chart)
        twists = torch.cat([linear, angular], dim=-1).unsqueeze(-3) * self._part_moves.unsqueeze(-1)
        return transforms, self._couplings.mT @ twists if self.chain.has_mimics else twists

    def _twists(self, pose: Tensor, chart: str) -> tuple[Tensor, Tensor, Tensor]:
        """Return part transforms and the twists of base and moving joints: linear and angular (..., 6 + J, 3)."""
        frames = self.frame_transforms(pose)
        joints = self.chain.joint_twists(frames)[0]
        linear, angular = _base_twists(pose, chart)
        linear = torch.cat([linear, joints[..., :3]], dim=-2)
        return frames.index_select(-3, self.part_index), linear, torch.cat([angular, joints[..., 3:]], dim=-2)

    def part_distances(self, points: Tensor, pose: Tensor) -> Tensor:
        """Return the distance of points to the solid of every part, before fusion.

        Args:
            points: (..., N, 3), metres.
            pose: (..., num_dofs).

        Returns:
            (..., N, P), metres, negative inside.

        Differentiable: in ``points``, ``pose`` and all shape parameters.
        """
        return self.placed_distances(points, self.part_transforms(pose)).mT

    def placed_distances(self, points: Tensor, transforms: Tensor, parts: Sequence[int] | None = None) -> Tensor:
        """Return the distance of points to the solids of parts that are placed anywhere, joints or no joints.

        Args:
            points: (..., N, 3), metres.
            transforms: (..., P, 4, 4) ``T_world_part``, of the parts in ``parts``.
            parts: indices of the parts; all by default.

        Returns:
            (..., P, N), metres, negative inside.

        Differentiable: in all.
        """
        local = self._local_planes(points, self._solid_frames(transforms, parts))
        return self.primitives.plane_distance(local, self._scaled_sizes(), parts)

    def distance(self, points: Tensor, pose: Tensor, *, parts: Sequence[int] | None = None) -> Tensor:
        """Return the signed distance of points to the fused surface, ``d = -nu log phi``.

        phi sums the fields ``exp(-d_q / nu)`` of the dominating part and its neighbors only, in the log domain.

        Args:
            points: (..., N, 3), metres.
            pose: (..., num_dofs).
            parts: indices of the parts that count, as those of one limb; all by default.

        Returns:
            (..., N), metres, negative inside; first-order accurate near the surface.

        Raises:
            InputError: if a shape is wrong.

        Differentiable: in ``points``, ``pose`` and all shape parameters, where the dominating part is unique.

        References: Dewaele et al. 2006, eqs. 1 and 2.
        """
        check_shape(points, "points", ("N", 3), batch=True)
        transforms = self.part_transforms(pose)
        if parts is not None:
            transforms = transforms[..., list(parts), :, :]
        return fuse(self.placed_distances(points, transforms, parts).mT, self._neighbors(parts), self.nu)[0]

    def distance_jacobian(
        self, points: Tensor, pose: Tensor, *, chart: str = "pose", parts: Sequence[int] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return the fused distance and its analytic Jacobian with respect to all degrees of freedom.

        Args:
            points: (..., N, 3), metres, fixed in the world.
            pose: (..., num_dofs).
            chart: see `part_twists`.
            parts: indices of the parts that count, as those of one limb; all by default.

        Returns:
            distance (..., N) and Jacobian (..., N, num_dofs).

        Differentiable: no; it is a derivative already.
        """
        transforms, linear, angular = self._twists(pose, chart)
        moves = self._part_moves
        if parts is not None:
            transforms, moves = transforms[..., list(parts), :, :], moves[list(parts)]
        solids = self._solid_frames(transforms, parts)
        local = x, y, z = self._local_planes(points, solids)
        distances, gradient = self.primitives.plane_gradient(local, self._scaled_sizes(), parts)
        fused, shares = fuse(distances.mT, self._neighbors(parts), self.nu)
        # A solid that moves by a twist leaves the point behind; force and moment are taken in the solid's own frame.
        fx, fy, fz = (plane * shares.mT for plane in gradient)
        moment = (_minor(y, fz, z, fy), _minor(z, fx, x, fz), _minor(x, fy, y, fx))
        wrench = torch.cat([fx, fy, fz, *moment], dim=-2)
        return fused, (self._solid_twists(linear, angular, solids, moves).mT @ wrench).mT

    def _solid_twists(self, linear: Tensor, angular: Tensor, solids: Tensor, moves: Tensor) -> Tensor:
        """Return (..., 6 P, num_dofs): what moves a solid backwards, in its own frame; a row per component and part."""
        angular = angular.unsqueeze(-3)
        linear = linear.unsqueeze(-3) + torch.linalg.cross(angular, solids[..., None, :, 3])
        both = torch.cat([linear, angular.expand_as(linear)], dim=-2) @ -solids[..., :3]
        moved = both.unflatten(-2, (2, -1)) * moves[:, None, :, None]
        twists = moved.movedim((-3, -1), (-4, -3)).flatten(-4, -2)
        return twists @ self._couplings if self.chain.has_mimics else twists

    def transform_jacobian(self, pose: Tensor, *, chart: str = "pose") -> tuple[Tensor, Tensor]:
        """Return the stacked part transforms and their analytic derivatives, the rows that skins are linear in.

        Args:
            pose: (..., num_dofs).
            chart: see `part_twists`.

        Returns:
            rows (..., 4 P, 3): for each part the transposed ``[R | t]``; derivatives (..., 4 P, 3, num_dofs).

        Differentiable: in ``pose``.
        """
        transforms, linear, angular = self._twists(pose, chart)
        rows = transforms.mT
        # An axis e turns by ``angular x e``; the row of a translation, whose fourth entry is one, also moves.
        identity = torch.eye(3, dtype=pose.dtype, device=pose.device).unsqueeze(-2)
        angular = angular.unsqueeze(-3)
        turns = torch.linalg.cross(angular, identity.expand(*angular.shape[:-3], 3, 1, 3))
        motions = torch.cat([turns, linear.unsqueeze(-3)], dim=-3).mT.flatten(-2)
        derivative = (rows.flatten(-3, -2) @ motions).unflatten(-1, (3, -1)) * self._row_moves
        derivative = derivative @ self._couplings if self.chain.has_mimics else derivative
        return rows[..., :3].flatten(-3, -2), derivative

    def surface_mesh(self, pose: Tensor | None = None, spacing: float | None = None) -> TriangleMesh:
        """Return a mesh of the fused surface.

        Args:
            pose: (num_dofs,); the rest pose by default.
            spacing: edge length of the grid, metres; by default `nu`, but at most 1.5 million grid points.

        Returns:
            a closed mesh in the module's dtype and device.

        Raises:
            InputError: if the grid would be too large.

        Differentiable: no.
        """
        pose = self.rest_pose() if pose is None else self.check_pose(pose)
        with torch.no_grad():
            transforms = self.part_transforms(pose)
            positions = self._solid_frames(transforms)[..., 3]
            reach = self.primitives.reaches(self._scaled_sizes()).unsqueeze(-1) + 3 * self.nu
            lower, upper = (positions - reach).amin(0), (positions + reach).amax(0)
        if spacing is None:
            spacing = max(self.nu, float((upper - lower).prod() / _MAX_SURFACE_CELLS) ** (1 / 3))
        return isosurface(lambda points: self.distance(points, pose), lower, upper, spacing)

    def _offset_scales(self) -> Tensor:
        if self._held is not None:
            return self._held[0]
        return nn.functional.pad(self.log_length_scales, (1, 0)).index_select(0, self._owners).exp()

    def _scaled_sizes(self) -> list[Tensor]:
        if self._held is not None:
            return self._held[1]
        return self.primitives.scaled_sizes(self.log_length_scales.exp(), self.log_radius_scales.exp())

    def _neighbors(self, parts: Sequence[int] | None) -> Tensor:
        return self.adjacency if parts is None else self.adjacency[list(parts)][:, list(parts)]

    def _solid_frames(self, transforms: Tensor, parts: Sequence[int] | None = None) -> Tensor:
        """Return ``[R | t]`` (..., P, 3, 4) of every solid in the world, or of those of some parts."""
        poses = self._solid_poses()
        return transforms[..., :3, :] @ (poses if parts is None else poses[list(parts)])

    def _solid_poses(self) -> Tensor:
        """Return (P, 4, 4): where each solid lies in its part."""
        if self._held is not None:
            return self._held[2]
        centers = self.primitives.centers * self.log_length_scales.exp().unsqueeze(-1)
        return rigid_matrix(self.primitives.rotations, centers)

    def _local_planes(self, points: Tensor, solids: Tensor) -> Planes:
        """Return points (..., N, 3) in every solid's frame, as planes (..., P, N)."""
        check_finite_dtype(points, self.rest)
        rotations = solids[..., :3]
        offsets = (solids[..., None, :, 3] @ rotations).movedim(-1, -3).flatten(-3, -2)
        # In place of a sum, which would write all points once more.
        local = (rotations.movedim(-1, -3).flatten(-3, -2) @ points.mT).sub_(offsets)
        x, y, z = local.unflatten(-2, (3, -1)).unbind(-3)
        return x, y, z


def _minor(a: Tensor, d: Tensor, b: Tensor, c: Tensor) -> Tensor:
    return torch.addcmul(a * d, b, c, value=-1)


def check_finite_dtype(points: Tensor, like: Tensor) -> None:
    """Raise InputError unless ``points`` has the dtype and device of the module: mixed dtypes lose precision."""
    if points.dtype != like.dtype or points.device != like.device:
        raise InputError(
            f"points are {points.dtype} on {points.device} but the shape is {like.dtype} on {like.device}; "
            f"convert one of them with .to()"
        )


def _base_twists(pose: Tensor, chart: str) -> tuple[Tensor, Tensor]:
    """Return the twists of the base's degrees of freedom: linear and angular (..., 6, 3)."""
    check_choice(chart, "chart", ("pose", "tangent"))
    identity = torch.eye(3, dtype=pose.dtype, device=pose.device).expand(*pose.shape[:-1], 3, 3)
    angular = identity if chart == "tangent" else left_jacobian(pose[..., 3:6]).mT
    linear = torch.linalg.cross(pose[..., None, :3].expand_as(angular), angular)
    return torch.cat([identity, linear], dim=-2), torch.cat([torch.zeros_like(identity), angular], dim=-2)


def _offset_owners(tree: KinematicTree, frames: list[int]) -> list[int]:
    """Return, per frame, 1 + the part whose length carries it, or 0: the nearest part above it in the tree."""
    owners = []
    for joint in tree.joints:
        ancestor = joint.parent
        while ancestor >= 0 and ancestor not in frames:
            ancestor = tree.joints[ancestor].parent
        owners.append(frames.index(ancestor) + 1 if ancestor >= 0 else 0)
    return owners
